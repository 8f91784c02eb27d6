"""Which frames of a video are kept, what an untouched sensor shows, and how kept frames are stored."""

"""From video files to the frames that matter: one decode a video, and everything that is measured on the way."""

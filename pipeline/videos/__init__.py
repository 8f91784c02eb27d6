"""From videos to kept frames, and which objects are for training.

In: `data.dir` and the catalogue of its objects. Out: data/videos.parquet and data/frames (stage `extract_frames`),
data/splits (`split`), data/audit (`audit`). importing/ makes such videos of recordings (`octopi import`).
"""

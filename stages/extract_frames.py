"""Keep each video's salient frames."""

from pathlib import Path

from pipeline.artifacts import read_table
from pipeline.frames import extract_frames
from pipeline.records import Video
from pipeline.stage import DATA, stage


def main() -> None:
    with stage("extract_frames") as run:
        videos = read_table(DATA / "videos.parquet", Video)
        frames = extract_frames(videos, Path(run.params.data.dir), run.params.frames, DATA / "frames")
        run.metrics["salient_frames"] = len(frames)


if __name__ == "__main__":
    main()

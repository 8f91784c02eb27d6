"""List the videos that decode."""

from pathlib import Path

from pipeline.artifacts import write_table
from pipeline.physiclear.catalogue import load_catalogue
from pipeline.records import Video
from pipeline.stage import DATA, stage
from pipeline.videos import catalogue_videos


def main() -> None:
    with stage("catalogue") as run:
        catalogue = load_catalogue(Path(run.params.data.catalogue))
        videos = catalogue_videos(Path(run.params.data.dir), catalogue)
        write_table(DATA / "videos.parquet", Video, videos)
        run.metrics["videos"] = len(videos)
        run.metrics["objects"] = len({v.object_id for v in videos})
        run.metrics["frames"] = sum(v.frames for v in videos)


if __name__ == "__main__":
    main()

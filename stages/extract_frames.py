"""Decode every video once: list what decodes, keep the frames that matter, measure for the audit."""

from pathlib import Path

from pipeline.core.io import write_table
from pipeline.core.runtime import CHECKPOINTS
from pipeline.running.stage import DATA, stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Video

if __name__ == "__main__":
    with stage("extract_frames") as run:
        from pipeline.videos.frames.extract import extract_frames

        data = run.params.data
        found = extract_frames(
            Path(data.dir),
            load_catalogue(Path(data.catalogue)),
            run.params.frames,
            DATA / "frames",
            CHECKPOINTS / "extract_frames",
        )
        write_table(DATA / "videos.parquet", Video, found.videos)
        run.metrics["videos"] = len(found.videos)
        run.metrics["objects"] = len({v.object_id for v in found.videos})
        run.metrics["frames"] = sum(v.frames for v in found.videos)
        run.metrics["kept_frames"] = len(found.frames)

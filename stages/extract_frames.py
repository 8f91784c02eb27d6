"""Decode every video once: list what decodes, keep the frames that matter, measure for the audit."""

from pathlib import Path

from pipeline.core.io import write_table
from pipeline.core.layout import CHECKPOINTS, FRAMES, VIDEOS
from pipeline.running.stage import stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Video

if __name__ == "__main__":
    with stage("extract_frames") as run:
        from pipeline.videos.frames.extract import extract_frames

        data = run.params.data
        catalogue, work = load_catalogue(Path(data.catalogue)), CHECKPOINTS / "extract_frames"
        found = extract_frames(Path(data.dir), catalogue, run.params.frames, FRAMES, work)
        write_table(VIDEOS, Video, found.videos)
        run.metrics["videos"] = len(found.videos)
        run.metrics["objects"] = len({v.object_id for v in found.videos})
        run.metrics["frames"] = sum(v.frames for v in found.videos)
        run.metrics["kept_frames"] = len(found.frames)

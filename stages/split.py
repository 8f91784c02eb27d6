"""Assign each object, and with it its videos, to training, validation or test; with kfold anew for each seed."""

import logging
from pathlib import Path

from pipeline.core.io import read_table, write_table
from pipeline.core.layout import VIDEOS, split_file
from pipeline.core.records import Part
from pipeline.running.stage import stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment, Video
from pipeline.videos.split import assign, assign_objects, untested

if __name__ == "__main__":
    with stage("split") as run:
        catalogue, config = load_catalogue(Path(run.params.data.catalogue)), run.params.split
        videos = read_table(VIDEOS, Video)
        for seed in run.params.ablation.seeds:
            split = assign(catalogue, videos, config, seed)
            write_table(split_file(seed), Assignment, split)
            for part in Part:
                run.metrics[f"{seed}.{part}_videos"] = sum(a.part == part for a in split)
                run.metrics[f"{seed}.{part}_objects"] = len({a.object_id for a in split if a.part == part})
        if not any(run.metrics[f"{seed}.{Part.TEST}_objects"] for seed in run.params.ablation.seeds):
            present = {video.object_id for video in videos}
            lacking = untested(assign_objects(catalogue, present, config), present)
            logging.getLogger(__name__).warning("%s", lacking)

"""Compute the embeddings of one encoder, base or fine-tuned."""

import sys
from pathlib import Path

from pipeline.io import read_table, save_tensors, write_table
from pipeline.embeddings import INDEX_FILE, TENSOR, TENSOR_FILE
from pipeline.videos.frames.store import FrameStore
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.model import FrameEncoder
from pipeline.trainable import load_trainable
from pipeline.weights import check_encoder
from pipeline.videos.catalogue import load_catalogue
from pipeline.plan import Encoder
from pipeline.records import Assignment, Embedding, Part
from pipeline.runtime import resolve_device
from pipeline.stage import DATA, stage
from pipeline.encoder.embed import embed_videos, standardize


def main() -> None:
    key = sys.argv[1]
    with stage("embed", key) as run:
        params = run.params
        weights = Path(params.encoder.weights)
        check_encoder(weights, params.frames.size)
        job = params.plan.embeddings[key]
        if job.encoder is Encoder.BASE:
            encoder: FrameEncoder = base_encoder(params.encoder)
        else:
            classes = [len(p.levels) for p in load_catalogue(Path(params.data.catalogue)).properties]
            classifier = property_classifier(params.encoder, classes)
            load_trainable(classifier, Path(job.encoder_dir) / "encoder.safetensors")
            encoder = classifier.encoder
        assignments = read_table(DATA / "splits.parquet", Assignment)
        tensor, index = embed_videos(
            encoder,
            FrameStore(DATA / "frames", params.encoder.reference),
            assignments,
            batch_size=params.encoder.embed_batch_size,
            device=resolve_device(params.runtime.device),
        )
        if params.encoder.standardize:
            tensor = standardize(tensor, index, {a.video_id for a in assignments if a.part == Part.TRAIN})
        out = DATA / "embeddings" / key
        save_tensors(out / TENSOR_FILE, {TENSOR: tensor})
        write_table(out / INDEX_FILE, Embedding, index)
        run.metrics["rows"] = len(index)
        run.metrics["norm"] = float(tensor.norm(dim=1).mean())


if __name__ == "__main__":
    main()

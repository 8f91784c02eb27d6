"""Align the projection to the language model."""

import sys

from pipeline.embeddings import TENSOR_FILE, EmbeddingStore
from pipeline.io import read_jsonl, write_table
from pipeline.language.training import Job, Material, align, assemble
from pipeline.records import Encoder, Measurement, Opd, Question
from pipeline.stage import DATA, stage
from pipeline.tracking import live


def main() -> None:
    encoder, opd, seed = Encoder(sys.argv[1]), Opd(sys.argv[2]), int(sys.argv[3])
    key = f"{encoder}-{opd}-{seed}"
    with stage("align", key) as run:
        params = run.params
        inputs = (DATA / "questions" / "train.jsonl", DATA / "embeddings" / f"{encoder}-{seed}" / TENSOR_FILE)
        material = Material(
            questions=read_jsonl(inputs[0], Question),
            store=EmbeddingStore(inputs[1].parent),
            opd=opd,
            language=params.language,
            per_video=params.frames.per_video,
            flip_probability=params.encoder.flip_probability,
            seed=params.seed + seed,
        )
        model, data = assemble(material, params.align.samples, "align")
        mark = material.mark(params.align, *inputs)
        with live(run) as callbacks:
            trained = align(model, data, params.align, params.runtime, Job(run.name, mark, material.seed, callbacks))
        run.finish_training(trained.history)
        out = DATA / "models" / "without" / key
        model.save_pretrained(out, trained.state)
        write_table(out / "history.parquet", Measurement, trained.history)


if __name__ == "__main__":
    main()

"""Fine-tune the aligned model end to end, the language model through low-rank adapters."""

import sys

from pipeline.embeddings import TENSOR_FILE, EmbeddingStore
from pipeline.io import read_jsonl, write_table
from pipeline.language.octopi import CONNECTOR_FILE
from pipeline.language.training import Job, Material, add_lora, assemble, finetune_lora
from pipeline.records import Encoder, Measurement, Opd, Question
from pipeline.stage import DATA, stage
from pipeline.tracking import live


def main() -> None:
    encoder, opd, seed = Encoder(sys.argv[1]), Opd(sys.argv[2]), int(sys.argv[3])
    key = f"{encoder}-{opd}-{seed}"
    with stage("lora", key) as run:
        params = run.params
        inputs = (
            DATA / "questions" / "train.jsonl",
            DATA / "embeddings" / f"{encoder}-{seed}" / TENSOR_FILE,
            DATA / "models" / "without" / key / CONNECTOR_FILE,
        )
        material = Material(
            questions=read_jsonl(inputs[0], Question),
            store=EmbeddingStore(inputs[1].parent),
            opd=opd,
            language=params.language,
            per_video=params.frames.per_video,
            flip_probability=params.encoder.flip_probability,
            seed=params.seed + seed,
        )
        model, data = assemble(material, params.lora.samples, "lora", aligned=inputs[2].parent)
        add_lora(model, params.lora)
        mark = material.mark(params.lora, *inputs)
        with live(run) as callbacks:
            trained = finetune_lora(
                model, data, params.lora, params.runtime, Job(run.name, mark, material.seed, callbacks)
            )
        run.finish_training(trained.history)
        out = DATA / "models" / "with" / key
        model.save_pretrained(out, trained.state)
        write_table(out / "history.parquet", Measurement, trained.history)


if __name__ == "__main__":
    main()

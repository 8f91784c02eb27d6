"""Teach a small language model, in words alone, to conclude: nothing where teach.samples is 0."""

from pathlib import Path

from pipeline.card import write_card
from pipeline.io import fingerprint, write_json, write_table
from pipeline.records import Measurement, Opd, Part
from pipeline.runtime import name_dtype
from pipeline.stage import DATA, stage
from pipeline.tasks.questions import drills
from pipeline.tracking.live import live
from pipeline.videos.catalogue import load_catalogue

OUT = DATA / "taught"


def main() -> None:
    with stage("teach", launched=True) as run:
        params, right = run.params, dict[str, float]()
        if params.teach.samples:
            from pipeline.embeddings import EmbeddingStore
            from pipeline.language.base import save_adapter
            from pipeline.language.octopi import ADAPTER_DIR
            from pipeline.language.training import Job, Material, add_lora, assemble, examine, fit

            catalogue, language = load_catalogue(Path(params.data.catalogue)), params.language
            material = Material(
                drills(catalogue, params.teach.samples, params.seed, Part.TRAIN),
                EmbeddingStore(),
                Opd.ALL,
                language.model_copy(update={"dtype": name_dtype(language.dtype, params.runtime.device), "start": ""}),
                per_video=0,
                flip_probability=0.0,
                seed=params.seed,
            )
            model, data = assemble(material, params.teach, "teach")
            # There is no touch to be projected.
            model.connector.requires_grad_(False)
            add_lora(model, params.lora)
            shape = params.lora.model_dump(include={"rank", "alpha", "dropout", "target_modules"})
            with live(run) as callbacks:
                key = fingerprint(material.fingerprint(params.teach), str(shape), *material.questions)
                trained = fit(model, data, params.teach, params.runtime, Job(run.name, key, material.seed, callbacks))
            run.finish_training(trained.history)
            write_table(OUT / "history.parquet", Measurement, trained.history)
            state = {name.removeprefix("llm."): value for name, value in trained.state.items()}
            save_adapter(model.llm, OUT / ADAPTER_DIR, state)
            write_card(
                OUT,
                "A language model's adapter, taught to conclude in words",
                bases={"language model": Path(language.weights)},
                data={"conversations in words": len(data), "touch": "none"},
                settings={**params.teach.model_dump(), **shape, "seed": params.seed},
                limits=("It has felt nothing, and describes nothing: it begins the training of what does.",),
            )
            right = examine(model, drills(catalogue, 60, params.seed, Part.TEST), params.language)
            run.metrics |= right
        write_json(OUT / "right.json", right)


if __name__ == "__main__":
    main()

"""Teach a language model, in words alone, to conclude from classes, where the scale has it."""

from pathlib import Path

from pipeline.embeddings import EmbeddingStore
from pipeline.evaluation.grading import described
from pipeline.io import fingerprint, write_csv, write_table
from pipeline.records import GATE, Described, Measurement, Opd, Part
from pipeline.runtime import name_dtype
from pipeline.stage import DATA, stage
from pipeline.tasks.questions import counts_by_task
from pipeline.tasks.told import made_up, told_questions
from pipeline.tracking.live import live
from pipeline.videos.catalogue import load_catalogue

OUT = DATA / "taught"


def main() -> None:
    with stage("teach", launched=True) as run:
        params = run.params
        scores: list[Described] = []
        if params.teach.samples:
            from pipeline.language.base import save_adapter
            from pipeline.language.generate import answer
            from pipeline.language.octopi import ADAPTER_DIR
            from pipeline.language.training import Job, Material, add_lora, assemble, fit, write_model_card

            catalogue = load_catalogue(Path(params.data.catalogue)).asking(params.questions.scenarios)
            counts = counts_by_task(params.questions, "train")
            shares = {task: round(params.teach.samples * n / sum(counts.values())) for task, n in counts.items()}
            modes, language = params.ablation.opd, params.language
            material = Material(
                told_questions(catalogue, shares, modes, params.questions, params.seed, Part.TRAIN),
                EmbeddingStore(),
                Opd.ALL,
                language.model_copy(update={"dtype": name_dtype(language.dtype, params.runtime.device)}),
                per_video=0,
                flip_probability=0.0,
                seed=params.seed,
            )
            model, data = assemble(material, params.teach, "teach")
            # There is no touch to be projected.
            model.connector.requires_grad_(False)
            add_lora(model, params.lora)
            with live(run) as callbacks:
                shape = params.lora.model_dump(include={"rank", "alpha", "dropout", "target_modules"})
                key = fingerprint(material.fingerprint(params.teach), str(shape), *material.questions)
                job = Job(run.name, key, material.seed, callbacks)
                trained = fit(model, data, params.teach, params.runtime, job)
            run.finish_training(trained.history)
            write_table(OUT / "history.parquet", Measurement, trained.history)
            save_adapter(model.llm, OUT / ADAPTER_DIR, model.llm.state_dict())
            write_model_card(OUT, material, data, params.teach)
            wanted = counts_by_task(params.questions, "evaluation")
            counts = {name: params.teach.gate_questions for name, count in wanted.items() if count and name != "OPD"}
            asked = told_questions(catalogue, counts, [Opd.ALL], params.questions, params.seed, Part.TEST)
            said = answer(model, material.store, asked, Opd.ALL, params.language, 0)
            scores += described("taught", asked, said, made_up(catalogue, params.seed))
            run.metrics |= {f"{s.model}_{s.task}": s.right / s.n for s in scores}
        write_csv(OUT / GATE, Described, scores)


if __name__ == "__main__":
    main()

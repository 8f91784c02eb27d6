"""Teach a small language model to reason about described things, where the scale names one."""

from functools import partial
from pathlib import Path

from pipeline.io import write_csv, write_table
from pipeline.records import GATE, Described, Measurement
from pipeline.stage import DATA, stage
from pipeline.tracking.live import live

OUT = DATA / "taught"


def main() -> None:
    with stage("teach") as run:
        params = run.params
        scores: list[Described] = []
        if params.teach.base:
            from pipeline.language.teach.gate import examine, gate_questions
            from pipeline.language.teach.training import teach, write_taught
            from pipeline.videos.catalogue import load_catalogue

            catalogue = load_catalogue(Path(params.data.catalogue))
            with live(run) as callbacks:
                llm, tokenizer, trained = teach(
                    params.teach, params.language, params.runtime, stage=run.name, seed=params.seed, callbacks=callbacks
                )
            run.finish_training(trained.history)
            write_table(OUT / "history.parquet", Measurement, trained.history)
            questions = gate_questions(catalogue, params.teach.gate_questions, params.seed)
            ask = partial(
                examine,
                tokenizer=tokenizer,
                questions=questions,
                system_prompt=params.language.system_prompt,
                batch_size=params.language.generation_batch_size,
            )
            with llm.disable_adapter():
                scores += ask(llm, model="untaught")
            taught = write_taught(OUT, llm, params.teach, params.language, params.seed, trained.history)
            scores += ask(taught, model="taught")
            run.metrics |= {f"{s.model}_{s.task}": s.right / max(1, s.n) for s in scores}
        write_csv(OUT / GATE, Described, scores)


if __name__ == "__main__":
    main()

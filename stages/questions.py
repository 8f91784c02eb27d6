"""Build the training and evaluation questions, the same for every variant."""

from pathlib import Path

from pipeline.io import read_table, write_jsonl
from pipeline.records import Assignment, Part
from pipeline.stage import DATA, stage
from pipeline.tasks.questions import build_questions, counts_by_task, pool_of
from pipeline.videos.catalogue import load_catalogue


def main() -> None:
    with stage("questions") as run:
        config = run.params.questions
        catalogue = load_catalogue(Path(run.params.data.catalogue)).asking(config.scenarios)
        assignments = read_table(DATA / "splits.parquet", Assignment)
        for name, part, counts, distinct in (
            ("train", Part.TRAIN, counts_by_task(config, "train"), False),
            ("evaluation", Part.TEST, counts_by_task(config, "evaluation"), True),
        ):
            pool = pool_of(part, assignments, catalogue)
            questions = build_questions(pool, counts, seed=config.seed, distinct=distinct, facts=config.facts)
            write_jsonl(DATA / "questions" / f"{name}.jsonl", questions)
            for task in counts:
                run.metrics[f"{name}.{task}"] = sum(q.task == task for q in questions)


if __name__ == "__main__":
    main()

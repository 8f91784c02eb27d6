"""Build the training and evaluation questions: the same for every variant, and for every seed of one split."""

from pathlib import Path

from pipeline.core.io import read_table, write_jsonl
from pipeline.core.layout import questions_file, split_file
from pipeline.core.records import Part
from pipeline.running.stage import stage
from pipeline.tasks.examples import build_examples
from pipeline.tasks.questions import build_questions, counts_by_task, pool_of
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment

if __name__ == "__main__":
    with stage("questions") as run:
        config = run.params.questions
        catalogue = load_catalogue(Path(run.params.data.catalogue)).asking(config.scenarios, config.wording)
        catalogue = catalogue.called(config.names)
        training = {name: getattr(config, name) for name in ("two_turns", "plainly")}
        for seed in run.params.ablation.seeds:
            assignments = read_table(split_file(seed), Assignment)
            for name, part, counts, distinct in (
                ("train", Part.TRAIN, counts_by_task(config, "train"), False),
                ("evaluation", Part.TEST, counts_by_task(config, "evaluation"), True),
            ):
                questions = build_questions(
                    pool_of(part, assignments, catalogue),
                    counts,
                    seed=config.seed,
                    distinct=distinct,
                    facts=config.facts,
                    restate=config.restate,
                    fold=run.params.split.fold_of(seed),
                    **(training if part is Part.TRAIN else {}),
                )
                write_jsonl(questions_file(seed, name), questions)
                for task in counts:
                    run.metrics[f"{seed}.{name}.{task}"] = sum(q.task == task for q in questions)
            examples = build_examples(assignments, catalogue, seed=config.seed)
            write_jsonl(questions_file(seed, "examples"), examples)

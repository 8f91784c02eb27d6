"""Grade the answers of one variant."""

import sys
from pathlib import Path

from pipeline.io import read_jsonl, write_table
from pipeline.evaluation.grading import grade, summarise
from pipeline.videos.catalogue import load_catalogue
from pipeline.records import Prediction, Question, Score
from pipeline.stage import DATA, stage


def main() -> None:
    key = sys.argv[1]
    with stage("grade", key) as run:
        scores = grade(
            read_jsonl(DATA / "questions" / "evaluation.jsonl", Question),
            read_jsonl(DATA / "answers" / key / "predictions.jsonl", Prediction),
            load_catalogue(Path(run.params.data.catalogue)),
        )
        write_table(DATA / "scores" / key / "scores.parquet", Score, scores)
        run.metrics.update(summarise(scores))


if __name__ == "__main__":
    main()

"""Run the hard cases of every part in every number format; a red row stops the chain here."""

from pathlib import Path

from pipeline.io import write_csv
from pipeline.stability.record import STABILITY_FILE, StabilityRow
from pipeline.stability.run import all_cases, judge_all, stop_on_red, summary
from pipeline.stage import DATA, stage

STANDINS = Path("standins")


def main() -> None:
    with stage("stability") as run:
        rows = judge_all(all_cases(STANDINS / "clip", STANDINS / "llama"))
        write_csv(DATA / STABILITY_FILE, StabilityRow, rows)
        stop_on_red(rows, DATA / STABILITY_FILE)
        run.metrics.update(summary(rows))


if __name__ == "__main__":
    main()

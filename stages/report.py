"""Scores, figures and the README of a report, from everything that the run has measured."""

from pathlib import Path

from pipeline.report.build import write_report
from pipeline.stage import stage


def main() -> None:
    with stage("report") as run:
        run.metrics.update(write_report(run.params, Path()))


if __name__ == "__main__":
    main()

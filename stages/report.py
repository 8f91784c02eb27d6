"""Turn scores into the paper's tables and figures."""

from pathlib import Path

from pipeline.reporting import write_report
from pipeline.stage import stage


def main() -> None:
    with stage("report") as run:
        run.metrics.update(write_report(run.params, Path()))


if __name__ == "__main__":
    main()

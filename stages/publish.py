"""Show the reproduction in MLflow: one parent run, one child a stage and variant."""

from pathlib import Path

from pipeline.stage import stage
from pipeline.tracking.publishing import publish


def main() -> None:
    with stage("publish") as run:
        publish(run.params, Path())


if __name__ == "__main__":
    main()

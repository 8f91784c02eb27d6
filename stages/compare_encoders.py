"""Turn cross-validated verdicts into tables that compare encoders and their rivals."""

from pathlib import Path

from pipeline.reporting.encoder_report import write_encoder_report
from pipeline.stage import stage


def main() -> None:
    with stage("compare_encoders") as run:
        run.metrics.update(write_encoder_report(run.params, Path()))


if __name__ == "__main__":
    main()

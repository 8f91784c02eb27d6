"""Scores, figures and the README of a report, from everything that the run has measured."""

from pathlib import Path

from pipeline.running.stage import stage

if __name__ == "__main__":
    with stage("report") as run:
        from pipeline.report.build import write_report

        run.metrics.update(write_report(run.params, Path()))

"""Scores to tables, figures and a page: measured beside published."""

from pipeline.reporting.report import write_report

__all__ = ["write_report"]

"""The audit's findings as a table of the report."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.records import Finding, Severity
from pipeline.reporting.table import Table

MOST_ALIKE = 12
"""More findings of one check than this are one row of the page."""


@dataclass(frozen=True)
class FindingRow:
    """One finding."""

    check: str
    item: str
    measured: str
    expected: str
    severity: str

    def display(self) -> Mapping[str, str]:
        """All columns."""
        return {
            "Severity": self.severity,
            "Check": self.check,
            "Item": self.item,
            "Measured": self.measured,
            "Expected": self.expected,
        }


def audit_table(findings: Sequence[Finding]) -> Table:
    """Every finding in the CSV, what needs attention on the page."""
    rows = [FindingRow(f.check, f.item, f.measured, f.expected, f.severity.value) for f in findings]
    counts = Counter(f.severity for f in findings)
    return Table(
        "audit",
        "Data audit",
        f"What was measured about files, contact, labels and leakage: {counts[Severity.ERROR]} errors (they stop the "
        f"chain), {counts[Severity.WARNING]} warnings, {counts[Severity.INFO]} other findings; all are in the CSV.",
        rows,
        _grouped([row for row in rows if row.severity != Severity.INFO]),
    )


def _grouped(rows: Sequence[FindingRow]) -> list[FindingRow]:
    """One row for all findings of a check that many items share; the CSV has each."""
    shown: list[FindingRow] = []
    for _, group in itertools.groupby(
        sorted(rows, key=lambda r: (r.severity, r.check)), lambda r: (r.severity, r.check)
    ):
        alike = list(group)
        if len(alike) <= MOST_ALIKE:
            shown += alike
        else:
            first = alike[0]
            names = ", ".join(row.item for row in alike[:MOST_ALIKE])
            item = f"{len(alike)} items: {names}, ..."
            shown.append(replace(first, item=item, measured=f"the first: {first.measured}"))
    return shown

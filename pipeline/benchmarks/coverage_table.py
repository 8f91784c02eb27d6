"""What the simulation of intervals and tests found, as rows and as a page for reading."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pipeline.benchmarks import BenchRow
from pipeline.statistics import wilson

Verdict = Literal["holds", "conservative", "liberal", ""]
Kind = Literal["accuracy", "difference", "seeds", "difference over seeds", "size", "power", "smallest effect"]
OVER_SEEDS = ("seeds", "difference over seeds")


class CoverageRow(BenchRow):
    """A method in a design."""

    kind: Kind
    method: str
    reported: bool
    """Whether the reports use it."""
    objects: int
    about: int
    correlation: float
    seeds: int
    truths: tuple[str, ...]
    shares: tuple[float, ...]
    """Covered or, by a test, rejected: one a truth."""
    verdict: tuple[Verdict, ...]
    """Whether that is 93 to 97 %, or of equal settings 5 %, as far as the repetitions can tell; empty for power."""
    repetitions: int


def verdict(share: float, repetitions: int, low: float, high: float) -> Verdict:
    """Whether a share lies in a range, or above or below it, as far as its Monte Carlo error can tell."""
    spread = wilson(share * repetitions, repetitions)
    if spread.high < low:
        return "liberal"
    return "conservative" if spread.low > high else "holds"


def table(rows: Sequence[CoverageRow]) -> str:
    """The rows as a page: first where the reported intervals and tests do not hold, then everything."""
    short, wide = (
        [f"- {r.case}: {named}" for r in rows if r.reported and (named := _shares(r, judged))]
        for judged in ("liberal", "conservative")
    )
    lines = [
        "# Coverage of intervals, size and power of tests",
        "",
        f"Simulated, {max(r.repetitions for r in rows)} repetitions a design (seeds: half), so that 95 % is known to "
        "about a point. In percent. *r* is the correlation within objects before answers are cut into right and "
        "wrong. **Bold**: below 93 % covered, or of equal settings more than 7 % rejected, beyond Monte Carlo error; "
        "*italic*: above 97 %, or fewer than 3 %. Truths are accuracies; of differences, the two accuracies. With "
        "*seeds* the truth is over all runs, so that one run cannot cover it. The smallest effect is what a plan of 5 "
        "questions an object should find in 80 of 100 repetitions.",
        "",
        "## Where what the reports use falls short",
        "",
        *(short or ["Nowhere."]),
        "",
        "## Where it covers more, or rejects less, than it says",
        "",
        *(wide or ["Nowhere."]),
    ]
    for kind in dict.fromkeys(r.kind for r in rows):
        chosen = [r for r in rows if r.kind == kind]
        widest = max((r.truths for r in chosen), key=len)
        heads = ("",) if kind == "smallest effect" else widest
        columns = ["Method", "Objects", "A question", "r", *(["Seeds"] if kind in OVER_SEEDS else []), *heads]
        lines += [
            "",
            f"## {kind.capitalize()}",
            "",
            f"| {' | '.join([*columns, 'Width'])} |",
            "|---" * len(columns) + "|---|",
        ]
        for row in chosen:
            seeds = [str(row.seeds)] if kind in OVER_SEEDS else []
            name = f"{row.method} (reported)" if row.reported else row.method
            shares = _marked(row) if kind != "smallest effect" else [f"{row.truths[0]}: {_marked(row)[0]}"]
            width = f"{row.cost:.2f}" if row.cost else ""
            cells = [name, str(row.objects), str(row.about), f"{row.correlation:g}", *seeds, *shares, width]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _shares(row: CoverageRow, judged: str) -> str:
    pairs = zip(row.truths, row.shares, row.verdict, strict=True)
    return ", ".join(f"{100 * share:.1f} % at {truth}" for truth, share, found in pairs if found == judged)


def _marked(row: CoverageRow) -> list[str]:
    marks = {"liberal": "**", "conservative": "*"}
    return [
        f"{(mark := marks.get(judged, ''))}{100 * share:.1f}{mark}"
        for share, judged in zip(row.shares, row.verdict, strict=True)
    ]

"""How much to describe before concluding: what the full system's answers cost, and what they got wrong."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from benchmarks.errors import Error, error_of
from benchmarks.table import Row, make_rows
from pipeline.config.params import load_params
from pipeline.core.io import read_csv, read_table
from pipeline.core.records import Graded, ScoreRow

DESCRIBED = ("PC", "PSS", "POM")
"""Tasks that can be answered without describing, over which errors are averaged."""
RULES = "heads and rules, no language model (told the classes of POM's objects)"


def describing(root: Path) -> list[Row]:
    """Tokens that the full system generates against its errors, means over `DESCRIBED`, under each OPD.

    Beside them stands what follows by rule from the encoder's heads, which generates nothing.

    Errors are the report's, tokens those of the answers that it is made of. The interval's ends are means of the tasks'
    ends: as wide as if all tasks erred together.
    """
    graded, report = root / "data" / "graded.parquet", root / "reports" / load_params(root / "params.yaml").report_name
    if not (graded.is_file() and (report / "scores.csv").is_file()):
        return []
    full = ("finetuned", "with", "real")
    ways = {opd: (*full, opd) for opd in ("all", "needed", "none")} | {RULES: ("finetuned", "", "real", "")}
    scores = [r for r in read_csv(report / "scores.csv", ScoreRow) if (r.measure, r.seed) == ("choice", "all")]
    answers = [a for a in read_table(graded, Graded) if (a.encoder, a.lora, a.touch) == full and a.task in DESCRIBED]
    costs, errors = {}, {}
    for name, way in ways.items():
        rows = [r for r in scores if (r.encoder, r.lora, r.touch, r.opd) == way and r.task in DESCRIBED]
        tokens = [0] if name == RULES else [a.tokens for a in answers if a.opd == name]
        if len(rows) == len(DESCRIBED) and tokens:
            own = [error_of(row) for row in rows]
            lows, highs = [e.low for e in own if e.low is not None], [e.high for e in own if e.high is not None]
            low, high = (fmean(lows), fmean(highs)) if len(lows) == len(highs) == len(own) else (None, None)
            errors[name] = Error(fmean(e.value for e in own), low, high, sum(e.n or 0 for e in own))
            costs[name] = [fmean(tokens)]
    if len(costs) < 2 or "all" not in costs:
        return []
    return make_rows(
        "describing",
        costs,
        unit="tokens an answer",
        baseline="all",
        errors=errors,
        error_of=f"error of the full system, mean over {', '.join(DESCRIBED)}",
        counts={name: {"tokens": own[0]} for name, own in costs.items()},
    )

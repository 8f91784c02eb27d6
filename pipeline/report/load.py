"""A written report, read back: what tables, the page and tracking build on."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.core.io import read_json
from pipeline.evaluation.rows import EffectRow, ScoreRow
from pipeline.running.errors import UserError

KEYS = ("task", "measure", "encoder", "lora", "opd")
"""Columns that join published cells to measured rows; "" stands for "does not apply"."""
SCORE_COLUMNS, EFFECT_COLUMNS = tuple(ScoreRow.model_fields), tuple(EffectRow.model_fields)
TEXT = frozenset((*KEYS, "touch", "seed", "part", "change", "model", "dataset"))
DATASET = "PhysiCLeAR"
"""The data set that most of the paper's figures are about."""
DATASETS = (DATASET, "avocados")
"""Data sets of the paper's figures, as properties.yaml names them; beside results on other data they would mislead."""


@dataclass(frozen=True)
class Report:
    """The files of one folder in reports/, such as reports/smoke-scenes; without a row where it lacks a file."""

    folder: Path
    scores: pd.DataFrame
    """`SCORE_COLUMNS`; accuracies are fractions."""
    effects: pd.DataFrame
    """`EFFECT_COLUMNS`; differences are fractions."""
    published: pd.DataFrame
    """The paper's figures; empty where the report is about other data."""
    provenance: dict[str, Any]
    samples: dict[str, Any] = field(default_factory=dict)


def load_report(folder: Path) -> Report:
    """Read a report that `write_report` wrote; raise UserError where its scores.csv or provenance.json is missing."""
    if not (folder / "scores.csv").is_file() or not (folder / "provenance.json").is_file():
        raise UserError(f"{folder}: no report (scores.csv, provenance.json); `dvc repro report` writes one")
    provenance, samples = read_json(folder / "provenance.json"), folder / "samples.json"
    return Report(
        folder,
        read_frame(folder / "scores.csv", SCORE_COLUMNS),
        read_frame(folder / "effects.csv", EFFECT_COLUMNS),
        published(str(provenance.get("dataset", ""))),
        provenance,
        read_json(samples) if samples.is_file() else {},
    )


def read_frame(file: Path, columns: tuple[str, ...]) -> pd.DataFrame:
    """Read a CSV whose keys are text and whose other columns are numbers; an empty frame where there is none.

    Raises:
        UserError: the file lacks a column.
    """
    if not file.is_file():
        return pd.DataFrame({name: pd.Series(dtype=object if name in TEXT else float) for name in columns})
    frame = pd.read_csv(file, dtype=dict.fromkeys(TEXT, str))
    missing = [name for name in columns if name not in frame]
    if missing:
        raise UserError(f"{file}: lacks {', '.join(missing)}; write it anew")
    return frame.fillna({name: "" for name in frame if name in TEXT})


@cache
def published(dataset: str = DATASET) -> pd.DataFrame:
    """The paper's figures about a data set: `KEYS`, model, value, n; no row where it is none of `DATASETS`.

    `value` is as printed: percent, a count, frames or an ICC. `model` is 7b, 13b, CLIP (the heads, without a language
    model), PG-InstructBLIP (which only sees) or `chance`. `n` is text. Where it begins with ~ the paper prints none:
    these are numbers that all of its percentages of the same questions fit.
    """
    every = read_frame(Path(__file__).with_name("published.csv"), (*KEYS, "model", "value", "n", "dataset"))
    return every[every["dataset"] == dataset].drop(columns="dataset")

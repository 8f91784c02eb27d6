"""What things cost: `python -m pipeline.benchmarks SECTION` writes reports/bench/SECTION.json."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import Field

from pipeline.params import load_params
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.records import Record


class BenchRow(Record):
    """One measured point; costs are compared only within one run on one machine."""

    case: str
    cost: float = Field(ge=0)
    """Median of the repeats."""
    unit: str
    baseline: str
    """The case of the same run that `ratio` refers to."""
    ratio: float = Field(ge=0)
    """Cost over the baseline's cost."""
    error: float | None = None
    """What the cost buys, where a section trades cost for error."""
    low: float
    """Lower end of the error's interval; of the repeats' costs where there is no error."""
    high: float
    """Upper end, likewise."""


DATA_VARIABLE = "OCTOPI_DATA_DIR"


def bench_videos(root: Path) -> tuple[Path, Catalogue]:
    """The videos to measure with: the folder that OCTOPI_DATA_DIR names, else the chain's own."""
    data = load_params(root / "params.yaml").data
    return Path(os.environ.get(DATA_VARIABLE) or root / data.dir), load_catalogue(root / data.catalogue)

"""`check`, which judges hard cases, and `--stability-csv`, which writes down what it judged."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from pipeline.core.io import write_csv
from tests.numerics.harness import Check, Format, Row

ROWS = pytest.StashKey[list[Row]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--stability-csv", type=Path, metavar="FILE", help="write every hard case's row to this file")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = []


def pytest_sessionfinish(session: pytest.Session) -> None:
    if path := session.config.getoption("--stability-csv", default=None):
        # In an order that does not depend on which test ran first.
        ordered = sorted(session.config.stash[ROWS], key=lambda r: (r.part, r.case, list(Format).index(r.format)))
        write_csv(path, Row, ordered)


@pytest.fixture(scope="module")
def check(request: pytest.FixtureRequest) -> Check:
    """Judges the cases of the module's part, which its `PART` names."""
    return Check(request.module.PART, request.config.stash[ROWS])


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums in one order, so that the same machine writes the same digits."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)

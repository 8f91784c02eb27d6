"""The drill, reduced: every bad input, and a few kills of the chain's first stages."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from tests.drill import Ledger, drill_bad_inputs, reduced_kills

KILLS = 5


def test_nothing_is_lost_and_every_bad_input_gets_its_line(tmp_path: Path) -> None:
    ledger = Ledger()
    # Side by side, since kills mostly wait; the words on what is wrong are printed.
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        kills = pool.submit(reduced_kills, tmp_path / "chain" / "a project", KILLS)
        drill_bad_inputs(ledger, tmp_path / "input")
        killed = kills.result()
    assert ledger.faults() == 0
    assert killed.faults() == 0
    assert sum(count["tries"] for count in killed.values()) == KILLS

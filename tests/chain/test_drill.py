"""Every bad input of the drill's table gets its line; its kills are in test_chain.py, which has a chain that ran."""

from __future__ import annotations

from pathlib import Path

from tests.drill import Ledger, drill_bad_inputs


def test_every_bad_input_gets_its_line(tmp_path: Path) -> None:
    ledger = Ledger()
    drill_bad_inputs(ledger, tmp_path / "input")
    assert len(ledger) > 15
    assert ledger.faults() == 0, "what is wrong is printed"

"""The table of costs and errors: its front, its ratios, how sections merge into it, and the figures drawn from it."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import __main__ as command
from benchmarks.figures import FOLDER
from benchmarks.table import CSV, Error, Row, front, make_rows, mean_of, merge, read_rows, share_of
from pipeline.evaluation.rows import ScoreRow
from tests.conftest import refused

POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(POINTS)
def test_the_front_is_what_no_other_beats(points: list[tuple[int, int]]) -> None:
    costs, errors = zip(*points, strict=True)
    found = front(costs, errors)
    # A second way: in order of cost, then error, only what has less error than all before stays, and its equals.
    lowest, expected = float("inf"), set()
    for cost, error in sorted(points):
        if error < lowest:
            expected.add((cost, error))
            lowest = error
    assert [point in expected for point in points] == found


def test_ratios_are_within_a_repeat() -> None:
    """A slow repeat slows all alike, and changes no ratio."""
    found = make_rows("q", {"a": [2.0, 300.0, 4.0], "b": [1.0, 100.0, 2.0]}, unit="ms", baseline="b")
    assert [(row.cost, row.cost_ratio) for row in found] == [(4, 2), (2, 1)]


def rows(question: str, *points: tuple[str, float, float | None]) -> list[Row]:
    return make_rows(
        question,
        {name: [cost] for name, cost, _ in points},
        unit="ms",
        baseline=points[0][0],
        errors={name: Error(e, e / 2, min(1.0, 2 * e), 9) for name, _, e in points if e is not None},
        error_of="share wrong",
        counts={points[0][0]: {"frames": 5}},
        machine="any",
    )


def test_merging_keeps_other_questions_and_their_order(tmp_path: Path) -> None:
    table = tmp_path / "speed_error.csv"
    kept, old = rows("kept", ("a", 1, 0.1), ("b", 3, 0.12345)), rows("old", ("a", 1, 0.5), ("gone", 2, 0.4))
    merge(table, [*old, *kept])
    assert read_rows(table) == [*old, *kept]
    fresh, new = rows("old", ("a", 7, None), ("b", 5, None)), rows("new", ("a", 1, 0.1))
    assert merge(table, [*new, *fresh]) == [*fresh, *kept, *new] == read_rows(table)
    before = table.read_bytes()
    merge(table, fresh)
    assert table.read_bytes() == before
    table.write_text("question,setting\nq,s\n")
    with refused("not a table"):
        read_rows(table)


def test_errors_have_intervals_over_objects() -> None:
    one = mean_of([1.0, 3.0, 2.0, 2.0], ["a", "a", "b", "b"])
    assert (one.value, one.low, one.high) == (2, 2, 2)
    two = mean_of([1.0, 3.0], ["a", "b"])
    # Student's t with one degree of freedom: 12.706, deviation sqrt 2 over sqrt 2.
    assert two.high == pytest.approx(2 + 12.706, abs=1e-3)
    assert two.low == 0
    assert mean_of([1.0], ["a"]) == Error(1.0, n=1)
    share = share_of([1, 0, 0, 1], [(o,) for o in "abcd"])
    assert share.low < share.value == 0.5 < share.high
    named = {"task": "t", "measure": "m", "encoder": "e", "seed": "all"}
    counted = {"right": 4, "unread": 0, "chance": 0.1, "n": 9, "sets": 4}
    score = ScoreRow.model_validate({**named, **counted, "accuracy": 0.5, "low": 0.4, "high": 0.7})
    assert Error.of(score).columns == pytest.approx({"error": 0.5, "low": 0.3, "high": 0.6, "n": 9})
    assert Error.of(score.model_copy(update={"low": None, "high": None})).columns == {"error": 0.5, "n": 9}


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from benchmarks import contact

    monkeypatch.chdir(tmp_path)
    merge(CSV, rows("other", ("a", 1, 0.2)))
    monkeypatch.setattr(contact, "measure", lambda root: rows("contact", ("x", 1, 0.1), ("y", 2, 0.05)))
    command.main(["contact"])
    assert [row.question for row in read_rows(CSV)] == ["other", "contact", "contact"]
    assert (CSV.parent / FOLDER / "contact.png").is_file()
    assert "x 2  error 0.05 (front)" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="frames, encoder, contact, systems, serving, training"):
        command.main(["startup"])

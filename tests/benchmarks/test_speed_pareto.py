"""Plots of cost against error: the front, and names that cover neither each other nor a point."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.benchmarks import BenchRow
from pipeline.benchmarks.pareto import draw_rows
from pipeline.speed.labels import MARKER, Box, place_labels
from pipeline.speed.pareto import Point, draw_pareto, front

FRAME = Box(0, 0, 1000, 600)
WIDTH, HEIGHT = 80.0, 14.0


def crosses(one: Box, other: Box) -> bool:
    """Whether two boxes have a point inside both, by intervals."""
    beside = one.right <= other.left or other.right <= one.left
    return not beside and one.bottom < other.top and other.bottom < one.top


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(0, 9)), max_size=12))
def test_the_front_holds_what_nothing_beats(pairs: list[tuple[int, int]]) -> None:
    points = [Point("", f"{i}", cost, error / 10) for i, (cost, error) in enumerate(pairs)]
    beaten = {(a, b) for a, b in pairs for c, d in pairs if (c <= a and d < b) or (c < a and d <= b)}
    found = front(points)
    assert {(int(p.cost), round(10 * p.error)) for p in found} == set(pairs) - beaten
    assert [p.cost for p in found] == sorted(p.cost for p in found)


@given(st.lists(st.tuples(st.floats(200, 800), st.floats(150, 450)), min_size=1, max_size=10))
def test_names_cover_nothing_where_there_is_room(points: list[tuple[float, float]]) -> None:
    boxes = place_labels(points, [(WIDTH, HEIGHT)] * len(points), FRAME)
    markers = [Box(x - MARKER, y - MARKER, x + MARKER, y + MARKER) for x, y in points]
    for one, other in itertools.combinations(boxes, 2):
        assert not crosses(one, other)
    for box in boxes:
        assert not any(crosses(box, marker) for marker in markers)
        assert (round(box.right - box.left, 6), round(box.top - box.bottom, 6)) == (WIDTH, HEIGHT)
        assert FRAME.left <= box.left <= box.right <= FRAME.right
        assert FRAME.bottom <= box.bottom <= box.top <= FRAME.top
    assert boxes == place_labels(points, [(WIDTH, HEIGHT)] * len(points), FRAME)


def test_points_in_one_place_have_names_of_their_own() -> None:
    boxes = place_labels([(500.0, 300.0)] * 12, [(WIDTH, HEIGHT)] * 12, FRAME)
    assert not any(crosses(a, b) for a, b in itertools.combinations(boxes, 2))


def test_a_lone_name_stands_beside_its_point_and_in_a_corner_turns_inward() -> None:
    (box,) = place_labels([(500.0, 300.0)], [(WIDTH, HEIGHT)], FRAME)
    assert box.left > 500
    assert box.bottom > 300
    assert box.left - 500 < 10
    (box,) = place_labels([(998.0, 598.0)], [(WIDTH, HEIGHT)], FRAME)
    assert box.right < 998
    assert box.top < 598


def test_a_name_leaves_a_line_and_a_large_marker_free() -> None:
    line = Box(450, 300, 650, 330)  # what stands above the point
    (box,) = place_labels([(500.0, 300.0)], [(WIDTH, HEIGHT)], FRAME, [line])
    assert not crosses(box, line)
    (box,) = place_labels([(500.0, 300.0)], [(WIDTH, HEIGHT)], FRAME, markers=[20.0])
    assert not crosses(box, Box(480, 280, 520, 320))


def test_without_room_every_name_still_has_a_place() -> None:
    tiny = Box(0, 0, 30, 10)
    points = [(15.0, 5.0)] * 6
    assert len(place_labels(points, [(WIDTH, HEIGHT)] * 6, tiny)) == 6
    assert place_labels([], [], tiny) == []


POINTS = [
    Point("a", "one", 1.0, 0.3, 0.2, 0.4),
    Point("a", "two", 1.01, 0.3, 0.2, 0.4, recommended=True),
    Point("b", "three", 9.0, 0.1),
]


@pytest.mark.parametrize("points", [POINTS, POINTS[:1], [Point("", "free", 0.02, 0.0)], POINTS[:2]])
def test_equal_points_give_equal_bytes(points: list[Point], tmp_path: Path) -> None:
    for name in ("one.png", "other.png"):
        draw_pareto(points, tmp_path / name, "Title", "cost", "error")
    written = (tmp_path / "one.png").read_bytes()
    assert written == (tmp_path / "other.png").read_bytes()
    assert written.startswith(b"\x89PNG")
    assert b"matplotlib" not in written.lower()


def test_rows_without_an_error_are_not_drawn(tmp_path: Path) -> None:
    rows = [
        BenchRow(case=case, cost=cost, unit="ms", baseline="a", ratio=1, error=error, low=0, high=1)
        for case, cost, error in (("a, x", 1, 0.5), ("a, y", 2, None), ("b, x", 2, 0.25))
    ]
    draw_rows(rows, tmp_path / "all.png", "t", "e")
    draw_rows([rows[0], rows[2]], tmp_path / "some.png", "t", "e")
    assert (tmp_path / "all.png").read_bytes() == (tmp_path / "some.png").read_bytes()

"""Where the names of points go in a plot, so that they cover neither each other nor a point. Lengths are in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

RADII = (6.0, 14.0, 24.0, 36.0, 50.0, 66.0, 84.0, 104.0)
"""How far from its point a name may stand; the nearest place that is free wins."""
MARKER = 5.0
SIDES = ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0))
"""To the right before to the left, as one reads."""
COVERED = 50.0
"""What a pixel covered of a name or a point counts, in pixels of distance: it is taken only where all is taken."""
CROSSED = 5.0
"""What a line behind a name counts: a name farther off is better than one on a line, if not by much."""


@dataclass(frozen=True)
class Box:
    """A rectangle."""

    left: float
    bottom: float
    right: float
    top: float

    def shared(self, other: Box) -> float:
        """The area that both cover; 0 where they only touch."""
        wide = min(self.right, other.right) - max(self.left, other.left)
        high = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(wide, 0.0) * max(high, 0.0)

    def outside(self, frame: Box) -> float:
        """How far it sticks out of a frame, summed over the sides."""
        gaps = frame.left - self.left, frame.bottom - self.bottom, self.right - frame.right, self.top - frame.top
        return sum(max(gap, 0.0) for gap in gaps)


Place = tuple[float, float]


def place_labels(
    points: Sequence[Place],
    sizes: Sequence[Place],
    frame: Box,
    lines: Sequence[Box] = (),
    markers: Sequence[float] = (),
) -> list[Box]:
    """A box for each name, in the order of the points; equal input gives equal boxes.

    From left to right each name takes the best of the places around its point: near, inside the frame, off all points
    and names that already stand, and off lines where that is cheap. Where everything is taken, the least covered wins.

    Args:
        points: Middles of the markers.
        sizes: Width and height of each name.
        frame: What names should stay inside of.
        lines: Thin boxes that may be covered, if need be.
        markers: Half a side of each point's marker; `MARKER` by default.
    """
    halves = markers or [MARKER] * len(points)
    drawn = [Box(x - half, y - half, x + half, y + half) for (x, y), half in zip(points, halves, strict=True)]
    placed: dict[int, Box] = {}
    for number in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        taken = [*drawn, *placed.values()]
        around = [(radius, _beside(points[number], sizes[number], radius, side)) for radius in RADII for side in SIDES]
        scores = [radius + _cost(box, taken, frame, lines) for radius, box in around]
        placed[number] = around[scores.index(min(scores))][1]
    return [placed[i] for i in range(len(points))]


def _beside(point: Place, size: Place, radius: float, side: tuple[int, int]) -> Box:
    (x, y), (width, height), (right, up) = point, size, side
    # Between two corners the distance is across; straight to a side it is to the middle of the name's edge.
    left = x + right * radius - (0 if right > 0 else width if right < 0 else width / 2)
    bottom = y + up * radius - (0 if up > 0 else height if up < 0 else height / 2)
    return Box(left, bottom, left + width, bottom + height)


def _cost(box: Box, taken: Sequence[Box], frame: Box, lines: Sequence[Box]) -> float:
    covered = sum(box.shared(other) for other in taken) + box.outside(frame)
    return COVERED * covered + CROSSED * sum(box.shared(line) > 0 for line in lines)

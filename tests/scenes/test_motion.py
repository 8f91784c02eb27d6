"""The hand's motion: physically possible at any length, and as long and as timed as what was measured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.scenes import motion
from pipeline.scenes.motion import FORCE_N, TWIST_DEGREES, make_motion

MEDIAN = 3


@given(st.integers(2, 300), st.integers(0, 2**32))
def test_a_hand_rests_presses_and_twists(frames: int, seed: int) -> None:
    hand = make_motion(frames, np.random.default_rng(seed))
    tracks = np.array([hand.force, hand.angle, hand.x, hand.y])
    assert tracks.shape == (4, frames)
    assert np.isfinite(tracks).all()
    assert hand.force[0] == 0, "the first frame shows the gel untouched"
    assert (hand.force >= 0).all()
    assert 0 < hand.force.max() <= FORCE_N[1], "even the shortest video shows contact"
    assert np.abs([hand.x, hand.y]).max() <= motion.REACH_MM
    turned = np.flatnonzero(np.diff(hand.angle))
    # Between two frames of a short video the hand may turn and then let go.
    assert (np.maximum(hand.force[turned], hand.force[turned + 1]) > 0).all(), "what turns is held"
    assert np.ptp(hand.angle) <= max(TWIST_DEGREES) + 1e-9


@given(st.integers(1, 60), st.integers(0, 1000))
def test_the_rate_changes_nothing_but_the_sampling(half: int, seed: int) -> None:
    slow, fast = (make_motion(n, np.random.default_rng(seed)) for n in (2 * half, 4 * half))
    np.testing.assert_allclose(slow.force, fast.force[::2], atol=1e-12)
    np.testing.assert_allclose(slow.angle, fast.angle[::2], atol=1e-9)


def test_times_and_places_are_those_that_were_measured() -> None:
    hands = [make_motion(500, np.random.default_rng(seed)) for seed in range(400)]
    force = np.stack([h.force / h.force.max() for h in hands])
    let_go = force[:, -1] < 0.05
    first = (force >= 0.1).argmax(axis=1) / 500
    last = 1 - (force[let_go, ::-1] >= 0.3).argmax(axis=1) / 500
    assert np.median(first) == pytest.approx(motion.BEGUN[MEDIAN], abs=0.01)
    assert np.median(last) == pytest.approx(motion.RELEASED[MEDIAN], abs=0.02)
    assert 1 - let_go.mean() == pytest.approx(motion.LINGER, abs=0.03)
    assert np.median([np.ptp(h.angle) for h in hands]) == pytest.approx(TWIST_DEGREES[MEDIAN], rel=0.15)
    for axis, (mean, _) in zip("xy", motion.CENTRE_MM, strict=True):
        assert np.mean([getattr(h, axis).mean() for h in hands]) == pytest.approx(mean, abs=0.25)
    travel = [np.hypot(h.x[-1] - h.x[0], h.y[-1] - h.y[0]) for h in hands]
    assert np.median(travel) == pytest.approx(motion.TRAVEL_MM[MEDIAN], abs=0.25)


def test_the_force_falls_while_the_hand_twists() -> None:
    hand = make_motion(1000, np.random.default_rng(3))
    turning = np.flatnonzero(np.diff(hand.angle))
    assert (np.diff(hand.force)[turning] <= 1e-12).all()

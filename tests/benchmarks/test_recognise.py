"""The expected error of recognition, against drawing all candidates one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from benchmarks.recognise import cosines, wrong


@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_mean_over_all_draws(seed: int) -> None:
    rng = np.random.default_rng(seed)
    objects = [*"aabbbccdde"]
    alike = cosines(rng.normal(size=(len(objects), 3)))
    touches = {o: [i for i, own in enumerate(objects) if own == o] for o in sorted(set(objects))}
    for k in (2, 3, 0):
        missed = []
        for query, own in enumerate(objects):
            # Each draw of objects counts alike, however many touches they have.
            right = [
                np.mean(
                    [
                        all(alike[query, i] < alike[query, kept] for i in others)
                        for others in itertools.product(*(touches[o] for o in chosen))
                    ]
                )
                for kept in touches[own]
                if kept != query
                for chosen in itertools.combinations(sorted(touches.keys() - {own}), (k or len(touches)) - 1)
            ]
            if right:
                missed.append(1 - np.mean(right))
        found = wrong(alike, objects, k)
        assert found is not None
        assert (found.value, found.n) == (pytest.approx(np.mean(missed)), len(missed))


def test_shuffled_names_fall_to_chance_and_equal_touches_are_recognised() -> None:
    rng = np.random.default_rng(0)
    values = np.repeat(rng.normal(size=(60, 32)), 3, axis=0) + 0.01 * rng.normal(size=(180, 32))
    objects = [f"{i:02}" for i in np.repeat(np.arange(60), 3)]
    for k in (2, 5):
        true = wrong(cosines(values), objects, k)
        chance = wrong(cosines(values), rng.permutation(objects).tolist(), k)
        assert true is not None
        assert chance is not None
        assert (true.value, chance.value) == (0, pytest.approx(1 - 1 / k, abs=0.03))


def test_candidates_of_one_session_are_touched_in_it() -> None:
    values = cosines(np.array([[1, 0], [0.9, 0.1], [1, 0], [0, 1]], dtype=float))
    objects, sessions = [*"aabc"], [*"1121"]
    everywhere, there = wrong(values, objects, 2), wrong(values, objects, 2, sessions)
    assert everywhere is not None
    assert there is not None
    assert (everywhere.value, there.value) == (pytest.approx(0.5), 0.0), "b, in another session, is as like as can be"
    assert wrong(values, [*"abcd"], 2) is None

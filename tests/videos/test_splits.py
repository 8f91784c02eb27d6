"""Splits: a partition by object, with nothing leaking between parts."""

from __future__ import annotations

import itertools
import re
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import SplitConfig
from pipeline.core.errors import UserError
from pipeline.core.records import Assignment, Part
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.split import VALIDATION, assign, untested, without_videos
from tests.conftest import ROOT, fake_videos, refused

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
OBJECTS = sorted(CATALOGUE.objects)
NAMES = ["paper", "release", "development", "kfold"]
TRAIN = {o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] == Part.TRAIN}


def objects_of(split: list[Assignment], part: Part) -> set[str]:
    return {a.object_id for a in split if a.part == part}


@settings(max_examples=16)
@given(
    st.sampled_from(NAMES), st.integers(0, 2**31 - 1), st.sets(st.sampled_from(OBJECTS), min_size=60), st.integers(0, 9)
)
def test_every_video_has_one_part_and_every_object_too(name: str, seed: int, objects: set[str], trained: int) -> None:
    """So no object is both trained on and tested under one seed."""
    videos = fake_videos(sorted(objects), 2)
    config = SplitConfig(name=name, seed=seed)
    split = assign(CATALOGUE, videos, config, trained)
    assert [a.video_id for a in split] == [v.video_id for v in videos]
    parts = {o: {a.part for a in split if a.object_id == o} for o in objects}
    assert all(len(where) == 1 for where in parts.values())
    again = trained + config.folds if name == "kfold" else trained + 1
    assert split == assign(CATALOGUE, videos, config, again), "a seed of the same fold has the same split"


@settings(max_examples=25)
@given(st.integers(3, 50), st.integers(0, 2**31 - 1), st.sets(st.sampled_from(OBJECTS), min_size=3))
def test_kfold_tests_every_object_once(folds: int, seed: int, objects: set[str]) -> None:
    videos = fake_videos(sorted(objects), 1)
    if len(objects) < folds:
        with pytest.raises(UserError, match=r"split\.folds"):
            assign(CATALOGUE, videos, SplitConfig(name="kfold", folds=folds, seed=seed))
        return
    tested: Counter[str] = Counter()
    for fold in range(folds):
        split = assign(CATALOGUE, videos, SplitConfig(name="kfold", folds=folds, seed=seed), fold)
        tested.update(objects_of(split, Part.TEST))
        assert len(objects_of(split, Part.TEST)) in (len(objects) // folds, -(-len(objects) // folds))
        learnt = len(objects) - len(objects_of(split, Part.TEST))
        parts = min(VALIDATION, learnt)
        assert len(objects_of(split, Part.VALIDATION)) in (learnt // parts, -(-learnt // parts))
        assert objects_of(split, Part.TRAIN), "some are left to learn from"
    assert tested == Counter(objects)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_folds_have_each_class_alike(seed: int) -> None:
    config = SplitConfig(name="kfold", folds=3, seed=seed)
    tested = [objects_of(assign(CATALOGUE, fake_videos(OBJECTS, 1), config, fold), Part.TEST) for fold in range(3)]
    assert sorted(map(len, tested)) == [24, 25, 25], "each of the catalogue's objects"
    for place, level in itertools.product(range(3), range(3)):
        counts = [sum(CATALOGUE.labels(o)[place] == level for o in fold) for fold in tested]
        assert max(counts) - min(counts) <= 2, (place, level)


@settings(max_examples=8)
@given(st.integers(0, 2**31 - 1), st.integers(1, 12))
def test_development_keeps_away_from_the_test_set(seed: int, count: int) -> None:
    videos = fake_videos(OBJECTS, 1)
    split = assign(CATALOGUE, videos, SplitConfig(name="development", seed=seed, test_objects=count))
    test = objects_of(split, Part.TEST)
    assert len(test) == count
    assert test <= TRAIN
    assert objects_of(split, Part.TRAIN) == TRAIN - test
    assert objects_of(split, Part.UNUSED) == {o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] == Part.TEST}


def test_development_is_stratified_and_seeded() -> None:
    chosen = set()
    for seed in range(6):
        split = assign(CATALOGUE, fake_videos(OBJECTS, 1), SplitConfig(name="development", seed=seed))
        test = objects_of(split, Part.TEST)
        chosen.add(frozenset(test))
        for index in range(3):
            whole = Counter(CATALOGUE.labels(o)[index] for o in TRAIN)
            part = Counter(CATALOGUE.labels(o)[index] for o in test)
            for level, number in whole.items():
                assert abs(part[level] - number / 60 * 7) < 1.5, "within one and a half objects of proportion"
    assert len(chosen) > 4


def test_development_draws_from_objects_that_have_videos() -> None:
    present = sorted(TRAIN)[::3]
    split = assign(CATALOGUE, fake_videos(present), SplitConfig(name="development"))
    assert len(objects_of(split, Part.TEST)) == 7
    with pytest.raises(UserError, match=r"split\.test_objects is 18, but 20 training .* allow 17"):
        assign(CATALOGUE, fake_videos(present), SplitConfig(name="development", test_objects=18))


def test_missing_objects_are_reported_or_refused() -> None:
    present = [o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] != Part.TEST and o != "denim"]
    split = assign(CATALOGUE, fake_videos(present), SplitConfig(name="paper"))
    assert not objects_of(split, Part.TEST)
    with refused(r"ice_block.*denim.*split\.missing"):
        assign(CATALOGUE, fake_videos(present), SplitConfig(name="paper", missing="error"))


def test_a_split_that_tests_nothing_says_so() -> None:
    assert without_videos({"rug": Part.TRAIN, "denim": Part.VALIDATION}, {"rug", "denim"}) == "no object is for test"
    said = untested({"rug": Part.TRAIN, "denim": Part.TEST, "mug": Part.UNUSED}, {"rug", "mug", "new"})
    assert "1 of 1 test objects have no videos (denim)" in said
    assert "2 with videos are in no part (mug, new)" in said
    assert "split.name=kfold" in said
    assert untested({"rug": Part.TRAIN, "denim": Part.TEST}, {"rug", "denim"}) == ""


def renamed(**columns: str) -> Catalogue:
    """The catalogue with other split columns: new name to old."""
    objects = {
        o.object_id: o.model_copy(update={"splits": {new: o.splits[old] for new, old in columns.items()}})
        for o in CATALOGUE.objects.values()
    }
    return CATALOGUE.model_copy(update={"objects": objects})


@pytest.mark.parametrize("name", ["paper", "release", "mine"])
def test_a_column_is_a_split(name: str) -> None:
    catalogue = renamed(paper="paper", release="release", mine="paper")
    split = assign(catalogue, fake_videos(OBJECTS), SplitConfig(name=name))
    for part in Part:
        assert objects_of(split, part) == {o for o in OBJECTS if catalogue.objects[o].splits[name] == part}


@pytest.mark.parametrize(
    ("columns", "name", "words"),
    [
        ({}, "paper", "split.name=paper is no split of the catalogue; allowed: kfold "),
        ({}, "development", "split.name=development needs the column split_paper; allowed: kfold "),
        ({"mine": "paper"}, "sideways", "allowed: mine, kfold "),
        ({"paper": "paper"}, "mine", "allowed: paper, development, kfold "),
    ],
)
def test_a_split_that_is_not_there_is_refused(columns: dict[str, str], name: str, words: str) -> None:
    other = renamed(**columns)
    with refused(re.escape(words)):
        assign(other, fake_videos(OBJECTS), SplitConfig(name=name))
    assert assign(other, fake_videos(OBJECTS), SplitConfig(name="kfold"))


@pytest.mark.parametrize("name", ["paper", "development"])
def test_nothing_to_train_on(name: str) -> None:
    for objects in (["denim", "ice_block"], []):
        with refused("train"):
            assign(CATALOGUE, fake_videos(objects), SplitConfig(name=name))

"""Splits: a partition by object, with nothing leaking between parts."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import SplitConfig
from pipeline.core.records import Part
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.split import VALIDATION, assign, untested
from tests.conftest import ROOT, fake_videos, refused

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
OBJECTS = sorted(CATALOGUE.objects)


def parts(objects: Iterable[str] = OBJECTS, fold: int = 0, **config: Any) -> dict[Part, set[str]]:
    """The objects of each part, of one video an object."""
    split = assign(CATALOGUE, fake_videos(sorted(objects), 1), SplitConfig(**config), fold)
    return {part: {a.object_id for a in split if a.part == part} for part in Part}


@settings(max_examples=16)
@given(
    st.sampled_from(["paper", "release", "kfold"]),
    st.integers(0, 2**31 - 1),
    st.sets(st.sampled_from(OBJECTS), min_size=60),
    st.integers(0, 9),
)
def test_every_video_has_one_part_and_every_object_too(name: str, seed: int, objects: set[str], trained: int) -> None:
    videos, config = fake_videos(sorted(objects), 2), SplitConfig(name=name, seed=seed)
    split = assign(CATALOGUE, videos, config, trained)
    assert [a.video_id for a in split] == [v.video_id for v in videos]
    assert len({(a.object_id, a.part) for a in split}) == len(objects)
    again = trained + config.folds if name == "kfold" else trained + 1
    assert split == assign(CATALOGUE, videos, config, again), "a seed of the same fold has the same split"


@settings(max_examples=25)
@given(st.integers(3, 50), st.integers(0, 2**31 - 1), st.sets(st.sampled_from(OBJECTS), min_size=3))
def test_kfold_tests_every_object_once(folds: int, seed: int, objects: set[str]) -> None:
    if len(objects) < folds:
        with refused(r"split\.folds"):
            parts(objects, name="kfold", folds=folds, seed=seed)
        return
    tested: Counter[str] = Counter()
    for fold in range(folds):
        split = parts(objects, fold, name="kfold", folds=folds, seed=seed)
        tested.update(split[Part.TEST])
        assert len(split[Part.TEST]) in (len(objects) // folds, -(-len(objects) // folds))
        learnt = len(objects) - len(split[Part.TEST])
        dealt = min(VALIDATION, learnt)
        assert len(split[Part.VALIDATION]) in (learnt // dealt, -(-learnt // dealt))
        assert split[Part.TRAIN], "some are left to learn from"
    assert tested == Counter(objects)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_folds_have_each_class_alike(seed: int) -> None:
    tested = [parts(fold=fold, name="kfold", folds=3, seed=seed)[Part.TEST] for fold in range(3)]
    assert sorted(map(len, tested)) == [24, 25, 25], "each of the catalogue's objects"
    for place, level in itertools.product(range(3), range(3)):
        counts = [sum(CATALOGUE.labels(o)[place] == level for o in fold) for fold in tested]
        assert max(counts) - min(counts) <= 2, (place, level)


def test_fewer_training_objects_change_no_other_part() -> None:
    few, more, whole = (parts(fold=1, name="kfold", folds=3, train_objects=n) for n in (5, 10, 0))
    assert few[Part.TRAIN] < more[Part.TRAIN] < whole[Part.TRAIN]
    assert (len(few[Part.TRAIN]), len(more[Part.TRAIN])) == (5, 10)
    for split in (few, more):
        assert split[Part.TRAIN] | split[Part.UNUSED] == whole[Part.TRAIN]
        assert all(split[part] == whole[part] for part in (Part.TEST, Part.VALIDATION))
    count = len(whole[Part.TRAIN])
    assert parts(fold=1, name="kfold", folds=3, train_objects=count) == whole
    with refused(rf"split\.train_objects is {count + 1}, but fold 1 has {count} training objects"):
        parts(fold=1, name="kfold", folds=3, train_objects=count + 1)


def test_missing_objects_are_reported_or_refused() -> None:
    tested = {o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] == Part.TEST}
    present = {*OBJECTS} - tested - {"denim"}
    assert not parts(present, name="paper")[Part.TEST]
    with refused(r"ice_block.*denim.*split\.missing"):
        parts(present, name="paper", missing="error")


def test_a_split_that_tests_nothing_says_so() -> None:
    said = untested({"rug": Part.TRAIN, "denim": Part.TEST, "mug": Part.UNUSED}, {"rug", "mug", "new"})
    assert "1 of 1 test objects have no videos (denim)" in said
    assert "2 with videos are in no part (mug, new)" in said
    assert "split.name=kfold" in said
    assert untested({"rug": Part.TRAIN, "denim": Part.TEST}, {"rug", "denim"}) == ""


def renamed(**columns: str) -> Catalogue:
    """The catalogue with other split columns: new name to old."""
    objects = {
        name: entry.model_copy(update={"splits": {new: entry.splits[old] for new, old in columns.items()}})
        for name, entry in CATALOGUE.objects.items()
    }
    return CATALOGUE.model_copy(update={"objects": objects})


@pytest.mark.parametrize("name", ["paper", "release", "mine"])
def test_a_column_is_a_split(name: str) -> None:
    catalogue = renamed(paper="paper", release="release", mine="paper")
    split = assign(catalogue, fake_videos(OBJECTS), SplitConfig(name=name))
    assert {(a.object_id, a.part) for a in split} == {(o, catalogue.objects[o].splits[name]) for o in OBJECTS}


def test_a_split_that_is_not_there_is_refused() -> None:
    with refused("split.name=mine is no split of the catalogue; allowed: paper, kfold "):
        assign(renamed(paper="paper"), fake_videos(OBJECTS), SplitConfig(name="mine"))
    assert assign(renamed(), fake_videos(OBJECTS), SplitConfig(name="kfold"))


@pytest.mark.parametrize("objects", [["denim", "ice_block"], []])
def test_nothing_to_train_on(objects: list[str]) -> None:
    with refused("no video of a training object"):
        parts(objects, name="paper")

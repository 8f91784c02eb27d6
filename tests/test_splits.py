"""Splits: a partition by object, with nothing leaking between parts."""

from __future__ import annotations

from collections import Counter, defaultdict

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import SplitConfig
from pipeline.errors import UserError
from pipeline.physiclear.catalogue import load_catalogue
from pipeline.records import Assignment, Part
from pipeline.splits import Split, assign, check_leakage
from tests.conftest import ROOT, fake_videos

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
OBJECTS = sorted(CATALOGUE.objects)
NAMES = ["paper", "release", "development", "kfold"]
TRAIN = {o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] == Part.TRAIN}


def objects_of(split: Split, part: Part) -> set[str]:
    return {a.object_id for a in split.assignments if a.part == part}


@given(
    st.sampled_from(NAMES), st.integers(0, 2**31 - 1), st.sets(st.sampled_from(OBJECTS), min_size=60), st.integers(0, 4)
)
def test_every_video_has_one_part_and_every_object_too(name: str, seed: int, objects: set[str], fold: int) -> None:
    videos = fake_videos(sorted(objects), 2)
    config = SplitConfig(name=name, seed=seed, fold=fold)
    split = assign(CATALOGUE, videos, config)
    assert [a.video_id for a in split.assignments] == [v.video_id for v in videos]
    parts = defaultdict(set)
    for a in split.assignments:
        parts[a.object_id].add(a.part)
    assert all(len(p) == 1 for p in parts.values())
    check_leakage(split.assignments, videos)
    assert split == assign(CATALOGUE, videos, config)
    present = {v.object_id for v in videos}
    for part, missing in split.missing.items():
        assert part in (Part.VALIDATION, Part.TEST)
        assert not present & set(missing)
    assert set(split.missing) == {Part.VALIDATION, Part.TEST}


@given(st.integers(3, 50), st.integers(0, 2**31 - 1), st.sets(st.sampled_from(OBJECTS), min_size=3))
def test_kfold_tests_every_object_once(folds: int, seed: int, objects: set[str]) -> None:
    videos = fake_videos(sorted(objects), 1)
    if len(objects) < folds:
        with pytest.raises(UserError, match=r"split\.folds"):
            assign(CATALOGUE, videos, SplitConfig(name="kfold", folds=folds, seed=seed))
        return
    tested: Counter[str] = Counter()
    validated: Counter[str] = Counter()
    for fold in range(folds):
        split = assign(CATALOGUE, videos, SplitConfig(name="kfold", folds=folds, fold=fold, seed=seed))
        tested.update(objects_of(split, Part.TEST))
        validated.update(objects_of(split, Part.VALIDATION))
        assert len(objects_of(split, Part.TEST)) in (len(objects) // folds, -(-len(objects) // folds))
    assert tested == validated == Counter(objects)


@pytest.mark.parametrize("name", ["paper", "release"])
def test_published_splits_follow_the_catalogue(name: str) -> None:
    split = assign(CATALOGUE, fake_videos(OBJECTS), SplitConfig(name=name))
    for part in Part:
        assert objects_of(split, part) == {o for o in OBJECTS if CATALOGUE.objects[o].splits[name] == part}
    assert split.missing == {Part.VALIDATION: (), Part.TEST: ()}


@settings(max_examples=25)
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
    for seed in range(8):
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
    assert split.missing[Part.VALIDATION] == ("denim",)
    assert len(split.missing[Part.TEST]) == 7
    assert not objects_of(split, Part.TEST)
    with pytest.raises(UserError) as caught:
        assign(CATALOGUE, fake_videos(present), SplitConfig(name="paper", missing="error"))
    for words in ("denim", "ice_block", "split.missing"):
        assert words in str(caught.value)


@pytest.mark.parametrize("name", ["paper", "development"])
def test_nothing_to_train_on(name: str) -> None:
    with pytest.raises(UserError, match="train"):
        assign(CATALOGUE, fake_videos(["denim", "ice_block"]), SplitConfig(name=name))
    with pytest.raises(UserError):
        assign(CATALOGUE, [], SplitConfig(name=name))


def test_an_object_in_two_parts_is_found() -> None:
    videos = fake_videos(["rug", "potato"], 2)
    parts = [Part.TRAIN, Part.TEST, Part.TRAIN, Part.TRAIN]
    assignments = [
        Assignment(video_id=v.video_id, object_id=v.object_id, part=p) for v, p in zip(videos, parts, strict=True)
    ]
    with pytest.raises(UserError, match="object rug stands in train and in test"):
        check_leakage(assignments, videos)


@pytest.mark.parametrize(("other", "leaks"), [(Part.TEST, True), (Part.TRAIN, False), (Part.UNUSED, False)])
def test_equal_content_in_two_parts_is_found(other: Part, leaks: bool) -> None:
    first, second = fake_videos(["rug", "potato"], 1)
    second = second.model_copy(update={"sha256": first.sha256})
    assignments = [
        Assignment(video_id=first.video_id, object_id="rug", part=Part.TRAIN),
        Assignment(video_id=second.video_id, object_id="potato", part=other),
    ]
    if not leaks:
        check_leakage(assignments, [first, second])
        return
    with pytest.raises(UserError, match=r"rug_0\.avi \(train\) and potato_0\.avi \(test\) have the same content"):
        check_leakage(assignments, [first, second])

"""What is read from free text: the longest wording, once, as whole words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.wording import contradiction, levels_named, mentioned, plain
from tests.conftest import ROOT

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
HARDNESS, ROUGHNESS, BUMPINESS = CATALOGUE.properties


@pytest.mark.parametrize(
    ("text", "hardness", "roughness", "bumpiness"),
    [
        ("", set(), set(), set()),
        ("Hard and smooth, with no bumps.", {2}, {0}, {0}),
        ("It is MODERATELY\nhard.", {1}, set(), set()),
        ("moderately-hard", {1}, set(), set()),
        ("It lacks noticeable roughness.", set(), {0}, set()),
        ("noticeable roughness", set(), {2}, set()),
        ("not rough, and without bumps", set(), {0}, {0}),
        ("a slight roughness and small irregularities", set(), {1}, {1}),
        ("no prominent bumps", set(), set(), {0}),
        ("prominent bumps, but not bumpy all over", set(), set(), {0, 2}),
        ("It is squishy where it is not hard.", {0}, set(), set()),
        ("hardly softened, roughly smoothed", set(), set(), set()),
        ("neither hard nor soft", {1}, set(), set()),
    ],
)
def test_classes_are_read_from_free_text(
    text: str, hardness: set[int], roughness: set[int], bumpiness: set[int]
) -> None:
    assert [levels_named(text, p) for p in CATALOGUE.properties] == [hardness, roughness, bumpiness]


def test_a_text_contradicts_a_label_that_it_names_another_class_for() -> None:
    assert contradiction("It is soft.", HARDNESS, 2) == {0}
    assert not contradiction("It is soft.", HARDNESS, 0)
    assert not contradiction("It is soft on a hard core.", HARDNESS, 2)
    assert not contradiction("It is red.", HARDNESS, 2)


def test_own_descriptions_contradict_nothing() -> None:
    for object_id in CATALOGUE.objects:
        for p, label in zip(CATALOGUE.properties, CATALOGUE.labels(object_id), strict=True):
            for text in (CATALOGUE.unstructured(object_id), CATALOGUE.describe(object_id)):
                assert levels_named(text, p) == {label}, text


@given(
    st.sampled_from(CATALOGUE.properties).flatmap(
        lambda p: st.tuples(st.just(p), st.sampled_from(sorted(p.wordings.items())))
    ),
    st.sampled_from(["It feels {}.", "{}", "({}), they say", "X {}\t-", "One: {}; two."]),
    st.sampled_from([str.upper, str.title, lambda w: w.replace(" ", "-"), lambda w: w.replace(" ", " \n ")]),
)
def test_every_wording_names_its_class_alone(pair: tuple, frame: str, disguise) -> None:
    prop, (wording, level) = pair
    assert levels_named(frame.format(disguise(wording)), prop) == {level}


@given(
    st.text("ab -", max_size=30),
    st.lists(st.text("ab ", min_size=1, max_size=6).filter(lambda t: bool(t.strip())), max_size=5),
)
def test_phrases_are_whole_words_of_the_text(text: str, phrases: list[str]) -> None:
    found = mentioned(text, phrases)
    assert set(found) <= {plain(p) for p in phrases}
    assert [len(p) for p in found] == sorted(map(len, found), reverse=True)
    for phrase in found:
        assert f" {phrase} " in f" {plain(text)} "
    for phrase in map(plain, phrases):
        if f" {phrase} " in f" {plain(text)} " and phrase not in found:
            assert any(phrase in longer or _overlap(phrase, longer) for longer in found)


def _overlap(one: str, two: str) -> bool:
    return any(one[:n] == two[-n:] or one[-n:] == two[:n] for n in range(1, min(len(one), len(two)) + 1))


def test_a_phrase_need_not_end_in_a_letter() -> None:
    assert mentioned("It is 100% (wet)!", ["100%", "wet)", "00%"]) == ["100%", "wet)"]

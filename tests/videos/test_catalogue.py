"""The catalogue against the paper's tables, bad ones, which classes a free text names, and splits by object."""

import itertools
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import SplitConfig
from pipeline.core.records import Part
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.catalogue.wording import levels_named, mentioned
from pipeline.videos.split import VALIDATION, assign, untested
from tests.conftest import CATALOGUE, PHYSICLEAR, fake_videos, refused

PAPER_TEST = {
    *("bath_towel", "clothes_peg", "hairbrush_bristles", "hairbrush_handle", "ice_block", "microfiber_cloth"),
    "toilet_brush_bristles",
}


def test_objects_parts_and_names(catalogue: Catalogue) -> None:
    paper, release = (
        {part: {o for o, entry in catalogue.objects.items() if entry.splits[split] == part} for part in Part}
        for split in ("paper", "release")
    )
    assert [len(paper[part]) for part in (Part.TRAIN, Part.VALIDATION, Part.TEST)] == [60, 7, 7]
    assert paper[Part.TEST] == PAPER_TEST
    assert release[Part.TEST] == PAPER_TEST - {"ice_block", "clothes_peg"} | {"orange", "eraser"}
    assert release[Part.VALIDATION] == paper[Part.VALIDATION] - {"bubble_wrap"} | {"lemon"}
    names = {o.name.lower() for o in catalogue.objects.values()}
    assert len(names) == 74 == len(catalogue.objects), "options of a matching question are told apart by name"
    assert all(o.material and all(len(r) == 3 for r in o.ratings) for o in catalogue.objects.values())


def test_a_label_is_the_rounded_mean_of_the_ratings(catalogue: Catalogue) -> None:
    gauze = catalogue.objects["gauze_pad"]
    assert (gauze.ratings[0], catalogue.labels("gauze_pad")[0]) == ((1, 2, 2), 2)
    for ratings in (r for raters in range(1, 5) for r in itertools.product(range(4), repeat=raters)):
        mean = Decimal(sum(ratings)) / len(ratings)
        expected = int(mean.quantize(Decimal(1), ROUND_HALF_UP))
        assert gauze.model_copy(update={"ratings": (ratings,)}).labels == (expected,)


def test_descriptions_name_every_class_and_no_other(catalogue: Catalogue) -> None:
    assert catalogue.structured((2, 0, 0)) == "Overall, it presents a hard and smooth surface with no bumps."
    assert catalogue.describe_one("gauze_pad", "hardness") == "Overall, it presents a hard surface."
    for object_id in catalogue.objects:
        assert catalogue.describe(object_id).endswith(catalogue.structured(catalogue.labels(object_id)))
        for p, label in zip(catalogue.properties, catalogue.labels(object_id), strict=True):
            for text in (catalogue.unstructured(object_id), catalogue.describe(object_id)):
                assert levels_named(text, p) == {label}, text
    for p in catalogue.properties:
        phrases = [phrase for level in p.phrases for phrase in level]
        assert len(set(phrases)) == len(phrases)


def test_one_wording_a_class_tells_classes_and_nothing_of_the_object() -> None:
    """Each property's first words then say its class, so that the likeliest word is that of the likeliest class."""
    whole = load_catalogue(PHYSICLEAR)
    assert whole.properties, "what was looked at before does not come along"
    one = whole.asking("published", "class")
    assert whole.asking("published").describe("rug") == whole.describe("rug") != one.describe("rug")
    said = {(whole.labels(o), one.unstructured(o)) for o in whole.objects}
    assert len(said) == len({labels for labels, _ in said}) == len({text for _, text in said})
    for object_id in whole.objects:
        for p, label in zip(whole.properties, whole.labels(object_id), strict=True):
            assert p.phrases[label][0] in one.describe(object_id)


HEADER = "object_id,name,material,part_of,part,split_paper,split_release,hardness,roughness,bumpiness"
GOOD = "ball,a ball,rubber,,,train,train,1 1 2,0 0 0,0 0 1"
SHORT = "object_id,name,hardness,roughness,bumpiness"
BALL = "ball,a ball,1 1 2,0,0 0 1"
BOWL = BALL.replace("ball,a ball", "bowl,a bowl")


def write(folder: Path, *lines: str, encoding: str = "utf-8", **more: Sequence[str]) -> Path:
    """A catalogue with PhysiCLeAR's language and these lines."""
    shutil.copy(PHYSICLEAR / "properties.yaml", folder)
    (folder / "objects.csv").write_text("\n".join(lines) + "\n", encoding=encoding)
    for file, told in more.items():
        (folder / f"{file}.csv").write_text("\n".join(told) + "\n", encoding=encoding)
    return folder


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([HEADER], r"objects\.csv.*no object"),
        ([HEADER, GOOD, GOOD], "line 3.*ball.*twice"),
        ([HEADER, GOOD.replace("1 1 2", "-1")], "line 2.*hardness.*0 to 2"),
        ([HEADER, GOOD.replace("train,train", "train,trian")], "line 2.*split_release.*trian.*validation"),
        ([HEADER, GOOD.replace("ball,", "../../evil,", 1)], r"line 2.*'\.\./\.\./evil'.*letters, digits"),
        ([HEADER, GOOD.replace("ball,", "b" * 151 + ",", 1)], r"line 2: object 'b{50}' .151 bytes. names files"),
        ([f"{SHORT},label_hardnes", f"{BALL},1"], r"objects\.csv.*label_hardnes .*no property"),
    ],
)
def test_a_bad_table_is_one_clear_line(tmp_path: Path, lines: list[str], words: str) -> None:
    with refused(words):
        load_catalogue(write(tmp_path, *lines))


@pytest.mark.parametrize(
    ("file", "lines", "words"),
    [
        ("descriptions", ["object_id,description", "ball,round", "balll,round"], r"line 3.*'balll'.*objects\.csv"),
        ("texts", ["object_id,text", '"ball","Round. Overall, it presents a hard surface."'], "line 2.*'Overall'"),
    ],
)
def test_a_bad_description_is_one_clear_line(tmp_path: Path, file: str, lines: list[str], words: str) -> None:
    with refused(rf"{file}\.csv.*{words}"):
        load_catalogue(write(tmp_path, SHORT, BALL, **{file: lines}))


def test_texts_are_told_where_they_are_asked_for_and_packed_nowhere(tmp_path: Path) -> None:
    loaded = load_catalogue(write(tmp_path, SHORT, BALL, BOWL, texts=["object_id,text", "ball,Round.", "ball,Odd."]))
    told, phrases = (loaded.asking("published", wording).called("number") for wording in ("texts", "object"))
    assert told.describe("ball") == f"Round. {loaded.structured((1, 0, 0))}"
    assert told.describe("bowl") == phrases.describe("bowl")
    assert Catalogue.model_validate(told.model_dump()) == phrases
    with refused(r"questions\.wording=texts.*texts\.csv"):
        phrases.asking("published", "texts")


def test_what_publishers_add(tmp_path: Path) -> None:
    lines = [f"label_roughness,{SHORT},label_hardness,split_mine,remark", f"2,{BALL},,validation,dented", f",{BOWL}"]
    described = ["description,object_id", '"Smooth, and soft.\nOld.",ball']
    loaded = load_catalogue(write(tmp_path, *lines, descriptions=described))
    ball, bowl = loaded.objects.values()
    assert (ball.stated, bowl.stated) == ((None, 2, None), (None, None, None))
    assert (ball.material, ball.part_of, ball.part, ball.ratings) == ("", "", "", ((1, 1, 2), (0,), (0, 0, 1)))
    assert loaded.labels("ball") == (1, 0, 0), "labels follow from the ratings, whatever is stated"
    assert (ball.description, bowl.description) == ("Smooth, and soft.\nOld.", "")
    assert (ball.splits, bowl.splits) == ({"mine": Part.VALIDATION}, {"mine": Part.UNUSED})
    assert loaded.split_names == ("mine",)
    assert load_catalogue(write(tmp_path, SHORT, BALL)).split_names == ()


def test_a_spreadsheet_s_csv_is_read(tmp_path: Path) -> None:
    lines = [SHORT.replace(",", " , "), "", BALL.replace(",", ", "), ",,,,"]
    loaded = load_catalogue(write(tmp_path, *lines, descriptions=["object_id,description"], encoding="utf-8-sig"))
    assert loaded.objects["ball"].name == "a ball"
    as_decimals = "ball,a ball,1.0 1 2.00,0,0 0 1"
    assert load_catalogue(write(tmp_path, SHORT, as_decimals)).objects == loaded.objects
    with refused(r"objects\.csv.*UTF-8"):
        load_catalogue(write(tmp_path, SHORT, BALL.replace("a ball", "a käse"), encoding="latin-1"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "combined"}, "combined.*rename"),
        ({"levels": ["flat", "hard to grip", "bumpy"]}, "hardness.*'hard'.*'hard to grip'"),
        ({"cues": [["even"], [], ["small bumps"]]}, "bumpiness.*'small bumps'.*two levels"),
        ({"alone": "Overall, it has bumps."}, r"bumpiness.*alone.*\{level\}"),
        ({"unstructured": "{hardness}, {roughness}."}, "does not name bumpiness"),
        ({"target": {"hardness": [3]}}, "stains.*hardness.*0 to 2"),
    ],
)
def test_a_language_that_cannot_be_graded_is_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    """Of its sentences, its first scenario, or its last property."""
    write(tmp_path, SHORT, BALL)
    language = yaml.safe_load((PHYSICLEAR / "properties.yaml").read_text())
    changed = language if changes.keys() & language.keys() else language["properties"][-1]
    (language["scenarios"][0] if "target" in changes else changed).update(changes)
    (tmp_path / "properties.yaml").write_text(yaml.safe_dump(language))
    with refused(words):
        load_catalogue(tmp_path)


@pytest.mark.parametrize(
    ("text", "hardness", "roughness", "bumpiness"),
    [
        ("Hard and smooth, with no bumps.", {2}, {0}, {0}),
        ("It is MODERATELY\nhard.", {1}, set(), set()),
        ("It lacks noticeable roughness.", set(), {0}, set()),
        ("not rough, and without bumps", set(), {0}, {0}),
        ("a slight roughness and small irregularities", set(), {1}, {1}),
        ("prominent bumps, but not bumpy all over", set(), set(), {0, 2}),
        ("It is squishy where it is not hard.", {0}, set(), set()),
        ("hardly softened, roughly smoothed", set(), set(), set()),
        ("neither hard nor soft", {1}, set(), set()),
    ],
)
def test_free_text_names_classes(text: str, hardness: set[int], roughness: set[int], bumpiness: set[int]) -> None:
    assert [levels_named(text, p) for p in CATALOGUE.properties] == [hardness, roughness, bumpiness]


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


def test_a_phrase_need_not_end_in_a_letter() -> None:
    assert mentioned("It is 100% (wet)!", ["100%", "wet)", "00%"]) == ["100%", "wet)"]


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


def test_missing_objects_are_reported() -> None:
    tested = {o for o in OBJECTS if CATALOGUE.objects[o].splits["paper"] == Part.TEST}
    present = {*OBJECTS} - tested - {"denim"}
    assert not parts(present, name="paper")[Part.TEST]
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

"""A model's copy for another sensor, by videos alone and by rated ones: against float64 of what its heads see."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from scipy.special import log_softmax, logsumexp

from pipeline.encoder.embed import standardize
from pipeline.training.embeddings import Statistics
from pipeline.use.adapt import adapt, as_learnt, rated_videos
from pipeline.use.few_ratings import Known, Rated, Way, fit, read_anew, standardised
from pipeline.use.folder import CONFIG, find_base, read_folder
from pipeline.use.model import UNRATED, Octopi
from pipeline.videos.catalogue import PROPERTIES, Catalogue, load_catalogue
from tests.checkpoints import edit, model_folder
from tests.conftest import ROOT, refused, write_video
from tests.use.shared import Made

EXAMPLES = ROOT / "examples"
VIDEOS = [EXAMPLES / f"{name}.mp4" for name in ("soft", "hard", "rough")]
CLASSES = [3, 2]


def planted(objects: int, seed: int = 0) -> tuple[Rated, Known]:
    """Two videos an object of three frames; the old heads' logits tell the classes, on another sensor's scale."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.stack([np.arange(objects) % 3, np.arange(objects) // 3 % 2], axis=1), 2, axis=0)
    told = np.concatenate([np.eye(3)[labels[:, 0]], np.eye(2)[labels[:, 1]]], axis=1)
    clips = np.concatenate([7 + 20 * told, np.zeros((len(told), 40))], axis=1)[:, None]
    clips = (clips + rng.normal(size=(len(told), 3, 45))).astype(np.float32)
    linear = np.eye(5, 45), np.zeros(5)
    return Rated(clips, labels, np.repeat([f"o{n:02}" for n in range(objects)], 2)), Known(linear, alike=True)


@pytest.mark.parametrize(("objects", "alike"), [(4, True), (12, True), (12, False)])
def test_new_heads_find_classes_that_others_heads_tell(objects: int, alike: bool) -> None:
    rated, known = planted(objects)
    read = read_anew(rated, CLASSES, known._replace(alike=alike), 0)
    np.testing.assert_array_equal(read.heads.predict(rated.clips), rated.labels)
    if objects == 12:
        assert (read.predicted == rated.labels).mean() > 0.9
    weights, biases = read.heads.linear()
    assert weights.shape == (5, 45)
    assert biases.shape == (5,)


def test_five_objects_are_tested_by_heads_chosen_like_those_that_ship() -> None:
    """Among several ways, though the four that are left without a tested one are too few to choose by."""
    rated, known = planted(5)
    read = read_anew(rated, CLASSES, known, 0)
    for name in {*rated.objects}:
        there = rated.objects == name
        told = [fit(rated.of(~there), CLASSES, known, w).evidence(rated.clips[there]) for w in Way if w is not Way.OLD]
        own = [table[there] for table in read.evidence]
        assert any(np.allclose(table, own[0]) for table, _ in told)


def test_an_object_is_tested_by_heads_that_never_saw_it() -> None:
    """Labels that nothing tells: heads know those of their own objects, and guess those that are held out."""
    rated, known = planted(20)
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(20, 1, 300)).repeat(2, axis=0).repeat(3, axis=1).astype(np.float32)
    labels = rng.integers(0, 2, (20, 2)).repeat(2, axis=0)
    blind = Rated(noise + 0.01 * rng.normal(size=noise.shape).astype(np.float32), labels, rated.objects)
    read = read_anew(blind, CLASSES, Known((np.eye(5, 300), np.zeros(5)), alike=False), 0)
    own = fit(blind, CLASSES, known, Way.FEATURES).predict(blind.clips)
    assert (own == labels).mean() > 0.9
    assert (read.predicted == labels).mean() < 0.75


def test_a_constant_logit_tells_nothing_and_breaks_nothing() -> None:
    rated, known = planted(6)
    linear = known.linear[0].copy()
    linear[2] = 0
    weights, biases = standardised((linear, known.linear[1]), rated.clips)
    logits = rated.clips.reshape(-1, 45) @ weights.T + biases
    np.testing.assert_allclose(logits.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(logits.std(axis=0), [1, 1, 0, 1, 1], atol=1e-6)


def test_new_logits_are_read_as_the_old_ones() -> None:
    """The same differences, but for a class that nobody has, whose logit lies where some did in training."""
    rng, classes = np.random.default_rng(0), [2, 3, 2]
    clips = rng.normal(size=(30, 5, 7)).astype(np.float32)
    known = Statistics(torch.tensor(rng.normal(size=7) / 4), torch.tensor(rng.uniform(1, 2, 7)), "frames")
    weights, biases = rng.normal(size=(7, 7)), rng.normal(size=7) / 4
    weights[5:], biases[4], biases[5:] = 0, -10, (0, -10)
    found = as_learnt(known, (weights, biases), clips, classes)
    assert found.frames == "frames"
    seen = standardize(torch.from_numpy(clips.reshape(-1, 7)), found).double()
    logits = clips.reshape(-1, 7).astype(np.float64) @ weights.T + biases
    read = (seen * known.scale + known.mean).numpy()
    for whole, present in ((slice(0, 2), slice(0, 2)), (slice(2, 5), slice(2, 4))):
        factor = np.sqrt((known.scale[whole] ** 2).mean().item() / logits[:, whole].var(axis=0).mean())
        np.testing.assert_allclose(read[:, present], factor * logits[:, present], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(seen.mean(0)[[4, 6]], torch.tensor([-1.0, -1.0]).double(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(seen[:, 5:].std(0, correction=0), torch.zeros(2).double())
    # A copy of a copy remembers no class that nobody had.
    other = rng.normal(size=(7, 7)), rng.normal(size=7)
    assert all(map(torch.equal, *(as_learnt(first, other, clips, classes).heads for first in (known, found))))


@pytest.fixture(scope="module")
def octopi() -> Octopi:
    return Octopi.from_pretrained(base=model_folder("smollm2"), dtype="float32")


@pytest.mark.slow
def test_without_ratings_logits_are_standardised(octopi: Octopi, tmp_path: Path) -> None:
    adapt(octopi, VIDEOS, tmp_path / "mine")
    mine = Octopi.from_pretrained(tmp_path / "mine", base=model_folder("smollm2"), dtype="float32")
    before, after = (torch.cat([m.encoder.encode(v).features for v in VIDEOS]).double() for m in (octopi, mine))
    expected = (before - before.mean(0)) / before.std(0, correction=0)
    _, scale, *_ = known = octopi.encoder.statistics
    read = (after * scale + known.mean).view(-1, 3, 3)
    factor = scale.view(3, 3).square().mean(1).sqrt()
    torch.testing.assert_close(read, expected.view(-1, 3, 3) * factor[:, None], rtol=1e-4, atol=1e-4)
    for place, video in enumerate(VIDEOS):
        logits = expected.view(3, -1, 9)[place].split(3, dim=1)
        found, temperatures = mine.encoder.classify(video).probabilities, mine.config.temperatures.values()
        for probabilities, own, temperature in zip(found, logits, temperatures, strict=True):
            pooled = logsumexp(log_softmax(own.numpy(), axis=1), axis=0) / temperature
            np.testing.assert_allclose(probabilities, np.exp(log_softmax(pooled)), atol=2e-3)
    assert not mine.config.scores, "they were another's"
    assert (octopi.config.calibrated, mine.config.calibrated) == (False, False)
    assert mine.doubts == (UNRATED,)
    assert mine.ask("Is it soft?", VIDEOS[0])
    with refused("is there already"):
        adapt(octopi, VIDEOS, tmp_path / "mine")
    told = tmp_path / "mine" / CONFIG
    edit(told, language="none")
    with refused("config.json: language"):
        read_folder(tmp_path / "mine")


@pytest.mark.slow
@pytest.mark.parametrize("other", [False, True], ids=["its own properties", "others"])
def test_with_ratings_heads_know_them(octopi: Octopi, catalogue: Catalogue, tmp_path: Path, other: bool) -> None:
    """The language model reads the new logits, each property's times a factor, as the old ones, or is not asked."""
    ratings = catalogue
    if other:  # Six classes, where the language model reads nine logits.
        shutil.copytree(EXAMPLES / "new_sensor", lab := tmp_path / "lab")
        properties = yaml.safe_load((lab / PROPERTIES).read_text(encoding="utf-8"))
        del properties["properties"][2]
        properties |= dict.fromkeys(("structured", "unstructured"), "Overall, {hardness}, {roughness}.")
        (lab / PROPERTIES).write_text(yaml.safe_dump(properties), encoding="utf-8")
        ratings = load_catalogue(lab)
    names = ["foam", "brick", "sandpaper"] if other else ["sponge_soft", "wood_ruler", "rug"]
    (tmp_path / "videos").mkdir()
    for name, video in zip(names, VIDEOS, strict=True):
        for number in range(2):
            shutil.copy(video, tmp_path / "videos" / f"{name}_{number}.mp4")
    shutil.copy(VIDEOS[0], tmp_path / "videos" / "unrated_0.mp4")
    found = rated_videos([tmp_path / "videos"], ratings)
    assert len(found) == 6
    told = adapt(octopi, [*found], tmp_path / "mine", catalogue=ratings, objects=[*found.values()])
    assert "3 rated objects (6 videos)" in told
    mine = Octopi.from_pretrained(tmp_path / "mine", base=model_folder("smollm2"), dtype="float32")
    assert (mine.doubts, mine.config.calibrated) == ((), True)
    described = mine.describe(VIDEOS[0])
    right = [p.levels[level] for p, level in zip(ratings.properties, ratings.labels(names[0]), strict=True)]
    assert not other or list(described.levels.values()) == right
    assert set(described.levels) == set(ratings.property_names)
    assert bool(described.sentence) is not other
    assert len(mine.rank(VIDEOS, ratings.properties[0].name).order) == 3
    assert bool(mine.match(VIDEOS, names).answer) is not other
    if other:
        with refused("knows other properties"):
            mine.ask("Is it soft?", VIDEOS[0])
    if not other:
        # Each object held out once, by heads that are fitted anew without it.
        clips = np.stack([octopi.encoder.encode(video).raw.numpy() for video in found])
        objects, (mean, scale, _, heads) = np.array([*found.values()]), octopi.encoder.statistics
        assert heads is not None
        rated = Rated(clips, np.array([ratings.labels(o) for o in objects]), objects)
        known, right = Known((heads[0].numpy(), heads[1].numpy()), alike=True), []
        for name in names:
            there = objects == name
            read = fit(rated.of(~there), [3, 3, 3], known, Way.OLD)
            right.append((read.predict(clips[there]) == rated.labels[there]).all(axis=1))
        assert f"all properties right in {100 * np.mean(right):.1f} %" in told
        weights, biases = fit(rated, [3, 3, 3], known, Way.OLD).linear()
        logits = (clips.reshape(-1, clips.shape[2]) @ weights.T + biases).reshape(-1, 3, 3)
        seen = np.concatenate([mine.encoder.encode(video).features.numpy() for video in found])
        factor = np.sqrt((scale.numpy().reshape(3, 3) ** 2).mean(1) / logits.var(axis=0).mean(1))
        shown = (seen * scale.numpy() + mean.numpy()).reshape(-1, 3, 3)
        np.testing.assert_allclose(shown, logits * factor[:, None], rtol=1e-3, atol=1e-3)
    with refused("has met"):
        adapt(mine, [*found], tmp_path / "again", catalogue=ratings, objects=[*found.values()])
    for video in found:
        video.rename(video.with_name(f"new_{video.name}"))
    news = {f"new_{o}": ratings.objects[o].model_copy(update={"object_id": f"new_{o}"}) for o in names}
    found = rated_videos([tmp_path / "videos"], more := ratings.model_copy(update={"objects": news}))
    again = adapt(mine, [*found], tmp_path / "again", catalogue=more, objects=[*found.values()])
    assert ("heads alone answer" in again) is other, "a copy of a copy says it, too"
    assert mine.numbered, "the language model knows no other names, whatever the catalogue has"
    adapt(mine, VIDEOS, inner := tmp_path / "mine" / "inner")
    copy, _ = read_folder(inner)
    assert {f.relative_to(inner).as_posix() for f in inner.rglob("*") if f.is_file()} == {*copy.files, CONFIG}
    assert (copy.rated, copy.calibrated) == (True, False), "its temperatures were those of other logits"


@pytest.mark.slow
def test_what_cannot_be_adapted(octopi: Octopi, catalogue: Catalogue, tmp_path: Path) -> None:
    with refused("1 rated object with touches"):
        adapt(octopi, VIDEOS, tmp_path / "mine", catalogue=catalogue, objects=["rug"] * 3)
    with refused("name the folder of videos"):
        rated_videos(VIDEOS[:1], catalogue)
    assert not (tmp_path / "mine").exists()


def test_heads_of_another_recipe_stay(
    made: Made, files: list[Path], catalogue: Catalogue, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = Octopi.from_pretrained(made.folder, device="cpu")
    with refused("heads are read anew where it has been fine-tuned with encoder.recipe=tuned"):
        adapt(model, files, tmp_path / "mine", catalogue=catalogue, objects=["rug", "pillow"])
    still = write_video(tmp_path / "still.avi", np.full((12, 48, 64, 3), 120, np.uint8))
    told = adapt(model, [*files, still], tmp_path / "mine")
    assert f"standardised by {len(files)} videos" in told
    assert "still.avi: left out, nothing touches the sensor" in caplog.text
    base, _ = find_base(made.folder, model.config.base)
    mine = Octopi.from_pretrained(tmp_path / "mine", base=base, device="cpu")
    assert mine.encoder.classify(files[0]) == model.encoder.classify(files[0])

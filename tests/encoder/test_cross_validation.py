"""Cross-validation of the encoder: honest, shared folds, kept over kills."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import CrossValidationConfig, EncoderConfig, Recipe
from pipeline.core.records import Assignment, Measurement, Part
from pipeline.core.runtime import derive_seed
from pipeline.encoder import cross_validation as module
from pipeline.encoder import frame_classifier
from pipeline.encoder.cross_validation import cross_validate_model
from pipeline.encoder.data import ClipDataset, EncoderData
from pipeline.encoder.finetune import Training, finetune
from pipeline.encoder.folds import Fold, Predict, deal
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.encoder.tuned import Trunks
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.weights import backbone_files
from tests.conftest import refused
from tests.encoder.conftest import relabelled
from tests.encoders import CPU, config, write_frames, write_pretrained, write_timm

OBJECTS = ("baseball", "controller_base", "cotton_ball", "ice_block", "millet", "pillow", "rug")
CONFIG = CrossValidationConfig(folds=3, repeats=2, seed=4)
SMALL = CrossValidationConfig(folds=2, repeats=1, seed=4)
CONSTANT = module.MODELS["constant"]
pytestmark = pytest.mark.usefixtures("elsewhere", "few_fits")


@pytest.fixture
def training(weights: Path, catalogue: Catalogue) -> Training:
    """Two videos an object and one more of the first; the pictures of an object are all of one grey of its own."""
    videos = {f"{o}_{i}": o for o in OBJECTS for i in range(3 if o == "baseball" else 2)}
    write_frames(Path("frames"), dict.fromkeys(videos, 3))
    assignments = [Assignment(video_id=v, object_id=o, part=Part.UNUSED) for v, o in videos.items()]
    data = EncoderData(FrameStore(Path("frames")), catalogue, assignments, 2)
    setting = EncoderConfig(weights=str(weights), prompts=2, epochs=2, batch_size=4)
    return painted(Training(data, setting, CPU, 0, ()), [20 + 30 * OBJECTS.index(o) for o in videos.values()])


def painted(training: Training, greys: Sequence[int]) -> Training:
    """Give the three frames of each video one grey."""
    pixels = np.load("frames/frames.npy")
    pixels[:] = np.repeat(greys, 3)[:, None, None, None]
    np.save("frames/frames.npy", pixels)
    return encoded(training, training.config)


def encoded(training: Training, setting: EncoderConfig) -> Training:
    """The same videos for another encoder."""
    data = replace(training.data, store=FrameStore(Path("frames"), setting.reference))
    return replace(training, data=data, config=setting, inputs=backbone_files(setting))


class Telling(FrameEncoder):
    """Says of a picture what its first pixel is, and little else."""

    def __init__(self, *_: object) -> None:
        super().__init__(3)

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        numbers = frame_indices.float()
        return torch.stack([frames[:, 0, 0, 0].float(), numbers, numbers**2], dim=1)


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80), st.integers(2, 7), st.integers(0, 99))
def test_folds_hold_whole_objects_and_are_even(numbers: list[int], folds: int, seed: int) -> None:
    objects = [f"o{n}" for n in numbers]
    folds = min(folds, len(set(objects)))
    dealt = deal(objects, folds, seed)
    assert sorted(itertools.chain.from_iterable(dealt)) == sorted(set(objects))
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert dealt == deal(objects[::-1], folds, seed)


def test_a_tested_objects_own_label_changes_nothing(training: Training, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each object has a grey of its own, so that heads that had learnt from one would know it again."""
    monkeypatch.setattr(module, "SideBySide", Telling)
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (100.0,))
    once = CONFIG.model_copy(update={"repeats": 1})
    whole = cross_validate_model("backbone", training, once)
    assert [r.video_id for r in whole] == [v.video_id for v in training.data.assignments]
    assert all(r.expected == training.data.catalogue.labels(r.object_id) for r in whole)
    changed = False
    for name in OBJECTS[:4]:
        other = cross_validate_model("backbone", replace(training, data=relabelled(training.data, name)), once)
        said, found = ({r.video_id: r.predicted for r in records} for records in (whole, other))
        assert all(said[video] == found[video] for video in said if video.startswith(name))
        changed = changed or said != found
    assert changed, "others learn from it"


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["paper", "release", "tuned"])
def test_what_is_tuned_learns_from_no_object_that_it_is_tested_on(
    recipe: Recipe, training: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some of a fold's objects choose the epoch; what each model says of each video by itself is what is written."""
    write_pretrained()
    folder = Path(training.config.weights) if recipe != "tuned" else write_timm(tmp_path / "timm")
    backbone = {"backbone": ("timm", "scenes"), "feature_stage": 2} if recipe == "tuned" else {}
    training = encoded(training, config(folder, recipe, epochs=1, **backbone))
    parts: list[dict[Part, set[str]]] = []
    said: dict[str, tuple[int, ...]] = {}

    def note(own: Training, *rest: Trunks) -> tuple[PropertyClassifier, list[Measurement]]:
        assert own.config == training.config
        parts.append({p: {a.object_id for a in own.data.assignments if a.part == p} for p in Part})
        model, history = finetune(own, *rest)
        tested = own.data.videos(Part.TEST)
        for video, item in zip(tested, ClipDataset(own.data.store, tested, per_video=2), strict=True):  # type: ignore
            with torch.no_grad():
                logits = model.eval()(item["frames"][None], item["frame_indices"][None])["logits"]
            said[video.video_id] = tuple(model.decide(logits)[0].tolist())
        return model, history

    monkeypatch.setattr(module, "finetune", note)
    found = cross_validate_model("backbone-tuned", training, SMALL)
    assert [p[Part.TEST] for p in parts] == [set(part) for part in deal(OBJECTS, 2, derive_seed(4, "folds", 0))]
    for own in parts:
        assert own[Part.VALIDATION]
        assert not own[Part.UNUSED]
        assert sorted(itertools.chain(*own.values())) == sorted(OBJECTS), "each in one part"
    videos = [v.video_id for v in training.data.assignments]
    assert [(r.video_id, r.predicted) for r in found] == [(v, said[v]) for v in videos]


def test_constant_by_hand(training: Training) -> None:
    """Each object counts once, however many videos it has; of equals the lowest classes."""
    found = cross_validate_model("constant", training, CONFIG)
    videos = [v.video_id for v in training.data.assignments]
    assert [(r.video_id, r.repeat) for r in found] == list(itertools.product(videos, (0, 1)))
    for repeat in range(2):
        for held in deal(OBJECTS, 3, derive_seed(4, "folds", repeat)):
            counts = Counter(training.data.catalogue.labels(o) for o in OBJECTS if o not in held)
            expected = min(c for c, n in counts.items() if n == max(counts.values()))
            assert {r.predicted for r in found if r.repeat == repeat and r.object_id in held} == {expected}
    assert len({r.predicted for r in found}) > 1, "folds differ here"


def test_with_fewer_objects_more_contain_fewer(
    training: Training, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A number behind a model's name is how many objects it learns from, or it says nothing; nothing else changes."""
    owners = np.array([a.object_id for a in training.data.assignments])
    learnt: list[set[str]] = []

    def noting(own: Training) -> Predict:
        def predict(fold: Fold) -> np.ndarray:
            assert fold.trained[np.isin(owners, owners[fold.trained])].all(), "all videos of an object"
            learnt.append(set(owners[fold.trained].tolist()))
            return CONSTANT(own)(fold)

        return predict

    assert len(cross_validate_model("constant-4", training, CONFIG)) == 2 * len(owners)
    assert not caplog.text
    assert cross_validate_model("constant-5", training, CONFIG) == [], "of 7 objects, one fold tests three"
    assert "constant-5: left out, as a fold has only 4 training objects" in caplog.text
    monkeypatch.setitem(module.MODELS, "constant", noting)
    for name in ("constant-1", "constant-3", "constant"):
        cross_validate_model(name, training, CONFIG)
    one, three, every = learnt[:6], learnt[6:12], learnt[12:]
    assert [len(objects) for objects in one + three] == [1] * 6 + [3] * 6
    assert all(a < b < c for a, b, c in zip(one, three, every, strict=True))
    assert len(set(map(frozenset, one))) > 1, "drawn anew for each fold"


def test_what_the_pictures_show_is_found(training: Training, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that show the class itself."""
    hardness = {o: training.data.catalogue.labels(o)[0] for o in OBJECTS}
    training = painted(training, [100 * hardness[a.object_id] for a in training.data.assignments])
    monkeypatch.setattr(module, "SideBySide", Telling)
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (10.0,))
    found = cross_validate_model("backbone", training, CrossValidationConfig(folds=7, repeats=1))
    shared = [r for r in found if list(hardness.values()).count(r.expected[0]) > 1]
    assert len(shared) > 8
    assert all(r.predicted[0] == r.expected[0] for r in shared), "classes that another object has, too"


def kill_after(count: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Make all models constant and interrupt them when asked for one more fold; returns the folds begun."""
    begun: list[tuple[int, int]] = []

    def until(training: Training) -> Predict:
        def counting(fold: Fold) -> np.ndarray:
            if len(begun) == count:
                raise KeyboardInterrupt
            begun.append((fold.repeat, fold.number))
            return CONSTANT(training)(fold)

        return counting

    monkeypatch.setattr(module, "MODELS", dict.fromkeys(module.MODELS, until))
    return begun


def killed(count: int, name: str, training: Training, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        kill_after(count, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_model(name, training, CONFIG)


@pytest.mark.parametrize("count", [0, 4])
def test_folds_survive(count: int, training: Training, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = cross_validate_model("constant", training, CONFIG)
    killed(count, "constant", training, monkeypatch)
    begun = kill_after(99, monkeypatch)
    fewer = CONFIG.model_copy(update={"models": ("constant", "backbone")})
    assert cross_validate_model("constant", training, fewer) == whole, "other models are no matter"
    assert begun == [(r, n) for r in range(2) for n in range(3)][count:]
    assert not any(tmp_path.glob("checkpoints/cross_validation/*")), "kept no longer than needed"


@pytest.mark.parametrize("other", ["model", "labels", "pretraining", "frames", "folds", "code"])
def test_folds_of_other_inputs_settings_or_code_are_not_taken_for_these(
    other: str, training: Training, versions: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    name, setting = "backbone", CONFIG
    write_pretrained()
    training = encoded(training, config(Path("none"), "tuned"))
    killed(2, name, training, monkeypatch)
    match other:
        case "model":
            name = "backbone-tuned"
        case "labels":
            training = replace(training, data=relabelled(training.data, "rug"))
        case "pretraining":
            write_pretrained(1)
        case "frames":
            training = replace(training, data=replace(training.data, per_video=3))
        case "folds":
            setting = CONFIG.model_copy(update={"seed": 5})
        case "code":
            versions("pipeline/training/trainer.py")
    begun = kill_after(99, monkeypatch)
    cross_validate_model(name, training, setting)
    assert len(begun) == 6


@pytest.mark.slow
def test_folds_need_as_many_objects_and_no_more(training: Training) -> None:
    """With one object to train on none is left to validate by."""
    data = replace(training.data, assignments=[a for a in training.data.assignments if a.object_id in OBJECTS[1:3]])
    assert len(cross_validate_model("backbone-tuned", replace(training, data=data), SMALL)) == 4
    with refused("cross_validation.folds is 8 but only 7 objects have videos"):
        cross_validate_model("constant", training, CrossValidationConfig(folds=8))

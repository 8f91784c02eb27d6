"""Cross-validation of the encoder: honest, shared folds, kept over kills."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import Compared, CrossValidationConfig, EncoderConfig, Recipe, RuntimeConfig
from pipeline.core.errors import UserError
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import derive_seed
from pipeline.encoder import cross_validation as module
from pipeline.encoder import finetune, frame_classifier
from pipeline.encoder.clips import ClipDataset, EncoderData
from pipeline.encoder.cross_validation import CrossValidationData, cross_validate_model
from pipeline.encoder.folds import Fold, Predict, cross_validate, deal
from pipeline.encoder.frame_classifier import Clips, FittedHeads, fit_frame_heads
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.videos.catalogue import Catalogue
from tests.conftest import fake_videos
from tests.encoder.conftest import Hook, killed_at
from tests.encoders import config, write_frames, write_pretrained, write_timm

OBJECTS = ("baseball", "controller_base", "cotton_ball", "ice_block", "millet", "pillow", "rug")
CONFIG = CrossValidationConfig(folds=3, repeats=2, seed=4)
SMALL = CrossValidationConfig(folds=2, repeats=1, seed=4)
CONSTANT = module.MODELS["constant"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints go to a folder of the working directory; fewer fits, since they are not what is tested."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (1e-3, 1e-2))
    monkeypatch.setattr(frame_classifier, "FOLDS", 2)


@pytest.fixture
def data(weights: Path, catalogue: Catalogue, tmp_path: Path) -> CrossValidationData:
    """Two videos an object and one more of the first; the pictures of an object are all of one grey of its own."""
    videos = [v for v in fake_videos(OBJECTS, 3) if v.video_id.endswith(("_0", "_1")) or v.object_id == "baseball"]
    folder = write_frames(tmp_path / "frames", {v.video_id: 3 for v in videos})
    paint(folder, [grey(v.object_id) for v in videos])
    return CrossValidationData(
        videos=videos,
        catalogue=catalogue,
        frames=folder,
        per_video=2,
        encoder=EncoderConfig(weights=str(weights), prompts=2, epochs=2, batch_size=4),
        runtime=RuntimeConfig(device="cpu"),
    )


def paint(folder: Path, greys: Sequence[int]) -> None:
    """Give the three frames of each video one grey."""
    pixels = np.load(folder / "frames.npy")
    pixels[:] = np.repeat(greys, 3)[:, None, None, None]
    np.save(folder / "frames.npy", pixels)


def grey(object_id: str) -> int:
    return 20 + 30 * OBJECTS.index(object_id)


class Telling(FrameEncoder):
    """Says of a picture what its first pixel is, and little else."""

    def __init__(self, *_: object) -> None:
        super().__init__(3)

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        numbers = frame_indices.float()
        return torch.stack([frames[:, 0, 0, 0].float(), numbers, numbers**2], dim=1)


def shown(clips: Clips) -> list[str]:
    """Whose pictures `Telling` was shown."""
    return [{grey(o): o for o in OBJECTS}[int(value)] for value in clips[:, 0, 0]]


def objects_of(data: CrossValidationData, chosen: np.ndarray) -> set[str]:
    return {o for o, c in zip(data.objects, chosen, strict=True) if c}


def parts_of(clips: EncoderData, data: CrossValidationData, fold: Fold) -> tuple[frozenset[str], frozenset[str]]:
    """The objects that a training learns from and those that it chooses by, after a look at who they are."""
    train, validation, test, unused = (
        frozenset(a.object_id for a in clips.assignments if a.part == part)
        for part in (Part.TRAIN, Part.VALIDATION, Part.TEST, Part.UNUSED)
    )
    assert test == objects_of(data, fold.tested)
    assert train | validation == objects_of(data, fold.trained)
    assert validation
    assert not validation & train
    assert not unused
    return train, validation


@pytest.fixture
def folds(monkeypatch: pytest.MonkeyPatch) -> list[Fold]:
    """The folds as they are asked for; the last is the one being predicted."""
    seen: list[Fold] = []

    def spying(predict: Predict, *args: object, **settings: int) -> np.ndarray:
        return cross_validate(lambda fold: (seen.append(fold), predict(fold))[1], *args, **settings)  # type: ignore

    monkeypatch.setattr(module, "cross_validate", spying)
    return seen


def dealt(setting: CrossValidationConfig) -> list[set[str]]:
    """The tested objects of every fold, whatever the model."""
    repeats = [deal(OBJECTS, setting.folds, derive_seed(4, "folds", repeat)) for repeat in range(setting.repeats)]
    return [set(part) for parts in repeats for part in parts]


# Folds


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80), st.integers(2, 7), st.integers(0, 99))
def test_folds_hold_whole_objects_and_are_even(numbers: list[int], folds: int, seed: int) -> None:
    objects = [f"o{n}" for n in numbers]
    folds = min(folds, len(set(objects)))
    dealt = deal(objects, folds, seed)
    assert sorted(itertools.chain.from_iterable(dealt)) == sorted(set(objects))
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert dealt == deal(objects[::-1], folds, seed)


# Who learns from what


def test_frozen_backbones_heads_learn_from_no_object_that_they_are_tested_on(
    data: CrossValidationData, folds: list[Fold], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the objects' names and by the pictures themselves, in the final fits and in those that choose."""
    monkeypatch.setattr(module, "SideBySide", Telling)
    fits: list[int] = []

    def spy(clips: Clips, labels: np.ndarray, objects: Sequence[str], *rest: object) -> FittedHeads:
        assert shown(clips) == list(objects)
        assert labels.tolist() == [list(data.catalogue.labels(o)) for o in objects]
        assert set(objects) <= objects_of(data, folds[-1].trained) - objects_of(data, folds[-1].tested)
        fits.append(len(set(objects)))
        fitted = fit_frame_heads(clips, labels, objects, *rest)  # type: ignore[arg-type]

        class Spied(FittedHeads):
            def predict(self, clips: Clips) -> np.ndarray:
                assert not set(shown(clips)) & set(objects)
                return super().predict(clips)

        return Spied(**vars(fitted))

    for place in (module, frame_classifier):
        monkeypatch.setattr(place, "fit_frame_heads", spy)
    found = cross_validate_model("backbone", data, CONFIG)
    assert [(r.video_id, r.repeat) for r in found] == [(v.video_id, n) for v in data.videos for n in (0, 1)]
    assert all(r.expected == data.catalogue.labels(r.object_id) for r in found)
    assert [objects_of(data, f.tested) for f in folds] == dealt(CONFIG)
    assert len(fits) == 6 * (2 * 2 + 1), "two strengths on two inner folds, and the fit itself"
    assert fits[4::5] == [len(objects_of(data, f.trained)) for f in folds]


@pytest.mark.parametrize("recipe", ["paper", "release", "tuned"])
def test_what_is_tuned_learns_from_no_object_that_it_is_tested_on(
    recipe: Recipe, data: CrossValidationData, folds: list[Fold], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some of a fold's objects choose the epoch; what each model says of each video by itself is what is written."""
    write_pretrained()
    folder = Path(data.encoder.weights) if recipe != "tuned" else write_timm(tmp_path / "timm")
    backbone = {"backbone": ("timm", "scenes"), "feature_stage": 2} if recipe == "tuned" else {}
    data = replace(data, encoder=config(folder, recipe, epochs=1, **backbone))
    chosen, said = set(), {}

    def spy(clips: EncoderData, setting: EncoderConfig, *rest: object, **others: object) -> object:
        assert setting == data.encoder
        assert (clips.store.references is None) == (recipe != "tuned")
        chosen.add(parts_of(clips, data, folds[-1])[1])
        model, history = finetune.finetune(clips, setting, *rest, **others)  # type: ignore[arg-type]
        tested = clips.videos(Part.TEST)
        for video, item in zip(tested, ClipDataset(clips.store, tested, per_video=2), strict=True):  # type: ignore
            with torch.no_grad():
                logits = model.eval()(item["frames"][None], item["frame_indices"][None])["logits"]
            said[video.video_id] = tuple(model.decide(logits)[0].tolist())
        return model, history

    monkeypatch.setattr(module, "finetune", spy)
    found = cross_validate_model("backbone-tuned", data, SMALL)
    assert [objects_of(data, f.tested) for f in folds] == dealt(SMALL)
    assert len(chosen) == 2, "drawn anew in each fold"
    assert [(r.video_id, r.predicted) for r in found] == [(v.video_id, said[v.video_id]) for v in data.videos]


# What they say


def test_constant_by_hand(data: CrossValidationData) -> None:
    """Each object counts once, however many videos it has; of equals the lowest classes."""
    found = cross_validate_model("constant", data, CONFIG)
    for repeat in range(2):
        for held in deal(OBJECTS, 3, derive_seed(4, "folds", repeat)):
            counts = Counter(data.catalogue.labels(o) for o in OBJECTS if o not in held)
            expected = min(c for c, n in counts.items() if n == max(counts.values()))
            assert {r.predicted for r in found if r.repeat == repeat and r.object_id in held} == {expected}
    assert len({r.predicted for r in found}) > 1, "folds differ here"


def test_what_the_pictures_show_is_found(data: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that show the class itself."""
    paint(data.frames, [100 * data.catalogue.labels(o)[0] for o in data.objects])
    monkeypatch.setattr(module, "SideBySide", Telling)
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (10.0,))
    found = cross_validate_model("backbone", data, CrossValidationConfig(folds=7, repeats=1))
    shared = [r for r in found if sum(data.catalogue.labels(o)[0] == r.expected[0] for o in OBJECTS) > 1]
    assert len(shared) > 8
    assert all(r.predicted[0] == r.expected[0] for r in shared), "classes that another object has, too"


def test_results_are_repeatable_and_independent_of_the_order(data: CrossValidationData) -> None:
    write_pretrained()
    data = replace(data, encoder=config(Path("none"), "tuned"))
    pixels = np.load(data.frames / "frames.npy")
    pixels += np.random.default_rng(0).integers(0, 20, pixels.shape, dtype=np.uint8)
    np.save(data.frames / "frames.npy", pixels)
    first = cross_validate_model("backbone", data, SMALL)
    torch.rand(7)
    assert cross_validate_model("backbone", data, SMALL) == first
    turned = cross_validate_model("backbone", replace(data, videos=data.videos[::-1]), SMALL)
    assert sorted(turned, key=lambda r: r.video_id) == sorted(first, key=lambda r: r.video_id)


# Kills


def kill_after(count: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Make all models constant and interrupt them when asked for one more fold; returns the folds begun."""
    begun: list[tuple[int, int]] = []

    def until(data: CrossValidationData) -> Predict:
        def counting(fold: Fold) -> np.ndarray:
            if len(begun) == count:
                raise KeyboardInterrupt
            begun.append((fold.repeat, fold.number))
            return CONSTANT(data)(fold)

        return counting

    for name in module.MODELS:
        monkeypatch.setitem(module.MODELS, name, until)
    return begun


def killed(count: int, name: Compared, data: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        kill_after(count, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_model(name, data, CONFIG)


@pytest.mark.parametrize("count", [0, 4])
def test_finished_folds_survive_a_kill(
    count: int, data: CrossValidationData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = cross_validate_model("constant", data, CONFIG)
    killed(count, "constant", data, monkeypatch)
    begun = kill_after(99, monkeypatch)
    fewer = CONFIG.model_copy(update={"models": ("constant", "backbone")})
    assert cross_validate_model("constant", data, fewer) == whole, "other models are no matter"
    assert begun == [(r, n) for r in range(2) for n in range(3)][count:]
    assert not any(tmp_path.glob("checkpoints/cross_validation/*")), "kept no longer than needed"


def relabelled(data: CrossValidationData) -> CrossValidationData:
    """Another rating of one object, as a corrected objects.csv has it."""
    rug = data.catalogue.objects["rug"]
    objects = {**data.catalogue.objects, "rug": rug.model_copy(update={"ratings": ((0, 0, 0), *rug.ratings[1:])})}
    return replace(data, catalogue=Catalogue(language=data.catalogue.language, objects=objects))


@pytest.mark.parametrize("other", ["model", "labels", "pretraining", "frames", "folds", "code"])
def test_folds_of_other_inputs_settings_or_code_are_not_taken_for_these(
    other: str, data: CrossValidationData, versions: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    name: Compared = "backbone"
    setting = CONFIG
    write_pretrained()
    data = replace(data, encoder=config(Path("none"), "tuned"))
    killed(2, name, data, monkeypatch)
    match other:
        case "model":
            name = "backbone-tuned"
        case "labels":
            data = relabelled(data)
        case "pretraining":
            write_pretrained(1)
        case "frames":
            data = replace(data, per_video=3)
        case "folds":
            setting = CONFIG.model_copy(update={"seed": 5})
        case "code":
            versions("pipeline/training/trainer.py")
    begun = kill_after(99, monkeypatch)
    cross_validate_model(name, data, setting)
    assert len(begun) == 6


@pytest.mark.parametrize(("seed", "left"), [(4, 1), (5, 2)], ids=["the same", "other folds"])
def test_a_killed_training_goes_on_only_with_its_own_objects(
    seed: int, left: int, data: CrossValidationData, before_updates: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in the second epoch of two. Else a model would be tested on objects that it learnt from."""
    original, epochs = finetune.train_classifier, []
    begun: list[int] = []
    stop: set[int] = set()
    before_updates(killed_at(stop, begun))

    def counting(
        model: PropertyClassifier, clips: EncoderData, config: EncoderConfig, *rest: object, **others: object
    ) -> list[Measurement]:
        before, epoch = len(begun), math.ceil(len(clips.videos(Part.TRAIN)) / config.batch_size)
        if not stop:
            stop.add(epoch)
        history = original(model, clips, config, *rest, **others)  # type: ignore[arg-type]
        epochs.append((len(begun) - before) / epoch)
        return history

    monkeypatch.setattr(finetune, "train_classifier", counting)
    with pytest.raises(KeyboardInterrupt):
        cross_validate_model("backbone-tuned", data, SMALL)
    cross_validate_model("backbone-tuned", data, SMALL.model_copy(update={"seed": seed}))
    assert epochs == [left, 2]


def test_folds_need_as_many_objects_and_no_more(data: CrossValidationData) -> None:
    """With one object to train on none is left to validate by."""
    few = replace(data, videos=[v for v in data.videos if v.object_id in OBJECTS[1:3]])
    assert len(cross_validate_model("backbone-tuned", few, SMALL)) == 4
    with pytest.raises(UserError, match=r"cross_validation.folds is 8 but only 7 objects have videos"):
        cross_validate_model("constant", data, CrossValidationConfig(folds=8))

"""The candidates' cross-validation: honest, shared folds, kept over kills."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.config import CrossValidationConfig, EncoderConfig, RuntimeConfig
from pipeline.core.errors import UserError
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import derive_seed
from pipeline.encoder import clips as clips_module
from pipeline.encoder import cross_validation as module
from pipeline.encoder import finetune, frame_classifier, tuned
from pipeline.encoder.candidates import CANDIDATES, Candidate, check_candidates
from pipeline.encoder.clips import EncoderData, LabelledVideo
from pipeline.encoder.cross_validation import CrossValidationData, cross_validate_candidate, frozen_encoder
from pipeline.encoder.folds import Fold, Predict, cross_validate, deal
from pipeline.encoder.frame_classifier import Clips, FittedHeads, JointFrameClassifier, fit_frame_heads
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.tuned import Trunks
from pipeline.videos.catalogue import Catalogue
from tests.conftest import fake_videos
from tests.encoder.conftest import Hook, killed_at
from tests.encoders import config, write_frames, write_pretrained, write_timm

OBJECTS = ("baseball", "controller_base", "cotton_ball", "ice_block", "millet", "pillow", "rug")
CONFIG = CrossValidationConfig(folds=3, repeats=2, seed=4)
SMALL = CrossValidationConfig(folds=2, repeats=1, seed=4)
CONSTANT = module.KINDS["constant"]


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


# Who learns from what


def test_frame_heads_learn_from_no_object_that_they_are_tested_on(
    data: CrossValidationData, folds: list[Fold], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the objects' names and by the pictures themselves, in the final fits and in those that choose."""
    monkeypatch.setattr(module, "frozen_encoder", Telling)
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

    monkeypatch.setattr(frame_classifier, "fit_frame_heads", spy)
    found = cross_validate_candidate(CANDIDATES["probe"], data, CONFIG)
    assert [(r.video_id, r.repeat) for r in found] == [(v.video_id, n) for v in data.videos for n in (0, 1)]
    assert all(r.expected == data.catalogue.labels(r.object_id) for r in found)
    assert len(fits) == 6 * (2 * 2 + 1), "two strengths on two inner folds, and the fit itself"
    assert fits[4::5] == [len(objects_of(data, f.trained)) for f in folds]


@pytest.mark.parametrize("name", ["paper", "paper-difference", "release", "scratch"])
def test_gradients_learn_from_no_object_that_they_are_tested_on(
    name: str, data: CrossValidationData, folds: list[Fold], monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen: list[frozenset[str]] = []

    def spy(
        model: PropertyClassifier, clips: EncoderData, config: EncoderConfig, *_: object, **__: object
    ) -> list[Measurement]:
        chosen.append(parts_of(clips, data, folds[-1])[1])
        assert config.recipe == ("release" if name == "release" else "paper")
        assert (clips.store.references is None) == (name in ("paper", "release"))
        assert isinstance(model.encoder, SceneEncoder) == (name == "scratch")
        assert CANDIDATES[name].settings.items() <= config.model_dump().items()
        # What normalises over a batch, or has a batch size of its own, is not computed in parts.
        assert config.micro_batch_size == (2 if name.startswith("paper") else 0)
        return []

    monkeypatch.setattr(finetune, "train_classifier", spy)
    data = replace(data, encoder=data.encoder.model_copy(update={"micro_batch_size": 2}))
    found = cross_validate_candidate(CANDIDATES[name], data, CONFIG)
    assert len(chosen) == len(folds) == 6
    assert len(set(chosen)) > 1, "drawn anew in each fold"
    assert all(0 <= p < 3 for r in found for p in r.predicted)


def test_tuning_learns_from_no_object_that_it_is_tested_on(
    data: CrossValidationData, folds: list[Fold], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trunks are run once for all folds, over frames alone; the rest is the fold's."""
    write_pretrained()
    folder = write_timm(tmp_path / "timm")
    setting = config(folder, "tuned", backbone=("timm", "scenes"), feature_stage=2, epochs=1)
    original, run, ran, tuned_on = finetune.tune, tuned.run_trunks, [], []

    def spy(model: JointFrameClassifier, trunks: Trunks, clips: EncoderData, *rest: object, **others: object) -> object:
        assert clips.store.references is not None
        tuned_on.append(parts_of(clips, data, folds[-1])[0])
        return original(model, trunks, clips, *rest, **others)  # type: ignore[arg-type]

    monkeypatch.setattr(finetune, "tune", spy)
    monkeypatch.setattr(tuned, "run_trunks", lambda *given, **more: ran.append(1) or run(*given, **more))
    found = cross_validate_candidate(CANDIDATES["backbone-tuned"], replace(data, encoder=setting), SMALL)
    assert (len(ran), len(tuned_on), len(set(tuned_on))) == (1, 2, 2)
    assert [r.video_id for r in found] == [v.video_id for v in data.videos]
    frozen = cross_validate_candidate(CANDIDATES["backbone"], replace(data, encoder=setting), SMALL)
    assert [r.video_id for r in frozen] == [v.video_id for v in data.videos]


def test_all_candidates_share_their_folds(
    data: CrossValidationData, folds: list[Fold], monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in module.KINDS:
        monkeypatch.setitem(module.KINDS, kind, CONSTANT)
    seen = set()
    for candidate in CANDIDATES.values():
        folds.clear()
        cross_validate_candidate(candidate, data, CONFIG)
        seen.add(tuple((f.repeat, f.number, f.tested.tobytes(), f.trained.tobytes()) for f in folds))
    assert len(seen) == 1
    dealt = [deal(OBJECTS, 3, derive_seed(4, "folds", repeat)) for repeat in range(2)]
    assert [objects_of(data, f.tested) for f in folds] == [set(part) for parts in dealt for part in parts]
    assert all((f.trained != f.tested).all() for f in folds)


# What they say


def test_constant_by_hand(data: CrossValidationData) -> None:
    """Each object counts once, however many videos it has; of equals the lowest classes."""
    found = cross_validate_candidate(CANDIDATES["constant"], data, CONFIG)
    for repeat in range(2):
        for held in deal(OBJECTS, 3, derive_seed(4, "folds", repeat)):
            counts = Counter(data.catalogue.labels(o) for o in OBJECTS if o not in held)
            expected = min(c for c, n in counts.items() if n == max(counts.values()))
            assert {r.predicted for r in found if r.repeat == repeat and r.object_id in held} == {expected}
    assert len({r.predicted for r in found}) > 1, "folds differ here"


def test_what_the_pictures_show_is_found(data: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that show the class itself."""
    paint(data.frames, [100 * data.catalogue.labels(o)[0] for o in data.objects])
    monkeypatch.setattr(module, "frozen_encoder", Telling)
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (10.0,))
    found = cross_validate_candidate(CANDIDATES["probe"], data, CrossValidationConfig(folds=7, repeats=1))
    shared = [r for r in found if sum(data.catalogue.labels(o)[0] == r.expected[0] for o in OBJECTS) > 1]
    assert len(shared) > 8
    assert all(r.predicted[0] == r.expected[0] for r in shared), "classes that another object has, too"


@pytest.mark.parametrize("name", ["probe-difference", "pretrained"])
def test_results_are_repeatable_and_independent_of_the_order(name: str, data: CrossValidationData) -> None:
    candidate = CANDIDATES[name]
    write_pretrained()
    pixels = np.load(data.frames / "frames.npy")
    pixels += np.random.default_rng(0).integers(0, 20, pixels.shape, dtype=np.uint8)
    np.save(data.frames / "frames.npy", pixels)
    first = cross_validate_candidate(candidate, data, SMALL)
    torch.rand(7)
    assert cross_validate_candidate(candidate, data, SMALL) == first
    turned = cross_validate_candidate(candidate, replace(data, videos=data.videos[::-1]), SMALL)
    assert sorted(turned, key=lambda r: r.video_id) == sorted(first, key=lambda r: r.video_id)


def test_the_pretrained_network_is_loaded(data: CrossValidationData) -> None:
    with pytest.raises(UserError, match="encoder.safetensors: no such file"):
        frozen_encoder(CANDIDATES["pretrained"], data)
    pretrained = write_pretrained(77).state_dict()
    loaded = frozen_encoder(CANDIDATES["pretrained"], data).get_submodule("backbones.0").state_dict()
    assert all(torch.equal(v, loaded[n]) for n, v in pretrained.items())


def test_as_many_frames_as_the_name_says(data: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "frozen_encoder", Telling)
    shapes: list[tuple[int, ...]] = []
    original = clips_module.describe_clips

    def seen(
        encoder: FrameEncoder, data: EncoderData, videos: Sequence[LabelledVideo], size: int, device: torch.device
    ) -> Clips:
        found = original(encoder, data, videos, size, device)
        shapes.append(found.shape)
        return found

    monkeypatch.setattr(clips_module, "describe_clips", seen)
    for name in ("", "-one-frame", "-ten-frames"):
        module.KINDS["frame_heads"](CANDIDATES[f"pretrained{name}"], data)
    assert shapes == [(15, frames, 3) for frames in (2, 1, 10)]


# Kills


def kill_after(count: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Make all candidates constant and interrupt them when asked for one more fold; returns the folds begun."""
    begun: list[tuple[int, int]] = []

    def until(candidate: Candidate, data: CrossValidationData) -> Predict:
        def counting(fold: Fold) -> np.ndarray:
            if len(begun) == count:
                raise KeyboardInterrupt
            begun.append((fold.repeat, fold.number))
            return CONSTANT(candidate, data)(fold)

        return counting

    for kind in module.KINDS:
        monkeypatch.setitem(module.KINDS, kind, until)
    return begun


def killed(count: int, candidate: Candidate, data: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        kill_after(count, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_candidate(candidate, data, CONFIG)


@pytest.mark.parametrize("count", [0, 4, 5])
def test_finished_folds_survive_a_kill(
    count: int, data: CrossValidationData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = cross_validate_candidate(CANDIDATES["constant"], data, CONFIG)
    killed(count, CANDIDATES["constant"], data, monkeypatch)
    begun = kill_after(99, monkeypatch)
    fewer = CONFIG.model_copy(update={"models": ("constant",)})
    assert cross_validate_candidate(CANDIDATES["constant"], data, fewer) == whole, "other models are no matter"
    assert begun == [(r, n) for r in range(2) for n in range(3)][count:]
    assert not any(tmp_path.glob("checkpoints/cross_validation/*")), "kept no longer than needed"


def relabelled(data: CrossValidationData) -> CrossValidationData:
    """Another rating of one object, as a corrected objects.csv has it."""
    rug = data.catalogue.objects["rug"]
    objects = {**data.catalogue.objects, "rug": rug.model_copy(update={"ratings": ((0, 0, 0), *rug.ratings[1:])})}
    return replace(data, catalogue=Catalogue(language=data.catalogue.language, objects=objects))


@pytest.mark.parametrize("other", ["labels", "pretraining", "frames", "folds", "code"])
def test_folds_of_other_inputs_settings_or_code_are_not_taken_for_these(
    other: str, data: CrossValidationData, versions: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    candidate, config = CANDIDATES["pretrained"], CONFIG
    write_pretrained()
    killed(2, candidate, data, monkeypatch)
    match other:
        case "labels":
            data = relabelled(data)
        case "pretraining":
            write_pretrained(1)
        case "frames":
            candidate = replace(candidate, frames=3)
        case "folds":
            config = CONFIG.model_copy(update={"seed": 5})
        case "code":
            versions("pipeline/training/trainer.py")
    begun = kill_after(99, monkeypatch)
    cross_validate_candidate(candidate, data, config)
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
        cross_validate_candidate(CANDIDATES["paper"], data, SMALL)
    cross_validate_candidate(CANDIDATES["paper"], data, SMALL.model_copy(update={"seed": seed}))
    assert epochs == [left, 2]


# Candidates


def test_a_candidate_that_cannot_be_trained_is_one_clear_line(weights: Path, tmp_path: Path) -> None:
    paper, other = config(weights, "paper"), config(weights, "tuned")
    check_candidates([name for name in CANDIDATES if name != "backbone-tuned"], paper, 32)
    check_candidates([n for n in CANDIDATES if n not in ("paper", "paper-difference", "scratch")], other, 32)
    with pytest.raises(UserError, match=r"^cross_validation.models: pretraind is no model; did you mean pretrained\?"):
        check_candidates(("paper", "pretraind"), paper, 32)
    for names, setting in ((("constant", "paper"), "release"), (("scratch",), "tuned"), (("backbone-tuned",), "paper")):
        with pytest.raises(
            UserError, match=rf"{names[-1]} would be trained with the settings of encoder.recipe={setting}"
        ):
            check_candidates(names, config(weights, setting), 32)
    folder = write_timm(tmp_path / "timm")
    check_candidates(("constant", "backbone", "backbone-tuned"), config(folder, "tuned"), 32)
    for name in ("probe", "release"):
        with pytest.raises(
            UserError, match=rf"{name} needs clip; leave it out, or: .*timm.open_clip_config.json does not exist"
        ):
            check_candidates((name,), config(folder, "tuned"), 32)
    with pytest.raises(UserError, match=r"probe needs clip; leave it out, or: .*frames\.pixels is 24"):
        check_candidates(("probe",), other, 24)


def test_folds_need_as_many_objects_and_no_more(data: CrossValidationData) -> None:
    """With one object to train on none is left to validate by."""
    few = replace(data, videos=[v for v in data.videos if v.object_id in OBJECTS[1:3]])
    assert len(cross_validate_candidate(CANDIDATES["paper"], few, SMALL)) == 4
    with pytest.raises(UserError, match=r"cross_validation.folds is 8 but only 7 objects have videos"):
        cross_validate_candidate(CANDIDATES["constant"], data, CrossValidationConfig(folds=8))

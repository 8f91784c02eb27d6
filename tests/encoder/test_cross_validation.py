"""The candidates' cross-validation: honest, shared folds, kept over kills."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pipeline.encoder.frame_heads import Clips, FittedHeads, fit_frame_heads
from pydantic import ValidationError
from torch.optim.optimizer import register_optimizer_step_pre_hook

from pipeline.config import CrossValidationConfig, EncoderConfig, RuntimeConfig
from pipeline.encoder import cross_validation as module
from pipeline.encoder import frame_heads as voting
from pipeline.encoder.baseline.features import video_features
from pipeline.encoder.baseline.predictor import PropertyPredictor
from pipeline.encoder.baseline.recordings import Recording, describe, recording_features
from pipeline.encoder.baseline.validation import Fold, Predict, deal
from pipeline.encoder.baseline.validation import cross_validate as fold_by_fold
from pipeline.encoder.candidates import CANDIDATES, LEARNING_CURVE, Candidate
from pipeline.encoder.cross_validation import CrossValidationData, cross_validate_candidate, frozen_encoder
from pipeline.encoder.finetune import EncoderData
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.errors import UserError
from pipeline.io import write_table
from pipeline.records import Measurement, Part, Probe
from pipeline.runtime import derive_seed, seed_everything
from pipeline.scales import compose
from pipeline.scenes.film import write_film
from pipeline.trainable import save_trainable, trainable_state
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.decoding import decode
from pipeline.videos.frames.reference import reference_indices
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.frames.subtraction import subtract
from tests.audit_records import probe
from tests.closure import ROOT
from tests.conftest import encode, fake_videos, moving_square
from tests.encoders import write_frames

OBJECTS = ("baseball", "controller_base", "cotton_ball", "ice_block", "millet", "pillow", "rug")
CONFIG = CrossValidationConfig(folds=3, repeats=2, seed=4)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints go to a folder of the working directory; fewer fits, since they are not what is tested."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(voting, "STRENGTHS", (1e-3, 1e-2))
    monkeypatch.setattr(voting, "FOLDS", 2)


@pytest.fixture
def arena(weights: Path, catalogue: Catalogue, tmp_path: Path) -> CrossValidationData:
    """Two videos an object and one more of the first; the pictures of an object are all of one grey of its own."""
    videos = [v for v in fake_videos(OBJECTS, 3) if v.video_id.endswith(("_0", "_1")) or v.object_id == "baseball"]
    folder = write_frames(tmp_path / "frames", {v.video_id: 3 for v in videos})
    pixels = np.load(folder / "frames.npy")
    for position, video in enumerate(videos):
        pixels[3 * position : 3 * position + 3] = grey(video.object_id)
    np.save(folder / "frames.npy", pixels)
    return CrossValidationData(
        videos=videos,
        catalogue=catalogue,
        frames=folder,
        recordings=tmp_path,
        per_video=2,
        encoder=EncoderConfig(weights=str(weights), prompts=2, epochs=2, batch_size=4),
        runtime=RuntimeConfig(device="cpu"),
        pretrained=tmp_path / "none" / "encoder.safetensors",
    )


def grey(object_id: str) -> int:
    return 20 + 30 * OBJECTS.index(object_id)


class Telling(FrameEncoder):
    """Says of a picture what its first pixel is, and little else."""

    def __init__(self) -> None:
        super().__init__(3)

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        return torch.stack([frames[:, 0, 0, 0].float(), frame_indices.float(), frame_indices.float() ** 2], dim=1)


def owners(clips: Clips) -> list[str]:
    """Whose pictures `Telling` was shown."""
    named = {grey(o): o for o in OBJECTS}
    return [named[int(value)] for value in clips[:, 0, 0]]


class Folds(list[Fold]):
    """The folds as they are asked for; the last is the one being predicted."""

    def tested(self, arena: CrossValidationData) -> set[str]:
        return {o for o, tested in zip(arena.objects, self[-1].tested, strict=True) if tested}

    def known(self, arena: CrossValidationData) -> set[str]:
        return {o for o, known in zip(arena.objects, self[-1].trained, strict=True) if known}


@pytest.fixture
def folds(monkeypatch: pytest.MonkeyPatch) -> Folds:
    seen = Folds()

    def spying(predict: Predict, *args: object, **settings: int) -> np.ndarray:
        def noting(fold: Fold) -> np.ndarray:
            seen.append(fold)
            return predict(fold)

        return fold_by_fold(noting, *args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "cross_validate", spying)
    return seen


# Who learns from what


@pytest.mark.parametrize("name", ["probe", "pretrained-independent", "pretrained-10-objects", "pretrained-3"])
def test_votes_learn_from_no_object_that_they_are_tested_on(
    name: str, arena: CrossValidationData, folds: Folds, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told by the objects' names and by the pictures themselves, in the final fits and in those that choose."""
    limit = {"pretrained-10-objects": 10, "pretrained-3": 3}.get(name)
    candidate = replace(CANDIDATES["probe"], objects=limit, joint=name != "pretrained-independent")
    monkeypatch.setattr(module, "frozen_encoder", lambda *_: Telling())
    fits: list[int] = []

    def spy(
        clips: Clips,
        labels: np.ndarray,
        objects: Sequence[str],
        classes: Sequence[int],
        strength: float,
        *,
        joint: bool,
    ) -> FittedHeads:
        assert owners(clips) == list(objects)
        assert labels.tolist() == [list(arena.catalogue.labels(o)) for o in objects]
        assert not set(objects) & folds.tested(arena)
        assert set(objects) <= folds.known(arena)
        assert joint == candidate.joint
        fits.append(len(set(objects)))
        votes = fit_frame_heads(clips, labels, objects, classes, strength, joint=joint)

        class Spied(FittedHeads):
            def predict(self, clips: Clips) -> np.ndarray:
                assert not set(owners(clips)) & set(objects)
                return super().predict(clips)

        return Spied(**vars(votes))

    monkeypatch.setattr(module, "fit_frame_heads", spy)
    monkeypatch.setattr(voting, "fit_frame_heads", spy)
    judged = cross_validate_candidate(candidate, arena, CONFIG)
    assert len(judged) == 2 * 15
    assert len(folds) == 6
    assert len(fits) == 6 * (2 * 2 + 1), "two strengths on two inner folds, and the fit itself"
    known = [len({o for o, t in zip(arena.objects, f.trained, strict=True) if t}) for f in folds]
    assert fits[4::5] == [min(limit or 99, k) for k in known]


@pytest.mark.parametrize("name", ["paper", "paper-difference", "release", "scratch"])
def test_gradients_learn_from_no_object_that_they_are_tested_on(
    name: str, arena: CrossValidationData, folds: Folds, monkeypatch: pytest.MonkeyPatch
) -> None:
    candidate = CANDIDATES[name]
    chosen: list[frozenset[str]] = []

    def spy(
        model: PropertyClassifier, data: EncoderData, config: EncoderConfig, runtime: RuntimeConfig, **_: object
    ) -> list[Measurement]:
        parts: dict[Part, set[str]] = {part: set() for part in Part}
        for assignment in data.assignments:
            parts[assignment.part].add(assignment.object_id)
        assert parts[Part.TEST] == folds.tested(arena)
        assert parts[Part.TRAIN] | parts[Part.VALIDATION] == folds.known(arena)
        assert parts[Part.VALIDATION]
        assert not parts[Part.VALIDATION] & parts[Part.TRAIN]
        assert not parts[Part.UNUSED]
        chosen.append(frozenset(parts[Part.VALIDATION]))
        assert config.recipe == ("release" if name == "release" else "paper")
        assert (data.store.references is None) == (name in ("paper", "release"))
        assert isinstance(model.encoder, SceneEncoder) == (name == "scratch")
        for key, value in candidate.settings.items():
            assert getattr(config, key) == value
        return []

    monkeypatch.setattr(module, "train_classifier", spy)
    judged = cross_validate_candidate(candidate, arena, CONFIG)
    assert len(chosen) == len(folds) == 6
    assert len(set(chosen)) > 1, "drawn anew in each fold"
    assert all(0 <= p < 3 for j in judged for p in j.predicted)


def test_a_limited_contestant_draws_anew_in_each_fold_and_nests(arena: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[int, list[frozenset[str]]] = {}

    def fake(candidate: Candidate, arena: CrossValidationData) -> Predict:
        def predict(fold: Fold) -> np.ndarray:
            used = frozenset(o for o, t in zip(arena.objects, fold.trained, strict=True) if t)
            drawn.setdefault(candidate.objects or 99, []).append(used)
            held = {o for o, t in zip(arena.objects, fold.tested, strict=True) if t}
            assert not used & held
            assert all(t == (o in used) for o, t in zip(arena.objects, fold.trained, strict=True)), "all their videos"
            return np.zeros((int(fold.tested.sum()), 3), np.int64)

        return predict

    monkeypatch.setitem(module.KINDS, "votes", fake)
    for count in (2, 3, None):
        cross_validate_candidate(replace(CANDIDATES["pretrained"], objects=count), arena, CONFIG)
    assert {len(s) for s in drawn[2]} == {2}
    assert {len(s) for s in drawn[3]} == {3}
    places = {
        tuple(sorted(known).index(o) for o in sorted(kept)) for kept, known in zip(drawn[3], drawn[99], strict=True)
    }
    assert len(places) > 3, "folds do not draw alike"
    assert all(a <= b <= c for a, b, c in zip(drawn[2], drawn[3], drawn[99], strict=True)), "fewer are some of more"


def test_all_contestants_share_their_folds(arena: CrossValidationData, folds: Folds, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> Predict:
        return lambda fold: np.zeros((int(fold.tested.sum()), 3), np.int64)

    for kind in ("trees", "votes", "gradient"):
        monkeypatch.setitem(module.KINDS, kind, none)
    seen = []
    for candidate in CANDIDATES.values():
        folds.clear()
        cross_validate_candidate(candidate, arena, CONFIG)
        seen.append([(f.repeat, f.number, f.tested.tobytes(), f.trained.tobytes()) for f in folds])
    assert all(one == seen[0] for one in seen)
    dealt = [deal(OBJECTS, 3, derive_seed(4, "folds", repeat)) for repeat in range(2)]
    held = [{o for o, t in zip(arena.objects, f.tested, strict=True) if t} for f in folds]
    assert held == [set(part) for parts in dealt for part in parts]
    assert all((f.trained != f.tested).all() for f in folds)


def test_each_video_is_judged_once_a_repeat(arena: CrossValidationData) -> None:
    judged = cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG)
    assert [(j.video_id, j.repeat) for j in judged] == [(v.video_id, r) for v in arena.videos for r in (0, 1)]
    assert all(j.expected == arena.catalogue.labels(j.object_id) for j in judged)


# What they say


def test_constant_by_hand(arena: CrossValidationData) -> None:
    """Each object counts once, however many videos it has; of equals the lowest classes."""
    judged = cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG)
    for repeat in range(2):
        for held in deal(OBJECTS, 3, derive_seed(4, "folds", repeat)):
            counts = Counter(arena.catalogue.labels(o) for o in OBJECTS if o not in held)
            most = max(counts.values())
            expected = min(c for c, n in counts.items() if n == most)
            assert {j.predicted for j in judged if j.repeat == repeat and j.object_id in held} == {expected}
    assert len({j.predicted for j in judged}) > 1, "folds differ here"


def test_what_the_pictures_tell_is_found(arena: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that show the class itself, by frozen features of the same; and by those that show nothing."""
    folder = arena.frames
    pixels = np.load(folder / "frames.npy")
    for position, video in enumerate(arena.videos):
        pixels[3 * position : 3 * position + 3] = 100 * arena.catalogue.labels(video.object_id)[0]
    np.save(folder / "frames.npy", pixels)
    monkeypatch.setattr(module, "frozen_encoder", lambda *_: Telling())
    candidate = replace(CANDIDATES["probe"], joint=False)
    monkeypatch.setattr(voting, "STRENGTHS", (10.0,))
    seen = cross_validate_candidate(candidate, arena, CrossValidationConfig(folds=7, repeats=1))
    shared = [j for j in seen if sum(arena.catalogue.labels(o)[0] == j.expected[0] for o in OBJECTS) > 1]
    assert len(shared) > 8
    assert all(j.predicted[0] == j.expected[0] for j in shared), "classes that another object has, too"


@pytest.mark.parametrize(
    "name", ["probe", "probe-difference", "pretrained-untrained", "pretrained-pooled", "pretrained-raw"]
)
def test_a_verdict_is_repeatable_and_independent_of_the_order(name: str, arena: CrossValidationData) -> None:
    candidate = CANDIDATES[name]
    if candidate.pretrained:
        candidate = replace(candidate, encoder="untrained")
    setting = CrossValidationConfig(folds=2, repeats=1)
    pixels = np.load(arena.frames / "frames.npy")
    pixels += np.random.default_rng(0).integers(0, 20, pixels.shape, dtype=np.uint8)
    np.save(arena.frames / "frames.npy", pixels)
    first = cross_validate_candidate(candidate, arena, setting)
    torch.rand(7)
    assert cross_validate_candidate(candidate, arena, setting) == first
    turned = cross_validate_candidate(candidate, replace(arena, videos=arena.videos[::-1]), setting)
    assert sorted(turned, key=lambda j: j.video_id) == sorted(first, key=lambda j: j.video_id)


def test_the_untrained_network_is_always_the_same_and_the_pretrained_one_is_loaded(arena: CrossValidationData) -> None:
    def state(candidate: str, arena: CrossValidationData) -> dict[str, torch.Tensor]:
        seed_everything(int(torch.randint(100, (1,))))
        return trainable_state(frozen_encoder(CANDIDATES[candidate], arena))

    one, other = state("pretrained-untrained", arena), state("pretrained-untrained", arena)
    assert all(torch.equal(one[n], other[n]) for n in one)
    with pytest.raises(UserError, match="encoder.safetensors: no such file"):
        state("pretrained", arena)
    seed_everything(77)
    pretrained = SceneEncoder()
    file = arena.frames / "encoder.safetensors"
    save_trainable(pretrained, file)
    loaded = state("pretrained", replace(arena, pretrained=file))
    assert all(torch.equal(v, loaded[n]) for n, v in trainable_state(pretrained).items())
    assert not torch.equal(loaded["layers.0.weight"], one["layers.0.weight"])


def test_frames_and_pooling_are_what_their_names_say(arena: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "frozen_encoder", lambda *_: Telling())
    shapes: dict[str, set[tuple[int, ...]]] = {}

    def spy(clips: Clips, *args: object, **settings: bool) -> FittedHeads:
        shapes.setdefault(name, set()).add(clips.shape[1:])
        if name == "pretrained-pooled":
            np.testing.assert_allclose(clips[:, 0, 1], 1.5)
        return fit_frame_heads(clips, *args, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "fit_frame_heads", spy)
    for name in ("pretrained", "pretrained-one-frame", "pretrained-ten-frames", "pretrained-pooled"):
        cross_validate_candidate(CANDIDATES[name], arena, CrossValidationConfig(folds=2, repeats=1))
    assert shapes == {
        "pretrained": {(2, 3)},
        "pretrained-one-frame": {(1, 3)},
        "pretrained-ten-frames": {(10, 3)},
        "pretrained-pooled": {(1, 3)},
    }


def test_the_mean_reference_is_of_training_videos_alone(
    arena: CrossValidationData, folds: Folds, monkeypatch: pytest.MonkeyPatch
) -> None:
    share, used = FrameStore.share_reference, []

    def spy(store: FrameStore, video_ids: Sequence[str]) -> None:
        known = [v.video_id for v, t in zip(arena.videos, folds[-1].trained, strict=True) if t]
        assert list(video_ids) == known
        used.append(known)
        share(store, video_ids)

    monkeypatch.setattr(FrameStore, "share_reference", spy)
    cross_validate_candidate(replace(CANDIDATES["pretrained-raw"], encoder="untrained"), arena, CrossValidationConfig(folds=3, repeats=1))
    assert len(used) == 3


def test_a_shared_reference_by_hand(arena: CrossValidationData) -> None:
    store, plain = FrameStore(arena.frames, "subtract"), FrameStore(arena.frames)
    references = np.load(arena.frames / "references.npy").astype(float)
    chosen = [arena.videos[i].video_id for i in (1, 4, 7)]
    store.share_reference(chosen)
    mean = np.floor(references[[1, 4, 7]].sum(axis=0) / 3 + 0.5).astype(np.uint8)  # Of three values none ends in .5.
    for video in arena.videos:
        expected = subtract(plain.pictures(video.video_id), mean)
        np.testing.assert_array_equal(store.pictures(video.video_id), expected)
    assert (np.load(arena.frames / "references.npy") == references).all(), "the file stays"


# Kills


CONSTANT = module.KINDS["constant"]


def kill_after(count: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Make all candidates constant and interrupt them when asked for one more fold; returns the folds begun."""
    begun: list[tuple[int, int]] = []

    def until(candidate: Candidate, arena: CrossValidationData) -> Predict:
        predict = CONSTANT(candidate, arena)

        def counting(fold: Fold) -> np.ndarray:
            if len(begun) == count:
                raise KeyboardInterrupt
            begun.append((fold.repeat, fold.number))
            return predict(fold)

        return counting

    for kind in module.KINDS:
        monkeypatch.setitem(module.KINDS, kind, until)
    return begun


@pytest.mark.parametrize("count", [0, 1, 4, 5])
def test_finished_folds_survive_a_kill(
    count: int, arena: CrossValidationData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG)
    assert not any(tmp_path.glob("checkpoints/cross_validation/*"))
    with monkeypatch.context() as patch:
        kill_after(count, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG)
    begun = kill_after(99, monkeypatch)
    assert cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG) == whole
    assert begun == [(r, n) for r in range(2) for n in range(3)][count:]
    assert not any(tmp_path.glob("checkpoints/cross_validation/*")), "kept no longer than needed"


def test_folds_of_other_settings_are_not_taken_for_these(arena: CrossValidationData, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        kill_after(2, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_candidate(CANDIDATES["constant"], arena, CONFIG)
    begun = kill_after(99, monkeypatch)
    other = CONFIG.model_copy(update={"seed": 5})
    cross_validate_candidate(CANDIDATES["constant"], arena, other)
    assert len(begun) == 6
    cross_validate_candidate(replace(CANDIDATES["constant"], joint=False), arena, CONFIG)
    assert len(begun) == 12


def relabelled(arena: CrossValidationData) -> CrossValidationData:
    """Another rating of one object, as a corrected objects.csv has it."""
    rug = arena.catalogue.objects["rug"]
    other = rug.model_copy(update={"ratings": ((0, 0, 0), *rug.ratings[1:])})
    objects = {**arena.catalogue.objects, "rug": other}
    return replace(arena, catalogue=Catalogue(language=arena.catalogue.language, objects=objects))


def pretrained_anew(arena: CrossValidationData) -> CrossValidationData:
    seed_everything(1)
    save_trainable(SceneEncoder(), arena.pretrained)
    return arena


@pytest.mark.parametrize("change", [relabelled, pretrained_anew])
def test_folds_of_other_inputs_are_not_taken_for_these(
    change: Callable[[CrossValidationData], CrossValidationData], arena: CrossValidationData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stage that was killed begins anew where its inputs have changed since."""
    save_trainable(SceneEncoder(), arena.pretrained)
    with monkeypatch.context() as patch:
        kill_after(2, patch)
        with pytest.raises(KeyboardInterrupt):
            cross_validate_candidate(CANDIDATES["pretrained"], arena, CONFIG)
    begun = kill_after(99, monkeypatch)
    cross_validate_candidate(CANDIDATES["pretrained"], change(arena), CONFIG)
    assert len(begun) == 6


class Updates:
    """Counts the updates of all optimisers; interrupts the one numbered `stop`."""

    def __init__(self) -> None:
        self.made = 0
        self.stop = -1

    def __call__(self, *_: object) -> None:
        self.made += 1
        if self.made == self.stop:
            raise KeyboardInterrupt


@pytest.fixture
def updates() -> Iterator[Updates]:
    counter = Updates()
    handle = register_optimizer_step_pre_hook(counter)
    yield counter
    handle.remove()


@pytest.mark.parametrize(
    ("change", "left"),
    [
        ({}, 1),
        ({"seed": 5}, 2),
    ],
    ids=["the same", "other folds"],
)
def test_a_killed_training_goes_on_only_with_its_own_objects(
    change: dict[str, int], left: int, arena: CrossValidationData, updates: Updates, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in the second epoch of two. Else a model would be judged on objects that it learnt from."""
    original, epochs = module.train_classifier, []

    def counting(
        model: PropertyClassifier, data: EncoderData, config: EncoderConfig, runtime: RuntimeConfig, **rest: object
    ) -> list[Measurement]:
        before, epoch = updates.made, math.ceil(len(data.videos(Part.TRAIN)) / config.batch_size)
        if updates.stop < 0:
            updates.stop = epoch + 1
        history = original(model, data, config, runtime, **rest)  # type: ignore[arg-type]
        epochs.append((updates.made - before) / epoch)
        return history

    monkeypatch.setattr(module, "train_classifier", counting)
    setting = CrossValidationConfig(folds=2, repeats=1, seed=4)
    with pytest.raises(KeyboardInterrupt):
        cross_validate_candidate(CANDIDATES["paper"], arena, setting)
    cross_validate_candidate(CANDIDATES["paper"], arena, setting.model_copy(update=change))
    assert epochs == [left, 2]


# Trees


def test_features_of_a_recording_are_those_of_five_frames_at_equal_distances(tmp_path: Path) -> None:
    for count in (1, 2, 4, 13, 25):
        path = encode(tmp_path / f"{count}.mkv", moving_square(count, count))
        frames = list(decode(path))
        reference = np.mean([frames[i] for i in reference_indices(count)], axis=0, dtype=np.float64)
        inner = [frames[round(k * (count - 1) / 6)] for k in range(1, 6)]
        np.testing.assert_allclose(
            describe(Recording(path, False)), video_features(inner, reference.astype(np.float32)), rtol=1e-4, atol=1e-5
        )


def test_a_recording_that_starts_touching_is_read_from_its_end(tmp_path: Path) -> None:
    frames = moving_square(25, 1)
    ahead = encode(tmp_path / "a.mkv", frames)
    back = encode(tmp_path / "b.mkv", frames[::-1])
    np.testing.assert_allclose(describe(Recording(ahead, True)), describe(Recording(back, False)), rtol=1e-4, atol=1e-5)
    assert not np.allclose(describe(Recording(ahead, True)), describe(Recording(ahead, False)))


def test_trees_are_the_baseline_on_whole_recordings(catalogue: Catalogue, weights: Path, tmp_path: Path) -> None:
    objects = ("baseball", "pillow", "rug", "ice_block")
    videos = [v.model_copy(update={"path": f"{v.video_id}.avi"}) for v in fake_videos(objects, 2)]
    for seed, video in enumerate(videos):
        write_film(tmp_path / video.path, moving_square(8, seed), 25.0)
    write_frames(tmp_path / "frames", {v.video_id: 1 for v in videos})
    touching = {"rug_1", "pillow_0"}
    write_table(
        tmp_path / "frames" / "probes.parquet",
        Probe,
        [probe(v.video_id, starts_touching=v.video_id in touching) for v in videos],
    )
    arena = CrossValidationData(
        videos=videos,
        catalogue=catalogue,
        frames=tmp_path / "frames",
        recordings=tmp_path,
        per_video=2,
        encoder=EncoderConfig(weights=str(weights)),
        runtime=RuntimeConfig(device="cpu"),
        pretrained=tmp_path / "none",
    )
    judged = cross_validate_candidate(CANDIDATES["trees"], arena, CrossValidationConfig(folds=2, repeats=1, seed=3))
    features = np.stack([describe(Recording(tmp_path / v.path, v.video_id in touching)) for v in videos])
    recordings = [Recording(tmp_path / v.path, v.video_id in touching) for v in videos]
    np.testing.assert_array_equal(recording_features(recordings), features)
    found = {j.video_id: j.predicted for j in judged}
    for number, held in enumerate(deal(objects, 2, derive_seed(3, "folds", 0))):
        known = [i for i, v in enumerate(videos) if v.object_id not in held]
        model = PropertyPredictor((3, 3, 3), seed=derive_seed(0, "trees", 0, number), jobs=1)
        labels = np.array([catalogue.labels(v.object_id) for v in videos])
        model.fit(features[known], labels[known], [videos[i].object_id for i in known])
        tested = [i for i, v in enumerate(videos) if v.object_id in held]
        assert [found[videos[i].video_id] for i in tested] == [
            tuple(p) for p in model.predict(features[tested]).tolist()
        ]


# Contestants


def test_each_variation_changes_one_thing_of_its_parent() -> None:
    for name, candidate in CANDIDATES.items():
        if not candidate.parent:
            continue
        parent = CANDIDATES[candidate.parent]
        assert not parent.parent, name
        changed = [k for k, v in asdict(candidate).items() if v != asdict(parent)[k] and k not in ("title", "parent")]
        assert len(changed) == 1, name
    titles = [c.title for c in CANDIDATES.values()]
    assert len(set(titles)) == len(titles)
    assert {CANDIDATES[f"pretrained-{n}-objects"].objects for n in LEARNING_CURVE} == set(LEARNING_CURVE)
    assert "trees" in CANDIDATES


def test_an_unknown_model_is_one_clear_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="strnog is no model"):
        CrossValidationConfig(models=("paper", "strnog"))
    with pytest.raises(UserError, match=r"strnog is no model; known: constant, trees, .*strong") as caught:
        compose("smoke", ["cross_validation.models=[paper,strnog]"], conf=ROOT / "conf")
    assert "cross_validation.models" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"cross_validation.models: names no model.*\[constant\] is the cheapest"):
        compose("smoke", ["cross_validation.models=[]"], conf=ROOT / "conf")
    assert CrossValidationConfig(models=tuple(CANDIDATES)).models == tuple(CANDIDATES)


@pytest.mark.parametrize(("key", "value"), [("folds", 1), ("folds", 51), ("repeats", 0), ("seed", -1)])
def test_numbers_out_of_range_are_refused(key: str, value: int) -> None:
    with pytest.raises(ValidationError, match=key):
        CrossValidationConfig.model_validate({key: value})

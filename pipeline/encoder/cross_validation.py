"""Grouped cross-validation of any candidate over all videos: no model is tested on an object that it learnt from.

What needs torch is imported where it is used: `constant` needs none.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.config import CrossValidationConfig, EncoderConfig, RuntimeConfig
from pipeline.core.errors import UserError
from pipeline.core.io import code_of, fingerprint, read_json, write_json
from pipeline.core.records import Assignment, OutOfFold, Part, Video
from pipeline.core.runtime import CHECKPOINTS, derive_seed, limit_threads, progress, resolve_device, seed_everything
from pipeline.encoder.candidates import Candidate
from pipeline.encoder.folds import Fold, Labels, Predict, cross_validate, deal
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import REFERENCES_FILE, TABLE_FILE, FrameStore
from pipeline.weights import BACKBONES

if TYPE_CHECKING:
    from pipeline.encoder.clips import EncoderData
    from pipeline.encoder.model import FrameEncoder

VALIDATION = 8
"""One in so many training objects is set aside where a training chooses its best epoch."""


@dataclass(frozen=True)
class CrossValidationData:
    """What all candidates share."""

    videos: Sequence[Video]
    """All with labels, in the order of the results."""
    catalogue: Catalogue
    frames: Path
    """Folder of the kept frames."""
    per_video: int
    encoder: EncoderConfig
    runtime: RuntimeConfig

    @property
    def objects(self) -> list[str]:
        """Of each video."""
        return [video.object_id for video in self.videos]

    @property
    def labels(self) -> Labels:
        """Videos x properties."""
        return np.array([self.catalogue.labels(o) for o in self.objects], dtype=np.int64)

    @property
    def classes(self) -> list[int]:
        """Number of classes of each property."""
        return [len(p.levels) for p in self.catalogue.properties]

    @property
    def files(self) -> list[Path]:
        """What results depend on besides the catalogue and the parameters."""
        files = [self.frames / TABLE_FILE, self.frames / REFERENCES_FILE]
        weights = (file for known in BACKBONES.values() for file in known.files(known.place(self.encoder)))
        return files + [file for file in weights if file.is_file()]

    def store(self, candidate: Candidate) -> FrameStore:
        """The frames as the candidate sees them."""
        chosen = self.encoder.reference if candidate.reference == "chain" else candidate.reference
        return FrameStore(self.frames, "none" if chosen == "none" else "subtract")

    def assignments(self, parts: dict[str, Part]) -> list[Assignment]:
        """All videos, in these parts; unused where `parts` does not say."""
        return [
            Assignment(video_id=v.video_id, object_id=v.object_id, part=parts.get(v.video_id, Part.UNUSED))
            for v in self.videos
        ]


def cross_validate_candidate(
    candidate: Candidate, data: CrossValidationData, config: CrossValidationConfig
) -> list[OutOfFold]:
    """Out-of-fold predictions of one candidate; finished folds survive a kill.

    Folds depend on the objects and `config` alone, so all candidates share them.

    Raises:
        UserError: where fewer objects than folds have videos.
    """
    objects = len(set(data.objects))
    if objects < config.folds:
        raise UserError(
            f"cross_validation.folds is {config.folds} but only {objects} objects have videos; lower it, to 2 at least"
        )
    labelled = repr([(v.video_id, data.catalogue.labels(v.object_id)) for v in data.videos])
    folds = config.model_copy(update={"models": ()})
    settings = (repr(candidate), folds, data.encoder, data.per_video, labelled)
    work = CHECKPOINTS / "cross_validation" / fingerprint(*settings, *data.files, *code_of("cross_validate"))
    predict = KINDS[candidate.kind](candidate, data)
    with progress(config.folds * config.repeats, "cross-validation", "fold") as advance:

        def resumed(fold: Fold) -> Labels:
            file = work / f"{fold.repeat}-{fold.number}.json"
            if not file.is_file():
                write_json(file, predict(fold).tolist())
            advance()
            return np.array(read_json(file), dtype=np.int64)

        predicted = cross_validate(
            resumed,
            data.objects,
            data.classes,
            folds=config.folds,
            repeats=config.repeats,
            seed=config.seed,
        )
    shutil.rmtree(work, ignore_errors=True)
    return [
        OutOfFold(
            video_id=video.video_id,
            object_id=video.object_id,
            repeat=repeat,
            expected=data.catalogue.labels(video.object_id),
            predicted=tuple(classes),
        )
        for video, repeats in zip(data.videos, predicted.tolist(), strict=True)
        for repeat, classes in enumerate(repeats)
    ]


def _constant(_: Candidate, data: CrossValidationData) -> Predict:
    def predict(fold: Fold) -> Labels:
        labels = dict(zip(np.array(data.objects)[fold.trained], map(tuple, data.labels[fold.trained]), strict=True))
        combinations, counts = np.unique(np.array(list(labels.values())), axis=0, return_counts=True)
        return np.tile(combinations[counts.argmax()], (int(fold.tested.sum()), 1))

    return predict


def _frame_heads(candidate: Candidate, data: CrossValidationData) -> Predict:
    """Features come from an encoder that has seen no label, so they are computed once for all folds."""
    from pipeline.encoder import frame_classifier
    from pipeline.encoder.clips import EncoderData, describe_clips

    limit_threads(data.runtime.threads)
    labels, owners = data.labels, np.array(data.objects)
    frames = candidate.frames or data.per_video
    shown = EncoderData(data.store(candidate), data.catalogue, data.assignments({}), frames)
    encoder, device = frozen_encoder(candidate, data), resolve_device(data.runtime.device)
    clips = describe_clips(encoder, shown, shown.videos(Part.UNUSED), data.encoder.embed_batch_size, device)

    def predict(fold: Fold) -> Labels:
        training = (clips[fold.trained], labels[fold.trained], owners[fold.trained].tolist(), data.classes)
        seed = derive_seed("votes", fold.repeat, fold.number)
        strength, _ = frame_classifier.choose_strength(*training, seed)
        heads = frame_classifier.fit_frame_heads(*training, strength)
        return heads.predict(clips[fold.tested])

    return predict


def frozen_encoder(candidate: Candidate, data: CrossValidationData) -> FrameEncoder:
    """The encoder that gives a `frame_heads` candidate its features."""
    from pipeline.encoder.model import SideBySide, load_backbones

    backbone = candidate.backbone or data.encoder.backbone
    return SideBySide(load_backbones(data.encoder.model_copy(update={"backbone": backbone})))


def _gradient(candidate: Candidate, data: CrossValidationData) -> Predict:
    from pipeline.encoder import finetune
    from pipeline.encoder.clips import classify
    from pipeline.encoder.model import Heads, PropertyClassifier
    from pipeline.encoder.recipes import property_classifier
    from pipeline.encoder.scene_encoder import SceneEncoder

    named = {"recipe": "release" if candidate.recipe == "release" else "paper", "backbone": ("clip",)}
    # What has a batch size of its own is computed whole, and so is a network that normalises over a batch.
    whole = {"micro_batch_size": 0} if candidate.settings or candidate.recipe == "scratch" else {}
    config = data.encoder.model_copy(update={**named, **whole, **candidate.settings})
    store, device = data.store(candidate), resolve_device(data.runtime.device)

    def predict(fold: Fold) -> Labels:
        clips, seed, inputs = _training(candidate, data, store, fold)
        if candidate.recipe == "scratch":
            encoder = SceneEncoder()
            model = PropertyClassifier(encoder, Heads(encoder.dim, data.classes), data.classes)
        else:
            model = property_classifier(config, data.classes)
        finetune.train_classifier(model, clips, config, data.runtime, seed=seed, inputs=inputs)
        found: dict[str, list[int]] = {}
        for record in classify(model, clips, [Part.TEST], config.batch_size, device):
            found.setdefault(record.video_id, []).append(record.predicted)
        tested = [v.video_id for v, wanted in zip(data.videos, fold.tested, strict=True) if wanted]
        return np.array([found[video] for video in tested], dtype=np.int64)

    return predict


def _tuned(candidate: Candidate, data: CrossValidationData) -> Predict:
    """Trunks have seen no label, so they are run once for all folds."""
    from pipeline.encoder import finetune
    from pipeline.encoder.clips import EncoderData
    from pipeline.encoder.tuned import FLIPS, AboveTrunks, Trunks, base_encoder, property_classifier, run_trunks

    limit_threads(data.runtime.threads)
    store, device, config = data.store(candidate), resolve_device(data.runtime.device), data.encoder

    @lru_cache(maxsize=1)
    def trunks() -> Trunks:
        clips = EncoderData(store, data.catalogue, data.assignments({}), data.per_video)
        flips = len(FLIPS) if config.flip_probability else 1
        return run_trunks(base_encoder(config), clips, clips.videos(Part.UNUSED), device, flips=flips)

    def predict(fold: Fold) -> Labels:
        clips, seed, inputs = _training(candidate, data, store, fold)
        model = property_classifier(config, data.classes)
        finetune.tune(model, trunks(), clips, config, data.runtime, seed=seed, inputs=inputs)
        logits = AboveTrunks(model).logits(trunks(), clips.videos(Part.TEST), device)
        return model.decide(logits).numpy()

    return predict


def _training(
    candidate: Candidate, data: CrossValidationData, store: FrameStore, fold: Fold
) -> tuple[EncoderData, int, list[Path | str]]:
    """A fold's videos in parts, some set aside to choose the epoch by; the seed; what its training depends on."""
    from pipeline.encoder.clips import EncoderData

    seed = derive_seed("gradient", fold.repeat, fold.number) % 2**31
    seed_everything(seed)
    trained = np.unique(np.array(data.objects)[fold.trained]).tolist()
    chosen = deal(trained, min(VALIDATION, len(trained)), seed)[0] if len(trained) > 1 else frozenset()
    parts = {
        video.video_id: Part.TEST if tested else Part.VALIDATION if video.object_id in chosen else Part.TRAIN
        for video, trained, tested in zip(data.videos, fold.trained, fold.tested, strict=True)
        if trained or tested
    }
    inputs: list[Path | str] = [repr(candidate), *data.files]
    return EncoderData(store, data.catalogue, data.assignments(parts), data.per_video), seed, inputs


KINDS: dict[str, Callable[[Candidate, CrossValidationData], Predict]] = {
    "constant": _constant,
    "frame_heads": _frame_heads,
    "gradient": _gradient,
    "tuned": _tuned,
}

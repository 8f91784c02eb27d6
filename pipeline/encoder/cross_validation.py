"""Grouped cross-validation of the chain's encoder over all videos: no model is tested on an object that it learnt from.

Compared are the backbones of `encoder.backbone` frozen, the same fine-tuned by `encoder.recipe`, and a constant.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from pipeline.config import Compared, CrossValidationConfig, EncoderConfig, RuntimeConfig
from pipeline.core.errors import UserError
from pipeline.core.io import code_of, fingerprint, read_json, write_json
from pipeline.core.records import Assignment, OutOfFold, Part, Video
from pipeline.core.runtime import CHECKPOINTS, derive_seed, limit_threads, progress, resolve_device
from pipeline.encoder.clips import EncoderData, classify, describe_clips
from pipeline.encoder.finetune import Training, finetune
from pipeline.encoder.folds import Fold, Labels, Predict, cross_validate, deal
from pipeline.encoder.frame_classifier import choose_strength, fit_frame_heads
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.encoder.tuned import Trunks, base_encoder, run_trunks
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import REFERENCES_FILE, TABLE_FILE, FrameStore
from pipeline.weights import backbone_files

VALIDATION = 8
"""One in so many training objects is set aside where a training chooses its best epoch."""


@dataclass(frozen=True)
class CrossValidationData:
    """What all models share."""

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
        return [self.frames / TABLE_FILE, self.frames / REFERENCES_FILE, *backbone_files(self.encoder)]

    def clips(self, parts: Mapping[str, Part]) -> EncoderData:
        """All videos, their objects in these parts; unused where `parts` does not say."""
        assignments = [
            Assignment(video_id=v.video_id, object_id=v.object_id, part=parts.get(v.object_id, Part.UNUSED))
            for v in self.videos
        ]
        return EncoderData(FrameStore(self.frames, self.encoder.reference), self.catalogue, assignments, self.per_video)


def cross_validate_model(name: Compared, data: CrossValidationData, config: CrossValidationConfig) -> list[OutOfFold]:
    """Out-of-fold predictions of one model; finished folds survive a kill.

    Folds depend on the objects and `config` alone, so all models share them.

    Raises:
        UserError: where fewer objects than folds have videos.
    """
    objects = len(set(data.objects))
    if objects < config.folds:
        raise UserError(
            f"cross_validation.folds is {config.folds} but only {objects} objects have videos; lower it, to 2 at least"
        )
    limit_threads(data.runtime.threads)
    labelled = repr([(v.video_id, data.catalogue.labels(v.object_id)) for v in data.videos])
    settings = (name, config.model_copy(update={"models": ()}), data.encoder, data.per_video, labelled)
    work = CHECKPOINTS / "cross_validation" / fingerprint(*settings, *data.files, *code_of("cross_validate"))
    predict = MODELS[name](data)
    with progress(config.folds * config.repeats, "cross-validation", "fold") as advance:

        def resumed(fold: Fold) -> Labels:
            file = work / f"{fold.repeat}-{fold.number}.json"
            if not file.is_file():
                write_json(file, predict(fold).tolist())
            advance()
            return np.array(read_json(file), dtype=np.int64)

        predicted = cross_validate(
            resumed, data.objects, data.classes, folds=config.folds, repeats=config.repeats, seed=config.seed
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


def _constant(data: CrossValidationData) -> Predict:
    """Predict the training objects' most frequent combination of classes; of equals the lowest."""

    def predict(fold: Fold) -> Labels:
        labels = dict(zip(np.array(data.objects)[fold.trained], map(tuple, data.labels[fold.trained]), strict=True))
        combinations, counts = np.unique(np.array(list(labels.values())), axis=0, return_counts=True)
        return np.tile(combinations[counts.argmax()], (int(fold.tested.sum()), 1))

    return predict


def _frozen(data: CrossValidationData) -> Predict:
    """Heads on frozen backbones. These have seen no label, so features are computed once for all folds."""
    labels, owners, shown = data.labels, np.array(data.objects), data.clips({})
    encoder, device = SideBySide(load_backbones(data.encoder)), resolve_device(data.runtime.device)
    clips = describe_clips(encoder, shown, shown.videos(Part.UNUSED), data.encoder.embed_batch_size, device)

    def predict(fold: Fold) -> Labels:
        training = (clips[fold.trained], labels[fold.trained], owners[fold.trained].tolist(), data.classes)
        strength, _ = choose_strength(*training, derive_seed("votes", fold.repeat, fold.number))
        return fit_frame_heads(*training, strength).predict(clips[fold.tested])

    return predict


def _tuned(data: CrossValidationData) -> Predict:
    """As the stage `finetune_encoder` trains, with some of a fold's training objects set aside to choose the epoch."""
    owners, device = np.array(data.objects), resolve_device(data.runtime.device)

    @cache
    def trunks() -> Trunks | None:
        """The frozen part has seen no label, so it is run once for all folds; where a fold is left to compute."""
        if data.encoder.recipe != "tuned":
            return None
        every, mirrored = data.clips({}), data.encoder.flip_probability > 0
        return run_trunks(base_encoder(data.encoder), every, every.videos(Part.UNUSED), device, mirrored=mirrored)

    def predict(fold: Fold) -> Labels:
        seed = derive_seed("gradient", fold.repeat, fold.number) % 2**31
        trained = np.unique(owners[fold.trained]).tolist()
        chosen = deal(trained, min(VALIDATION, len(trained)), seed)[0] if len(trained) > 1 else ()
        parts = dict.fromkeys(owners[fold.tested].tolist(), Part.TEST) | dict.fromkeys(trained, Part.TRAIN)
        clips = data.clips(parts | dict.fromkeys(chosen, Part.VALIDATION))
        model, _ = finetune(Training(clips, data.encoder, data.runtime, seed, data.files), trunks())
        found = classify(model, clips, [Part.TEST], data.encoder.batch_size, device)
        # Records come property by property, each over all tested videos in their order.
        return np.array([record.predicted for record in found]).reshape(len(data.classes), -1).T

    return predict


MODELS: dict[Compared, Callable[[CrossValidationData], Predict]] = {
    "constant": _constant,
    "backbone": _frozen,
    "backbone-tuned": _tuned,
}

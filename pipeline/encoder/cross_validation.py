"""Grouped cross-validation of the chain's encoder over all videos: no model is tested on an object that it learnt from.

Compared are the backbones of `encoder.backbone` frozen, the same fine-tuned by `encoder.recipe`, and a constant; each
also with few training objects, which says what a new sensor needs.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from pipeline.config import CrossValidationConfig
from pipeline.core.errors import UserError
from pipeline.core.io import code_of, fingerprint, read_json, write_json
from pipeline.core.records import OutOfFold, Part
from pipeline.core.runtime import CHECKPOINTS, derive_seed, progress, resolve_device
from pipeline.encoder.data import EncoderData, classify, describe_clips
from pipeline.encoder.finetune import Training, finetune
from pipeline.encoder.folds import Fold, Labels, Predict, cross_validate, deal
from pipeline.encoder.frame_classifier import choose_strength, fit_frame_heads
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.encoder.tuned import Trunks, base_encoder, run_trunks

logger = logging.getLogger(__name__)

VALIDATION = 8
"""One in so many training objects is set aside where a training chooses its best epoch."""


def cross_validate_model(name: str, training: Training, config: CrossValidationConfig) -> list[OutOfFold]:
    """Out-of-fold predictions of one model for all videos; finished folds survive a kill.

    All videos of `training` are in the part UNUSED, as each fold sets parts of its own. Folds depend on the objects and
    `config` alone, so all models share them. `name` is one of `MODELS`, or with a number behind it as
    `cross_validation.models` has it; a number that a fold's training objects do not reach gives no predictions, as the
    model would be another than its name says. Fewer objects than folds are a UserError.
    """
    data, (owners, labels) = training.data, _videos(training.data)
    objects = len(set(owners.tolist()))
    if objects < config.folds:
        raise UserError(
            f"cross_validation.folds is {config.folds} but only {objects} objects have videos; lower it, to 2 at least"
        )
    (kind, fewer), fewest = kind_of(name), objects - -(-objects // config.folds)
    if fewer and fewer > fewest:
        logger.warning("%s: left out, as a fold has only %d training objects", name, fewest)
        return []
    labelled = repr([(a.video_id, data.catalogue.labels(a.object_id)) for a in data.assignments])
    settings = (name, config.model_copy(update={"models": ()}), training.config, data.per_video, labelled)
    work = CHECKPOINTS / "cross_validation" / fingerprint(*settings, *training.inputs, *code_of("cross_validate"))
    predict = MODELS[kind](training)
    with progress(config.folds * config.repeats, "cross-validation", "fold") as advance:

        def resumed(fold: Fold) -> Labels:
            file = work / f"{fold.repeat}-{fold.number}.json"
            if not file.is_file():
                # The first of a shuffled order: of two numbers, the larger has all objects of the smaller.
                order = np.random.default_rng(derive_seed(config.seed, "fewer", fold.repeat, fold.number))
                kept = order.permutation(np.unique(owners[fold.trained]))[:fewer]
                few = replace(fold, trained=fold.trained & np.isin(owners, kept))
                write_json(file, predict(few).tolist())
            advance()
            return np.array(read_json(file), dtype=np.int64)

        predicted = cross_validate(
            resumed, owners.tolist(), data.classes, folds=config.folds, repeats=config.repeats, seed=config.seed
        )
    shutil.rmtree(work, ignore_errors=True)
    return [
        OutOfFold(
            video_id=video.video_id,
            object_id=video.object_id,
            repeat=repeat,
            expected=tuple(expected),
            predicted=tuple(classes),
        )
        for video, expected, repeats in zip(data.assignments, labels.tolist(), predicted.tolist(), strict=True)
        for repeat, classes in enumerate(repeats)
    ]


def kind_of(name: str) -> tuple[str, int | None]:
    """A name in `MODELS`, and how many objects it learns from: 10 of `backbone-10`, None for all."""
    kind, _, count = name.rpartition("-")
    return (kind, int(count)) if count.isdecimal() else (name, None)


def _videos(data: EncoderData) -> tuple[np.ndarray, Labels]:
    """The object of each video, and its classes, videos x properties."""
    owners = [a.object_id for a in data.assignments]
    return np.array(owners), np.array([data.catalogue.labels(o) for o in owners], dtype=np.int64)


def _constant(training: Training) -> Predict:
    """Predict the training objects' most frequent combination of classes; of equals the lowest."""
    owners, labels = _videos(training.data)

    def predict(fold: Fold) -> Labels:
        # By object, as each counts once, however many videos it has.
        known = dict(zip(owners[fold.trained], map(tuple, labels[fold.trained]), strict=True))
        combinations, counts = np.unique(np.array(list(known.values())), axis=0, return_counts=True)
        return np.tile(combinations[counts.argmax()], (int(fold.tested.sum()), 1))

    return predict


def _frozen(training: Training) -> Predict:
    """Heads on frozen backbones. These have seen no label, so features are computed once for all folds."""
    data, (owners, labels) = training.data, _videos(training.data)
    encoder, device = SideBySide(load_backbones(training.config)), resolve_device(training.runtime.device)
    clips = describe_clips(encoder, data, data.videos(Part.UNUSED), training.config.embed_batch_size, device)

    def predict(fold: Fold) -> Labels:
        known = (clips[fold.trained], labels[fold.trained], owners[fold.trained].tolist(), data.classes)
        strength, _ = choose_strength(*known, derive_seed("votes", fold.repeat, fold.number))
        return fit_frame_heads(*known, strength).predict(clips[fold.tested])

    return predict


def _tuned(training: Training) -> Predict:
    """As the stage `finetune_encoder` trains, with some of a fold's training objects set aside to choose the epoch."""
    (owners, _), config, device = _videos(training.data), training.config, resolve_device(training.runtime.device)

    @cache
    def trunks() -> Trunks | None:
        """The frozen part has seen no label, so it is run once for all folds; where a fold is left to compute."""
        if config.recipe != "tuned":
            return None
        data, mirrored = training.data, config.flip_probability > 0
        return run_trunks(base_encoder(config), data, data.videos(Part.UNUSED), device, mirrored=mirrored)

    def predict(fold: Fold) -> Labels:
        seed = derive_seed("gradient", fold.repeat, fold.number) % 2**31
        trained = np.unique(owners[fold.trained]).tolist()
        chosen = deal(trained, min(VALIDATION, len(trained)), seed)[0] if len(trained) > 1 else ()
        parts = dict.fromkeys(owners[fold.tested].tolist(), Part.TEST) | dict.fromkeys(trained, Part.TRAIN)
        parts |= dict.fromkeys(chosen, Part.VALIDATION)
        # A model that is limited to fewer training objects leaves the others unused.
        dealt = [a.model_copy(update={"part": parts.get(a.object_id, a.part)}) for a in training.data.assignments]
        data = replace(training.data, assignments=dealt)
        model, _ = finetune(replace(training, data=data, seed=seed), trunks())
        found = classify(model, data, [Part.TEST], config.batch_size, device)
        # Records come property by property, each over all tested videos in their order.
        return np.array([record.predicted for record in found]).reshape(len(data.classes), -1).T

    return predict


MODELS: dict[str, Callable[[Training], Predict]] = {
    "constant": _constant,
    "backbone": _frozen,
    "backbone-tuned": _tuned,
}

"""Grouped cross-validation of any contestant over all videos: nobody is judged on an object that it learnt from."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.config import CrossValidationConfig, EncoderConfig, RuntimeConfig
from pipeline.encoder.baseline.predictor import Labels
from pipeline.encoder.baseline.recordings import Recording, recording_features
from pipeline.encoder.baseline.validation import Fold, Predict, cross_validate, deal, forest
from pipeline.encoder.candidates import Candidate
from pipeline.encoder.finetune import EncoderData, classify, describe_clips, train_classifier
from pipeline.encoder.frame_heads import Clips, choose_strength, fit_votes
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.errors import UserError
from pipeline.io import read_json, read_table, write_json
from pipeline.records import Assignment, OutOfFold, Part, Probe, Video
from pipeline.runtime import CHECKPOINTS, derive_seed, resolve_device, seed_everything
from pipeline.trainable import load_trainable
from pipeline.training import fingerprint
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import PROBES_FILE, REFERENCES_FILE, TABLE_FILE, FrameStore
from pipeline.weights import clip_file

VALIDATION = 8
"""One in so many training objects is set aside where a training chooses its best epoch."""


@dataclass(frozen=True)
class Arena:
    """What all contestants share."""

    videos: Sequence[Video]
    """All with labels, in the order of the results."""
    catalogue: Catalogue
    frames: Path
    """Folder of the kept frames."""
    recordings: Path
    """Folder of the videos themselves."""
    per_video: int
    encoder: EncoderConfig
    runtime: RuntimeConfig
    pretrained: Path
    """File of the encoder that scenes have pretrained; need not exist where no contestant takes it."""

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
        return [self.frames / TABLE_FILE, self.frames / REFERENCES_FILE, clip_file(Path(self.encoder.weights))]

    def store(self, contestant: Candidate) -> FrameStore:
        """The frames as the contestant sees them."""
        return FrameStore(self.frames, "subtract" if contestant.reference == "own" else "none")


def judge(contestant: Candidate, arena: Arena, config: CrossValidationConfig) -> list[OutOfFold]:
    """Cross-validate one contestant; finished folds survive a kill.

    Folds depend on the objects and `config` alone, so all contestants share them.
    """
    made_of = [*arena.files, *([arena.pretrained] if arena.pretrained.is_file() else [])]
    objects = len(set(arena.objects))
    if objects < config.folds:
        raise UserError(
            f"cross_validation.folds is {config.folds} but only {objects} objects have videos; lower it, to 2 at least"
        )
    labelled = repr([(v.video_id, arena.catalogue.labels(v.object_id)) for v in arena.videos])
    mark = fingerprint(repr(contestant), config, arena.encoder, arena.per_video, labelled, *made_of)
    work = CHECKPOINTS / "cross_validation" / mark
    predict = _remembered(_limited(KINDS[contestant.kind](contestant, arena), contestant, arena), work)
    predicted = cross_validate(
        predict,
        arena.labels,
        arena.objects,
        arena.classes,
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
            expected=arena.catalogue.labels(video.object_id),
            predicted=tuple(classes),
        )
        for video, repeated in zip(arena.videos, predicted.tolist(), strict=True)
        for repeat, classes in enumerate(repeated)
    ]


def _remembered(predict: Predict, work: Path) -> Predict:
    def lookup(fold: Fold) -> Labels:
        file = work / f"{fold.repeat}-{fold.number}.json"
        if not file.is_file():
            write_json(file, predict(fold).tolist())
        return np.array(read_json(file), dtype=np.int64)

    return lookup


def _limited(predict: Predict, contestant: Candidate, arena: Arena) -> Predict:
    """Leave only so many training objects, drawn anew in each fold."""
    count = contestant.objects
    if count is None:
        return predict
    owners = np.array(arena.objects)

    def fewer(fold: Fold) -> Labels:
        known = np.unique(owners[fold.trained])
        rng = np.random.default_rng(derive_seed("objects", fold.repeat, fold.number))
        kept = rng.permutation(known)[:count]
        return predict(Fold(fold.trained & np.isin(owners, kept), fold.tested, fold.repeat, fold.number))

    return fewer


def _constant(_: Candidate, arena: Arena) -> Predict:
    def predict(fold: Fold) -> Labels:
        seen = dict(zip(np.array(arena.objects)[fold.trained], map(tuple, arena.labels[fold.trained]), strict=True))
        combinations, counts = np.unique(np.array(list(seen.values())), axis=0, return_counts=True)
        return np.tile(combinations[counts.argmax()], (int(fold.tested.sum()), 1))

    return predict


def _trees(_: Candidate, arena: Arena) -> Predict:
    touching = {p.video_id for p in read_table(arena.frames / PROBES_FILE, Probe) if p.starts_touching}
    features = recording_features(
        [Recording(arena.recordings / video.path, video.video_id in touching) for video in arena.videos]
    )
    return forest(features, arena.labels, arena.objects, arena.classes)


def _votes(contestant: Candidate, arena: Arena) -> Predict:
    """Features come from an encoder that has seen no label, so they are computed once for all folds."""
    labels, owners = arena.labels, np.array(arena.objects)
    encoder = frozen_encoder(contestant, arena)
    own = None if contestant.reference == "mean" else _features(encoder, contestant, arena, arena.store(contestant))

    def predict(fold: Fold) -> Labels:
        clips = own
        if clips is None:
            store = FrameStore(arena.frames, "subtract")
            assert store.references is not None, "they were asked for"
            learnt = [v.video_id for v, known in zip(arena.videos, fold.trained, strict=True) if known]
            store.share_reference(learnt)
            clips = _features(encoder, contestant, arena, store)
        inner = owners[fold.trained].tolist()
        learnt_clips, learnt_labels = clips[fold.trained], labels[fold.trained]
        seed = derive_seed("votes", fold.repeat, fold.number)
        strength, _ = choose_strength(learnt_clips, learnt_labels, inner, arena.classes, seed, joint=contestant.joint)
        votes = fit_votes(learnt_clips, learnt_labels, inner, arena.classes, strength, joint=contestant.joint)
        return votes.predict(clips[fold.tested])

    return predict


def frozen_encoder(contestant: Candidate, arena: Arena) -> FrameEncoder:
    """The encoder whose frames vote."""
    if contestant.encoder == "clip":
        # As CLIP reads it, whatever the recipe of the chain.
        return base_encoder(arena.encoder.model_copy(update={"recipe": "paper"}))
    seed_everything(0)
    encoder = SceneEncoder()
    if contestant.encoder == "scenes":
        load_trainable(encoder, arena.pretrained)
    return encoder


def _features(encoder: FrameEncoder, contestant: Candidate, arena: Arena, store: FrameStore) -> Clips:
    per_video = contestant.frames or arena.per_video
    data = EncoderData(store, arena.catalogue, _assignments(arena, {}), per_video)
    device, batch = resolve_device(arena.runtime.device), arena.encoder.embed_batch_size
    clips = describe_clips(encoder, data, data.videos(Part.UNUSED), batch, device)
    return clips.mean(axis=1, keepdims=True) if contestant.pooled else clips


def _gradient(contestant: Candidate, arena: Arena) -> Predict:
    recipe = "release" if contestant.recipe == "release" else "paper"
    config = arena.encoder.model_copy(update={"recipe": recipe, **contestant.settings})
    store = arena.store(contestant)

    def predict(fold: Fold) -> Labels:
        seed = derive_seed("gradient", fold.repeat, fold.number) % 2**31
        seed_everything(seed)
        known = np.unique(np.array(arena.objects)[fold.trained]).tolist()
        chosen = deal(known, min(VALIDATION, len(known)), seed)[0] if len(known) > 1 else frozenset()
        parts = {
            video.video_id: Part.TEST if tested else Part.VALIDATION if video.object_id in chosen else Part.TRAIN
            for video, trained, tested in zip(arena.videos, fold.trained, fold.tested, strict=True)
            if trained or tested
        }
        data = EncoderData(store, arena.catalogue, _assignments(arena, parts), arena.per_video)
        model = (
            _from_scratch(arena.classes)
            if contestant.recipe == "scratch"
            else property_classifier(config, arena.classes)
        )
        marks = [repr(contestant), repr(arena.labels.tolist()), repr(sorted(parts.items()))]
        train_classifier(model, data, config, arena.runtime, seed=seed, inputs=[*marks, *arena.files])
        judged = classify(model, data, [Part.TEST], config.batch_size, resolve_device(arena.runtime.device))
        found: dict[str, list[int]] = {}
        for record in judged:
            found.setdefault(record.video_id, []).append(record.predicted)
        tested = [v.video_id for v, wanted in zip(arena.videos, fold.tested, strict=True) if wanted]
        return np.array([found[video] for video in tested], dtype=np.int64)

    return predict


def _from_scratch(classes: Sequence[int]) -> PropertyClassifier:
    encoder = SceneEncoder()
    return PropertyClassifier(encoder, Heads(encoder.dim, classes), classes)


def _assignments(arena: Arena, parts: dict[str, Part]) -> list[Assignment]:
    return [
        Assignment(video_id=v.video_id, object_id=v.object_id, part=parts.get(v.video_id, Part.UNUSED))
        for v in arena.videos
    ]


KINDS: dict[str, Callable[[Candidate, Arena], Predict]] = {
    "constant": _constant,
    "trees": _trees,
    "votes": _votes,
    "gradient": _gradient,
}

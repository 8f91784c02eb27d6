"""Encoders on one core: number and side of frames, number formats and visual prompts.

Frozen encoders have seen no label; each is judged by a grouped cross-validation of its heads. Prompts are trained for
a few epochs and judged on the development split's validation videos, which also choose the epoch.

`int8` is torch's dynamic quantisation of linear layers, of which the pretrained encoder has none.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, cast

import cv2
import numpy as np
import torch
from torch import nn

from benchmarks.classifier import heads_error
from benchmarks.errors import WRONG, Error, share_of
from benchmarks.frames import bench_videos
from benchmarks.table import Row, make_rows
from benchmarks.timing import flops_of, interleaved, machine, megabytes, one_thread
from pipeline.config import PRETRAINED, EncoderConfig, FramesConfig, RuntimeConfig, SplitConfig
from pipeline.config.params import load_params
from pipeline.core.errors import UserError
from pipeline.core.records import Part, Video
from pipeline.core.runtime import seed_everything
from pipeline.encoder.clips import ClipDataset, EncoderData, LabelledVideo, classify
from pipeline.encoder.cross_validation import CrossValidationData
from pipeline.encoder.finetune import train_classifier
from pipeline.encoder.model import FrameEncoder, PropertyClassifier, base_encoder
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.trainable import load_trainable
from pipeline.videos.files import list_videos
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.split import assign
from pipeline.weights import CLIP_CONFIG

Clip = Mapping[str, torch.Tensor]
SIDE, FRAMES = 120, 5
"""Pixels and frames a video, where these are not what differs."""
ALONE = "ms a video, encoder alone"


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    videos: int = 25
    """That are timed, spread over the objects."""
    repeats: int = 5
    folds: int = 5
    deals: int = 3
    epochs: int = 8
    prompts: tuple[tuple[int, int], ...] = ((8, 0), (1, 0), (32, 0), (8, 1))
    """Prompts a layer, and layers from the first (0: all); the first is the baseline, the paper's."""


@dataclass(frozen=True, kw_only=True)
class Setup(CrossValidationData):
    """What all encoders of a run share."""

    pretrained: Path
    size: Size

    def timed(self) -> list[Video]:
        """At equal distances in the order of the videos, which is by object."""
        count = min(self.size.videos, len(self.videos))
        return [self.videos[i * len(self.videos) // count] for i in range(count)]


def measure(root: Path, size: Size | None = None) -> list[Row]:
    """All questions, over the videos that `frames.bench_videos` finds.

    Raises:
        UserError: without pretrained weights, or where there are too few objects for folds.
    """
    size = size or Size()
    folder, catalogue = bench_videos(root)
    pretrained = root / PRETRAINED
    if not pretrained.is_file():
        raise UserError(f"{pretrained}: no such file; `octopi scale small`, `dvc repro pretrain` make it")
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < 2 * size.folds:
        raise UserError(f"{folder}: bench encoder needs videos of {2 * size.folds} objects or more")
    params = load_params(root / "params.yaml").encoder
    changed = {"recipe": "paper", "backbone": ("clip",), "reference": "none", "weights": str(root / params.weights)}
    if not (root / params.weights / CLIP_CONFIG).is_file():
        raise UserError(
            f"{root / params.weights}: bench encoder compares with a CLIP; name its folder in encoder.weights"
        )
    with one_thread(), TemporaryDirectory() as made:
        frames = Path(made) / "frames"
        config = FramesConfig(selection="salient", pixels=SIDE)
        videos = extract_frames(folder, catalogue, config, frames, Path(made) / "partial").videos
        setup = Setup(
            videos=videos,
            catalogue=catalogue,
            frames=frames,
            per_video=FRAMES,
            encoder=params.model_copy(update=changed),
            runtime=RuntimeConfig(device="cpu", threads=1),
            pretrained=pretrained,
            size=size,
        )
        return [*frozen(setup), *prompts(setup)]


# --- Frozen encoders


@torch.inference_mode()
def features(encoder: FrameEncoder, clip: Clip) -> torch.Tensor:
    """What the heads are given of a clip: float32, frames x features."""
    return encoder.describe(clip["frames"], clip["frame_indices"]).float()


@dataclass(frozen=True)
class Setting:
    """A frozen encoder and what it is shown."""

    encoder: Literal["pretrained", "clip"] = "pretrained"
    side: int = SIDE
    """Pixels; frames, or their differences to the reference, are resized by area."""
    frames: int = FRAMES
    form: Literal["float32", "bfloat16", "int8"] = "float32"


USUAL, CLIP = Setting(), Setting("clip")
QUESTIONS: dict[str, dict[str, Setting]] = {
    "encoder frames": {
        "5 frames": USUAL,
        "1 frame": replace(USUAL, frames=1),
        **{f"{n} frames": replace(USUAL, frames=n) for n in (2, 3, 10)},
    },
    "frame size": {f"{side} pixels": replace(USUAL, side=side) for side in (SIDE, 90, 60, 30)},
    "number format, pretrained encoder": {"float32": USUAL, "bfloat16": replace(USUAL, form="bfloat16")},
    "number format, CLIP": {
        "float32": CLIP,
        "bfloat16": replace(CLIP, form="bfloat16"),
        "int8": replace(CLIP, form="int8"),
    },
}
"""Settings by name; the first of each question is its baseline."""


def frozen(setup: Setup) -> list[Row]:
    """Cost and error of all settings of `QUESTIONS`, each measured once, all in turns."""
    distinct = {str(s): s for settings in QUESTIONS.values() for s in settings.values()}
    encoders = {name: _encoder(setting, setup) for name, setting in distinct.items()}
    shown = {name: [_clip(s, setup, video) for video in setup.timed()] for name, s in distinct.items()}
    timed: dict[str, Callable[[int], object]] = {
        name: lambda i, name=name: features(encoders[name], shown[name][i])  # type: ignore[misc]
        for name in distinct
    }
    costs = interleaved(timed, range(len(setup.timed())), setup.size.repeats)
    errors = {name: _error(encoders[name], setting, setup) for name, setting in distinct.items()}
    counts = {}
    for name, setting in distinct.items():
        counts[name] = {"frames": float(setting.frames), "megabytes": megabytes(encoders[name])}
        if setting.form != "int8":
            clip = shown[name][0]
            counts[name]["flops"] = flops_of(partial(encoders[name].describe, clip["frames"], clip["frame_indices"]))
    rows = []
    for question, settings in QUESTIONS.items():
        rows += make_rows(
            question,
            {name: costs[str(setting)] for name, setting in settings.items()},
            unit=ALONE,
            baseline=next(iter(settings)),
            errors={name: errors[str(setting)] for name, setting in settings.items()},
            error_of=WRONG,
            counts={name: counts[str(setting)] for name, setting in settings.items()},
            machine=machine("1 thread"),
        )
    return rows


def _encoder(setting: Setting, setup: Setup) -> FrameEncoder:
    encoder: FrameEncoder = SceneEncoder() if setting.encoder == "pretrained" else base_encoder(setup.encoder)
    if setting.encoder == "pretrained":
        load_trainable(encoder, setup.pretrained)
    return formatted(encoder.eval(), setting.form)


def formatted(encoder: FrameEncoder, form: str) -> FrameEncoder:
    """A copy that computes in another number format."""
    changed = copy.deepcopy(encoder)
    if form == "int8":
        with warnings.catch_warnings():  # Its successor is a package of its own, which is not needed for this.
            warnings.simplefilter("ignore")
            return cast(FrameEncoder, torch.ao.quantization.quantize_dynamic(changed, {nn.Linear}, torch.qint8))
    return changed.to(torch.bfloat16) if form == "bfloat16" else changed


def _clip(setting: Setting, setup: Setup, video: Video) -> Clip:
    """A video's evaluation clip as the setting shows it: `frames` and `frame_indices`, as `ClipDataset` has them."""
    store = FrameStore(setup.frames, "subtract" if setting.encoder == "pretrained" else "none")
    item = ClipDataset(store, [LabelledVideo(video.video_id, ())], per_video=setting.frames)[0]
    if setting.side == SIDE:
        return item
    size = (setting.side, setting.side)
    smaller = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in item["frames"].numpy()]
    return {**item, "frames": torch.from_numpy(np.stack(smaller))}


def _error(encoder: FrameEncoder, setting: Setting, setup: Setup) -> Error:
    """Of the frozen encoder's heads, whose settings are chosen inside the training folds."""
    clips = np.stack([features(encoder, _clip(setting, setup, video)).numpy() for video in setup.videos])
    return heads_error(clips, clips, setup.labels, setup.objects, setup.classes, setup.size.folds, setup.size.deals)


# --- Visual prompts


def prompts(setup: Setup) -> list[Row]:
    """The paper's recipe with other prompts."""
    assignments = assign(setup.catalogue, setup.videos, SplitConfig(name="development"))
    data = EncoderData(FrameStore(setup.frames), setup.catalogue, assignments, FRAMES)
    shown = ClipDataset(data.store, [LabelledVideo(v.video_id, ()) for v in setup.timed()], per_video=FRAMES)
    clips = [shown[i] for i in range(len(shown))]
    timed: dict[str, Callable[[Clip], object]] = {}
    errors, counts = {}, {}
    for count, layers in setup.size.prompts:
        name = f"{count} at {'the first layer' if layers == 1 else f'{layers} layers' if layers else 'all layers'}"
        changed = {"prompts": count, "prompt_layers": layers, "epochs": setup.size.epochs}
        config = setup.encoder.model_copy(update=changed)
        seed_everything(0)
        model = property_classifier(config, setup.classes)
        inputs = ["bench", *(f"{a.video_id} {a.part}" for a in data.assignments)]
        train_classifier(model, data, config, setup.runtime, seed=0, inputs=inputs)
        errors[name] = _validation_error(model.eval(), data, config)
        timed[name] = partial(features, model.encoder)
        # Not in inference mode: the counter fails there at parameters that are put into a layer, as prompts are.
        flops = flops_of(partial(model.encoder.describe, clips[0]["frames"], clips[0]["frame_indices"]))
        counts[name] = {"frames": float(FRAMES), "megabytes": megabytes(model), "flops": flops}
    return make_rows(
        "prompts",
        interleaved(timed, clips, setup.size.repeats),
        unit=ALONE,
        baseline=next(iter(timed)),
        errors=errors,
        error_of="share of validation videos, which also chose the epoch, of which not every property is right",
        counts=counts,
        machine=machine("1 thread"),
    )


def _validation_error(model: PropertyClassifier, data: EncoderData, config: EncoderConfig) -> Error:
    wrong: dict[str, bool] = {}
    objects: dict[str, tuple[str, ...]] = {}
    for found in classify(model, data, [Part.VALIDATION], config.batch_size, torch.device("cpu")):
        wrong[found.video_id] = wrong.get(found.video_id, False) or found.predicted != found.expected
        objects[found.video_id] = (found.object_id,)
    return share_of([float(w) for w in wrong.values()], list(objects.values()))

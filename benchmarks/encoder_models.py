"""Encoders whole, from a video's file to its classes, and CLIP under visual prompts trained for a few epochs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from benchmarks.errors import WRONG, Error, error_of, reported, share_of
from benchmarks.table import Row, make_rows
from benchmarks.timing import flops_of, interleaved, machine, megabytes
from pipeline.config import EncoderConfig, FramesConfig, SplitConfig
from pipeline.core.records import Part
from pipeline.core.runtime import seed_everything
from pipeline.encoder.candidates import CANDIDATES, Candidate
from pipeline.encoder.clips import ClipDataset, EncoderData, LabelledVideo, classify
from pipeline.encoder.finetune import train_classifier
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier, base_encoder
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.sampling import sample_evaluation
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.frames.subtraction import subtract
from pipeline.videos.split import assign

if TYPE_CHECKING:
    from benchmarks.encoder import Setup

SIDE, FRAMES = 120, 5
"""Pixels and frames a video, where these are not what differs."""
WHOLE = ("probe", "paper", "scratch", "pretrained", "pretrained-one-frame", "pretrained-ten-frames")
ALONE = "ms a video, encoder alone"


@torch.inference_mode()
def features(encoder: FrameEncoder, clip: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """What the heads are given of a clip: float32, frames x features."""
    return encoder.describe(clip["frames"], clip["frame_indices"]).float()


def whole(setup: Setup, reports: Path) -> list[Row]:
    """From the file to the classes."""
    settings: dict[str, Callable[[VideoFile], object]] = {}
    counts: dict[str, dict[str, float]] = {}
    for name in WHOLE:
        candidate = CANDIDATES[name]
        model, frames = _classifier(candidate, setup).eval(), candidate.frames or FRAMES
        settings[name] = partial(_decide, model, candidate.reference == "own", frames)
        clip = torch.zeros(1, frames, SIDE, SIDE, 3, dtype=torch.uint8), torch.zeros(1, frames, dtype=torch.int64)
        flops = flops_of(partial(model, *clip))
        counts[name] = {"frames": frames, "megabytes": megabytes(model), "flops": flops}
    files = [VideoFile(setup.recordings / v.path, v.path, v.object_id, v.video_id) for v in setup.timed()]
    measured = reported(reports, task="cross_validation", measure="combined").values()
    # The report that compares most of them, and of such the one over most videos.
    scores = max(measured, key=lambda rows: (len(rows), rows[0].n), default=[])
    return make_rows(
        "encoder",
        interleaved(settings, files, setup.size.repeats),
        unit="ms a video",
        baseline="pretrained",
        errors={row.encoder: error_of(row) for row in scores if row.encoder in WHOLE},
        error_of=WRONG,
        counts=counts,
        machine=machine("1 thread"),
    )


def _classifier(candidate: Candidate, setup: Setup) -> PropertyClassifier:
    """A candidate with heads that have learnt nothing."""
    seed_everything(0)
    if candidate.kind == "frame_heads":
        return JointFrameClassifier(
            base_encoder(setup.encoder) if "clip" in candidate.backbone else SceneEncoder(), setup.classes
        )
    if candidate.recipe == "scratch":
        encoder = SceneEncoder()
        return PropertyClassifier(encoder, Heads(encoder.dim, setup.classes), setup.classes)
    return property_classifier(setup.encoder, setup.classes)


def _scan(file: VideoFile) -> Scan:
    found = scan(file, FramesConfig(selection="salient", pixels=SIDE))
    assert isinstance(found, Scan), "all videos were extracted before"
    return found


@torch.inference_mode()
def _decide(model: PropertyClassifier, differences: bool, frames: int, file: VideoFile) -> torch.Tensor:
    found = _scan(file)
    chosen = [found.kept[p] for p in sample_evaluation(len(found.kept), frames)]
    pictures = np.stack([kept.image for kept in chosen])
    if differences:
        pictures = subtract(pictures, found.reference)
    places = torch.tensor([[kept.index for kept in chosen]])
    return model.decide(model(torch.from_numpy(pictures)[None], places)["logits"])


def prompts(setup: Setup) -> list[Row]:
    """The paper's recipe with other prompts."""
    assignments = assign(setup.catalogue, setup.videos, SplitConfig(name="development"))
    data = EncoderData(FrameStore(setup.frames), setup.catalogue, assignments, FRAMES)
    shown = ClipDataset(data.store, [LabelledVideo(v.video_id, ()) for v in setup.timed()], per_video=FRAMES)
    clips = [shown[i] for i in range(len(shown))]
    timed: dict[str, Callable[[Mapping[str, torch.Tensor]], object]] = {}
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

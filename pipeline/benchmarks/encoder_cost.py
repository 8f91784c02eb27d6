"""What encoders cost on one core: contestants from the file to the decided classes, and CLIPs of several sizes.

A contestant's video is decoded, its frames are chosen and fitted (`pipeline.videos.frames.scan`), its reference is subtracted
where the contestant wants that, the frames are embedded and the heads decide. All of them get frames of `SIDE` pixels,
as in the cross-validation whose errors stand beside the costs. Trees decode a second time, whole frames; the first pass
tells them where the reference is. Where cost depends on no training, weights are random, and trees have grown on random
features of as many videos. All cases take turns at each video, so that a busy machine slows all alike.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from pipeline.io import read_table
from pipeline.encoder.baseline.features import VIDEO_FEATURE_NAMES
from pipeline.encoder.baseline.predictor import Labels, PropertyPredictor
from pipeline.encoder.baseline.recordings import FRAMES as TREE_FRAMES
from pipeline.encoder.baseline.recordings import Recording, describe
from pipeline.encoder.baseline.validation import Verdict, collect, compare, summarise
from pipeline.benchmarks import BenchRow
from pipeline.benchmarks.operations import counted
from pipeline.encoder.candidates import CONTESTANTS, Contestant
from pipeline.sampling import sample_evaluation
from pipeline.videos.frames.scan import Scan, scan
from pipeline.videos.frames.subtraction import subtract
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.model import Heads, PropertyClassifier
from pipeline.records import Judged
from pipeline.runtime import seed_everything
from pipeline.config import FramesConfig
from pipeline.encoder.cross_validation import Arena, frozen_encoder
from pipeline.videos.files import VideoFile

SIDE = 120
FRAMES = 5
SEED = 0
SAMPLE = 25
"""Videos that are timed, spread over the objects."""
REPEATS = 5
"""How often they are gone through."""
MODELS = ("trees", "probe", "paper", "release", "scratch", "strong", "strong-one-frame", "strong-ten-frames")
BASELINE = "model, strong"
SCAN = "decoding and selection, no model"
VIDEO, ALONE = "ms a video", "ms a video, encoder alone"
TRUE_SHAPES = ("ViT-B-32-quickgelu", "ViT-L-14-quickgelu")
"""open_clip's names; their weights are random here."""

T = TypeVar("T")
Costs = Mapping[str, Sequence[float]]
"""Of each case, one figure a repeat."""


class EncoderRow(BenchRow):
    """A setting with what else it costs, and its paired difference to the baseline where both have an error."""

    frames: int | None = None
    """A video."""
    megabytes: float | None = None
    """Parameters and buffers of encoder and heads as they lie in memory, in 10^6 bytes."""
    parameters: int | None = None
    flops: int | None = None
    """Operations of encoder and heads for one video, or of the unit's frame; without decoding, and where torch can
    count them."""
    difference: float | None = None
    """Combined accuracy less the baseline's, on the same videos."""
    difference_low: float | None = None
    """Ends of its object-clustered 95 % interval."""
    difference_high: float | None = None


def models(arena: Arena, root: Path) -> list[EncoderRow]:
    """Every contestant of `MODELS`, and the pass over a video that all of them begin with."""
    cases: dict[str, Callable[[VideoFile], object]] = {SCAN: scan_video}
    columns: dict[str, dict[str, float]] = {SCAN: {}}
    for name in MODELS:
        case, contestant = f"model, {name}", CONTESTANTS[name]
        if contestant.kind == "trees":
            cases[case], columns[case] = _trees(arena), {"frames": TREE_FRAMES}
        else:
            model = classifier(contestant, arena).eval()
            frames = contestant.frames or arena.per_video
            cases[case] = _network(model, contestant, frames)
            clip = torch.zeros(1, frames, SIDE, SIDE, 3, dtype=torch.uint8), torch.zeros(1, frames)
            columns[case] = {
                "frames": frames,
                "megabytes": megabytes(model),
                "parameters": parameters(model),
                "flops": counted(lambda model=model, clip=clip: model(*clip)),  # type: ignore[misc]
            }
    sample = [
        VideoFile(arena.recordings / v.path, v.path, v.object_id, v.video_id) for v in spread(arena.videos, SAMPLE)
    ]
    costs = take_turns(cases, sample)
    verdicts = {f"model, {name}": judged(root, name) for name in MODELS}
    rows = []
    for case in cases:
        row = make_row(case, VIDEO, costs, BASELINE, **columns[case])
        rows.append(with_error(row, verdicts.get(case), verdicts[BASELINE], arena.classes))
    return rows


def sizes(weights: Path) -> list[EncoderRow]:
    """What the text tower weighs and takes to load, and a frame of 224 x 224 pixels in CLIPs of true shape."""
    import open_clip

    loads: dict[str, Callable[[int], nn.Module]] = {
        "both towers of CLIP": lambda _: open_clip.create_model(f"local-dir:{weights}", require_pretrained=True),
        "CLIP's visual tower": lambda _: load_visual_tower(weights).module,
    }
    loaded = {name: load(0) for name, load in loads.items()}
    size = {f"weight, {name}": [megabytes(module)] for name, module in loaded.items()}
    spent = take_turns({f"loading, {name}": load for name, load in loads.items()}, [0])
    seconds = {case: [ms / 1000 for ms in costs] for case, costs in spent.items()}
    rows = []
    for unit, costs in (("MB of parameters", size), ("s to load", seconds)):
        for case, module in zip(costs, loaded.values(), strict=True):
            columns = {"megabytes": megabytes(module), "parameters": parameters(module)}
            rows.append(make_row(case, unit, costs, next(iter(costs)), **columns))
    for name in TRUE_SHAPES:
        rows += _true_shape(name)
    return rows


def _true_shape(name: str) -> list[EncoderRow]:
    import open_clip

    seed_everything(SEED)
    visual = open_clip.CLIP(**open_clip.get_model_config(name)).visual.eval()
    half = copy.deepcopy(visual).to(torch.bfloat16)
    towers = {f"{name}, float32": visual, f"{name}, bfloat16": half}
    cases = {f"{name}, float32": visual, f"{name}, bfloat16": lambda frame: half(frame.to(torch.bfloat16))}
    frame = torch.rand(1, 3, *visual.image_size)
    with torch.inference_mode():
        costs = take_turns(cases, [frame])
        flops = counted(lambda: visual(frame))
    unit, first = "ms a frame, encoder alone", next(iter(towers))
    return [
        make_row(
            case, unit, costs, first, frames=1, megabytes=megabytes(tower), parameters=parameters(tower), flops=flops
        )
        for case, tower in towers.items()
    ]


def classifier(contestant: Contestant, arena: Arena) -> PropertyClassifier:
    """A contestant with heads that have learnt nothing."""
    seed_everything(SEED)
    if contestant.kind == "votes":
        return FrameVotes(frozen_encoder(contestant, arena), arena.classes)
    if contestant.recipe == "scratch":
        encoder = SceneEncoder()
        return PropertyClassifier(encoder, Heads(encoder.dim, arena.classes), arena.classes)
    return property_classifier(arena.encoder.model_copy(update={"recipe": contestant.recipe}), arena.classes)


def scan_video(file: VideoFile) -> Scan:
    """The pass that all contestants begin with."""
    found = scan(file, FramesConfig(selection="salient", size=SIDE))
    assert isinstance(found, Scan), "all videos were extracted before"
    return found


def _network(model: PropertyClassifier, contestant: Contestant, frames: int) -> Callable[[VideoFile], torch.Tensor]:
    @torch.inference_mode()
    def decide(file: VideoFile) -> torch.Tensor:
        found = scan_video(file)
        chosen = [found.kept[p] for p in sample_evaluation(len(found.kept), frames)]
        pictures = np.stack([kept.image for kept in chosen])
        if contestant.reference == "own":
            pictures = subtract(pictures, found.reference)
        moments = torch.tensor([[kept.index for kept in chosen]])
        return model.decide(model(torch.from_numpy(pictures)[None], moments)["logits"])

    return decide


def _trees(arena: Arena) -> Callable[[VideoFile], Labels]:
    shape = len(arena.videos), len(VIDEO_FEATURE_NAMES)
    features = np.random.default_rng(SEED).standard_normal(shape, dtype=np.float32)
    predictor = PropertyPredictor(arena.classes, seed=SEED, jobs=1).fit(features, arena.labels, arena.objects)

    def decide(file: VideoFile) -> Labels:
        found = scan_video(file)
        return predictor.predict(describe(Recording(file.path, found.probe.starts_touching))[None])

    return decide


def judged(root: Path, name: str) -> list[Verdict] | None:
    """What the cross-validation found of a contestant, by video; None where it was not run."""
    file = root / "data" / "cross_validation" / name / "judged.parquet"
    return collect(read_table(file, Judged)) if file.is_file() else None


def with_error(
    row: EncoderRow, own: Sequence[Verdict] | None, baseline: Sequence[Verdict] | None, classes: Sequence[int]
) -> EncoderRow:
    """The row with its error and interval, and its difference to the baseline where that is about the same videos.

    Without verdicts on two objects or more there is no interval, and the row stays as it is.
    """
    accuracy = summarise(own, classes).combined if own else None
    if own is None or accuracy is None or accuracy.interval is None:
        return row
    found = {"error": 1 - accuracy.value, "low": 1 - accuracy.interval.high, "high": 1 - accuracy.interval.low}
    if baseline and [(v.object_id, v.expected) for v in own] == [(v.object_id, v.expected) for v in baseline]:
        gap = compare(baseline, own)
        assert gap.interval is not None, "there are several objects"
        found |= {"difference": gap.value, "difference_low": gap.interval.low, "difference_high": gap.interval.high}
    return row.model_copy(update={name: round(value, 4) for name, value in found.items()})


def make_row(case: str, unit: str, costs: Costs, baseline: str, **columns: float) -> EncoderRow:
    """A row without an error; the ratio is the median of those within a repeat."""
    own = costs[case]
    values = {
        "cost": median(own),
        "ratio": median(a / b for a, b in zip(own, costs[baseline], strict=True)),
        "low": min(own),
        "high": max(own),
    }
    rounded = {name: round(value, 3) for name, value in (values | columns).items()}
    return EncoderRow.model_validate({"case": case, "unit": unit, "baseline": baseline, **rounded})


def take_turns(cases: Mapping[str, Callable[[T], object]], items: Sequence[T]) -> dict[str, list[float]]:
    """Milliseconds an item, the median over all: one figure a repeat. Every case is run once before, uncounted."""
    for run in cases.values():
        run(items[0])
    found: dict[str, list[float]] = {case: [] for case in cases}
    for _ in range(REPEATS):
        spent: dict[str, list[float]] = {case: [] for case in cases}
        for item in items:
            for case, run in cases.items():
                started = perf_counter()
                run(item)
                spent[case].append(1000 * (perf_counter() - started))
        for case, costs in spent.items():
            found[case].append(median(costs))
    return found


@contextmanager
def one_core() -> Iterator[None]:
    """Keep torch to one thread; decoding and trees have no more anyway."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def spread(videos: Sequence[T], count: int) -> list[T]:
    """So many of the videos, at equal distances in their order, which is by object."""
    count = min(count, len(videos))
    return [videos[i * len(videos) // count] for i in range(count)]


def parameters(module: nn.Module) -> int:
    """How many there are, frozen ones included; those that are 8-bit are not counted by torch."""
    return sum(p.numel() for p in module.parameters())


def megabytes(module: nn.Module) -> float:
    """Parameters and buffers, in 10^6 bytes."""
    return sum(map(_bytes, module.state_dict().values())) / 1e6


def _bytes(value: object) -> int:
    """Of a tensor, or of what quantised layers keep in its place."""
    if isinstance(value, torch.Tensor):
        return value.numel() * value.element_size()
    return sum(map(_bytes, value)) if isinstance(value, tuple) else 0

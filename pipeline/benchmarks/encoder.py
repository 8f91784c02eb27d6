"""Encoders: what each choice costs and what it brings, in one run on one core.

Whole models and CLIPs of several sizes are in `pipeline.benchmarks.encoder_cost`, prompts and the speed of training in
`pipeline.benchmarks.encoder_training`. Here are the choices that no training is needed for: how large frames are, how
many of them there are, and the format that numbers are in. Their encoders are frozen and have seen no label, so each is
judged by a grouped cross-validation of the strong recipe's heads alone: folds are the same for all, what is set is
chosen inside the training folds.

Number formats: `bfloat16` turns all weights and what flows between layers into it. `int8` is torch's dynamic
quantisation, which holds the weights of linear layers in 8 bits and rounds what comes in as it runs: of CLIP these are
the two layers of each block's perceptron, while attention keeps its matrices in a form of its own, in float32. The
strong encoder has convolutions only, which dynamic quantisation leaves alone: there is nothing to compare.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, cast

import cv2
import numpy as np
import torch
from torch import nn

from pipeline.encoder.baseline.predictor import Labels
from pipeline.encoder.baseline.validation import Fold, Verdict, cross_validate
from pipeline.benchmarks import bench_videos
from pipeline.benchmarks.encoder_cost import (
    ALONE,
    FRAMES,
    SAMPLE,
    SCAN,
    SEED,
    SIDE,
    VIDEO,
    EncoderRow,
    make_row,
    megabytes,
    models,
    one_core,
    parameters,
    sizes,
    spread,
    take_turns,
    with_error,
)
from pipeline.benchmarks.encoder_training import Describe, prompts, training_speed
from pipeline.benchmarks.operations import counted
from pipeline.benchmarks.pareto import draw_rows
from pipeline.params import load_params
from pipeline.encoder.candidates import CONTESTANTS
from pipeline.encoder.clips import ClipDataset
from pipeline.errors import UserError
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.frames.subtraction import Pictures
from pipeline.encoder.model import FrameEncoder
from pipeline.weights import check_encoder
from pipeline.parallel import run_parallel
from pipeline.records import Assignment, Part
from pipeline.runtime import derive_seed
from pipeline.config import FramesConfig, RuntimeConfig, SplitConfig
from pipeline.videos.split import assign
from pipeline.encoder.cross_validation import Arena, frozen_encoder
from pipeline.encoder.finetune import EncoderData, describe_clips
from pipeline.encoder.frame_heads import Clips, choose_strength, fit_votes
from pipeline.videos.files import list_videos

Format = Literal["float32", "bfloat16", "int8"]

SIDES = (90, 60, 30)
COUNTS = (1, 2, 3, 10)
FORMATS: tuple[Format, ...] = ("float32", "bfloat16", "int8")
FOLDS, REPEATS = 5, 3
"""Of the cross-validation."""
FEWEST = 10
"""Objects: four fifths of them are dealt into five folds again."""
BASELINE = "strong, default"
"""`FRAMES` frames of `SIDE` pixels, in float32."""
PRETRAINED = Path("data") / "pretrained" / "scenes" / "encoder.safetensors"
SCALE = "`octopi scale small encoder.recipe=strong`"
PICTURE = Path("reports") / "bench" / "encoder.png"


@dataclass(frozen=True)
class Setting:
    """A frozen encoder and what it is shown; as it stands, the strong default."""

    case: str = BASELINE
    contestant: Literal["strong", "probe"] = "strong"
    side: int = SIDE
    """Pixels; frames are resized by area, difference pictures after the subtraction."""
    frames: int = FRAMES
    form: Format = "float32"

    def data(self, arena: Arena) -> EncoderData:
        """All videos, as the encoder is shown them."""
        own = CONTESTANTS[self.contestant].reference == "own"
        store = SmallerStore(arena.frames, "subtract" if own else "none", self.side)
        assignments = [Assignment(video_id=v.video_id, object_id=v.object_id, part=Part.UNUSED) for v in arena.videos]
        return EncoderData(store, arena.catalogue, assignments, self.frames)


@dataclass(frozen=True)
class Trial:
    """What a setting says of every video, for a process that judges it."""

    case: str
    clips: Clips
    labels: Labels
    objects: Sequence[str]
    classes: Sequence[int]

    def __str__(self) -> str:
        return self.case


class SmallerStore(FrameStore):
    """A store whose pictures, or difference pictures, are resized by area to a side."""

    def __init__(self, folder: Path, reference: Literal["none", "subtract"], side: int) -> None:
        super().__init__(folder, reference)
        self.side = side

    def pictures(self, video_id: str, positions: Sequence[int] | None = None) -> Pictures:
        """As the parent's, smaller."""
        size = (self.side, self.side)
        pictures = super().pictures(video_id, positions)
        return np.stack([cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in pictures])


def settings() -> list[Setting]:
    """All that is compared; the first is the baseline."""
    return [
        Setting(),
        *(Setting(f"side of a frame, {side} pixels", side=side) for side in SIDES),
        *(Setting(f"frames a video, {n} frame{'s' * (n > 1)}", frames=n) for n in COUNTS),
        Setting("number format, bfloat16", form="bfloat16"),
        *(Setting(f"CLIP's number format, {form}", "probe", form=form) for form in FORMATS),
    ]


def measure(root: Path) -> Sequence[EncoderRow]:
    """Measure everything over the videos of `bench_videos`; draws the Pareto front beside the figures.

    Raises:
        UserError: without pretrained weights, without a CLIP that fits, or where there are too few objects for folds.
    """
    folder, catalogue = bench_videos(root)
    if not (root / PRETRAINED).is_file():
        raise UserError(f"{root / PRETRAINED}: no such file; {SCALE} and `dvc repro pretrain` make it")
    encoder = load_params(root / "params.yaml").encoder
    weights = root / encoder.weights
    try:
        check_encoder(weights, SIDE)
    except UserError as error:
        raise UserError(f"bench encoder wants the stand-in CLIP, which {SCALE} chooses ({error})") from None
    if len({f.object_id for f in list_videos(folder, catalogue).files}) < FEWEST:
        raise UserError(f"{folder}: bench encoder needs videos of {FEWEST} objects or more")
    with one_core(), TemporaryDirectory() as made:
        frames = Path(made) / "frames"
        config = FramesConfig(selection="salient", size=SIDE)
        arena = Arena(
            videos=extract_frames(folder, catalogue, config, frames, Path(made) / "partial").videos,
            catalogue=catalogue,
            frames=frames,
            recordings=folder,
            per_video=FRAMES,
            encoder=encoder.model_copy(update={"recipe": "paper", "reference": "none", "weights": str(weights)}),
            runtime=RuntimeConfig(device="cpu", threads=1),
            pretrained=root / PRETRAINED,
        )
        # First, since it may find that there are too few objects.
        split = assign(catalogue, arena.videos, SplitConfig(name="development"))
        whole, settled = models(arena, root), trade(arena)
        rows = [*whole, *settled, *prompts(arena, split.assignments), *sizes(weights), *training_speed(arena)]
        title = f"Encoders on one core: {len(arena.videos)} videos of {len(set(arena.objects))} objects"
    draw(whole, settled, root / PICTURE, title)
    return rows


def draw(whole: Sequence[EncoderRow], settled: Sequence[EncoderRow], path: Path, title: str) -> None:
    """Cost against error of models and settings; what is alike for all settings, decoding, is added to their costs."""
    decoding = next(row.cost for row in whole if row.case == SCAN)
    judged = [row for row in whole if row.error is not None]
    moved = [row.model_copy(update={"cost": row.cost + decoding}) for row in settled]
    rows = [row.model_copy(update={"unit": f"{VIDEO}, decoding included"}) for row in (*judged, *moved)]
    draw_rows(rows, path, title, "error (not all properties right), object-clustered 95 % interval")


def trade(arena: Arena) -> list[EncoderRow]:
    """Cost and error of all `settings`."""
    trials, cases, shown, columns = [], {}, {}, {}
    for setting in settings():
        encoder = frozen_encoder(CONTESTANTS[setting.contestant], arena).eval()
        changed = formatted(encoder, setting.form)
        data = setting.data(arena)
        videos = data.videos(Part.UNUSED)
        clips = describe_clips(changed, data, videos, arena.encoder.embed_batch_size, torch.device("cpu"))
        trials.append(Trial(setting.case, clips, arena.labels, arena.objects, arena.classes))
        sample = ClipDataset(data.store, spread(videos, SAMPLE), per_video=setting.frames)
        shown[setting.case] = [sample[i] for i in range(len(sample))]
        cases[setting.case] = partial(_describe, Describe(changed), shown[setting.case])
        columns[setting.case] = {
            "frames": setting.frames,
            "megabytes": megabytes(changed),
            "parameters": parameters(encoder),
        }
        if setting.form != "int8":
            columns[setting.case]["flops"] = counted(partial(_describe, Describe(changed), shown[setting.case], 0))
    costs = take_turns(cases, range(len(shown[BASELINE])))
    verdicts = dict(zip(cases, run_parallel(judge, trials, "encoder", "setting"), strict=True))
    rows = []
    for case in cases:
        row = make_row(case, ALONE, costs, BASELINE, **columns[case])
        rows.append(with_error(row, verdicts[case], verdicts[BASELINE], arena.classes))
    return rows


def _describe(describe: Describe, clips: Sequence[dict[str, torch.Tensor]], place: int) -> None:
    describe(clips[place])


def formatted(encoder: FrameEncoder, form: Format) -> FrameEncoder:
    """A copy of a frozen encoder that computes in another number format; it still gives what it gave, nearly."""
    changed = copy.deepcopy(encoder)
    if form == "int8":
        with warnings.catch_warnings():  # Its successor is a package of its own, which is not needed for this.
            warnings.simplefilter("ignore")
            return cast(FrameEncoder, torch.ao.quantization.quantize_dynamic(changed, {nn.Linear}, torch.qint8))
    if form == "bfloat16":
        changed = changed.to(torch.bfloat16)
    return changed


def judge(trial: Trial) -> tuple[Verdict, ...]:
    """Cross-validate the strong recipe's heads, with the seeds that the contestants' cross-validation has."""
    owners = np.array(trial.objects)

    def predict(fold: Fold) -> Labels:
        clips, labels, inner = trial.clips[fold.trained], trial.labels[fold.trained], owners[fold.trained].tolist()
        seed = derive_seed("votes", fold.repeat, fold.number)
        strength, _ = choose_strength(clips, labels, inner, trial.classes, seed)
        return fit_votes(clips, labels, inner, trial.classes, strength).predict(trial.clips[fold.tested])

    return cross_validate(predict, trial.labels, trial.objects, trial.classes, folds=FOLDS, repeats=REPEATS, seed=SEED)

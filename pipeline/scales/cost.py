"""What a scale takes besides memory: downloads, disk, and hours, counted before anything runs.

Hours follow from floating-point operations (2 a weight and token forward, as many again for the gradient that passes a
frozen weight; Kaplan et al. 2020, section 2.1) and from a device's rate. Stages without such a count are named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from pipeline.config import Params
from pipeline.core.embeddings import FLIPS
from pipeline.core.errors import UserError, counted, did_you_mean
from pipeline.core.records import Encoder, Part
from pipeline.scales.memory import BYTES, FLOAT32_BYTES, GIB, Shapes, Use, launched, trained_parameters
from pipeline.tasks.questions import counts_by_task
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos
from pipeline.videos.frames.selection import kept_count
from pipeline.videos.split import assign_objects
from pipeline.weights import DOWNLOADED
from pipeline.weights.check import layers, parameters

GB = 1e9


class Card(NamedTuple):
    """A GPU by its data sheet."""

    flops: float
    """Dense bfloat16 operations a second, added up in float32."""
    bandwidth: float
    """Bytes a second."""
    gib: float


CARDS = {
    "rtx3090": Card(71e12, 936e9, 24),
    "rtx4090": Card(165e12, 1008e9, 24),
    "a6000": Card(155e12, 768e9, 48),
    "a100": Card(312e12, 2039e9, 80),
    "h100": Card(989e12, 3350e9, 80),
}
"""From NVIDIA's data sheets: RTX 3090 and 4090 (Ada white paper), RTX A6000, A100 80 GB SXM, H100 SXM."""
UTILISATION = 0.35
"""Share of a card's peak that training reaches: an assumption. Large trainings report .21 to .46 (Chowdhery et al.
2022, table 3); small batches reach less."""
USUAL_FRAMES = 112
"""Frames of a video, which is not opened to count them: the paper's average."""
REST = ("pretrain", "finetune_encoder", "embed")
"""Stages that run a model and may not be counted: for want of shapes, videos, or a formula."""


class Hours(NamedTuple):
    """What all runs of a stage, over its variants, take together."""

    stage: str
    runs: int
    work: float
    """Floating-point operations."""
    read: float = 0.0
    """Bytes of weights that are read again for each token said."""

    def on(self, flops: float, bandwidth: float | None) -> float:
        """Hours at these rates: the longer of computing and reading."""
        return max(self.work / flops, self.read / bandwidth if bandwidth else 0) / 3600


def costs(params: Params, shapes: Shapes, uses: list[Use], card: str = "") -> Iterator[str]:
    """Sentences about downloads, disk, hours, and what does not fit the card.

    Args:
        uses: Memory by stage, from `memory.count`.
        card: One of `CARDS`; empty for this machine's processor.
    """
    if card and card not in CARDS:
        raise UserError(f"--card {card}: not known; {did_you_mean(card, CARDS)}it is one of {', '.join(CARDS)}")
    place = Path(params.data.dir)
    if params.data.source == "scenes":
        objects = [*(params.scenes.objects or shapes.catalogue.objects)] * params.scenes.videos_per_object
    else:
        objects = [f.object_id for f in list_videos(place, shapes.catalogue).files] if place.is_dir() else []
    for folder, llm in ((Path(params.encoder.weights), None), (Path(params.language.weights), shapes.llm)):
        found = next((d for d in DOWNLOADED.values() if d.folder == folder.name), None)
        if found and not folder.is_dir():
            size = f"{parameters(llm) * 2 / GB:.0f} GB" if llm is not None else "1.7 GB, its text tower included"
            yield f"Download: {found.repository}, {size}, to {folder} (README, section Real weights)."
    if params.data.source == "videos" and not place.is_dir():
        yield f"Videos: {params.data.dir} is not there (README, section Real videos)."
    rows = embedded(params, shapes.catalogue, objects)
    hours = work(params, shapes, len(objects), rows)
    yield disk(params, shapes, rows, {h.stage: h.runs for h in hours})
    yield from describe(hours, params, card)
    if card:
        yield from fits(uses, CARDS[card].gib)
    devices, sharded = launched(params.runtime.launcher)
    if shapes.llm is not None and sharded:
        each = parameters(shapes.llm) * BYTES[params.language.dtype] / GB
        yield (
            f"Host memory: each of {devices} processes loads the whole language model ({each:.3g} GB) before it keeps "
            f"its share, {devices * each:.3g} GB together."
        )


def embedded(params: Params, catalogue: Catalogue, objects: Sequence[str]) -> dict[Encoder, tuple[int, int]]:
    """By encoder, how many frames `embed` computes and how many it writes, from the object of each video.

    All kept frames are, those of training videos in all mirrored versions; by the base encoder once for all seeds.
    """
    kept = kept_count(params.scenes.frames if params.data.source == "scenes" else USUAL_FRAMES, params.frames)
    seeds, times = params.ablation.seeds, len(FLIPS) if params.encoder.flip_probability else 1
    weigh = {Part.TRAIN: times, Part.VALIDATION: 1, Part.TEST: 1, Part.UNUSED: 0}
    splits = [assign_objects(catalogue, set(objects), params.split, seed) for seed in seeds] if objects else []
    each = [[kept * weigh[parts.get(o, Part.UNUSED)] for parts in splits] for o in objects]
    own, shared = sum(map(sum, each)), sum(map(max, each))
    found = {Encoder.FINETUNED: (own, own), Encoder.BASE: (shared, shared * len(seeds)), Encoder.WORDS: (0, own)}
    return {encoder: found[encoder] for encoder in params.ablation.encoders}


def disk(params: Params, shapes: Shapes, rows: Mapping[Encoder, tuple[int, int]], runs: Mapping[str, int]) -> str:
    """What the chain writes of its own: embeddings, trained models, and the checkpoints of the one that trains."""
    shown = sum(written for _, written in rows.values())
    total = shown * FLOAT32_BYTES * shapes.embedding
    parts = [f"embeddings {_round(total / GB)}" if shown else "embeddings not known without the videos"]
    if shapes.llm is not None:
        connector, words, adapters = trained_parameters(params, shapes.llm, shapes.embedding)
        models = FLOAT32_BYTES * ((connector + words) * (runs["align"] + runs["lora"]) + adapters * runs["lora"])
        # Weights and Adam's two means.
        checkpoints = 3 * FLOAT32_BYTES * (connector + words + adapters)
        parts += [f"data/models {_round(models / GB)}", f"checkpoints {_round(checkpoints / GB)} while one trains"]
        total += models + checkpoints
    return (
        f"Disk in GB: {_round(total / GB)} besides videos and downloads ({', '.join(parts)}); DVC's cache links to the "
        "same files where the disk allows."
    )


def work(params: Params, shapes: Shapes, videos: int, rows: Mapping[Encoder, tuple[int, int]]) -> list[Hours]:
    """Count the stages' operations; `videos` is how many there are, 0 where that is not known, `rows` as `embedded`."""
    found = []
    encoder, seeds, variants = params.encoder, len(params.ablation.seeds), params.ablation.variants()
    tower, llm, lengths = shapes.tower, shapes.llm, shapes.lengths
    if tower is not None and videos:
        picture = 2 * parameters(tower) * (len(tower.positional_embedding) + encoder.prompts)
        shown = videos * params.frames.per_video
        if encoder.recipe in ("paper", "release"):
            found.append(Hours("finetune_encoder", seeds, 2 * seeds * encoder.epochs * shown * picture))
        found.append(Hours("embed", 1, sum(computed for computed, _ in rows.values()) * picture))
    if llm is not None:
        inside = parameters(layers(llm))
        forward, outside = 2 * inside, parameters(llm) - inside
        # Checkpointing computes each layer's forward once more.
        back = forward * (2 if params.runtime.gradient_checkpointing else 1)
        aligned = len({(v.encoder, v.opd, v.seed) for v in variants})
        adapted = sum(v.lora == "with" for v in variants)
        for stage, runs, config in (("align", aligned, params.align), ("lora", adapted, params.lora)):
            tokens = runs * config.samples * config.epochs * lengths.mean_training
            learnt = runs * config.samples * config.epochs * lengths.mean_answer
            found.append(Hours(stage, runs, tokens * (forward + back) + learnt * 6 * outside))
        systems = len(variants) + len(params.ablation.touch) * seeds
        asked = systems * sum(counts_by_task(params.questions, "evaluation").values())
        said = asked * lengths.mean_answer
        weights = parameters(llm) * BYTES[params.language.dtype]
        batch = params.language.generation_batch_size
        tokens = asked * lengths.mean_prompt + said
        found.append(Hours("answer", len(variants), tokens * forward + 2 * said * outside, said / batch * weights))
    return found


def describe(hours: list[Hours], params: Params, card: str) -> Iterator[str]:
    """Lines about time, on the card named, or on this machine's processor, whose rate is measured now."""
    if not hours:
        yield "Hours: not counted, as the shapes of the base models are not known."
        return
    devices, _ = launched(params.runtime.launcher)
    if card:
        known = CARDS[card]
        flops, bandwidth = UTILISATION * known.flops, known.bandwidth
        how = f"on {card}, if training reaches {UTILISATION:.0%} of its {known.flops / 1e12:.0f} TFLOP/s"
    else:
        flops, bandwidth = measured_rate(), None
        how = f"on this processor, at the {flops / 1e9:.0f} GFLOP/s that it reaches now (name a GPU with --card)"
    each = [(h, h.on(flops * (devices if h.stage in ("align", "lora") else 1), bandwidth)) for h in hours]
    yield f"Hours {how}: " + ", ".join(f"{h.stage} {_round(t)} ({counted(h.runs, 'run')})" for h, t in each) + "."
    least = sum(t for _, t in each)
    together = f"{_round(least)} together"
    if card:
        # The paper: 5 h of a 7b model on an A6000, where .24 h are counted.
        together = f"{_round(least)} to {_round(20 * least)} together: the paper's took 20 times what is counted so"
    rest = [s for s in REST if s not in {h.stage for h in hours}]
    yield f"{together}. Not counted: {', '.join(rest)}, and the work on videos."


def _round(number: float) -> str:
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"


def measured_rate(side: int = 1024, seconds: float = 0.5) -> float:
    """Floating-point operations a second of float32 matrix products on this processor, the median of several."""
    import torch
    from torch.utils.benchmark import Timer

    factors = {"a": torch.rand(side, side), "b": torch.rand(side, side)}
    timer = Timer("a @ b", globals=factors, num_threads=torch.get_num_threads())
    return float(2 * side**3 / timer.blocked_autorange(min_run_time=seconds).median)


def fits(uses: list[Use], gib: float) -> Iterator[str]:
    """Stages that do not fit a card, each with the setting that lowers it."""
    mends = {
        "finetune_encoder": "encoder.micro_batch_size=1 encoder.autocast=bfloat16",
        "embed": "encoder.embed_batch_size=8",
        "align": "align.micro_batch_size=1 align.train_embeddings=new runtime.gradient_checkpointing=true",
        "lora": "lora.micro_batch_size=1 align.train_embeddings=new runtime.gradient_checkpointing=true",
        "answer": "language.generation_batch_size=4",
    }
    for use in uses:
        if use.total / GIB > 0.9 * gib:
            what = "exceeds" if use.total / GIB > gib else "nears"
            # Where the weights alone are too many, no smaller batch helps.
            mend = "language.quantization=nf4" if use.parameters / GIB > 0.8 * gib else mends[use.stage]
            yield f"{use.stage} {what} {gib:g} GiB: set {mend} (docs/scale.md)."

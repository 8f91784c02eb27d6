"""What a scale takes besides memory: a card, downloads, disk, and hours where they are known; before anything runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.config import Params
from pipeline.core.records import Encoder, Part
from pipeline.running.errors import counted
from pipeline.scales.memory import BYTES, GIB, Shapes, Use, launched, trained_parameters
from pipeline.training.embeddings import FLIPS
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos
from pipeline.videos.frames.selection import kept_count
from pipeline.videos.split import MORE, assign_objects, few
from pipeline.weights import DOWNLOADED, made
from pipeline.weights.check import parameters

GB = 1e9
USUAL_FRAMES = 112
"""Frames of a video, which is not opened to count them: the paper's average."""
PACKAGES, CLIP = 7.7 * GB, 1.7 * GB
"""What `make install` puts into .venv, and the download of CLIP ViT-L/14 with its text tower."""
CARDS = (24, 40, 48, 80)
"""Memory of usual cards, in GB."""
DRIVERS = {"12": 525, "13": 580}
"""The oldest NVIDIA driver for Linux, by CUDA's major version (release notes of the CUDA toolkit)."""
HOURS = {
    "smoke": "0.1 on two cores",
    "small": "24 on two cores (estimated)",
    "invented": "24 on two cores (estimated)",
    "rehearsal": "0.4 on two cores (docs/scale.md)",
}
"""By scale, with its own settings; measured, where nothing else is said."""
PAPER = {"paper-7b": (6, 5, "its RTX A6000"), "paper-13b": (6, 6.5, "its two RTX A6000")}
"""Hours of the encoder and of a language model's training, on what, by the paper (Yu et al. 2024, section V-C)."""


def costs(params: Params, shapes: Shapes) -> Iterator[str]:
    """Lines about downloads, disk, the host's memory, and hours."""
    place, fetched = Path(params.data.dir), 0.0
    if params.data.source == "scenes":
        objects = [*(params.scenes.objects or shapes.catalogue.objects)] * params.scenes.videos_per_object
    else:
        objects = [f.object_id for f in list_videos(place, shapes.catalogue).files] if place.is_dir() else []
    for folder, llm in ((Path(params.encoder.weights), None), (Path(params.language.weights), shapes.llm)):
        found = next((d for d in DOWNLOADED.values() if d.folder == folder.name), None)
        if found and not folder.is_dir():
            # Pickles are converted into a second folder, and may be removed then.
            vicuna = (2 * parameters(llm) if llm else 0, 2, " as pickles")
            known = {"vicuna": vicuna, "clip": (CLIP, 1, " with its text tower")}
            size, times, what = known.get(folder.name.partition("-")[0], (0, 0, ""))
            fetched += size * times
            much = f", {_round(size / GB)} GB{what}" if size else ""
            yield f"Download: {found.repository}{much}, to {folder} (`octopi weights` checks it)."
    if params.data.source == "videos" and not place.is_dir():
        yield f"Videos: {params.data.dir} is not there (README, Real videos, real weights)."
    for seed in params.ablation.seeds if objects else ():
        if said := few(assign_objects(shapes.catalogue, {*objects}, params.split, seed), {*objects}):
            yield f"Objects under seed {seed}: {said}; {MORE}."
    if not params.ablation.train:
        yield "Nothing is trained: memory and disk are those of the models in evaluate.models, which are not counted."
        return
    yield disk(params, shapes, objects, fetched)
    devices, sharded = launched(params.runtime.launcher)
    if shapes.llm is not None and sharded:
        each = parameters(shapes.llm) * BYTES[params.language.dtype] / GB
        yield (
            f"Host memory: each of {devices} processes loads the whole language model ({each:.3g} GB) before it keeps "
            f"its share, {devices * each:.3g} GB together."
        )
    if params.scale not in PAPER:
        yield f"Hours, by the scale's own settings: {HOURS.get(params.scale, 'not measured')}."
        return
    variants, (tuning, training, card) = params.ablation.variants(), PAPER[params.scale]
    seeds, models = len(params.ablation.seeds), len({(v.encoder, v.opd, v.seed) for v in variants})
    yield (
        f"Hours: {tuning * seeds + training * models:g}, answers not counted, if it is as fast as the paper was on "
        f"{card}: {tuning} for each of {counted(seeds, 'encoder')}, {training:g} for each of "
        f"{counted(models, 'language model')}. {params.scale} has never been run here with its real weights."
    )


def card(params: Params, uses: Sequence[Use]) -> str:
    """Which card, and which driver, a scale for CUDA takes."""
    import torch

    need = max(use.total for use in uses) + 2 * GIB
    size = next((f"{size} GB" for size in CARDS if need <= size * GB), "more than 80 GB, so several")
    oldest = DRIVERS.get(str(torch.version.cuda).partition(".")[0], "(see its CUDA)")
    return f"Card: {size}, with two GiB more than is counted; NVIDIA driver {oldest} or newer, for the locked torch."


def embedded(params: Params, catalogue: Catalogue, objects: Sequence[str]) -> int:
    """How many embeddings `embed` writes, from the object of each video: of all kept frames, of training videos in all
    mirrored versions; the base encoder's once for each seed.
    """
    kept = kept_count(params.scenes.frames if params.data.source == "scenes" else USUAL_FRAMES, params.frames)
    seeds, times = params.ablation.seeds, len(FLIPS) if params.encoder.flip_probability else 1
    weigh = {Part.TRAIN: times, Part.VALIDATION: 1, Part.TEST: 1, Part.UNUSED: 0}
    splits = [assign_objects(catalogue, set(objects), params.split, seed) for seed in seeds] if objects else []
    each = [[kept * weigh[parts.get(o, Part.UNUSED)] for parts in splits] for o in objects]
    own, shared = sum(map(sum, each)), len(seeds) * sum(map(max, each))
    return sum(shared if encoder is Encoder.BASE else own for encoder in params.ablation.encoders)


def disk(params: Params, shapes: Shapes, objects: Sequence[str], fetched: float = 0.0) -> str:
    """All that lies on the disk in the end, and beside it while something is made.

    Args:
        fetched: Bytes of downloads that are not there yet, twice those that are converted.
    """
    rows, variants = embedded(params, shapes.catalogue, objects), params.ablation.variants()
    total: float = rows * 4 * shapes.embedding
    videos = sum(f.stat().st_size for f in Path(params.data.dir).rglob("*") if f.is_file())
    frames = params.scenes.frames if params.data.source == "scenes" else USUAL_FRAMES
    pictures = len(objects) * kept_count(frames, params.frames) * 3 * params.frames.pixels**2
    parts = [f"embeddings {_round(total / GB)}" if rows else "embeddings and frames not known without the videos"]
    bases = (
        (params.encoder.weights, shapes.tower, 4),
        (params.language.weights, shapes.llm, BYTES[params.language.dtype]),
    )
    own = sum(parameters(model) * each for folder, model, each in bases if model is not None and made(Path(folder)))
    total += PACKAGES + fetched + pictures + videos + own
    parts += [f"frames {_round(pictures / GB)}, videos {_round(videos / GB)}"] if rows else []
    parts += [f"packages {_round(PACKAGES / GB)}", *([f"downloads {_round(fetched / GB)}"] if fetched else [])]
    parts += [f"base models {_round(own / GB)}"] if own else []
    if shapes.llm is not None:
        connector, words, adapters = trained_parameters(params, shapes.llm, shapes.embedding)
        aligned, adapted = len({(v.encoder, v.opd, v.seed) for v in variants}), sum(v.lora == "with" for v in variants)
        models = 4 * ((connector + words) * (aligned + adapted) + adapters * adapted)
        # Weights and Adam's two means.
        checkpoints = 3 * 4 * (connector + words + adapters)
        parts += [f"data/models {_round(models / GB)}", f"checkpoints {_round(checkpoints / GB)} while one trains"]
        total += models + checkpoints
    return (
        f"Disk in GB: {_round(total / GB)} in all ({', '.join(parts)}), where DVC's cache can link to the same files."
    )


def _round(number: float) -> str:
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"

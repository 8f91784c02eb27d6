"""What a scale takes besides memory: downloads, disk, and hours where they were measured; before anything runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from pipeline.config import Params
from pipeline.core.records import Encoder, Part
from pipeline.scales.memory import BYTES, Shapes, launched, trained_parameters
from pipeline.training.embeddings import FLIPS
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos
from pipeline.videos.frames.selection import kept_count
from pipeline.videos.split import assign_objects
from pipeline.weights import DOWNLOADED
from pipeline.weights.check import parameters

GB = 1e9
USUAL_FRAMES = 112
"""Frames of a video, which is not opened to count them: the paper's average."""
HOURS = {
    "smoke": "0.1 on two cores",
    "finetune": "0.2 of each language model on two cores",
    "rehearsal": "0.4 on two cores (docs/scale.md)",
    "paper-7b": "6 of the encoder and 5 of each language model, on the paper's RTX A6000",
    "paper-13b": "6 of the encoder and 6.5 of each language model, on the paper's two RTX A6000",
}
"""By scale, as its own settings were measured: here, or by the paper (Yu et al. 2024, section V-C)."""


def costs(params: Params, shapes: Shapes) -> Iterator[str]:
    """Lines about downloads, disk, the host's memory, and hours."""
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
    yield disk(params, shapes, objects)
    devices, sharded = launched(params.runtime.launcher)
    if shapes.llm is not None and sharded:
        each = parameters(shapes.llm) * BYTES[params.language.dtype] / GB
        yield (
            f"Host memory: each of {devices} processes loads the whole language model ({each:.3g} GB) before it keeps "
            f"its share, {devices * each:.3g} GB together."
        )
    yield f"Hours, by the scale's own settings: {HOURS.get(params.scale, 'not measured')}."


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


def disk(params: Params, shapes: Shapes, objects: Sequence[str]) -> str:
    """What the chain writes of its own: embeddings, trained models, and the checkpoints of the one that trains."""
    rows, variants = embedded(params, shapes.catalogue, objects), params.ablation.variants()
    total = rows * 4 * shapes.embedding
    parts = [f"embeddings {_round(total / GB)}" if rows else "embeddings not known without the videos"]
    if shapes.llm is not None:
        connector, words, adapters = trained_parameters(params, shapes.llm, shapes.embedding)
        aligned, adapted = len({(v.encoder, v.opd, v.seed) for v in variants}), sum(v.lora == "with" for v in variants)
        models = 4 * ((connector + words) * (aligned + adapted) + adapters * adapted)
        # Weights and Adam's two means.
        checkpoints = 3 * 4 * (connector + words + adapters)
        parts += [f"data/models {_round(models / GB)}", f"checkpoints {_round(checkpoints / GB)} while one trains"]
        total += models + checkpoints
    return (
        f"Disk in GB: {_round(total / GB)} besides videos and downloads ({', '.join(parts)}); DVC's cache links to the "
        "same files where the disk allows."
    )


def _round(number: float) -> str:
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"

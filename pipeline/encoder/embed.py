"""Embeddings of all kept frames by the frozen encoder, once for every later stage."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import chain

import numpy as np
import torch

from pipeline.embeddings import FLIPS, Statistics
from pipeline.encoder.model import FrameEncoder
from pipeline.errors import UserError
from pipeline.records import Assignment, Embedding, Flip, Part
from pipeline.runtime import track
from pipeline.videos.frames.store import FrameStore

AXES: dict[Flip, tuple[int, ...]] = {"none": (), "horizontal": (2,), "vertical": (1,), "both": (1, 2)}
"""Axes of frames x height x width that a flip reverses."""


@torch.inference_mode()
def embed_videos(
    encoder: FrameEncoder,
    store: FrameStore,
    assignments: Sequence[Assignment],
    *,
    batch_size: int,
    device: torch.device,
) -> tuple[torch.Tensor, list[Embedding]]:
    """Embed each kept frame of each used video; training videos also mirrored in all the ways that training draws.

    Returns:
        The embeddings (float32, rows x dim) and what each row is.

    Raises:
        UserError: naming the video, where an embedding is not finite.
    """
    encoder = encoder.to(device).eval()
    blocks: list[torch.Tensor] = []
    index: list[Embedding] = []
    used = [a for a in assignments if a.part != Part.UNUSED]
    for assignment in track(used, "embed", "video"):
        rows = store.rows(assignment.video_id)
        pixels = store.pictures(assignment.video_id)
        flips = FLIPS if assignment.part == Part.TRAIN else FLIPS[:1]
        # All mirrored versions in one tensor: larger batches cost less a frame.
        frames = torch.from_numpy(np.concatenate([np.flip(pixels, AXES[flip]) for flip in flips]))
        frame_indices = torch.tensor([store.index[row].frame_index for row in rows] * len(flips))
        batches = zip(frames.split(batch_size), frame_indices.split(batch_size), strict=True)
        block = torch.cat([encoder(some.to(device), when.to(device)).float().cpu() for some, when in batches])
        if not block.isfinite().all():
            raise UserError(f"{assignment.video_id}: its embedding is not finite; check the video and the encoder")
        for flip in flips:
            for row in rows:
                frame = store.index[row].frame_index
                index.append(Embedding(video_id=assignment.video_id, frame_index=frame, flip=flip, row=len(index)))
        blocks.append(block)
    return torch.cat(blocks), index


def union(splits: Iterable[Sequence[Assignment]]) -> list[Assignment]:
    """What several splits of the same videos want embedded: a video is mirrored where any of them trains on it."""
    found: dict[str, Assignment] = {}
    for assignment in chain.from_iterable(splits):
        known = found.get(assignment.video_id)
        if known is None or assignment.part == Part.TRAIN or known.part == Part.UNUSED:
            found[assignment.video_id] = assignment
    return list(found.values())


def statistics(embeddings: torch.Tensor, index: Sequence[Embedding], training: Collection[str]) -> Statistics:
    """Mean and deviation of each dimension over the training videos' unmirrored frames alone.

    A dimension that never changes there has the scale 1, and is so only shifted.
    """
    rows = [e.row for e in index if e.video_id in training and e.flip == "none"]
    mean, deviation = embeddings[rows].double().mean(0), embeddings[rows].double().std(0, correction=0)
    return Statistics(mean, torch.where(deviation > 0, deviation, torch.ones_like(deviation)))


def standardize(embeddings: torch.Tensor, known: Statistics) -> torch.Tensor:
    """Embeddings, rows x dim, in deviations from the training frames' mean: float32."""
    return ((embeddings.double() - known.mean) / known.scale).float()

"""Embeddings of all kept frames by the frozen encoder, once for every later stage."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pipeline.config import EncoderConfig
from pipeline.core.records import Embedding, Flip, Part
from pipeline.core.runtime import DeviceName, derive_seed, resolve_device
from pipeline.encoder.data import AXES
from pipeline.encoder.frame_classifier import FOLDS, Clips, Labels, choose_strength, deal, fit_frame_heads
from pipeline.encoder.model import FrameEncoder
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_with
from pipeline.training.embeddings import FLIPS, Statistics
from pipeline.training.trainable import load_trainable
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.records import Assignment

ROWS_AT_ONCE = 2**16
"""Rows whose statistics are taken at a time."""


class Loaded(NamedTuple):
    """What embeds: an encoder and the frames that it reads."""

    encoder: FrameEncoder
    store: FrameStore
    device: torch.device
    batch_size: int
    mirrored: bool = True
    """Whether training draws mirrored frames."""


@dataclass(frozen=True)
class EncoderSource:
    """Where an encoder and its frames lie; called, it loads them, in this process or in a cluster's worker."""

    config: EncoderConfig
    device: DeviceName
    frames: Path
    catalogue: Path
    state: Path | None
    """What fine-tuning trained; None for the base encoder."""
    run: float = 0.0
    """Start time of the stage: a worker may outlive a run, and the next has its files at the same place."""

    def __call__(self) -> Loaded:
        """Load them."""
        if self.state is None:
            encoder = base_encoder(self.config)
        else:
            classes = [len(p.levels) for p in load_catalogue(self.catalogue).properties]
            classifier = property_classifier(self.config, classes)
            load_trainable(classifier, self.state)
            encoder = classifier.encoder
        device = resolve_device(self.device)
        store = FrameStore(self.frames, self.config.reference)
        mirrored = self.config.flip_probability > 0
        return Loaded(encoder.to(device).eval(), store, device, self.config.embed_batch_size, mirrored)


def embed_videos(
    loaded: Loaded, assignments: Sequence[Assignment], source: EncoderSource | None = None
) -> tuple[torch.Tensor, list[Embedding]]:
    """Embeddings of each kept frame of each used video, float32, rows x dim, and what each row is.

    Training videos are also embedded mirrored in all the ways that training draws. One that is not finite is a
    UserError. `source` is that of `loaded`, for the workers of a cluster.
    """
    used = [a for a in assignments if a.part != Part.UNUSED]
    index: list[Embedding] = []
    for assignment in used:
        frames = [loaded.store.index[row].frame_index for row in loaded.store.rows(assignment.video_id)]
        for flip in _flips(loaded, assignment):
            for frame in frames:
                index.append(Embedding(video_id=assignment.video_id, frame_index=frame, flip=flip, row=len(index)))
    embeddings, row = torch.empty(len(index), loaded.encoder.dim), 0
    for block in run_with(loaded, source, _embed_video, used, "embed", "video"):
        embeddings[row : row + len(block)] = torch.from_numpy(block)
        row += len(block)
    return embeddings, index


def _flips(loaded: Loaded, assignment: Assignment) -> Sequence[Flip]:
    return FLIPS if loaded.mirrored and assignment.part == Part.TRAIN else FLIPS[:1]


@torch.inference_mode()
def _embed_video(loaded: Loaded, assignment: Assignment) -> np.ndarray:
    """Embeddings of a video's frames, flip by flip: float32, rows x dim."""
    encoder, store, device, batch_size, _ = loaded
    rows, pixels = store.rows(assignment.video_id), store.pictures(assignment.video_id)
    flips = _flips(loaded, assignment)
    # All mirrored versions in one tensor: larger batches cost less a frame.
    frames = torch.from_numpy(np.concatenate([np.flip(pixels, AXES[flip]) for flip in flips]))
    frame_indices = torch.tensor([store.index[row].frame_index for row in rows] * len(flips))
    batches = zip(frames.split(batch_size), frame_indices.split(batch_size), strict=True)
    block = torch.cat([encoder(some.to(device), when.to(device)).float().cpu() for some, when in batches])
    if not block.isfinite().all():
        raise UserError(f"{assignment.video_id}: its embedding is not finite; check the video and the encoder")
    embeddings: np.ndarray = block.numpy()
    return embeddings


def union(splits: Iterable[Sequence[Assignment]]) -> list[Assignment]:
    """One assignment a video for several splits: it is embedded where any uses it, mirrored where any trains on it."""
    found: dict[str, Assignment] = {}
    for assignment in chain.from_iterable(splits):
        known = found.get(assignment.video_id)
        if known is None or assignment.part == Part.TRAIN or known.part == Part.UNUSED:
            found[assignment.video_id] = assignment
    return list(found.values())


def statistics(embeddings: torch.Tensor, index: Sequence[Embedding], training: Collection[str]) -> Statistics:
    """Mean and deviation of each dimension over the training videos' unmirrored frames alone.

    A dimension that is constant there gets the scale 1, so it is only shifted.
    """
    rows = torch.tensor([e.row for e in index if e.video_id in training and e.flip == "none"])
    # A part at a time, as float64 takes three times the room of all of them.
    mean = sum((embeddings[part].double().sum(0) for part in rows.split(ROWS_AT_ONCE)), torch.tensor(0.0)) / len(rows)
    squares = (((embeddings[part].double() - mean) ** 2).sum(0) for part in rows.split(ROWS_AT_ONCE))
    # NumPy's root is exact; that of MKL, which torch takes, depends on the maker of the processor.
    deviation = torch.from_numpy(np.sqrt((sum(squares, torch.tensor(0.0)) / len(rows)).numpy()))
    return Statistics(mean, torch.where(deviation > 0, deviation, torch.ones_like(deviation)))


def standardize(embeddings: torch.Tensor, known: Statistics) -> torch.Tensor:
    """Standardise embeddings, rows x dim, or their logits where the statistics have heads: float32."""
    values = embeddings.double()
    if known.heads is not None:
        values = values @ known.heads[0].T + known.heads[1]
    return ((values - known.mean) / known.scale).float()


def logits_of(
    embeddings: torch.Tensor, index: Sequence[Embedding], split: Sequence[Assignment], catalogue: Catalogue, seed: int
) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Property heads' logits of each frame, rows x classes of all properties, float64, and the heads' linear map.

    They are a bottleneck through which a small language model cannot recognise training objects. Heads know the labels
    of the objects that they were fitted to, by their videos' unmirrored frames. A language model that learnt from such
    logits would believe them more than it should on new objects. So the training objects are dealt into `FOLDS` parts,
    and each video's logits are those of heads that did not see its part. All other videos get heads of all training
    objects, whose map is returned as `Statistics` has it.
    """
    rows: dict[str, list[int]] = defaultdict(list)
    plain: dict[str, list[int]] = defaultdict(list)
    for entry in index:
        rows[entry.video_id].append(entry.row)
        if entry.flip == "none":
            plain[entry.video_id].append(entry.row)
    training = {a.video_id: a.object_id for a in split if a.part == Part.TRAIN and a.video_id in plain}
    classes = [len(p.levels) for p in catalogue.properties]

    def known(videos: Iterable[str]) -> tuple[Clips, Labels, list[str], list[int]]:
        # A frame is a clip of its own, as videos have different numbers of kept frames.
        frames = {row: training[video] for video in videos for row in plain[video]}
        labels = np.array([catalogue.labels(o) for o in frames.values()])
        return embeddings[list(frames)].numpy()[:, None], labels, list(frames.values()), classes

    def heads(videos: Iterable[str]) -> tuple[torch.Tensor, torch.Tensor]:
        weights, biases = fit_frame_heads(*known(videos), strength).linear()
        return torch.from_numpy(weights), torch.from_numpy(biases)

    strength, _ = choose_strength(*known(training), seed)
    weights, biases = heads(training)
    found = embeddings.double() @ weights.T + biases
    for held in deal(list(training.values()), min(FOLDS, len({*training.values()})), derive_seed(seed, "logits")):
        others = [video for video, o in training.items() if o not in held]
        w, b = heads(others) if others else (weights, biases)
        own = [row for video, o in training.items() if o in held for row in rows[video]]
        found[own] = embeddings[own].double() @ w.T + b
    return found, (weights, biases)

"""Tactile embeddings, computed once by the frozen encoder and looked up ever after."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from copy import copy
from pathlib import Path
from typing import NamedTuple

import torch

from pipeline.core.io import load_tensors, read_table, save_tensors
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding, Flip
from pipeline.running.errors import UserError

FLIPS: tuple[Flip, ...] = ("none", "horizontal", "vertical", "both")
STATISTICS_FILE = "statistics.safetensors"


class Statistics(NamedTuple):
    """Mean and scale by which embeddings are standardised, and the frame settings that they are valid for."""

    mean: torch.Tensor
    scale: torch.Tensor
    """float64, dim each."""
    frames: str = ""
    """Fingerprint of the frame settings: frames that are selected otherwise have other statistics."""
    heads: tuple[torch.Tensor, torch.Tensor] | None = None
    """Where logits stand in place of features (`encoder.embedding=logits`), the heads that give them: weights, classes
    of all properties x features, and biases; float64. Mean and scale are then of the logits."""

    def save(self, file: Path) -> None:
        """Write them as safetensors."""
        heads = dict(zip(("weights", "biases"), self.heads or (), strict=False))
        save_tensors(file, {"mean": self.mean, "scale": self.scale, **heads}, {"frames": self.frames})

    @classmethod
    def load(cls, file: Path) -> Statistics:
        """Read what `save` wrote."""
        from safetensors import safe_open

        tensors = load_tensors(file)
        heads = (tensors["weights"], tensors["biases"]) if "weights" in tensors else None
        with safe_open(file, framework="pt") as stream:
            return cls(tensors["mean"], tensors["scale"], stream.metadata()["frames"], heads)


class EmbeddingStore:
    """Embeddings of every kept frame; of training videos also mirrored, where `encoder.flip_probability` is above 0.

    Args:
        folder: Where `embed` wrote them; without a folder the store is empty.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._rows: dict[tuple[str, str], list[int]] = defaultdict(list)
        self.tensor = torch.zeros(0, 1)
        """float32, rows x dim."""
        if folder is None:
            return
        self.folder = folder
        self.tensor = load_tensors(folder / TENSOR_FILE)[TENSOR]
        for entry in read_table(folder / INDEX_FILE, Embedding):
            self._rows[entry.video_id, entry.flip].append(entry.row)

    @property
    def dim(self) -> int:
        """Length of an embedding."""
        return self.tensor.shape[1]

    def count(self, video_id: str) -> int:
        """Kept frames of a video; a video without any is a UserError."""
        return len(self.rows(video_id))

    def rows(self, video_id: str) -> list[int]:
        """Where the embeddings of a video's kept frames, as they are, stand in the tensor."""
        if (video_id, "none") not in self._rows:
            raise UserError(f"{self.folder / INDEX_FILE}: {video_id} has no embedding; run `dvc repro`")
        return self._rows[video_id, "none"]

    def features(self, video_id: str, positions: Sequence[int], flip: Flip = "none") -> torch.Tensor:
        """Embeddings of the frames at these positions in the list of kept frames: positions x dim."""
        rows = self._rows[video_id, flip]
        return self.tensor[[rows[p] for p in positions]]

    def with_rows(self, rows: Mapping[str, Sequence[int]], tensor: torch.Tensor) -> EmbeddingStore:
        """A store that gives, for each of these videos, these rows of a tensor; it has no mirrored ones."""
        other = copy(self)
        other.tensor, other._rows = tensor, defaultdict(list, {(v, "none"): list(own) for v, own in rows.items()})
        return other

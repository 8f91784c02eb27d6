"""Tactile embeddings, computed once by the frozen encoder and looked up ever after."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch

from pipeline.artifacts import load_tensors, read_table
from pipeline.records import Embedding, Flip

FLIPS: tuple[Flip, ...] = ("none", "horizontal", "vertical", "both")
TENSOR = "embeddings"
TENSOR_FILE = "embeddings.safetensors"
INDEX_FILE = "index.parquet"


class TactileFeatures(Protocol):
    """Where conversations take the embeddings of a video's frames from."""

    @property
    def dim(self) -> int:
        """Length of an embedding."""
        ...

    def count(self, video_id: str) -> int:
        """Frames that a video has embeddings of."""
        ...

    def features(self, video_id: str, positions: Sequence[int], flip: Flip = "none") -> torch.Tensor:
        """Embeddings of the frames at these positions: positions x dim."""
        ...


class EmbeddingStore:
    """Embeddings of every salient frame; training videos also in their three mirrored versions."""

    def __init__(self, folder: Path) -> None:
        self.tensor = load_tensors(folder / TENSOR_FILE)[TENSOR]
        """float32, rows x dim."""
        self._rows: dict[tuple[str, str], list[int]] = defaultdict(list)
        for entry in read_table(folder / INDEX_FILE, Embedding):
            self._rows[entry.video_id, entry.flip].append(entry.row)

    @property
    def dim(self) -> int:
        """Length of an embedding."""
        return self.tensor.shape[1]

    def count(self, video_id: str) -> int:
        """Salient frames of a video."""
        return len(self._rows[video_id, "none"])

    def features(self, video_id: str, positions: Sequence[int], flip: Flip = "none") -> torch.Tensor:
        """Embeddings of the frames at these positions in the list of salient frames: positions x dim."""
        rows = self._rows[video_id, flip]
        return self.tensor[[rows[p] for p in positions]]

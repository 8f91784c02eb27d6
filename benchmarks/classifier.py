"""The classifier that compares numbers and sizes of frames: a frozen EfficientNet-lite0, the chain's frame heads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from benchmarks.table import Error, share_of
from pipeline.config import EncoderConfig
from pipeline.core.runtime import derive_seed
from pipeline.encoder.frame_classifier import Clips, Labels, choose_strength, deal, fit_frame_heads
from pipeline.encoder.model import FrameEncoder, load_backbones
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.make import make


@contextmanager
def weights() -> Iterator[Path]:
    """A folder of EfficientNet-lite0, as the chain makes it from an installed package, for as long as it is used."""
    with TemporaryDirectory() as folder:
        make("efficientnet-lite0", Path(folder) / "weights")
        yield Path(folder) / "weights"


@cache
def _backbone(folder: Path) -> FrameEncoder:
    torch.set_num_threads(1)
    return load_backbones(EncoderConfig(recipe="tuned", backbone=("timm",), weights=str(folder)))[0]


@torch.inference_mode()
def features(pictures: np.ndarray, folder: Path) -> np.ndarray:
    """float32, pictures x features, of difference pictures, uint8, pictures x height x width x RGB."""
    return np.asarray(_backbone(folder)(torch.from_numpy(pictures), torch.zeros(len(pictures), dtype=torch.int64)))


def heads_error(clips: Clips, objects: Sequence[str], catalogue: Catalogue, folds: int, deals: int) -> Error:
    """`table.WRONG` of frame heads in grouped folds, their penalty chosen inside the training objects.

    Args:
        clips: Videos x frames x features.
        objects: Each video's object; folds depend on these alone.
        deals: How often the folds are dealt.
    """
    owners, classes = np.array(objects), [len(p.levels) for p in catalogue.properties]
    labels: Labels = np.array([catalogue.labels(o) for o in objects])
    wrong = np.zeros(len(objects))
    for repeat in range(deals):
        for number, held in enumerate(deal(objects, folds, derive_seed(0, "folds", repeat))):
            out = np.isin(owners, list(held))
            training = (clips[~out], labels[~out], owners[~out].tolist(), classes)
            strength, _ = choose_strength(*training, derive_seed("votes", repeat, number))
            found = fit_frame_heads(*training, strength).predict(clips[out])
            wrong[out] += (found != labels[out]).any(axis=1)
    return share_of(wrong / deals, [(o,) for o in objects])

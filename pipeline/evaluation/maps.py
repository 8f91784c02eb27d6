"""Embeddings without a trained head: two-dimensional maps of videos."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipeline.core.io import read_table
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment

MAPPED = 400
"""Maximum number of videos on a map, taken evenly; exact t-SNE, equal on any processor, costs n squared."""
PERPLEXITY = 30.0
"""t-SNE's usual perplexity (van der Maaten and Hinton 2008); with few videos it is a third of their number."""


def means(folder: Path, videos: Sequence[Assignment]) -> NDArray[np.float64]:
    """The mean of each video's embeddings, as `embed` wrote them to a folder: videos x dim."""
    from safetensors.numpy import load_file

    tensor, rows = load_file(folder / TENSOR_FILE)[TENSOR], defaultdict[str, list[int]](list)
    for entry in read_table(folder / INDEX_FILE, Embedding):
        if entry.flip == "none":
            rows[entry.video_id].append(entry.row)
    return np.stack([tensor[rows[v.video_id]].mean(0, dtype=np.float64) for v in videos])


def map_frame(features: NDArray[np.float64], videos: Sequence[Assignment], catalogue: Catalogue) -> pd.DataFrame:
    """Two maps of embeddings, by principal components and by t-SNE with a fixed seed.

    A row a map and video: method, video_id, x, y, and a column a property with the word for its class.
    """
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE

    chosen = np.unique(np.linspace(0, len(videos) - 1, min(len(videos), MAPPED)).round().astype(int))
    flat = PCA(2, svd_solver="full").fit_transform(features[chosen])
    perplexity = min(PERPLEXITY, max(1.0, (len(chosen) - 1) / 3))
    near = TSNE(perplexity=perplexity, init="pca", method="exact", random_state=0).fit_transform(features[chosen])
    rows = []
    for method, places in (("PCA", flat), ("t-SNE", near)):
        for number, (x, y) in zip(chosen, places, strict=True):
            video = videos[number]
            labels = zip(catalogue.properties, catalogue.labels(video.object_id), strict=True)
            place = {"method": method, "video_id": video.video_id, "x": float(f"{x:.5g}"), "y": float(f"{y:.5g}")}
            rows.append(place | {p.name: p.levels[level] for p, level in labels})
    return pd.DataFrame(rows)

"""Recognition without training: which of k objects, each remembered by one touch, is most similar to another touch?"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.table import Error, Row, make_rows, share_of
from pipeline.config.params import load_params
from pipeline.core.io import read_table
from pipeline.core.records import Probe, Video
from pipeline.core.runtime import derive_seed, processor, track

Values = npt.NDArray[np.float64]
KEPT, UNTOUCHED, SHUFFLED = "embedding", "untouched sensor", "names shuffled"
COUNTS = (2, 5)
"""Objects to choose from; and all."""


def measure(root: Path) -> list[Row]:
    """Errors of the shipped model's encoder, which was trained on none of these objects, on the videos of the chain.

    A sensor drifts while it records, and one object's videos are mostly recorded together: even the no-contact picture
    recognises them. So that picture is measured too, as a baseline, and candidates are also drawn within one session.
    """
    from pipeline.use.model import Octopi
    from pipeline.videos.audit.leakage import sessions

    params = load_params(root / "params.yaml")
    octopi, folder = Octopi.from_pretrained(device="cpu"), Path(params.data.dir)
    videos = {v.video_id: v for v in read_table(root / "data" / "videos.parquet", Video)}
    probes = [p for p in read_table(root / "data" / "frames" / "probes.parquet", Probe) if p.video_id in videos]
    encoded = [octopi.encoder.encode(folder / p.path) for p in track(probes, "touches", "video")]
    objects, names = [p.object_id for p in probes], sessions(probes)
    shuffled = np.random.default_rng(derive_seed(0, "names")).permutation(objects).tolist()
    kinds = {
        KEPT: np.array([e.embedding.double().numpy() for e in encoded]),
        "property heads' logits": np.array([e.features.double().numpy().mean(0) for e in encoded]),
        UNTOUCHED: np.array([p.thumbnail for p in probes], dtype=np.float64),
    }
    rows: list[Row] = []
    for place, where in (("", None), (", candidates of one session", names)):
        errors: dict[str, Error] = {}
        for k in (*COUNTS, 0):
            size = f", {k or 'all'} objects"
            for kind, values in kinds.items():
                errors |= {kind + size: error} if (error := wrong(cosines(values), objects, k, where)) else {}
            chance = wrong(cosines(kinds[KEPT]), shuffled, k, where)
            errors |= {f"{SHUFFLED}{size}": chance} if chance else {}
        if f"{KEPT}, all objects" in errors:
            numbers = {SHUFFLED: kinds[KEPT].shape[1], **{kind: values.shape[1] for kind, values in kinds.items()}}
            rows += make_rows(
                f"recognise, {params.data.source}{place}",
                {name: [numbers[next(k for k in numbers if name.startswith(k))]] for name in errors},
                unit="numbers kept of a touch",
                baseline=f"{KEPT}, all objects",
                errors=errors,
                error_of="share of touches taken for another object, each remembered by one touch",
                machine=processor(),
            )
    return rows


def cosines(values: Values) -> Values:
    """Similarity of each two touches, from touches x dim."""
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    unit = values / np.where(lengths > 0, lengths, 1)
    return unit @ unit.T


def wrong(alike: Values, objects: list[str], k: int, sessions: list[str] | None = None) -> Error | None:
    """The expected error over all draws of k objects and of the touch that each is remembered by.

    A touch is recognised if the remembered touch of its object is more similar than those of the k - 1 others. For one
    other object, the probability of this is the share of its touches that are less similar. For k - 1 of n others, it
    is the product of their shares, averaged over all choices: the elementary symmetric polynomial of the n shares
    divided by the number of choices. So it is computed exactly, without sampling.

    Args:
        alike: Similarity, touches x touches.
        k: 0 takes all objects.
        sessions: The session of each touch; candidates are then only objects that were touched in the same session.

    Returns:
        None where no touch has another of its object and k - 1 other objects beside it.
    """
    whose, where = np.array(objects), np.array(sessions or [""] * len(objects))
    mistakes, about = list[float](), list[tuple[str, ...]]()
    for query in range(len(whose)):
        beside = where == where[query]
        same = [i for i in np.flatnonzero(beside & (whose == whose[query])) if i != query]
        others = [np.flatnonzero(beside & (whose == o)) for o in np.unique(whose[beside & (whose != whose[query])])]
        drawn = k - 1 if k else len(others)
        if not same or not others or len(others) < drawn:
            continue
        right = []
        for kept in same:
            # Mean products of 0, 1, ... shares of the objects so far; a choice contains the next one or not.
            means = np.eye(1, drawn + 1)[0]
            for seen, touches in enumerate(others, 1):
                share = float((alike[query, touches] < alike[query, kept]).mean())
                size = np.arange(1, drawn + 1)
                means[1:] += np.clip(size / seen, 0, 1) * (share * means[:-1] - means[1:])
            right.append(means[drawn])
        mistakes.append(1 - float(np.mean(right)))
        about.append((str(whose[query]),))
    return share_of(np.clip(mistakes, 0, 1), about) if mistakes else None

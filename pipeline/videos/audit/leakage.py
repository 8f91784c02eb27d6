"""Data leakage: the same video, object or recording session in two parts, and what predicts labels without touch."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean, pstdev

import numpy as np

from pipeline.core.records import Part
from pipeline.core.runtime import derive_seed
from pipeline.videos.audit.files import by_rate, quiet_level, touches
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Finding, Probe, Severity, finding

DUPLICATE = 0.91
"""Smallest similarity of near-duplicates, however few videos there are. Among 354 real videos, pairs of different
objects reach .905."""
CHANCE = 0.01
"""The probability that any pair of different objects in a data set is called a near-duplicate by chance."""
SPREAD = 2.0
"""Sessions are told apart where references lie farther from each other than this many times the usual distance between
nearest neighbours (average linkage)."""
PERMUTATIONS = 2000
FOLDS = 5
RIDGE = 1.0
"""Ridge penalty of the regression that predicts labels; its features have a total variance of one."""
FEWEST = 16
"""Minimum number of similarities that the tail of their distribution is fitted to: with fewer than 256 pairs of videos
only `DUPLICATE` counts."""
SAMPLE = 5000
"""Maximum number of videos for clustering sessions and for predicting labels; of more, a random sample is taken.
Clustering takes memory and time that grow with the square of the number; prediction is repeated 2000 times."""
ALPHA = 0.1
"""Below this p value a prediction from nothing but the untouched sensor is a warning. It is not .05, as a few dozen
objects give the test little power, and to miss a leak costs more than to look into a false one."""
LEARNT_FROM = (Part.TRAIN, Part.VALIDATION)
Parts = Mapping[str, Part]
"""Training, validation or test by video id, without those that are in none."""


def check_leakage(
    probes: Sequence[Probe], splits: Sequence[Sequence[Assignment]], catalogue: Catalogue
) -> Iterator[Finding]:
    """All checks of this module. Those of the split are made for each of `splits`, or as if none were used."""
    if not probes:
        return
    recorded = sessions(probes)
    for assignments in splits or [()]:
        # What is unused stands in no part, like what no split knows.
        parts = {a.video_id: a.part for a in assignments if a.part != Part.UNUSED}
        stands: dict[str, set[Part]] = defaultdict(set)
        for p in probes:
            if p.video_id in parts:
                stands[p.object_id].add(parts[p.video_id])
        crossing = [name for name in sorted(stands) if len(stands[name]) > 1]
        for name in crossing:
            yield finding("object in two parts", name, ", ".join(sorted(stands[name])), "one part", Severity.ERROR)
        if assignments:
            yield finding("object in two parts", "all", f"{len(crossing)} of {len(stands)} objects", "0")
        yield from _copies(probes, parts)
        yield from near_copies(probes, parts)
        yield from _sessions(probes, parts, recorded, catalogue)
    yield from _untouched_predictions(probes, recorded, catalogue)


def sessions(probes: Sequence[Probe]) -> list[str]:
    """The recording session of each video: as videos.csv names it, else told apart by format and untouched picture.

    The untouched picture carries the sensor's gel, dust and light. Its brightness is taken off, since that drifts.
    """
    names, unnamed = {p.video_id: p.session for p in probes}, [p for p in probes if not p.session]
    rates = {p.video_id: rate for rate, group in by_rate(unnamed).items() for p in group}
    formats: dict[tuple[float, int, int], list[Probe]] = defaultdict(list)
    for p in unnamed:
        formats[rates[p.video_id], p.width, p.height].append(p)
    for (rate, width, height), group in formats.items():
        pictures = np.array([p.thumbnail for p in group]).reshape(len(group), -1, 3)
        clusters = _clusters((pictures - pictures.mean(1, keepdims=True)).reshape(len(group), -1))
        looks: dict[int, list[str]] = defaultdict(list)
        for p, cluster in zip(group, clusters.tolist(), strict=True):
            looks[cluster].append(p.video_id)
        # The largest cluster is the first, so that names do not depend on the order of the videos.
        for number, look in enumerate(sorted(looks.values(), key=lambda own: (-len(own), min(own))), 1):
            names |= dict.fromkeys(look, f"{rate:.4g} frames/s, {width}x{height}, look {number}")
    return [names[p.video_id] for p in probes]


def _clusters(pictures: np.ndarray) -> np.ndarray:
    """A number for each picture (pictures x values), the same for those that look alike.

    Of more than `SAMPLE` pictures a sample is clustered, and each other one goes with the nearest of it.
    """
    from scipy.cluster.hierarchy import fcluster, linkage
    from scipy.spatial import cKDTree

    if len(pictures) <= 2:
        return np.ones(len(pictures), dtype=int)
    some = pictures[_sampled(len(pictures))]
    tree = cKDTree(some)
    usual = float(np.median(tree.query(some, 2)[0][:, 1]))
    clusters = fcluster(linkage(some, "average"), max(SPREAD * usual, 1e-9), "distance")
    nearest: np.ndarray = clusters[tree.query(pictures)[1]]
    return nearest


def _sampled(count: int) -> np.ndarray:
    """At most `SAMPLE` places among so many, in order; at random, since videos in a list may come by turns."""
    return np.sort(np.random.default_rng(0).permutation(count)[:SAMPLE])


def predictability(
    features: np.ndarray, labels: Sequence[int], objects: Sequence[str], seed: int
) -> tuple[float, list[float]]:
    """The share of videos of unseen objects whose label the features predict; and the same for permuted labels.

    Features are videos x dimensions; labels are classes, equal for videos of one object. Ridge regression on one-hot
    classes; objects are dealt into folds. Labels are permuted among objects, so videos of one keep a common label.
    """
    from sklearn.linear_model import Ridge
    from sklearn.preprocessing import StandardScaler

    names, member = np.unique(objects, return_inverse=True)
    rng = np.random.default_rng(seed)
    fold = rng.permutation(len(names)) % min(FOLDS, len(names))
    own = np.zeros(len(names), dtype=int)
    own[member] = labels
    orders = np.stack([own, *(rng.permutation(own) for _ in range(PERMUTATIONS))])
    classes = np.eye(max(labels) + 1)[orders]  # orders x objects x classes
    right = np.zeros(len(orders))
    scaled = StandardScaler().fit_transform(features) / np.sqrt(features.shape[1])
    for number in range(fold.max() + 1):
        test = fold[member] == number
        # Predictions are linear in the labels, which videos of an object share. So each object's weight in a prediction
        # is computed once, without labels, and a permutation costs one matrix product.
        owner = np.eye(len(names))[member[~test]]
        chances = Ridge(alpha=RIDGE).fit(scaled[~test], owner).predict(scaled[test])
        scores = np.einsum("vn,onc->ovc", chances, classes, optimize=True)
        # Rounded, since sessions make classes exactly equally likely: the first then wins on every processor.
        right += (scores.round(9).argmax(2) == orders[:, member[test]]).sum(1)
    shares = right / len(member)
    return float(shares[0]), shares[1:].tolist()


def _copies(probes: Sequence[Probe], parts: Parts) -> Iterator[Finding]:
    earlier: dict[str, list[Probe]] = defaultdict(list)
    for video in probes:
        if twins := earlier[video.sha256]:
            twin = next((t for t in twins if _crosses(parts, video, t)), twins[0])
            yield _pair("same content", video, twin, "equal bytes", _crosses(parts, video, twin))
        twins.append(video)
    yield finding("same content", "all", f"{len(probes) - len(earlier)} of {len(probes)} files", "0")


def near_copies(probes: Sequence[Probe], parts: Parts) -> Iterator[Finding]:
    """Pairs of videos whose contacts are more alike than different objects are by chance; last, the closest pair."""
    level = quiet_level(probes)
    shown = [p for p in probes if touches(p, level)]
    if len(shown) < 2:
        yield finding("near-duplicate", "all", f"{len(shown)} videos in contact: nothing to compare")
        return
    own = likeness_vectors(np.array([p.signature for p in shown]))
    objects = np.unique([p.object_id for p in shown], return_inverse=True)[1]
    pairs = (len(objects) ** 2 - int((np.bincount(objects) ** 2).sum())) // 2
    closest, largest, close = 0.0, np.empty(0), list[tuple[Probe, Probe, float]]()
    # A video at a time with all behind it: a table of all pairs of 100,000 would take 80 GB.
    for i, vector in enumerate(own[:-1]):
        alike = own[i + 1 :] @ vector
        closest = max(closest, float(alike.max()))
        close += [(shown[i], shown[i + 1 + j], alike[j]) for j in np.flatnonzero(alike > DUPLICATE).tolist()]
        # The bound follows from the largest likenesses of different objects, so no others are kept.
        chance = alike[objects[i + 1 :] != objects[i]]
        largest = np.sort(np.concatenate([largest, chance]))[-math.isqrt(pairs) - 1 :]
    bound = likeness_bound(largest[::-1], pairs)
    for one, other, likeness in close:
        # `_copies` reports files with equal bytes.
        if likeness > bound and one.sha256 != other.sha256:
            measured, crosses = f"contact is alike by {likeness:.3f}", _crosses(parts, one, other)
            if one.object_id == other.object_id and not crosses:
                # One object pressed twice in the same way looks alike, and leaks nothing.
                twice = f"{measured} with {one.path}, the same object"
                yield finding("near-duplicate", other.path, twice, "different videos")
            else:
                yield _pair("near-duplicate", other, one, measured, crosses)
    measured = f"closest pair of {len(shown)} videos in contact is alike by {closest:.3f}"
    yield finding("near-duplicate", "all", measured, f"at most {bound:.3f}")


def likeness_vectors(signatures: np.ndarray) -> np.ndarray:
    """Vectors whose products are the likenesses of contacts: correlations after what many videos share is divided out.

    A pattern that many videos share, such as a smooth blob, is weak evidence of a copy; one that only two share is
    strong evidence. So signatures (videos x values, each of mean 0 and norm 1) are whitened by their own covariance.
    The identity is added to it, or the common pattern of two copies would itself be divided out.
    """
    shared = np.linalg.cholesky(signatures.T @ signatures + np.eye(signatures.shape[1]))
    own = np.linalg.solve(shared, signatures.T).T
    unit: np.ndarray = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-12)
    return unit


def likeness_bound(largest: np.ndarray, pairs: int) -> float:
    """The likeness that, by chance, one of so many pairs of different objects exceeds with probability `CHANCE`.

    It is extrapolated from their m + 1 largest likenesses, in descending order, with m = sqrt(pairs). Under Fisher's
    transformation this tail is exponential; the m-th and the m/4-th give its rate, as the largest of all may be copies.
    The bound is where the tail expects `CHANCE` pairs, so it grows with the logarithm of their number.
    """
    m = math.isqrt(pairs)
    if m < FEWEST:
        return DUPLICATE
    upper, lower = np.arctanh(np.minimum(largest[[m // 4, m]], 1 - 1e-9))
    return max(DUPLICATE, math.tanh(lower + (upper - lower) / math.log(4) * math.log(m / CHANCE)))


def _crosses(parts: Parts, one: Probe, other: Probe) -> bool:
    """Whether two videos stand in different parts of the split."""
    return len({parts[p.video_id] for p in (one, other) if p.video_id in parts}) == 2


def _pair(check: str, video: Probe, twin: Probe, measured: str, crosses: bool) -> Finding:
    where = "in another part of the split: remove one of them" if crosses else "remove one of them"
    severity = Severity.ERROR if crosses else Severity.WARNING
    return finding(check, video.path, f"{measured} with {twin.path}, {where}", "different videos", severity)


def _sessions(probes: Sequence[Probe], parts: Parts, names: Sequence[str], catalogue: Catalogue) -> Iterator[Finding]:
    """What each session holds beside the whole, and whether training and test share it."""

    def shares(objects: set[str]) -> str:
        """How the objects' classes are spread, in percent of each property's levels."""
        told = []
        for place, prop in enumerate(catalogue.properties):
            counts = Counter(catalogue.labels(o)[place] for o in objects)
            percent = "/".join(f"{100 * counts[i] / len(objects):.0f}" for i in range(len(prop.levels)))
            told.append(f"{prop.name} {percent} %")
        return "; ".join(told)

    members: dict[str, list[Probe]] = defaultdict(list)
    for name, probe in zip(names, probes, strict=True):
        members[name].append(probe)
    whole = shares({p.object_id for p in probes})
    for name, own in sorted(members.items()):
        objects = {p.object_id for p in own}
        light = fmean(p.brightness for p in own)
        measured = f"{len(own)} videos of {len(objects)} objects, brightness {light:.1f}; {shares(objects)}"
        yield finding("session", name, measured, whole)
        counts = Counter(parts.get(p.video_id, Part.UNUSED) for p in own)
        if counts[Part.TEST] and any(counts[part] for part in LEARNT_FROM):
            counted = ", ".join(f"{counts[part]} {part}" for part in (*LEARNT_FROM, Part.TEST) if counts[part])
            yield finding("session in two parts", name, counted, "one part", Severity.WARNING)


def _untouched_predictions(probes: Sequence[Probe], names: Sequence[str], catalogue: Catalogue) -> Iterator[Finding]:
    """Whether the no-contact picture or the session alone predicts the property of an unseen object."""
    chosen = _sampled(len(probes)).tolist()
    objects = [probes[i].object_id for i in chosen]
    distinct, session = np.unique([names[i] for i in chosen], return_inverse=True)
    pictures = np.array([probes[i].thumbnail for i in chosen])
    inputs = {"no-contact reference": pictures, "session": np.eye(len(distinct))[session]}
    for place, prop in enumerate(catalogue.properties):
        labels = [catalogue.labels(o)[place] for o in objects]
        for what, features in inputs.items():
            check = f"predicted from the {what} alone"
            if len(set(objects)) < FOLDS or len(set(labels)) < 2 or features.shape[1] < 2:
                yield finding(check, prop.name, "undefined: too few objects, classes or sessions", "")
                continue
            share, null = predictability(features, labels, objects, derive_seed(0, what, prop.name))
            p = (1 + sum(n >= share - 1e-12 for n in null)) / (1 + len(null))
            expected = f"{100 * fmean(null):.1f} +- {100 * pstdev(null):.1f} % if it told nothing"
            severity = Severity.WARNING if p < ALPHA else Severity.INFO
            yield finding(check, prop.name, f"{100 * share:.1f} %, p = {p:.4f}", expected, severity)

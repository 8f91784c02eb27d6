"""Which objects are for training, validation and test; no object ever stands in two of them."""

from __future__ import annotations

import random
from collections.abc import Collection, Mapping, Sequence
from operator import eq
from pathlib import Path

from pipeline.config import SplitConfig
from pipeline.core.io import read_table
from pipeline.core.layout import split_file
from pipeline.core.records import Part
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Video

VALIDATION = 8
"""With kfold, one in so many of the objects that are not tested is for validation; a whole fold would leave too few to
train on."""
ENOUGH = 10
"""Rated objects that are recommended at the least (docs/data.md)."""
MORE = f"{ENOUGH} or more to learn from (docs/data.md, How many objects are enough?)"


def assign(catalogue: Catalogue, videos: Sequence[Video], config: SplitConfig, seed: int = 0) -> list[Assignment]:
    """Put every video into the part of its object (`assign_objects`)."""
    parts = assign_objects(catalogue, {video.object_id for video in videos}, config, seed)
    return [
        Assignment(video_id=v.video_id, object_id=v.object_id, part=parts.get(v.object_id, Part.UNUSED)) for v in videos
    ]


def assign_objects(
    catalogue: Catalogue, present: Collection[str], config: SplitConfig, seed: int = 0
) -> dict[str, Part]:
    """The part of each object under one seed, by id.

    `kfold` deals all objects that have videos into folds: the seed's fold is for test, so that over all folds every
    object is tested once. One in eight of the other objects is for validation. Of the rest, `train_objects` are for
    training (0: all). Any other name is that of a `split_` column of the catalogue. `present` are the objects that have
    videos. Only the split of kfold depends on `seed` (one of `ablation.seeds`).

    Raises:
        UserError: if there is no such split, no training video remains, or there are too few objects for the folds.
    """
    name, allowed = config.name, [*catalogue.split_names, "kfold"]
    if name not in allowed:
        raise UserError(
            f"split.name={name} is no split of the catalogue; allowed: {', '.join(allowed)} (see objects.csv)"
        )
    fold = config.fold_of(seed)
    if fold is not None:
        parts = _deal(catalogue, present, config, fold)
    else:
        parts = {o.object_id: o.splits[name] for o in catalogue.objects.values()}
    if not any(parts.get(object_id) == Part.TRAIN for object_id in present):
        raise UserError(f"split {name}: no video of a training object; add videos, or choose another split.name")
    return parts


def few(parts: Mapping[str, Part], present: Collection[str]) -> str:
    """In words, how many objects with videos are for what, where those for training are fewer than `ENOUGH`."""
    train, validate, test = (sum(parts.get(o) is part for o in present) for part in list(Part)[:3])
    return "" if train >= ENOUGH else f"{train} objects to train on, {validate} to validate, {test} to test"


def untested(parts: Mapping[str, Part], present: Collection[str]) -> str:
    """In words, which objects have a part but no videos, or the reverse, and whether any is for test; else empty."""
    said = []
    for part in (Part.TEST, Part.VALIDATION):
        known = sorted(o for o, own in parts.items() if own == part)
        if lacking := [o for o in known if o not in present]:
            said.append(f"{len(lacking)} of {len(known)} {part} objects have no videos ({', '.join(lacking)})")
        elif not known and part is Part.TEST:
            said.append("no object is for test")
    if spare := sorted(o for o in present if parts.get(o, Part.UNUSED) is Part.UNUSED):
        said.append(f"{len(spare)} with videos are in no part ({', '.join(spare)}): objects.csv gives parts")
    if not any(parts.get(o) is Part.TEST for o in present):
        said.append("so nothing can be asked; split.name=kfold tests every object that has videos")
    return "; ".join(said)


def read_splits(config: SplitConfig, seeds: Sequence[int], root: Path = Path()) -> dict[int, list[Assignment]]:
    """The splits of the project in `root` that differ, by their first seed: one a fold with kfold, else one."""
    first = {config.fold_of(seed): seed for seed in reversed(seeds)}
    return {seed: read_table(root / split_file(seed), Assignment) for seed in sorted(first.values())}


def _deal(catalogue: Catalogue, present: Collection[str], config: SplitConfig, fold: int) -> dict[str, Part]:
    """Put one fold into test and a few of the other objects into validation, with classes spread as in the rest."""
    if len(present) < config.folds:
        raise UserError(f"split.folds is {config.folds}, but only {len(present)} objects have videos; lower it")
    labels = {o: catalogue.labels(o) for o in present}
    tested = _balanced(labels, config.folds, derive_seed(config.seed, "kfold"))[fold]
    learnt = {o: label for o, label in labels.items() if o not in tested}
    chosen = _balanced(learnt, min(VALIDATION, len(learnt)), derive_seed(config.seed, f"validation {fold}"))[0]
    rest = sorted(learnt.keys() - set(chosen))
    random.Random(derive_seed(config.seed, f"training {fold}")).shuffle(rest)
    if config.train_objects > len(rest):
        raise UserError(
            f"split.train_objects is {config.train_objects}, but fold {fold} has {len(rest)} training objects; lower it"
        )
    unused = rest[config.train_objects :] if config.train_objects else []
    known = {**dict.fromkeys(tested, Part.TEST), **dict.fromkeys(chosen, Part.VALIDATION)}
    return {**dict.fromkeys(labels, Part.TRAIN), **dict.fromkeys(unused, Part.UNUSED), **known}


def _balanced(labels: Mapping[str, tuple[int, ...]], count: int, seed: int) -> list[list[str]]:
    """Shuffle the objects and deal them out, each to the group that has least of its classes.

    Sizes of groups differ by one at the most, since an object always goes to one of the smallest.
    """
    objects = sorted(labels)
    random.Random(seed).shuffle(objects)
    groups: list[list[str]] = [[] for _ in range(count)]
    for o in sorted(objects, key=lambda o: labels[o]):
        smallest = min(map(len, groups))
        open_groups = [members for members in groups if len(members) == smallest]
        min(open_groups, key=lambda members: sum(sum(map(eq, labels[o], labels[m])) for m in members)).append(o)
    return groups

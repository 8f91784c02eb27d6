"""A trained model's copy for another sensor or other objects: by videos alone, or by rated ones."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from pipeline.core.io import atomic_folder, load_tensors, save_tensors, sha256, write_json, write_text
from pipeline.core.records import Encoder
from pipeline.encoder.embed import standardize
from pipeline.encoder.frame_classifier import Clips, FittedHeads, JointFrameClassifier
from pipeline.evaluation.calibration import likeliest_temperature
from pipeline.evaluation.intervals import accuracy_interval
from pipeline.running.errors import UserError, counted
from pipeline.running.progress import track
from pipeline.training.card import CARD_FILE
from pipeline.training.embeddings import STATISTICS_FILE, Statistics
from pipeline.use.encoding import EncodedVideo
from pipeline.use.few_ratings import Known, Linear, Rated, Reading, on_features, read_anew, standardised
from pipeline.use.folder import BASE_DIR, CATALOGUE, CONFIG, ENCODER_DIR, FITTED, TRAINED, distance
from pipeline.use.model import Octopi
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos, raise_errors
from pipeline.videos.split import MORE

log = logging.getLogger(__name__)
FARTHEST = 1.0
"""How far the mean of a new logit may lie from the old one's, in deviations of the old one. That of a class which no
rated object has would lie farther off than any in training. The limit was chosen by how often the language model then
names the classes of its heads, on real videos without their labels."""

CARD = """# {name}, fitted to another sensor

A copy of `{name}`, whose card has the licences of its weights and what they were trained on; these are unchanged.

{told}
"""


class Adapted(NamedTuple):
    """What was changed."""

    changed: dict[str, torch.Tensor]
    """Tensors of the property heads, in place of the old ones; empty where they stay."""
    statistics: Statistics
    told: str
    """What a reader should know of it."""
    temperatures: dict[str, float]
    """By which the logits of each property are divided for its probabilities; empty where they stay."""


def rated_videos(folders: Sequence[Path], catalogue: Catalogue) -> dict[Path, str]:
    """The videos of folders by the object that each is of; those of unrated objects are left out with a warning."""
    found: dict[Path, str] = {}
    for folder in folders:
        if folder.is_file():
            raise UserError(
                f"{folder}: is a file; name the folder of videos that the catalogue's objects are rated for"
            )
        listing = list_videos(folder, catalogue)
        raise_errors(folder, listing.findings)
        for finding in listing.findings:
            log.warning("%s: %s", finding.item, finding.measured)
        found |= {file.path: file.object_id for file in listing.files}
    return found


def adapt(
    model: Octopi,
    videos: Sequence[Path],
    to: Path,
    *,
    catalogue: Catalogue | None = None,
    objects: Sequence[str] = (),
    seed: int = 0,
) -> str:
    """Copy a model's folder for the sensor of these videos, and say what the copy knows.

    Embeddings or the logits of the property heads are standardised by the videos' frames, as another sensor shifts and
    scales them. With ratings the heads are read anew on the frozen encoder (`pipeline.use.few_ratings`). A language
    model that reads logits is given the new ones as it learnt to read them (`as_learnt`); it is not trained.

    Args:
        catalogue: Ratings of any properties. Where they are not the model's, heads alone answer.
        objects: With a catalogue, the object of each video.
        seed: Of the folds that the copy is tested by.

    Raises:
        UserError: for a model with nothing to adapt or that has met a rated object, too few or unusable videos, or
            where `to` is there already.
    """
    config = model.config
    if to.exists():
        raise UserError(f"{to}: is there already; name a folder that is not")
    classifier = model.encoder.classifier
    heads = isinstance(classifier, JointFrameClassifier) and config.encoder_used is Encoder.FINETUNED
    if catalogue is not None and not heads:
        raise UserError(
            f"{model.folder}: heads are read anew where it has been fine-tuned with encoder.recipe=tuned; leave "
            "--catalogue out, or train such a model"
        )
    if not heads and not config.encoder.standardize:
        raise UserError("encoder.standardize was off in training, so there is nothing to adapt; train the model anew")
    encoded = [model.encoder.encode(video) for video in track(videos, "adapt", "video")]
    for video in encoded:
        if not video.touched:
            log.warning("%s: left out, %s", video.name, video.touch.notes[0])
    if catalogue is not None:
        objects = [name for name, video in zip(objects, encoded, strict=True) if video.touched]
        if met := sorted({*config.objects} & {*objects}):
            raise UserError(
                f"{model.folder}: has met {met[0]}, so it cannot be tested by it; adapt the model that it was made of, "
                "or leave the object out"
            )
        if len({*objects}) < 2:
            raise UserError(f"{counted(len({*objects}), 'rated object')} with touches; heads need two, better {MORE}")
    encoded = [video for video in encoded if video.touched]
    if sum(len(video.raw) for video in encoded) < 2:
        raise UserError("fewer than two frames with touches have no deviation; name more videos")
    made = _without_ratings(model, encoded) if catalogue is None else _rated(model, encoded, catalogue, objects, seed)
    update: dict[str, Any] = {
        "variant": to.name,
        "names": "number" if model.numbered else "catalogue",
        "scores": {},
        "temperatures": made.temperatures or config.temperatures,
    }
    update["trained_on"] = FITTED if catalogue is None and not config.rated else "videos"
    # Rounded up to the digits that config.json keeps, so that the farthest video itself is not flagged.
    farthest = max(distance(standardize(video.raw, made.statistics).double().numpy()) for video in encoded)
    update["usual"] = math.ceil(1e4 * farthest) / 1e4
    if catalogue is not None:
        same = [*catalogue.classes.items()] == [*model.catalogue.classes.items()]
        update |= {"speaks": config.speaks and same, "objects": tuple(sorted({*config.objects, *objects}))}
    with atomic_folder(to) as folder:
        for name in config.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(model.folder / name, folder / name)
        if (base := model.folder / BASE_DIR).is_dir():
            shutil.copytree(base, folder / BASE_DIR)
        made.statistics.save(folder / ENCODER_DIR / STATISTICS_FILE)
        if made.changed:
            kept = {n: t for n, t in load_tensors(folder / ENCODER_DIR / TRAINED).items() if not n.startswith("heads.")}
            save_tensors(folder / ENCODER_DIR / TRAINED, kept | made.changed)
        if catalogue is not None:
            write_json(folder / CATALOGUE, catalogue.model_dump(mode="json"))
        write_text(folder / CARD_FILE, CARD.format(name=model.name, told=made.told))
        changed = (f"{ENCODER_DIR}/{STATISTICS_FILE}", f"{ENCODER_DIR}/{TRAINED}", CATALOGUE, CARD_FILE)
        update["files"] = {**config.files, **{name: sha256(folder / name) for name in changed}}
        write_json(folder / CONFIG, config.model_copy(update=update).model_dump(mode="json"))
    return made.told


def _without_ratings(model: Octopi, encoded: Sequence[EncodedVideo]) -> Adapted:
    """Standardise what the language model reads, and the heads' logits, by these videos."""
    statistics, classifier = model.encoder.statistics, model.encoder.classifier
    clips, changed, what = _clips(encoded), dict[str, torch.Tensor](), list[str]()
    if statistics.heads is not None and model.config.speaks:
        classes = [len(p.levels) for p in model.catalogue.properties]
        statistics = as_learnt(statistics, standardised(_linear(model), clips), clips, classes)
    elif model.config.encoder.standardize:
        what = ["embeddings"]
        std, mean = torch.std_mean(torch.cat([video.features for video in encoded]).double(), dim=0, correction=0)
        # The features are standardised already, so the new mean and deviation come on top of the old ones. A dimension
        # that is constant in these frames gives no estimate of its scale, so the old scale stays.
        mean, scale = statistics.mean + mean * statistics.scale, statistics.scale * torch.where(std > 0, std, 1.0)
        statistics = statistics._replace(mean=mean, scale=scale)
    if isinstance(classifier, JointFrameClassifier) and model.config.encoder_used is Encoder.FINETUNED:
        # Which classes occur together among the objects of its training says nothing of other objects.
        none = np.zeros(classifier.classes)
        changed = _tensors(on_features(standardised(_linear(model), clips), clips, classifier.classes, none))
    what += ["logits of its property heads"] if changed or statistics.heads is not None else []
    told = f"The {' and '.join(what)} are standardised by {counted(len(encoded), 'video')}, without a label. "
    told += "It was tested on nothing."
    # Those of the old logits do not hold for the new ones.
    return Adapted(changed, statistics, told, dict.fromkeys(model.properties, 1.0) if changed else {})


def as_learnt(known: Statistics, heads: Linear, clips: Clips, classes: Sequence[int]) -> Statistics:
    """Have a language model read new heads' logits as it learnt to read those of the old ones.

    It learnt which differences between the logits of a property mean which class. To standardise each logit would
    change them, so each property has one factor, by which its logits deviate as the old ones do.

    Args:
        known: Mean and deviation of the old logits, which stay.
        heads: Weights and biases of the new ones.
        clips: Features of videos that the deviation is measured on, videos x frames x dim.
        classes: How many each property has.
    """
    weights, biases = map(torch.from_numpy, heads)
    logits = torch.from_numpy(clips).double().flatten(0, 1) @ weights.T + biases
    std, mean = torch.std_mean(logits, dim=0, correction=0)
    own, old = (torch.stack([part.norm() for part in each.split([*classes])]) for each in (std, known.scale))
    # Where all rated objects have one class, its logits are constant.
    factor = torch.where(own > 1e-6, old / own, 1.0).repeat_interleave(torch.tensor(classes))
    place = ((mean * factor - known.mean) / known.scale).clamp(-FARTHEST, FARTHEST)
    shown = (weights * factor[:, None], (biases - mean) * factor + known.mean + place * known.scale)
    return known._replace(heads=shown)


def _rated(
    model: Octopi, encoded: Sequence[EncodedVideo], catalogue: Catalogue, objects: Sequence[str], seed: int
) -> Adapted:
    """Read the heads anew, and test them on objects that were held out."""
    levels = [len(p.levels) for p in catalogue.properties]
    same = [*catalogue.classes.items()] == [*model.catalogue.classes.items()]
    labels, clips = np.array([catalogue.labels(o) for o in objects]), _clips(encoded)
    read = read_anew(Rated(clips, labels, np.array(objects)), levels, Known(_linear(model), same), seed)
    statistics = model.encoder.statistics
    if statistics.heads is None:
        statistics = _without_ratings(model, encoded).statistics
    elif same and model.config.speaks:
        statistics = as_learnt(statistics, read.heads.linear(), clips, levels)
    temperatures = {
        p.name: likeliest_temperature(np.exp(table), labels[:, place], objects)
        for place, (p, table) in enumerate(zip(catalogue.properties, read.evidence, strict=True))
    }
    told = _expected(read, labels, objects, catalogue.classes)
    if not (same and model.config.speaks):
        told += "\nIts language model knows other properties, and is not asked; heads alone answer."
    return Adapted(_tensors(read.heads), statistics, told, temperatures)


def _expected(read: Reading, labels: np.ndarray, objects: Sequence[str], classes: dict[str, tuple[str, ...]]) -> str:
    """What is to be expected of new objects, by those that were held out."""

    def right(found: np.ndarray) -> np.ndarray:
        whole: np.ndarray = (found == labels).all(axis=1).astype(np.float64)
        return whole

    whole = right(read.predicted)
    each = ", ".join(
        f"{name} {100 * s:.0f}" for name, s in zip(classes, (read.predicted == labels).mean(0), strict=True)
    )
    interval = accuracy_interval(whole, [(name,) for name in objects])
    ends = "" if interval is None else f" [{100 * interval.low:.0f}, {100 * interval.high:.0f}]"
    number, share, half = len({*objects}), 100 * whole.mean(), 100 * right(read.halved).mean()
    chance, usual = 100 / math.prod(map(len, classes.values())), 100 * right(read.usual).mean()
    rest = f"chance {chance:.1f}, the most frequent classes {usual:.1f}"
    more = (
        f"twice as many objects may bring some {share - half:.0f} points more"
        if share > half
        else "what more objects would bring cannot be said"
    )
    return (
        f"Its property heads are read from {read.way}, by {counted(number, 'rated object')} "
        f"({counted(len(labels), 'video')}).\n"
        f"Expected of new objects (each held out once): all properties right in {share:.1f} %{ends} of videos\n"
        f"({each}); {rest}.\nHalf as many objects gave {half:.1f} %, so {more}."
    )


def _clips(encoded: Sequence[EncodedVideo]) -> np.ndarray:
    """Features of the encoder, videos x frames x dim."""
    return np.stack([video.raw.numpy() for video in encoded])


def _linear(model: Octopi) -> tuple[np.ndarray, np.ndarray]:
    """The logits' linear map: that which the language model reads, or else that of the property heads."""
    if model.encoder.statistics.heads is not None and model.config.speaks:
        weights, biases = model.encoder.statistics.heads
        return weights.numpy(), biases.numpy()
    state = {name: t.detach().cpu().double().numpy() for name, t in model.encoder.classifier.state_dict().items()}
    count = len(model.catalogue.properties)
    weights = np.concatenate([state[f"heads.{n}.weight"] for n in range(count)]) / state["spread"]
    return weights, np.concatenate([state[f"heads.{n}.bias"] for n in range(count)]) - weights @ state["centre"]


def _tensors(found: FittedHeads) -> dict[str, torch.Tensor]:
    """Heads as a model's file has them."""
    named: dict[str, np.ndarray] = {"centre": found.centre, "spread": found.spread, "dependence": found.dependence}
    for number, (weight, bias) in enumerate(zip(found.weights, found.biases, strict=True)):
        named |= {f"heads.{number}.weight": weight, f"heads.{number}.bias": bias}
    return {name: torch.from_numpy(np.ascontiguousarray(array)).float() for name, array in named.items()}

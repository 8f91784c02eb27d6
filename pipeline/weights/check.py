"""Whether folders of base weights are whole and fit together, by their headers: asked when a scale is chosen."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import UserError
from pipeline.core.io import tensor_shapes
from pipeline.weights import BACKBONES, CLIP_CONFIG, again
from pipeline.weights.shapes import LIKE_LLAMA, LLM_CONFIG, Llama, Vision, read_form

if TYPE_CHECKING:
    from tokenizers import Tokenizer

LLM_WEIGHTS, TOKENIZER = "model.safetensors", "tokenizer.json"
PLAIN_TOWER = {"layers", "width", "patch_size", "image_size", "head_width"}
"""Keys of `vision_cfg` that `Vision.tensors` follows from; with others, open_clip alone knows the shapes."""
Found = Mapping[str, tuple[Path, tuple[int, ...]]]
"""The file and the shape of each tensor."""


def check_language_files(folder: Path, key: str = "language.weights") -> None:
    """Raise UserError where a language model's files are cut off, broken, or do not fit together.

    `pipeline.weights.check_language` has seen that they are there.

    Args:
        folder: Nothing is said of one that is not there, since the chain may make it.
        key: The parameter that names it.
    """
    if not folder.is_dir():
        return
    file = folder / LLM_CONFIG
    form = read_form(file)
    if not isinstance(form.get("model_type"), str):
        raise UserError(f"{key}: {file} names no model_type; {again(folder)}")
    read_form(folder / "tokenizer_config.json")
    words = read_tokenizer(folder).get_vocab(with_added_tokens=False)
    found = stored(weight_files(folder, LLM_WEIGHTS, key), key, again(folder))
    if form["model_type"] not in LIKE_LLAMA or "quantization_config" in form:
        return
    llama = Llama.read(folder)
    assert llama is not None
    check_shapes(found, llama.tensors, file, key)
    if (last := max(words.values(), default=0)) >= llama.vocab_size:
        raise UserError(
            f"{key}: {folder / TOKENIZER} has words up to number {last}, but vocab_size of {file} is "
            f"{llama.vocab_size}; take both from one model"
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
    if not folder.is_dir():
        return
    read = [BACKBONES[name] for name in backbone if BACKBONES[name].key == "weights"]
    files = {file for each in read for file in each.files(folder) if file.suffix == ".safetensors"}
    found = stored(files, key, again(folder))
    if "clip" in backbone:
        tower = Vision.read(folder)
        if tower is None:
            raise UserError(f"{key}: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
        if read_form(folder / CLIP_CONFIG)["model_cfg"]["vision_cfg"].keys() <= PLAIN_TOWER:
            check_shapes(found, tower.tensors, folder / CLIP_CONFIG, key)


def read_tokenizer(folder: Path) -> Tokenizer:
    """The fast tokenizer of a folder; raises UserError where its file is broken."""
    from tokenizers import Tokenizer

    try:
        return Tokenizer.from_file(str(folder / TOKENIZER))
    except Exception as error:  # The library raises nothing narrower.
        raise UserError(f"{folder / TOKENIZER} is no fast tokenizer ({error}); {again(folder)}") from None


def weight_files(folder: Path, name: str, key: str) -> list[Path]:
    """The file of this name, or the shards that its index names, as transformers looks for them.

    Raises:
        UserError: where there is neither, the index is broken, or a shard is missing.
    """
    file, index = folder / name, folder / f"{name}.index.json"
    if file.is_file():
        return [file]
    if not index.is_file():
        raise UserError(f"{key}: {folder} has neither {name} nor {index.name} beside its shards; {again(folder)}")
    places: Any = read_form(index).get("weight_map")
    if not isinstance(places, dict) or not places or not all(isinstance(p, str) for p in places.values()):
        raise UserError(f"{key}: {index} maps no tensors to files (weight_map); {again(folder)}")
    shards = [folder / shard for shard in sorted(set(places.values()))]
    for shard in shards:
        if not shard.is_file():
            raise UserError(f"{key}: {shard} does not exist, but {index.name} names it; {again(folder)}")
    return shards


def stored(files: Collection[Path], key: str, mend: str) -> Found:
    """The tensors of safetensors files, by their headers; raises UserError where one is broken or cut off."""
    try:
        return {name: (file, shape) for file in files for name, shape in tensor_shapes(file, mend).items()}
    except UserError as error:
        raise UserError(f"{key}: {error}") from None


def check_shapes(found: Found, wanted: Mapping[str, tuple[int, ...]], config: Path, key: str) -> None:
    """Raise UserError where a tensor is missing or of another shape than its configuration says."""
    mend = f"take it and {config.name} from one model"
    for name, shape in wanted.items():
        if name not in found:
            raise UserError(f"{key}: {config.parent} has no tensor {name}, which {config} asks for; {mend}")
        file, own = found[name]
        if own != shape:
            raise UserError(f"{key}: {name} in {file} is {_by(own)}, but {config} makes it {_by(shape)}; {mend}")


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "one number"

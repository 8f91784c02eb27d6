"""Base models that the user downloads: brought into the form that the chain reads, or checked where they lie.

A pickle is read on the user's word alone, and then for its tensors: no code of it is run.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.io import atomic_folder, load_tensors, save_tensors, sha256, write_json, write_text
from pipeline.running.errors import UserError
from pipeline.weights import DOWNLOADED, check_language, load_language, sparsh
from pipeline.weights.backbones import CLIP_CONFIG, CLIP_WEIGHTS, frame_side
from pipeline.weights.check import (
    LLM_CONFIG,
    PUBLISHED_CLIP,
    PUBLISHED_LANGUAGE,
    SHAPES,
    TOKENIZER,
    check_encoder_files,
    check_language_files,
    read_form,
    stored_shapes,
)
from pipeline.weights.clip_layout import PICTURES, open_clip_form, to_open_clip

if TYPE_CHECKING:
    import torch

SUMS, PIECES = "SHA256SUMS", "tokenizer.model"
COPIED = (".safetensors", ".json", ".md", ".model", ".txt", "")
"""Endings of weights, and of what lies beside them: settings, card, licence."""
CARDS = (".md", ".txt", "")
COMPUTED = "rotary_emb.inv_freq"
"""A tensor that older files store with each layer of a Llama; it follows from the configuration."""


def new_folder(to: Path) -> Path:
    """`to`; raises UserError where it is there already, as what lies in it would be lost."""
    if to.exists():
        raise UserError(f"{to} is there already; remove it, or name another folder with --to")
    return to


def adopt(name: str, source: Path, to: Path | None = None, *, trust_pickle: bool = False) -> Path:
    """Check a downloaded model, bring it into the form that the chain reads, and list the SHA-256 of its files.

    Args:
        name: In `DOWNLOADED`.
        to: Where it goes; without it, it stays where nothing is to be converted, and else goes to weights/.
        trust_pickle: Whether pickles may be read, for their tensors alone.

    Returns:
        Where it lies.

    Raises:
        UserError: for a folder with something else than was published under this name, or with a broken file; for
            pickles without `trust_pickle`; and where `to` is there already.
    """
    repository, known = DOWNLOADED[name]
    if not source.is_dir():
        raise UserError(f"{source} is no folder; `hf download {repository} --local-dir {source}` makes it")
    if known in PUBLISHED_CLIP:
        check, convert = check_clip, convert_clip
        # Of a folder with neither layout's configuration, the check says what is missing.
        converted = (source / CLIP_CONFIG).is_file() or not (source / PICTURES).is_file()
    else:
        check, convert = check_vicuna, convert_vicuna
        converted = (source / TOKENIZER).is_file() and any(source.glob("*.safetensors"))
    if to is None and converted and name != "sparsh":
        check(source, name)
        write_sums(source)
        return source
    to = new_folder(to or Path("weights") / known)
    with atomic_folder(to) as temporary:
        try:
            if name == "sparsh":
                write_sparsh(source, temporary, name)
            else:
                if not converted:
                    convert(source, temporary, name, trust_pickle)
                copy(source, temporary, CARDS if convert is convert_clip and not converted else COPIED)
                check(temporary, name)
        except UserError as error:  # What is wrong is so in the folder that was downloaded.
            raise UserError(str(error).replace(str(temporary), str(source))) from None
        write_sums(temporary)
    return to


def write_sums(folder: Path) -> None:
    """List the SHA-256 of a folder's files in it, as `sha256sum --check` reads it; hidden files are left out."""
    names = [f.relative_to(folder) for f in sorted(folder.rglob("*")) if f.is_file()]
    shown = [n for n in names if n.as_posix() != SUMS and not any(part.startswith(".") for part in n.parts)]
    write_text(folder / SUMS, "".join(f"{sha256(folder / n)}  {n.as_posix()}\n" for n in shown))


def check_vicuna(folder: Path, name: str) -> None:
    """Raise UserError where a folder in the chain's form is not what was published as `name`."""
    check_language(folder, name, exists=True)
    check_values(read_form(folder / LLM_CONFIG), PUBLISHED_LANGUAGE[DOWNLOADED[name].folder], folder, name)
    check_language_files(folder, name)


def convert_vicuna(source: Path, target: Path, name: str, trust_pickle: bool) -> None:
    """Write a fast tokenizer and safetensors where a downloaded language model lacks them."""
    from huggingface_hub import save_torch_state_dict
    from transformers import AutoTokenizer

    # First, before many gigabytes of another model are read.
    read_form(source / "tokenizer_config.json")
    check_values(read_form(source / LLM_CONFIG), PUBLISHED_LANGUAGE[DOWNLOADED[name].folder], source, name)
    if not (source / TOKENIZER).is_file():
        # Without it, transformers would make a tokenizer of no words.
        if not (source / PIECES).is_file():
            raise UserError(f"{name}: {source} has neither {TOKENIZER} nor {PIECES}; download them again")
        try:
            tokenizer = AutoTokenizer.from_pretrained(source, local_files_only=True, trust_remote_code=False)
        except Exception:  # For a file that is cut off, transformers asks for other packages.
            raise UserError(f"{name}: {source / PIECES} is no tokenizer; download it again") from None
        tokenizer.save_pretrained(target)
    if not any(source.glob("*.safetensors")):
        # Mapped from disk, tensors pass through in their own number format without taking memory; the model's
        # `save_pretrained` would take twice its size.
        states = [read_pickle(file, name, trust_pickle) for file in sorted(source.glob("pytorch_model*.bin"))]
        load_language(source, name, use_safetensors=False, **SHAPES)
        kept = {n: value for state in states for n, value in state.items() if not n.endswith(COMPUTED)}
        save_torch_state_dict(kept, target, max_shard_size="10GB", metadata={"format": "pt"})


def convert_clip(source: Path, target: Path, name: str, trust_pickle: bool) -> None:
    """Write a CLIP of transformers' as open_clip has it."""
    write_json(target / CLIP_CONFIG, open_clip_form(source))
    save_tensors(target / CLIP_WEIGHTS[0], to_open_clip(read_weights(source, name, trust_pickle)), {"format": "pt"})


def read_weights(source: Path, name: str, trust_pickle: bool) -> dict[str, torch.Tensor]:
    """All tensors of a folder of transformers': of its safetensors, or where it has none of its trusted pickles."""
    if files := sorted(source.glob("*.safetensors")):
        stored_shapes(files, name)  # Raises for one that is cut off.
        return {key: value for file in files for key, value in load_tensors(file).items()}
    if not (pickles := sorted(source.glob("pytorch_model*.bin"))):
        raise UserError(f"{name}: {source} has no weights, neither safetensors nor a pickle; download them again")
    return {key: value for file in pickles for key, value in read_pickle(file, name, trust_pickle).items()}


def check_clip(folder: Path, name: str) -> None:
    """Raise UserError where a folder in open_clip's layout is not what was published as `name`.

    Shapes, quick-GELU and normalisation are held to it: with others embeddings differ by a little, and nothing shows.
    """
    import open_clip

    frame_side(folder, "clip")  # Raises where a file is missing, or the configuration is of something else.
    form = read_form(folder / CLIP_CONFIG)
    published = open_clip.get_model_config(PUBLISHED_CLIP[DOWNLOADED[name].folder])
    # What a file leaves out, open_clip takes for OpenAI's.
    pictures = {"mean": [*open_clip.OPENAI_DATASET_MEAN], "std": [*open_clip.OPENAI_DATASET_STD]}
    found, wanted = (
        {"head_width": 64, **m["vision_cfg"], "embed_dim": m.get("embed_dim"), "quick_gelu": m.get("quick_gelu", False)}
        for m in (form["model_cfg"], published)
    )
    own = form.get("preprocess_cfg")
    found |= pictures | (own if isinstance(own, dict) else {})
    check_values(found, wanted | pictures, folder, name)
    check_encoder_files(folder, ("clip",), name)


def write_sparsh(source: Path, target: Path, name: str) -> None:
    """Write a downloaded Sparsh encoder as timm lays out its own networks, held to the published layout."""
    files = sorted(source.glob("*.safetensors"))
    if len(files) != 1:
        raise UserError(
            f"{name}: {source} has {len(files)} files *.safetensors, not the one published; download it again"
        )
    copy(source, target, CARDS)
    stored_shapes(files, name)  # Raises for one that is cut off.
    sparsh.write(target, load_tensors(files[0]), name)


def check_values(found: Mapping[str, Any], known: Mapping[str, Any], folder: Path, name: str) -> None:
    """Raise UserError where a configuration has another value than was published."""
    for word, value in known.items():
        if found.get(word) != value:
            mend = "download that one, or name the one that it is"
            if word == "quick_gelu":
                mend = "where the weights are OpenAI's, set that in its configuration"
            raise UserError(
                f"{name}: {folder} has {word} {found.get(word)!r}, but {DOWNLOADED[name].folder} was published with "
                f"{value!r}; {mend}"
            )


def read_pickle(file: Path, key: str, trusted: bool) -> dict[str, torch.Tensor]:
    """The tensors of a pickle, mapped from disk; raises UserError where it is broken, holds more or is not trusted."""
    import torch

    if not trusted:
        raise UserError(
            f"{key}: {file} is a pickle, and there are no safetensors; where you trust it, add --trust-pickle: its "
            "tensors are read, and nothing of it is run"
        )
    try:
        state = torch.load(file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file))
    except Exception:  # A damaged one may end torch's reader by nearly any of them.
        state = None
    if not isinstance(state, dict) or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise UserError(f"{key}: {file} is cut off, or holds more than tensors, which is not run; download it again")
    return state


def copy(source: Path, target: Path, endings: tuple[str, ...]) -> None:
    """Copy files of these endings that are not there yet, but no hidden file, list of hashes or index of pickles."""
    for file in source.iterdir():
        odd = file.name.startswith(".") or file.name == SUMS or file.name.endswith(".bin.index.json")
        if file.is_file() and file.suffix in endings and not odd and not (target / file.name).exists():
            shutil.copyfile(file, target / file.name)

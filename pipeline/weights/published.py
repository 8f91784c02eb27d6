"""Base models that the user downloads: brought into the form that the chain reads, or checked where they lie.

Published values are those of `pipeline.weights.shapes`. A pickle is read on the user's word alone, and then for its
tensors: no code of it is run.
"""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import UserError
from pipeline.core.io import atomic_folder, load_tensors, save_tensors, sha256, write_json, write_text
from pipeline.weights import CLIP_CONFIG, CLIP_WEIGHTS, DOWNLOADED, check_language, clip_file
from pipeline.weights.check import (
    LLM_WEIGHTS,
    TOKENIZER,
    check_encoder_files,
    check_language_files,
    check_shapes,
    read_tokenizer,
    stored,
    weight_files,
)
from pipeline.weights.shapes import LLM_CONFIG, PUBLISHED_LANGUAGE, PUBLISHED_VISION, Llama, Vision, read_form

if TYPE_CHECKING:
    import torch

SUMS = "SHA256SUMS"
PIECES = "tokenizer.model"
"""SentencePiece's file."""
LLM_PICKLE = "pytorch_model.bin"
CLIP_PICKLES = ("open_clip_pytorch_model.bin", LLM_PICKLE)
PICTURES = {"mean": [0.48145466, 0.4578275, 0.40821073], "std": [0.26862954, 0.26130258, 0.27577711]}
"""How pixels in [0, 1] are normalised for OpenAI's CLIP (clip.py of github.com/openai/CLIP)."""
SIDE_FILES = (".json", ".md", ".model", ".txt", "")
"""Endings of what is copied beside the weights: settings, card, licence."""
COMPUTED = "rotary_emb.inv_freq"
"""Once stored with each layer of a Llama; it follows from the configuration."""
TEXTS = (
    "A chat between a curious user and an artificial intelligence assistant.",
    "USER: Which is rougher, 1 or 23?\nASSISTANT: 東京, Überraschung; \ttwo  spaces 😀",
)
"""Read with the fast tokenizer and the slow one. Neither begins with a blank, which they read differently."""


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
    clip = known in PUBLISHED_VISION
    if clip:
        ready = (source / CLIP_CONFIG).is_file() and clip_file(source).is_file()
    else:
        ready = (source / TOKENIZER).is_file() and _has(source, LLM_WEIGHTS)
    if to is None and ready:
        check_clip(source, known, name) if clip else check_vicuna(source, known, name)
        write_sums(source)
        return source
    to = new_folder(to or Path("weights") / known)
    with atomic_folder(to) as temporary:
        (write_clip if clip else write_vicuna)(source, temporary, known, name, trust_pickle)
        write_sums(temporary)
    return to


def write_sums(folder: Path) -> None:
    """List the SHA-256 of a folder's files in it, as `sha256sum --check` reads it; hidden files are left out."""
    names = [f.relative_to(folder) for f in sorted(folder.rglob("*")) if f.is_file()]
    shown = [n for n in names if n.as_posix() != SUMS and not any(part.startswith(".") for part in n.parts)]
    write_text(folder / SUMS, "".join(f"{sha256(folder / n)}  {n.as_posix()}\n" for n in shown))


# ---- language models ----


def check_vicuna(folder: Path, known: str, key: str) -> None:
    """Raise UserError where a folder in the chain's form is not what was published as `known`.

    Args:
        key: What the line begins with.
    """
    check_language(folder, key, exists=True)
    check_values(read_form(folder / LLM_CONFIG), PUBLISHED_LANGUAGE[known], folder / LLM_CONFIG, known, key)
    check_language_files(folder, key)
    check_tokenizer(folder, folder / PIECES, known, key)


def write_vicuna(source: Path, target: Path, known: str, key: str, trust_pickle: bool) -> None:
    """Write a downloaded language model with a fast tokenizer and safetensors; what can be wrong is asked first."""
    form = source / LLM_CONFIG
    for file in (form, source / "tokenizer_config.json"):
        if not file.is_file():
            raise UserError(f"{key}: {file} does not exist; download it again")
    check_values(read_form(form), PUBLISHED_LANGUAGE[known], form, known, key)
    llama = Llama.read(source)
    assert llama is not None
    pickled = not _has(source, LLM_WEIGHTS)
    files = _pickles(source, (LLM_PICKLE,), key) if pickled else weight_files(source, LLM_WEIGHTS, key)
    shards = {file: read_pickle(file, key, trust_pickle) for file in files} if pickled else {}
    found = {name: (file, tuple(value.shape)) for file, state in shards.items() for name, value in state.items()}
    check_shapes(found or stored(files, key, "download it again"), llama.tensors, form, key)
    copy_beside(source, target)
    fast = (source / TOKENIZER).is_file()
    if not fast:
        write_tokenizer(source, target, key)
    check_tokenizer(source if fast else target, source / PIECES, known, key)
    if pickled:
        write_shards(shards, target)
    else:
        for file in files:
            shutil.copyfile(file, target / file.name)


def write_shards(shards: Mapping[Path, Mapping[str, torch.Tensor]], target: Path) -> None:
    """Write each pickle's tensors as a safetensors file, and the index that transformers wants where there are several.

    They are written in the number format that they came in. `read_pickle` has mapped them from disk, so that they pass
    through without taking memory of their own.
    """
    places: dict[str, str] = {}
    for file, state in shards.items():
        kept = {name: value for name, value in state.items() if not name.endswith(COMPUTED)}
        name = file.with_suffix(".safetensors").name.removeprefix("pytorch_")
        save_tensors(target / name, kept, {"format": "pt"})
        places |= dict.fromkeys(kept, name)
    if len(shards) > 1:
        size = sum(value.nbytes for state in shards.values() for name, value in state.items() if name in places)
        write_json(target / f"{LLM_WEIGHTS}.index.json", {"metadata": {"total_size": size}, "weight_map": places})


def write_tokenizer(source: Path, target: Path, key: str) -> None:
    """Write the fast tokenizer of a SentencePiece model."""
    from transformers import AutoTokenizer

    if not (source / PIECES).is_file():
        raise UserError(f"{key}: {source} has neither {TOKENIZER} nor {PIECES}; download them again")
    pieces(source / PIECES, key)
    try:
        tokenizer = AutoTokenizer.from_pretrained(source, local_files_only=True, trust_remote_code=False)
    except Exception as error:  # transformers raises nearly anything for a file that is cut off.
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{key}: the tokenizer in {source} cannot be read ({reason}); download it again") from None
    tokenizer.save_pretrained(target)


def check_tokenizer(folder: Path, file: Path, known: str, key: str) -> None:
    """Raise UserError where a folder's fast tokenizer is broken, or not the one of SentencePiece's file.

    Args:
        file: It is held to that where it is there.
    """
    fast = read_tokenizer(folder)
    if not file.is_file():
        return
    slow, words = pieces(file, key), PUBLISHED_LANGUAGE[known]["vocab_size"]
    if (own := slow.get_piece_size()) != words:
        raise UserError(f"{key}: {file} has {own} words, but {known} was published with {words}; download it again")
    for text in TEXTS:
        if fast.encode(text, add_special_tokens=False).ids != slow.encode(text):
            raise UserError(
                f"{key}: {folder / TOKENIZER} reads texts otherwise than {file.name}; remove it to convert that anew"
            )


def pieces(file: Path, key: str) -> Any:
    """SentencePiece with its own file; raises UserError where that is broken."""
    from sentencepiece import SentencePieceProcessor

    try:
        return SentencePieceProcessor(model_file=str(file))
    except (OSError, RuntimeError):
        raise UserError(f"{key}: {file} is no SentencePiece model; download it again") from None


# ---- CLIP ----


def check_clip(folder: Path, known: str, key: str) -> None:
    """Raise UserError where a folder in open_clip's layout is not what was published as `known`."""
    check_clip_values(folder, folder / CLIP_CONFIG, known, key)
    check_encoder_files(folder, ("clip",), key)


def check_clip_values(folder: Path, named: Path, known: str, key: str) -> None:
    """Hold open_clip_config.json of a folder to what was published: shapes, quick-GELU, normalisation.

    Args:
        named: The file that it was made of, for the UserError.
    """
    tower, form = Vision.read(folder), read_form(folder / CLIP_CONFIG)
    # What the file leaves out, open_clip takes for OpenAI's.
    own = form.get("preprocess_cfg", {})
    pictures = PICTURES | (own if isinstance(own, dict) else {})
    found = {**vars(tower), **pictures} if tower else {}
    check_values(found, PUBLISHED_VISION[known] | PICTURES, named, known, key)


def write_clip(source: Path, target: Path, known: str, key: str, trust_pickle: bool) -> None:
    """Write a downloaded CLIP, in open_clip's layout or in transformers', as open_clip has it."""
    from pipeline.weights import openai_clip

    own = (source / CLIP_CONFIG).is_file()
    named = source / (CLIP_CONFIG if own else LLM_CONFIG)
    other = source / "preprocessor_config.json"
    for file in (named,) if own else (named, other):
        if not file.is_file():
            raise UserError(f"{key}: {file} does not exist; download it again")
    try:
        form = read_form(named) if own else openai_clip.configuration(read_form(named), read_form(other))
    except UserError:
        raise
    except Exception as error:  # transformers refuses configurations by several of them.
        reason = " ".join(str(error).split())[:200]
        raise UserError(f"{key}: {named} and {other.name} are no CLIP's ({reason}); download them again") from None
    write_json(target / CLIP_CONFIG, form)
    check_clip_values(target, named, known, key)
    if (weights := clip_file(source)).is_file():
        stored([weights], key, "download it again")
        state: Mapping[str, torch.Tensor] = load_tensors(weights)
    else:
        (weights,) = _pickles(source, CLIP_PICKLES if own else (LLM_PICKLE,), key)
        state = read_pickle(weights, key, trust_pickle)
    try:
        state = state if own else openai_clip.renamed(state)
    except KeyError as error:
        raise UserError(f"{key}: {weights} has no {error}; download it again") from None
    found = {name: (weights, tuple(value.shape)) for name, value in state.items()}
    tower = Vision.read(target)
    assert tower is not None
    check_shapes(found, tower.tensors, named, key)
    save_tensors(target / CLIP_WEIGHTS[0], state, {"format": "pt"})
    copy_beside(source, target, leave=(LLM_CONFIG, CLIP_CONFIG))


# ---- both ----


def check_values(found: Mapping[str, Any], known: Mapping[str, Any], file: Path, name: str, key: str) -> None:
    """Raise UserError where a configuration has another value than was published."""
    for word, value in known.items():
        if found.get(word) != value:
            # Nothing else shows this fault: shapes are the same, and embeddings differ by a little.
            mend = "download that one, or name the one that it is"
            mend = "where the weights are OpenAI's, set that in the file" if word == "quick_gelu" else mend
            raise UserError(
                f"{key}: {file} has {word} {found.get(word)!r}, but {name} was published with {value!r}; {mend}"
            )


def read_pickle(file: Path, key: str, trusted: bool) -> dict[str, torch.Tensor]:
    """The tensors of a pickle, mapped from disk; raises UserError where it holds more, is broken, or is not trusted."""
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


def copy_beside(source: Path, target: Path, leave: tuple[str, ...] = ()) -> None:
    """Copy what lies beside the weights."""
    for file in source.iterdir():
        wanted = file.suffix in SIDE_FILES and not file.name.startswith(".") and file.name not in (*leave, SUMS)
        if file.is_file() and wanted and not file.name.endswith(f"{LLM_PICKLE}.index.json"):
            shutil.copyfile(file, target / file.name)


def _has(folder: Path, name: str) -> bool:
    return (folder / name).is_file() or (folder / f"{name}.index.json").is_file()


def _pickles(folder: Path, names: tuple[str, ...], key: str) -> list[Path]:
    found = next((name for name in names if _has(folder, name)), None)
    if found is None:
        raise UserError(f"{key}: {folder} has no weights, neither safetensors nor {names[0]}; download them again")
    return weight_files(folder, found, key)

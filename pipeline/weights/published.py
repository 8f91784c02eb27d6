"""Base models that the user downloads: brought into the form that the chain reads, or checked where they lie.

A pickle is read on the user's word alone, and then for its tensors: no code of it is run.
"""

from __future__ import annotations

import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.errors import UserError
from pipeline.core.io import atomic_folder, load_tensors, save_tensors, sha256, write_json, write_text
from pipeline.weights import CLIP_CONFIG, CLIP_WEIGHTS, DOWNLOADED, check_language, clip_file, load_language, sparsh
from pipeline.weights.check import (
    LLM_CONFIG,
    PUBLISHED_CLIP,
    PUBLISHED_LANGUAGE,
    SHAPES,
    TOKENIZER,
    check_encoder_files,
    check_language_files,
    read_form,
    read_tokenizer,
    read_tower,
    stored_shapes,
)

if TYPE_CHECKING:
    import torch

SUMS = "SHA256SUMS"
PIECES = "tokenizer.model"
"""SentencePiece's file."""
CLIP_PICKLES = ("open_clip_pytorch_model.bin", "pytorch_model.bin")
SETTINGS = (".json", ".md", ".model", ".txt", "")
"""Endings of what lies beside the weights: settings, card, licence."""
COMPUTED = "rotary_emb.inv_freq"
"""A tensor that older files store with each layer of a Llama; it follows from the configuration."""
TEXTS = (
    "A chat between a curious user and an artificial intelligence assistant.",
    "USER: Which is rougher, 1 or 23?\nASSISTANT: 東京, Überraschung; \ttwo  spaces 😀",
)
"""Read with the fast tokenizer and the slow one. Neither begins with a blank, which they read differently."""
OPEN_CLIP_NAMES = (
    (r"^vision_model\.", "visual."),
    (r"^text_model\.", ""),
    (r"^visual_projection\.weight", "visual.proj"),
    (r"^text_projection\.weight", "text_projection"),
    (r"encoder\.layers\.", "transformer.resblocks."),
    (r"self_attn\.", "attn."),
    (r"layer_norm(?=[12]\.)", "ln_"),
    (r"mlp\.fc1", "mlp.c_fc"),
    (r"mlp\.fc2", "mlp.c_proj"),
    (r"embeddings\.class_embedding", "class_embedding"),
    (r"embeddings\.patch_embedding", "conv1"),
    (r"embeddings\.token_embedding", "token_embedding"),
    (r"embeddings\.position_embedding\.weight", "positional_embedding"),
    (r"pre_layrnorm", "ln_pre"),
    (r"post_layernorm", "ln_post"),
    (r"final_layer_norm", "ln_final"),
)
"""Patterns of names in transformers' CLIP, and what open_clip has in their place; one after the other."""


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
        check, write = check_clip, write_clip
        ready = (source / CLIP_CONFIG).is_file() and clip_file(source).is_file()
    else:
        check, write = check_vicuna, write_sparsh if name == "sparsh" else write_vicuna
        ready = name != "sparsh" and (source / TOKENIZER).is_file() and any(source.glob("*.safetensors"))
    if to is None and ready:
        check(source, name)
        write_sums(source)
        return source
    to = new_folder(to or Path("weights") / known)
    with atomic_folder(to) as temporary:
        try:
            write(source, temporary, name, trust_pickle)
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
    """Raise UserError where a folder in the chain's form is not what was published as `name`.

    Its fast tokenizer must read texts as SentencePiece's file does, where that is there.
    """
    from sentencepiece import SentencePieceProcessor

    check_language(folder, name, exists=True)
    published = PUBLISHED_LANGUAGE[DOWNLOADED[name].folder]
    check_values(read_form(folder / LLM_CONFIG), published, folder, name)
    check_language_files(folder, name)
    file, words = folder / PIECES, published["vocab_size"]
    if not file.is_file():
        return
    try:
        slow = SentencePieceProcessor(model_file=str(file))
    except (OSError, RuntimeError):
        raise UserError(f"{name}: {file} is no SentencePiece model; download it again") from None
    if (own := slow.get_piece_size()) != words:
        raise UserError(f"{name}: {file} has {own} words, but was published with {words}; download it again")
    fast = read_tokenizer(folder)
    if any(fast.encode(text, add_special_tokens=False).ids != slow.encode(text) for text in TEXTS):
        raise UserError(
            f"{name}: {folder / TOKENIZER} reads texts otherwise than {file.name}; remove it to convert that anew"
        )


def write_vicuna(source: Path, target: Path, name: str, trust_pickle: bool) -> None:
    """Write a downloaded language model with a fast tokenizer and safetensors, and check it."""
    from huggingface_hub import save_torch_state_dict
    from transformers import AutoTokenizer

    # First, before many gigabytes of another model are read.
    read_form(source / "tokenizer_config.json")
    check_values(read_form(source / LLM_CONFIG), PUBLISHED_LANGUAGE[DOWNLOADED[name].folder], source, name)
    copy(source, target, *SETTINGS, ".safetensors")
    if not (source / TOKENIZER).is_file():
        if not (source / PIECES).is_file():
            raise UserError(f"{name}: {source} has neither {TOKENIZER} nor {PIECES}; download them again")
        try:
            tokenizer = AutoTokenizer.from_pretrained(source, local_files_only=True, trust_remote_code=False)
        except Exception:  # For a file that is cut off, transformers asks for other packages.
            raise UserError(f"{name}: {source / PIECES} is no SentencePiece model; download it again") from None
        tokenizer.save_pretrained(target)
    if not any(source.glob("*.safetensors")):
        # Mapped from disk, tensors pass through in their own number format without taking memory; the model's
        # `save_pretrained` would take twice its size.
        states = [read_state(file, name, trust_pickle) for file in sorted(source.glob("pytorch_model*.bin"))]
        load_language(source, name, use_safetensors=False, **SHAPES)
        kept = {n: value for state in states for n, value in state.items() if not n.endswith(COMPUTED)}
        save_torch_state_dict(kept, target, max_shard_size="10GB", metadata={"format": "pt"})
    check_vicuna(target, name)


def check_clip(folder: Path, name: str) -> None:
    """Raise UserError where a folder in open_clip's layout is not what was published as `name`.

    Shapes, quick-GELU and normalisation are held to it: with others embeddings differ by a little, and nothing shows.
    """
    import open_clip

    read_tower(folder)  # Raises for a broken configuration.
    form = read_form(folder / CLIP_CONFIG)
    published = open_clip.get_model_config(PUBLISHED_CLIP[DOWNLOADED[name].folder])
    # What a file leaves out, open_clip takes for OpenAI's.
    pictures = {"mean": [*open_clip.OPENAI_DATASET_MEAN], "std": [*open_clip.OPENAI_DATASET_STD]}
    found, wanted = (
        {"head_width": 64, **m["vision_cfg"], "embed_dim": m["embed_dim"], "quick_gelu": m.get("quick_gelu", False)}
        for m in (form["model_cfg"], published)
    )
    own = form.get("preprocess_cfg")
    found |= pictures | (own if isinstance(own, dict) else {})
    check_values(found, wanted | pictures, folder, name)
    check_encoder_files(folder, ("clip",), name)


def write_clip(source: Path, target: Path, name: str, trust_pickle: bool) -> None:
    """Write a downloaded CLIP, in open_clip's layout or in transformers', as open_clip has it, and check it."""
    import open_clip

    copy(source, target, *SETTINGS)
    theirs = not (source / CLIP_CONFIG).is_file()
    if theirs:
        model, pictures = (read_form(source / file) for file in (LLM_CONFIG, "preprocessor_config.json"))
        # Shapes are those that were published, to which the tensors are held; what they do not show is read.
        form = open_clip.get_model_config(PUBLISHED_CLIP[DOWNLOADED[name].folder])
        towers = [model[part] for part in ("vision_config", "text_config") if isinstance(model.get(part), dict)]
        quick = all(tower.get("hidden_act", "quick_gelu") == "quick_gelu" for tower in towers)
        normalised = {"mean": pictures.get("image_mean"), "std": pictures.get("image_std")}
        write_json(target / CLIP_CONFIG, {"model_cfg": form | {"quick_gelu": quick}, "preprocess_cfg": normalised})
        (target / LLM_CONFIG).unlink()  # Of another library.
    files = [file for file in (clip_file(source), *(source / n for n in CLIP_PICKLES)) if file.is_file()]
    if not files:
        raise UserError(f"{name}: {source} has no weights, neither safetensors nor a pickle; download them again")
    state = read_state(files[0], name, trust_pickle)
    save_tensors(target / CLIP_WEIGHTS[0], to_open_clip(state) if theirs else state, {"format": "pt"})
    check_clip(target, name)


def to_open_clip(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """All tensors of transformers' CLIPModel under open_clip's names, a layer's three maps of attention in one."""
    import torch

    found = {}
    for name, value in state.items():
        for pattern, there in OPEN_CLIP_NAMES:
            name = re.sub(pattern, there, name)
        if name.endswith("position_ids"):
            continue  # Once stored; they are the numbers 0, 1, 2 and so on.
        # open_clip multiplies by its projections from the other side.
        found[name] = value.T.contiguous() if name in ("visual.proj", "text_projection") else value
    for first in [name for name in found if ".attn.q_proj." in name]:
        names = [first.replace("q_proj", part) for part in ("q_proj", "k_proj", "v_proj")]
        # Where one is missing, the sum is too short, which the check of shapes sees.
        found[first.replace("q_proj.", "in_proj_")] = torch.cat([found.pop(name) for name in names if name in found])
    return found


def write_sparsh(source: Path, target: Path, name: str, trust_pickle: bool) -> None:
    """Write a downloaded Sparsh encoder as timm lays out its own networks, held to the published layout."""
    files = sorted(source.glob("*.safetensors"))
    if len(files) != 1:
        raise UserError(
            f"{name}: {source} has {len(files)} files *.safetensors, not the one published; download it again"
        )
    copy(source, target, ".md", ".txt", "")
    sparsh.write(target, read_state(files[0], name, trust_pickle), name)


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


def read_state(file: Path, key: str, trusted: bool) -> dict[str, torch.Tensor]:
    """The tensors of a file; raises UserError where it is broken, or a pickle that holds more or is not trusted.

    A pickle's are mapped from disk.
    """
    import torch

    if file.suffix == ".safetensors":
        stored_shapes([file], key)  # Raises for one that is cut off.
        return load_tensors(file)
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


def copy(source: Path, target: Path, *endings: str) -> None:
    """Copy files of these endings, but no hidden file, list of hashes or index of pickled shards."""
    for file in source.iterdir():
        odd = file.name.startswith(".") or file.name == SUMS or file.name.endswith(".bin.index.json")
        if file.is_file() and file.suffix in endings and not odd:
            shutil.copyfile(file, target / file.name)

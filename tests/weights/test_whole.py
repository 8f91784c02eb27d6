"""Folders of weights that are cut off, broken, or do not fit together are refused when a scale is chosen, in a line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import AutoConfig, AutoModelForCausalLM
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.errors import UserError
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.timm_backbone import load_backbone
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.weights import check_encoder, check_finite, check_language
from pipeline.weights.check import check_encoder_files, check_language_files
from tests.checkpoints import cut, edit, replace, write_clip, write_llama
from tests.closure import ROOT
from tests.conftest import refused
from tests.encoders import config, write_timm


def renamed(file: Path, old: str, new: str) -> None:
    tensors = load_file(file)
    save_file({new if name == old else name: value for name, value in tensors.items()}, file)


ONE = "model.safetensors"
INDEX = "model.safetensors.index.json"
LANGUAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut by a byte": (lambda f: cut(f / ONE), "model.safetensors is cut off or not a safetensors file .*; download it"),
    "a byte too many": (lambda f: (f / ONE).write_bytes((f / ONE).read_bytes() + b"x"), "model.safetensors is cut off"),
    "nothing in the weights": (lambda f: (f / ONE).write_bytes(b""), "model.safetensors is cut off"),
    "a pointer of Git LFS": (lambda f: (f / ONE).write_text("version https://git-lfs"), "model.safetensors is cut off"),
    "no tokenizer": (lambda f: (f / "tokenizer.json").unlink(), "tokenizer.json does not exist"),
    "empty tokenizer": (lambda f: (f / "tokenizer.json").write_text(""), "tokenizer.json is no fast tokenizer"),
    "tokenizer of nothing": (lambda f: (f / "tokenizer.json").write_text("{}"), "tokenizer.json is no fast tokenizer"),
    "tokenizer's settings": (lambda f: (f / "tokenizer_config.json").write_text("{"), "_config.json is not a JSON obj"),
    "settings cut": (lambda f: cut(f / "config.json", 9), "/config.json is not a JSON object"),
    "settings in UTF-16": (lambda f: (f / "config.json").write_bytes("{}".encode("utf-16")), "is not a JSON object"),
    "settings are a list": (lambda f: (f / "config.json").write_text("[]"), "/config.json is not a JSON object"),
    "no kind": (lambda f: edit(f / "config.json", model_type=None), "cannot be loaded .*model_type"),
    "no hidden_size": (
        lambda f: edit(f / "config.json", hidden_size=None),
        r"lm_head.weight is \[260, 32\], not \[260, 40",
    ),
    "a size that is a text": (
        lambda f: edit(f / "config.json", vocab_size="260"),
        "'vocab_size' expected int, got str",
    ),
    "no heads": (lambda f: edit(f / "config.json", num_attention_heads=0), "cannot be loaded .*zero"),
    "wider": (
        lambda f: edit(f / "config.json", intermediate_size=65),
        r"mlp.down_proj.weight is \[32, 64\], not .*; take",
    ),
    "deeper": (
        lambda f: edit(f / "config.json", num_hidden_layers=3),
        "model.layers.2.input_layernorm.weight is missing",
    ),
    "a tensor under another name": (lambda f: renamed(f / ONE, "lm_head.weight", "x"), "lm_head.weight is missing"),
    "fewer words than the tokenizer": (
        lambda f: (
            edit(f / "config.json", vocab_size=259),
            *(replace(f / ONE, name, torch.zeros(259, 32)) for name in ("lm_head.weight", "model.embed_tokens.weight")),
        ),
        "tokenizer.json has words up to number 259, but vocab_size of .*/config.json is 259",
    ),
    "neither file nor index": (
        lambda f: (f / ONE).rename(f / "model-1-of-1.safetensors"),
        "no file named model.safete",
    ),
}
SHARDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no shard": (
        lambda f: (f / "model-00002-of-00007.safetensors").unlink(),
        "No such file.*model-00002-of-00007",
    ),
    "a shard cut by a byte": (lambda f: cut(f / "model-00003-of-00007.safetensors"), "model-00003-of-00007.* is cut"),
    "a broken index": (lambda f: cut(f / INDEX, 9), "llama cannot be loaded"),
    "an empty index": (lambda f: edit(f / INDEX, weight_map={}), "llama cannot be loaded"),
    "a shard twice": (
        lambda f: copyfile(f / "model-00003-of-00007.safetensors", f / "model-00004-of-00007.safetensors"),
        r"model.layers\S+ is missing",
    ),
}
CLIP_FILE, CLIP_FORM = "open_clip_model.safetensors", "open_clip_config.json"


def vision(folder: Path, **changes: Any) -> None:
    form = json.loads((folder / CLIP_FORM).read_text())
    form["model_cfg"]["vision_cfg"] |= changes
    vision = {k: v for k, v in form["model_cfg"]["vision_cfg"].items() if v is not None}
    (folder / CLIP_FORM).write_text(json.dumps(form | {"model_cfg": form["model_cfg"] | {"vision_cfg": vision}}))


CLIP: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut by a byte": (lambda f: cut(f / CLIP_FILE), "open_clip_model.safetensors is cut off"),
    "deeper": (lambda f: vision(f, layers=3), 'Missing key.* "transformer.resblocks.2'),
    "wider": (lambda f: vision(f, width=48), "does not fit its open_clip_config.json .*mismatch for class_embedding"),
    "other patches": (lambda f: vision(f, patch_size=8), "mismatch for positional_embedding"),
    "a narrower middle": (lambda f: vision(f, mlp_ratio=2.0), "mismatch for transformer.resblocks.0.mlp.c_fc.weight"),
    "a width of letters": (lambda f: vision(f, width="x"), "open_clip_config.json is no configuration of open_clip's"),
    "a ResNet": (lambda f: vision(f, layers=[3, 4, 6, 3]), "is no vision transformer"),
    "a network of timm's": (lambda f: vision(f, timm_model_name="test_vit"), "is no vision transformer"),
    "settings cut": (lambda f: cut(f / CLIP_FORM, 9), "open_clip_config.json"),
    "no settings": (lambda f: (f / CLIP_FORM).write_text("{}"), "open_clip_config.json"),
}


@pytest.fixture(autouse=True)
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that sees the project's inputs, but has params.yaml and data/ of its own."""
    for name in ("conf", "pipeline"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)


def scale(*overrides: str) -> str | None:
    """The line that `octopi scale` ends with; None where it is content."""
    result = CliRunner().invoke(app, ["scale", "smoke", *overrides])
    assert (result.exception is None) == Path("params.yaml").exists()
    if result.exception is None:
        return None
    assert isinstance(result.exception, UserError), repr(result.exception)
    return str(result.exception)


def check(folder: Path) -> None:
    """What `octopi scale` asks of a folder."""
    if folder.name == "clip":
        check_encoder(folder, 32, ("clip",))
        check_encoder_files(folder, ("clip",))
    else:
        check_language(folder)
        check_language_files(folder)


@pytest.mark.parametrize(
    ("kind", "name"),
    [*(("llama", name) for name in LANGUAGE), *(("shards", name) for name in SHARDS), *(("clip", n) for n in CLIP)],
)
def test_a_broken_folder_is_one_line(kind: str, name: str) -> None:
    tables = {"llama": LANGUAGE, "shards": SHARDS, "clip": CLIP}
    if kind == "clip":
        folder = write_clip(Path("clip"))
    else:
        folder = write_llama(Path("llama"), shard="20KB" if kind == "shards" else "5GB")
    check(folder)
    damage, words = tables[kind][name]
    damage(folder)
    with refused(words) as caught:
        check(folder)
    assert str(folder) in str(caught.value)


def test_the_command_names_what_is_broken_before_it_writes() -> None:
    """Also where counting memory reads the same file before."""
    for name in ("empty tokenizer", "no hidden_size"):
        damage, words = LANGUAGE[name]
        folder = write_llama(Path(name))
        damage(folder)
        assert re.search(words, scale(f"language.weights={folder}") or "")
    for name in ("cut by a byte", "a width of letters"):
        damage, words = CLIP[name]
        folder = write_clip(Path(name) / "clip")
        damage(folder)
        assert re.search(words, scale(f"encoder.weights={folder}") or "")
    whole = write_llama(Path("llama")), write_clip(Path("clip"))
    assert scale(f"language.weights={whole[0]}", f"encoder.weights={whole[1]}") is None


def test_a_timm_file_that_is_cut_off_is_named_when_the_scale_is_chosen() -> None:
    folder = write_timm(Path("timm"))
    check_encoder_files(folder, ("timm", "scenes"))
    cut(folder / ONE)
    check_encoder_files(folder, ("scenes",))
    with pytest.raises(UserError, match=r"^encoder.weights: timm/model.safetensors is cut off"):
        check_encoder_files(folder, ("timm", "scenes"))


# What is right is not refused.


@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("kind", ["llama", "mistral", "qwen2", "gpt_neox"])
def test_whole_models_of_several_kinds_pass(kind: str, tied: bool) -> None:
    folder = write_llama(Path("llama"))
    sizes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    form = AutoConfig.for_model(kind, **sizes, vocab_size=260, tie_word_embeddings=tied)
    AutoModelForCausalLM.from_config(form).save_pretrained(folder)
    check_language_files(folder)


def test_a_padding_token_beyond_the_words_passes() -> None:
    """As LLaMA's checkpoints often have one; the chain gives it a row when it adds its own tokens."""
    folder = write_llama(Path("llama"))
    file = folder / "tokenizer.json"
    form = json.loads(file.read_text())
    form["added_tokens"].append(form["added_tokens"][0] | {"id": 260, "content": "[PAD]"})
    file.write_text(json.dumps(form))
    check_language_files(folder)


# At loading


@pytest.mark.parametrize("name", [name for name in LANGUAGE if "tokenizer" in name and "words" not in name])
def test_a_broken_tokenizer_is_one_line_at_loading_too(name: str) -> None:
    folder = write_llama(Path("llama"))
    LANGUAGE[name][0](folder)
    with pytest.raises(UserError, match=r"\Alanguage.weights: [^\n]*llama[^\n]*\Z"):
        load_tokenizer(folder)


def test_values_that_are_not_finite_are_named_at_loading() -> None:
    folder = write_llama(Path("llama"), shard="20KB")
    name = "model.layers.1.mlp.down_proj.weight"
    file = folder / json.loads((folder / INDEX).read_text())["weight_map"][name]
    value = load_file(file)[name]
    value[3, 5] = torch.nan
    replace(file, name, value)
    check_language_files(folder)
    with pytest.raises(UserError, match=rf"\Alanguage.weights: {name} in {file} holds values that are not finite; d"):
        load_llm(folder, torch.float32)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_one_value_that_is_not_finite_is_found_wherever_it_stands(bad: float, dtype: torch.dtype) -> None:
    draw = torch.Generator().manual_seed(0)
    largest = torch.finfo(dtype).max
    for rows, columns in ((1, 1), (3, 7), (129, 65)):
        value = torch.randn(rows, columns, generator=draw).to(dtype)
        value[0, 0] = largest
        check_finite(Path(), "key", [("a", value), ("empty", value[:0]), ("turned", value.T), ("bytes", value.byte())])
        for place in torch.randint(rows * columns, (40,), generator=draw).tolist():
            worse = value.clone()
            worse.view(-1)[place] = bad
            with pytest.raises(UserError, match="key: w in . holds values that are not finite; download it again"):
                check_finite(Path(), "key", [("a", value), ("w", worse)])


def test_a_tower_with_a_nan_is_named_at_loading() -> None:
    folder = write_clip(Path("clip"))
    name = "visual.transformer.resblocks.1.mlp.c_fc.bias"
    replace(folder / CLIP_FILE, name, torch.full((128,), float("nan")))
    check_encoder_files(folder, ("clip",))
    with pytest.raises(UserError, match=rf"{name.removeprefix('visual.')} in clip/{CLIP_FILE} holds .* not finite"):
        load_visual_tower(folder)


def test_a_tower_in_a_pickle_is_not_loaded() -> None:
    folder = write_clip(Path("clip"))
    torch.save(load_file(folder / CLIP_FILE), folder / "open_clip_pytorch_model.bin")
    (folder / CLIP_FILE).unlink()
    with pytest.raises(UserError, match=rf"\Aencoder.weights: clip/{CLIP_FILE} does not exist; [^\n]*\Z"):
        load_visual_tower(folder)


def test_a_timm_network_with_a_nan_in_its_statistics_is_named_at_loading() -> None:
    folder = write_timm(Path("timm"))
    name = next(n for n in load_file(folder / ONE) if n.endswith("running_var"))
    replace(folder / ONE, name, torch.full_like(load_file(folder / ONE)[name], float("nan")))
    with pytest.raises(UserError, match=rf"{name} in timm/{ONE} holds values that are not finite"):
        load_backbone(config(folder, "tuned", backbone=("timm",)), tuned=False)

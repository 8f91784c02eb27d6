"""Folders of weights that are cut off, broken, or do not fit together are refused when a scale is chosen, in a line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from math import prod
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from transformers import LlamaConfig, LlamaForCausalLM
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.errors import UserError
from pipeline.core.io import tensor_shapes
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.timm_backbone import load_backbone
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.weights import check_encoder, check_finite, check_language
from pipeline.weights.check import check_encoder_files, check_language_files
from pipeline.weights.shapes import Llama, Vision
from tests.checkpoints import cut, edit, replace, write_clip, write_llama
from tests.closure import ROOT
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
    "no kind": (lambda f: edit(f / "config.json", model_type=None), "/config.json names no model_type"),
    "no hidden_size": (
        lambda f: edit(f / "config.json", hidden_size=None),
        "/config.json: hidden_size must be a whole number of 1 or more and is missing",
    ),
    "a size that is a text": (lambda f: edit(f / "config.json", vocab_size="260"), "vocab_size must be .* is '260'"),
    "a size that is true": (
        lambda f: edit(f / "config.json", num_hidden_layers=True),
        "num_hidden_layers .* True",
    ),
    "no heads": (lambda f: edit(f / "config.json", num_attention_heads=0), "num_attention_heads must .* is 0"),
    "heads of a text": (lambda f: edit(f / "config.json", num_key_value_heads="2"), "num_key_value_heads must .* '2'"),
    "more words": (
        lambda f: edit(f / "config.json", vocab_size=261),
        "model.embed_tokens.weight in .*/model.safetensors is 260 x 32, but .*/config.json makes it 261 x 32; take it",
    ),
    "wider": (lambda f: edit(f / "config.json", intermediate_size=65), "mlp.gate_proj.weight in .* is 64 x 32, but"),
    "deeper": (lambda f: edit(f / "config.json", num_hidden_layers=3), "has no tensor model.layers.2.self_attn.q_proj"),
    "a tensor under another name": (lambda f: renamed(f / ONE, "lm_head.weight", "x"), "has no tensor lm_head.weight"),
    "fewer words than the tokenizer": (
        lambda f: (
            edit(f / "config.json", vocab_size=259),
            *(replace(f / ONE, name, torch.zeros(259, 32)) for name in ("lm_head.weight", "model.embed_tokens.weight")),
        ),
        "tokenizer.json has words up to number 259, but vocab_size of .*/config.json is 259",
    ),
    "neither file nor index": (
        lambda f: (f / ONE).rename(f / "model-00001-of-00001.safetensors"),
        "has neither model.safetensors nor model.safetensors.index.json",
    ),
}
SHARDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no shard": (lambda f: (f / "model-00002-of-00007.safetensors").unlink(), "model-00002-of-00007.safetensors does"),
    "a shard cut by a byte": (lambda f: cut(f / "model-00003-of-00007.safetensors"), "model-00003-of-00007.* is cut"),
    "a broken index": (lambda f: cut(f / INDEX, 9), "index.json is not a JSON object"),
    "an empty index": (lambda f: edit(f / INDEX, weight_map={}), "index.json maps no tensors to files"),
    "an index of numbers": (lambda f: edit(f / INDEX, weight_map={"a": 1}), "index.json maps no tensors to files"),
    "a shard twice": (
        lambda f: copyfile(f / "model-00003-of-00007.safetensors", f / "model-00004-of-00007.safetensors"),
        "has no tensor model.layers",
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
    "deeper": (lambda f: vision(f, layers=3), "has no tensor visual.transformer.resblocks.2"),
    "wider": (lambda f: vision(f, width=48), "visual.class_embedding in .* is 32, but .*config.json makes it 48"),
    "other patches": (lambda f: vision(f, patch_size=8), "visual.positional_embedding .* is 5 x 32, but .* 17 x 32"),
    "no width": (lambda f: vision(f, width=None), "open_clip_config.json: width must be a whole number"),
    "a ResNet": (lambda f: vision(f, layers=[3, 4, 6, 3]), "is no vision transformer"),
    "a network of timm's": (lambda f: vision(f, layers=None, timm_model_name="x"), "is no vision transformer"),
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


def check_both(folder: Path) -> None:
    """What `octopi scale` asks of a language model's folder."""
    check_language(folder)
    check_language_files(folder)


def check_tower(folder: Path) -> None:
    """What `octopi scale` asks of a CLIP's folder."""
    check_encoder(folder, 32, ("clip",))
    check_encoder_files(folder, ("clip",))


@pytest.mark.parametrize("name", [*LANGUAGE, *SHARDS])
def test_a_broken_language_model_is_one_line(name: str) -> None:
    folder = write_llama(Path("llama"), shard="20KB" if name in SHARDS else "5GB")
    check_both(folder)
    damage, words = (LANGUAGE | SHARDS)[name]
    damage(folder)
    with pytest.raises(UserError, match=r"\A[^\n]*llama(/| has)[^\n]*\Z") as caught:
        check_both(folder)
    assert re.search(words, str(caught.value)), caught.value


@pytest.mark.parametrize("name", CLIP)
def test_a_broken_clip_is_one_line(name: str) -> None:
    folder = write_clip(Path("clip"))
    check_tower(folder)
    damage, words = CLIP[name]
    damage(folder)
    with pytest.raises(UserError, match=r"\A[^\n]*clip[^\n]*\Z") as caught:
        check_tower(folder)
    assert re.search(words, str(caught.value)), caught.value


def test_the_command_names_what_is_broken_before_it_writes() -> None:
    """Also where counting memory reads the same file before."""
    for name in ("empty tokenizer", "no hidden_size"):
        damage, words = LANGUAGE[name]
        folder = write_llama(Path(name))
        damage(folder)
        assert re.search(words, scale(f"language.weights={folder}") or "")
    for name in ("cut by a byte", "no width"):
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


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_a_file_of_any_other_length_is_refused(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("any") / "x.safetensors"
    shapes = data.draw(
        st.dictionaries(st.text(min_size=1, max_size=3), st.lists(st.integers(0, 3), max_size=3), min_size=1)
    )
    save_file({name: torch.zeros(shape) for name, shape in shapes.items()}, file)
    assert tensor_shapes(file) == {name: tuple(shape) for name, shape in shapes.items()}
    content = file.read_bytes()
    at = data.draw(st.integers(0, len(content) - 1))
    file.write_bytes(content[:at])
    with pytest.raises(UserError, match="x.safetensors is cut off"):
        tensor_shapes(file)


# What is right is not refused.


@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("kind", ["llama", "mistral", "qwen2", "gpt_neox"])
def test_whole_models_of_several_kinds_pass(kind: str, tied: bool) -> None:
    from transformers import AutoConfig, AutoModelForCausalLM

    folder = write_llama(Path("llama"))
    form = AutoConfig.for_model(
        kind,
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=4,
        vocab_size=260,
        tie_word_embeddings=tied,
    )
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


def test_what_only_open_clip_knows_passes() -> None:
    folder = write_clip(Path("clip"))
    vision(folder, mlp_ratio=2.0)
    check_encoder_files(folder, ("clip",))


@pytest.mark.parametrize("keys", [4, 2])
@pytest.mark.parametrize("tied", [True, False])
def test_tensors_are_those_that_transformers_makes(keys: int, tied: bool) -> None:
    form = LlamaConfig(
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=3,
        num_attention_heads=4,
        num_key_value_heads=keys,
        vocab_size=100,
        tie_word_embeddings=tied,
    )
    made = {name: tuple(p.shape) for name, p in LlamaForCausalLM(form).named_parameters()}
    llama = Llama(32, 48, 3, 4, 100, keys, 8, tied)
    assert llama.tensors == made
    assert llama.parameters == sum(map(prod, made.values()))


def test_tensors_are_those_that_open_clip_makes() -> None:
    stored = tensor_shapes(write_clip(Path("clip")) / CLIP_FILE)
    tower = Vision.read(Path("clip"))
    assert tower is not None
    assert tower.tensors == {name: shape for name, shape in stored.items() if name.startswith("visual.")}
    assert tower.parameters == sum(map(prod, tower.tensors.values()))


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

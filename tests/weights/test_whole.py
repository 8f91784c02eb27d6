"""Folders of weights that are cut off, broken, or do not fit together are refused when a scale is chosen, in a line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from shutil import copytree
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


def other_vocabulary(folder: Path) -> None:
    edit(folder / "config.json", vocab_size=259)
    for name in ("lm_head.weight", "model.embed_tokens.weight"):
        replace(folder / ONE, name, torch.zeros(259, 32))


Damage = tuple[Callable[[Path], object], str]
EMPTY_TOKENIZER: Damage = (lambda f: (f / "tokenizer.json").write_text(""), "tokenizer.json is no fast tokenizer")
NO_WIDTH: Damage = (
    lambda f: edit(f / "config.json", hidden_size=None),
    r"lm_head.weight is \[260, 32\], not \[260, 40",
)
LANGUAGE: list[Damage] = [
    EMPTY_TOKENIZER,
    NO_WIDTH,
    (lambda f: cut(f / ONE), "model.safetensors is cut off or not a safetensors file .*; download it"),
    (lambda f: (f / ONE).write_bytes((f / ONE).read_bytes() + b"x"), "model.safetensors is cut off"),
    (lambda f: (f / ONE).write_text("version https://git-lfs"), "model.safetensors is cut off"),
    (lambda f: (f / "tokenizer.json").unlink(), "tokenizer.json does not exist"),
    (lambda f: (f / "tokenizer_config.json").write_text("{"), "_config.json is not a JSON object"),
    (lambda f: (f / "config.json").write_bytes("{}".encode("utf-16")), "is not a JSON object"),
    (lambda f: (f / "config.json").write_text("[]"), "/config.json is not a JSON object"),
    (lambda f: edit(f / "config.json", model_type=None), "cannot be loaded .*model_type"),
    (lambda f: edit(f / "config.json", num_attention_heads=0), "cannot be loaded .*zero"),
    (lambda f: edit(f / "config.json", intermediate_size=65), r"mlp.down_proj.weight is \[32, 64\], not .*; take"),
    (lambda f: renamed(f / ONE, "lm_head.weight", "x"), "lm_head.weight is missing"),
    (other_vocabulary, "tokenizer.json has words up to number 259, but vocab_size of .*/config.json is 259"),
]
SHARDS: list[Damage] = [
    (lambda f: (f / "model-00002-of-00007.safetensors").unlink(), "No such file.*model-00002-of-00007"),
    (lambda f: cut(f / "model-00003-of-00007.safetensors"), "model-00003-of-00007.* is cut"),
    (lambda f: edit(f / INDEX, weight_map={}), "shards cannot be loaded"),
]
CLIP_FILE, CLIP_FORM = "open_clip_model.safetensors", "open_clip_config.json"


def vision(folder: Path, **changes: Any) -> None:
    form = json.loads((folder / CLIP_FORM).read_text())
    form["model_cfg"]["vision_cfg"] |= changes
    vision = {k: v for k, v in form["model_cfg"]["vision_cfg"].items() if v is not None}
    (folder / CLIP_FORM).write_text(json.dumps(form | {"model_cfg": form["model_cfg"] | {"vision_cfg": vision}}))


CUT_TOWER: Damage = (lambda f: cut(f / CLIP_FILE), "open_clip_model.safetensors is cut off")
NO_NUMBER: Damage = (lambda f: vision(f, width="x"), "open_clip_config.json is no configuration of open_clip's")
CLIP: list[Damage] = [
    CUT_TOWER,
    NO_NUMBER,
    (lambda f: vision(f, layers=3), 'Missing key.* "transformer.resblocks.2'),
    (lambda f: vision(f, width=48), "does not fit its open_clip_config.json .*mismatch for class_embedding"),
    (lambda f: vision(f, layers=[3, 4, 6, 3]), "is no vision transformer"),
    (lambda f: vision(f, timm_model_name="test_vit"), "is no vision transformer"),
    (lambda f: (f / CLIP_FORM).write_text("{}"), "open_clip_config.json"),
]


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
    ("kind", "damage", "words"),
    [(kind, *each) for kind, table in (("llama", LANGUAGE), ("shards", SHARDS), ("clip", CLIP)) for each in table],
)
def test_a_broken_folder_is_one_line(kind: str, damage: Callable[[Path], object], words: str) -> None:
    if kind == "clip":
        folder = write_clip(Path(kind))
    else:
        folder = write_llama(Path(kind), shard="20KB" if kind == "shards" else "5GB")
    check(folder)
    damage(folder)
    with refused(words) as caught:
        check(folder)
    assert str(folder) in str(caught.value)


def test_the_command_names_what_is_broken_before_it_writes() -> None:
    """Also where counting memory reads the same file before."""
    whole = {"language": write_llama(Path("llama")), "encoder": write_clip(Path("clip"))}
    spoiled = {"language": (EMPTY_TOKENIZER, NO_WIDTH), "encoder": (CUT_TOWER, NO_NUMBER)}
    for number, (part, (damage, words)) in enumerate((part, each) for part, both in spoiled.items() for each in both):
        broken = Path(str(number)) / whole[part].name
        copytree(whole[part], broken)
        damage(broken)
        assert re.search(words, scale(f"{part}.weights={broken}") or "")
    assert scale(*(f"{part}.weights={folder}" for part, folder in whole.items())) is None


def test_a_timm_file_that_is_cut_off_is_named_when_the_scale_is_chosen() -> None:
    folder = write_timm(Path("timm"))
    check_encoder_files(folder, ("timm", "scenes"))
    cut(folder / ONE)
    check_encoder_files(folder, ("scenes",))
    with refused("^encoder.weights: timm/model.safetensors is cut off"):
        check_encoder_files(folder, ("timm", "scenes"))


# What is right is not refused.


@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("kind", ["llama", "gpt_neox"])
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


def test_a_broken_tokenizer_is_one_line_at_loading_too() -> None:
    folder = write_llama(Path("llama"))
    for content in ("", "{}"):
        (folder / "tokenizer.json").write_text(content)
        with refused("^language.weights: .*llama"):
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


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
@pytest.mark.parametrize("bad", [float("nan"), -float("inf")])
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

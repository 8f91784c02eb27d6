"""Downloaded models in their published layouts, at tiny widths: converted, checked, or refused in a line."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import open_clip
import pytest
import torch
from safetensors.torch import load_file, save_file
from sentencepiece import SentencePieceProcessor, SentencePieceTrainer
from transformers import AutoTokenizer, LlamaConfig, LlamaForCausalLM

from pipeline.language.base import load_llm, load_tokenizer
from pipeline.scales import compose
from pipeline.weights import DOWNLOADED
from pipeline.weights.check import PUBLISHED_LANGUAGE, check_language_files
from pipeline.weights.make import CATALOGUE
from tests.checkpoints import CLIP_CONFIG, contents, cut, edit, write_clip
from tests.conftest import ROOT, octopi, refused

PICTURES = {"mean": [*open_clip.OPENAI_DATASET_MEAN], "std": [*open_clip.OPENAI_DATASET_STD]}
WORDS = 600
SIZES = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 4}
LLAMA = SIZES | {"vocab_size": WORDS}
FIRST, SECOND = "pytorch_model-00001-of-00002.bin", "pytorch_model-00002-of-00002.bin"
INDEX = "pytorch_model.bin.index.json"
TO = Path("weights/vicuna-7b-v1.5")
CONFIG = """{"architectures": ["LlamaForCausalLM"], "model_type": "llama", "hidden_act": "silu", "bos_token_id": 1,
"eos_token_id": 2, "pad_token_id": 0, "max_position_embeddings": 4096, "num_key_value_heads": 4, "rms_norm_eps": 1e-05,
"tie_word_embeddings": false, "torch_dtype": "float16", "use_cache": true}"""
TOKENIZER_CONFIG = """{"add_bos_token": true, "add_eos_token": false, "clean_up_tokenization_spaces": false,
"legacy": false, "model_max_length": 4096, "pad_token": null, "padding_side": "right", "sp_model_kwargs": {},
"tokenizer_class": "LlamaTokenizer"}"""
LINES = [line for file in sorted(CATALOGUE.iterdir()) for line in file.read_text().splitlines()]
HARD = (
    "", "東京 Überraschung 😀", "two  spaces   three", "\ttab\n\nline ", "1.50 / 23", "x ▁ y", "\0", "e\u0301 ﬁ \u3000x"
)  # fmt: skip


@pytest.fixture(autouse=True)
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, and models published at these widths."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PUBLISHED_LANGUAGE, "vicuna-7b-v1.5", PUBLISHED_LANGUAGE["vicuna-7b-v1.5"] | LLAMA)
    text = {"context_length": 10, "vocab_size": 40, "width": 24, "heads": 3, "layers": 2}
    model = CLIP_CONFIG["model_cfg"] | {"text_cfg": text}
    monkeypatch.setattr(open_clip, "get_model_config", lambda name: model if name == "ViT-L-14-quickgelu" else None)


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SentencePiece's, trained as Llama's were."""
    folder = tmp_path_factory.mktemp("pieces")
    (folder / "text").write_text("\n".join(LINES))
    SentencePieceTrainer.train(
        input=str(folder / "text"), model_prefix=str(folder / "tokenizer"), model_type="bpe", vocab_size=WORDS,
        byte_fallback=True, split_digits=True, allow_whitespace_only_pieces=True, remove_extra_whitespaces=False,
        normalization_rule_name="identity", pad_id=-1, unk_id=0, bos_id=1, eos_id=2, minloglevel=2,
    )  # fmt: skip
    return folder / "tokenizer.model"


def weights() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return dict(LlamaForCausalLM(LlamaConfig(**LLAMA)).half().state_dict())


def save_shards(folder: Path, state: dict[str, torch.Tensor], **how: Any) -> None:
    """Two files with a buffer of each layer beside its weights, as transformers stored it then, and their index."""
    first = {n: v for n, v in state.items() if "layers.1" not in n and "lm_head" not in n}
    second = {n: v for n, v in state.items() if n not in first}
    for layer, part in enumerate((first, second)):
        part[f"model.layers.{layer}.self_attn.rotary_emb.inv_freq"] = torch.ones(4)
    torch.save(first, folder / FIRST, **how)
    torch.save(second, folder / SECOND, **how)
    places = dict.fromkeys(first, FIRST) | dict.fromkeys(second, SECOND)
    (folder / INDEX).write_text(json.dumps({"metadata": {"total_size": 0}, "weight_map": places}))


@pytest.fixture
def vicuna(pieces: Path) -> Path:
    """A folder as lmsys/vicuna-7b-v1.5 has it: slow tokenizer, pickles, settings of transformers 4.31."""
    folder = Path("download")
    folder.mkdir()
    (folder / "tokenizer.model").write_bytes(pieces.read_bytes())
    (folder / "config.json").write_text(json.dumps(json.loads(CONFIG) | LLAMA))
    # Its temperature without sampling is one that transformers no longer saves.
    (folder / "generation_config.json").write_text('{"pad_token_id": 0, "temperature": 0.9, "top_p": 0.6}')
    plain = dict.fromkeys(("lstrip", "normalized", "rstrip", "single_word"), False)
    special = {"bos_token": "<s>", "eos_token": "</s>", "unk_token": "<unk>"}
    named = {name: {"content": text, **plain} for name, text in special.items()}
    typed = {name: {"__type": "AddedToken", **each} for name, each in named.items()}
    (folder / "tokenizer_config.json").write_text(json.dumps(json.loads(TOKENIZER_CONFIG) | typed))
    (folder / "special_tokens_map.json").write_text(json.dumps({"pad_token": "<unk>", **named}))
    (folder / "README.md").write_text("---\nlicense: llama2\n---\n")
    (folder / ".gitattributes").write_text("*.bin filter=lfs")
    save_shards(folder, weights())
    return folder


def test_a_downloaded_vicuna_becomes_what_the_chain_reads(vicuna: Path, pieces: Path) -> None:
    before = contents(vicuna)
    assert "weights/vicuna-7b-v1.5: written, with SHA256SUMS" in octopi(
        "weights", "vicuna-7b", vicuna, "--trust-pickle"
    )
    assert contents(vicuna) == before
    assert not list(TO.glob("*.bin*"))
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=TO, check=True)
    assert len((TO / "SHA256SUMS").read_text().splitlines()) == len(contents(TO)) - 1
    check_language_files(TO)

    model = load_llm(TO, torch.float16)
    assert all(torch.equal(value, model.state_dict()[name]) for name, value in weights().items())
    assert not [name for file in TO.glob("*.safetensors") for name in load_file(file) if "inv_freq" in name]
    ids = model.generate(torch.tensor([[1, 5, 9]]), max_new_tokens=3, do_sample=False)
    assert ids.shape[1] > 3

    slow = SentencePieceProcessor(model_file=str(pieces))
    plain = AutoTokenizer.from_pretrained(TO, local_files_only=True)
    assert (plain.bos_token, plain.eos_token, plain.unk_token, plain.pad_token) == ("<s>", "</s>", "<unk>", "<unk>")
    assert len(plain) == WORDS
    for tokenizer in (plain, load_tokenizer(TO)):
        for text in [*(line.strip() for line in LINES[::20]), *HARD]:
            assert tokenizer(text).input_ids == [1, *slow.encode(text)], text
            assert tokenizer(text, add_special_tokens=False).input_ids == slow.encode(text), text
    said = plain("ASSISTANT: soft</s>USER: and", add_special_tokens=False).input_ids
    assert said.count(2) == 1, "an end token within a conversation is one"
    assert plain.decode(said) == "ASSISTANT: soft</s>USER: and", "what follows it is no new word"


def test_what_was_converted_is_checked_where_it_lies(vicuna: Path) -> None:
    octopi("weights", "vicuna-7b", vicuna, "--to", "elsewhere", "--trust-pickle")
    before = contents(Path("elsewhere"))
    assert "elsewhere: checked, with SHA256SUMS" in octopi("weights", "vicuna-7b", "elsewhere")
    assert contents(Path("elsewhere")) == before
    octopi("weights", "vicuna-7b", "elsewhere", "--to", "copy")
    assert contents(Path("copy")) == before
    with refused("elsewhere has hidden_size 32, but vicuna-13b-v1.5 was published with 5120"):
        octopi("weights", "vicuna-13b", "elsewhere")
    cut(Path("elsewhere/model.safetensors"))
    for to in ((), ("--to", "other")):
        with refused("elsewhere/model.safetensors is cut off"):
            octopi("weights", "vicuna-7b", "elsewhere", *to)
    assert not list(Path().glob("*other*"))


@pytest.mark.parametrize("form", ["safetensors", "one pickle", "before torch 1.6"])
def test_other_files_are_read_too(form: str, vicuna: Path) -> None:
    if form == "safetensors":
        save_file(weights(), vicuna / "model.safetensors", {"format": "pt"})
    elif form == "one pickle":
        for name in (FIRST, SECOND, INDEX):
            (vicuna / name).unlink()
        torch.save(weights(), vicuna / "pytorch_model.bin")
    else:
        save_shards(vicuna, weights(), _use_new_zipfile_serialization=False)
    octopi("weights", "vicuna-7b", vicuna, *([] if form == "safetensors" else ["--trust-pickle"]))
    assert not list(TO.glob("*.bin*"))
    state = load_llm(TO, torch.float16).state_dict()
    assert all(torch.equal(value, state[name]) for name, value in weights().items())
    load_tokenizer(TO)


def test_they_go_where_the_scales_look_for_them() -> None:
    for scale, name in (("paper-7b", "vicuna-7b"), ("paper-13b", "vicuna-13b")):
        params = compose(scale, conf=ROOT / "conf")
        assert params.language.weights == f"weights/{DOWNLOADED[name].folder}"
        assert params.encoder.weights == f"weights/{DOWNLOADED['clip-vit-large'].folder}"


FORM = "open_clip_config.json"


@pytest.fixture
def clip() -> Path:
    """As timm/vit_large_patch14_clip_224.openai has it."""
    folder = write_clip(Path("clip"))
    (folder / FORM).write_text(json.dumps({"model_cfg": CLIP_CONFIG["model_cfg"], "preprocess_cfg": PICTURES}))
    return folder


def test_a_clip_as_open_clip_has_it_is_checked_where_it_lies(clip: Path) -> None:
    before = contents(clip)
    assert "clip: checked, with SHA256SUMS" in octopi("weights", "clip-vit-large", clip)
    assert before.items() < contents(clip).items()
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=clip, check=True)


class Evil:
    def __reduce__(self) -> Any:
        return Path.touch, (Path("ran"),)


def evil(folder: Path, file: str = FIRST) -> None:
    torch.save({"a": Evil()}, folder / file)


NARROW = {"model.layers.1.mlp.up_proj.weight": torch.zeros(48, 31)}
UNLIKE = CLIP_CONFIG["model_cfg"] | {"quick_gelu": None}
TRUSTED = "vicuna-7b download --trust-pickle"


@pytest.mark.parametrize(
    ("arguments", "damage", "words"),
    [
        ("vicuna-13b nowhere", evil, "no folder; `hf download lmsys/vicuna-13b-v1.5 --local-dir nowhere` makes it"),
        ("tiny-clip download", evil, "tiny-clip is not downloaded but made; leave download out"),
        ("vicuna-7b download --to download --trust-pickle", evil, "is there already; remove it, or .* with --to"),
        ("vicuna-7b download", evil, f"download/{FIRST} is a pickle.* add --trust-pickle"),
        (TRUSTED, lambda f: evil(f, SECOND), f"{SECOND} is cut off, or holds more than tensors"),
        (f"{TRUSTED} --to there", lambda f: save_shards(f, weights() | NARROW), r"up_proj.weight is \[48, 31\]"),
        (TRUSTED, lambda f: edit(f / "config.json", hidden_size=64), "download has hidden_size 64, but .* with 32"),
        ("clip-vit-large clip", lambda _: edit(Path("clip") / FORM, model_cfg=UNLIKE), "quick_gelu None, but .* True"),
    ],
)
@pytest.mark.usefixtures("clip")
def test_what_is_refused_is_one_line_and_leaves_nothing(
    arguments: str, damage: Callable[[Path], object], words: str, vicuna: Path
) -> None:
    """Nor is any code run."""
    damage(vicuna)
    before = contents(Path())
    with refused(words):
        octopi("weights", *arguments.split())
    assert contents(Path()) == before

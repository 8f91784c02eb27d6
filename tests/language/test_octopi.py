"""The model: embeddings in their places, the loss, and what is saved, loaded and refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from peft import PeftModel
from safetensors.torch import load_file, save_file
from transformers import AutoModelForCausalLM

from pipeline.config import LanguageConfig
from pipeline.core.records import Question
from pipeline.language.base import load_tokenizer
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.conversations import collate
from pipeline.language.lora import add_lora
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import assemble
from pipeline.training.embeddings import EmbeddingStore
from tests.checkpoints import contents, edit, replace, write_llama
from tests.conftest import refused
from tests.language.conftest import DIM, LORA, adapted, assert_comes_back, call, material, taking

CONNECTOR = "connector.safetensors"
ADAPTER = "adapter/adapter_model.safetensors"


@pytest.mark.parametrize("kind", ["Llama", "Gemma"])
def test_normalized_touch_is_as_long_as_words(kind: str, tmp_path: Path) -> None:
    """However long the projection makes it, and so too in a model that is read back."""
    model = OctopiForCausalLM.from_base(write_llama(tmp_path / "base", kind=kind), DIM, normalize=True)
    words = model.llm.get_input_embeddings()(torch.arange(260))
    torch.testing.assert_close(model.connector.delimiters, words.mean(0).expand(2, -1))
    ids = call(model)["input_ids"]
    frames = ids[0] == model.frame_id
    for size in (1e-3, 1.0, 1e4):
        embedded = model.embed(ids, size * call(model)["features"])[0]
        lengths = embedded[frames].square().mean(1).sqrt()
        torch.testing.assert_close(lengths, words.square().mean().sqrt().expand(2), rtol=1e-3, atol=0)
        assert torch.equal(embedded[0], words[5])
    model.save_pretrained(tmp_path)
    assert_comes_back(model, tmp_path)


def trained(model: OctopiForCausalLM) -> OctopiForCausalLM:
    for parameter in model.connector.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return adapted(model)


def test_all_linear_layers_are_adapted_and_read_back(model: OctopiForCausalLM, tmp_path: Path) -> None:
    """PEFT's own name for all but the layer of the logits."""
    with refused("no layer q_projection"):
        add_lora(model, LORA.model_copy(update={"target_modules": ("q_projection",)}))
    linear = {name.rsplit(".", 1)[-1] for name, part in model.llm.named_modules() if isinstance(part, torch.nn.Linear)}
    add_lora(model, LORA.model_copy(update={"target_modules": "all-linear"}))
    changed = {name.split(".")[-4] for name, _ in model.llm.named_parameters() if "lora_B" in name}
    assert changed == linear - {"lm_head"}
    trained(model).save_pretrained(tmp_path)
    assert_comes_back(model, tmp_path)


@pytest.mark.parametrize("form", [{}, {"tie_word_embeddings": True}, {"num_key_value_heads": 1}])
def test_what_is_saved_comes_back_to_the_bit_and_in_the_same_bytes(form: dict[str, Any], tmp_path: Path) -> None:
    model = OctopiForCausalLM.from_base(write_llama(tmp_path / "base", **form), DIM).eval()
    fresh = model(**call(model)).logits
    model = trained(model)
    assert not torch.allclose(model(**call(model)).logits, fresh)
    model.save_pretrained(tmp_path / "a")
    loaded = assert_comes_back(model, tmp_path / "a")
    loaded.save_pretrained(tmp_path / "b")
    model.save_pretrained(tmp_path / "c", {n: v.clone() for n, v in model.state_dict().items()})
    assert contents(tmp_path / "a") == contents(tmp_path / "b") == contents(tmp_path / "c")
    assert set(contents(tmp_path / "a")) == {"config.json", CONNECTOR, "adapter/adapter_config.json", ADAPTER}
    # Models saved before word embeddings could be trained do not say so.
    edit(tmp_path / "a" / "config.json", trained_embeddings=None)
    assert OctopiForCausalLM.from_pretrained(tmp_path / "a").words is None


def test_plain_peft_loads_the_adapter(model: OctopiForCausalLM, language: LanguageConfig, tmp_path: Path) -> None:
    trained(model).save_pretrained(tmp_path)
    plain = PeftModel.from_pretrained(AutoModelForCausalLM.from_pretrained(language.weights), tmp_path / "adapter")
    embeddings = model.embed(**call(model))
    assert torch.equal(plain(inputs_embeds=embeddings).logits, model.llm(inputs_embeds=embeddings).logits)


@pytest.mark.parametrize(("pad", "bos"), [("<pad>", True), ("</s>", False), (None, False)])
def test_any_padding_token_leaves_the_end_to_be_learnt(
    pad: str | None, bos: bool, questions: list[Question], store: EmbeddingStore, tmp_path: Path
) -> None:
    setting = LanguageConfig(weights=str(write_llama(tmp_path, bos=bos, pad=pad)))
    model, data = assemble(material(setting, questions, store), taking(6), "test")
    assert model.tokenizer.pad_token == (pad or "<unk>")
    samples = [data[i] for i in range(len(data))]
    for row, sample in zip(collate(samples)["labels"], samples, strict=True):
        kept = row[row != IGNORE_INDEX]
        assert kept[-1] == model.tokenizer.eos_token_id
        assert torch.equal(kept, sample["labels"][sample["labels"] != IGNORE_INDEX])
        assert (sample["input_ids"][0] == model.tokenizer.bos_token_id) == bos


def test_lacking_tokens(tmp_path: Path) -> None:
    folder = write_llama(tmp_path, pad=None)
    edit(folder / "tokenizer_config.json", unk_token=None)
    assert load_tokenizer(folder).pad_token == "</s>"
    edit(folder / "tokenizer_config.json", eos_token=None)
    with refused("language.weights: .*names no eos_token"):
        load_tokenizer(folder)
    folder = write_llama(tmp_path, vocab_size=255)
    with refused("the tokenizer .* has .*, of which the model has no embedding"):
        OctopiForCausalLM.from_base(folder, DIM)


def test_rows_that_no_token_has_are_no_matter(tmp_path: Path) -> None:
    """Many checkpoints round their matrix up: the tactile tokens' ids are then rows of it, which are never read."""
    model = OctopiForCausalLM.from_base(write_llama(tmp_path, vocab_size=320), DIM)
    assert model.frame_id < 320
    before = model.embed(**call(model))
    with torch.no_grad():
        model.llm.get_input_embeddings().weight[260:] = float("nan")
    assert torch.equal(model.embed(**call(model)), before)


def without_first(file: Path) -> None:
    _, *rest = sorted(load_file(file).items())
    save_file(dict(rest), file, {"format": "pt"})


def not_finite(file: Path) -> None:
    name, value = max(load_file(file).items())
    replace(file, name, torch.full_like(value, float("nan")))


BROKEN: list[tuple[str, Callable[[Path], object], str]] = [
    (ADAPTER, lambda file: file.rename(file.with_suffix(".bin")), r"no such file \(pickled adapters are refused\)"),
    (ADAPTER, without_first, "its adapter is broken or of another language model .*layers.0.self_attn.k_proj"),
    (CONNECTOR, not_finite, "connector.* is not finite"),
]


@pytest.mark.parametrize(("file", "spoil", "message"), BROKEN)
def test_a_broken_model_is_one_line(
    file: str, spoil: Callable[[Path], object], message: str, model: OctopiForCausalLM, tmp_path: Path
) -> None:
    model.train_words()
    trained(model).save_pretrained(tmp_path)
    spoil(tmp_path / file)
    with refused(message):
        OctopiForCausalLM.from_pretrained(tmp_path)


def test_another_base_is_refused(model: OctopiForCausalLM, tmp_path: Path) -> None:
    trained(model).save_pretrained(tmp_path / "saved")
    with refused("made for word embeddings of 32, but .*base has 64"):
        OctopiForCausalLM.from_pretrained(tmp_path / "saved", base=write_llama(tmp_path / "base", hidden_size=64))

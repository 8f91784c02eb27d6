"""Saving and loading: bases of many kinds, what plain PEFT reads, and what is refused."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from pipeline import training as shared
from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.errors import UserError
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.conversations import ConversationCollator
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Job, add_lora, assemble, finetune_lora
from pipeline.records import Opd, Question
from tests.checkpoints import write_llama
from tests.language.shared import DIM, SMALL, generation, language, material, model, questions, store

__all__ = ["language", "model", "questions", "store"]
"""Fixtures."""
LORA = LoraTrainConfig(samples=1, rank=4, alpha=8, dropout=0.0)


def call(model: OctopiForCausalLM) -> dict[str, torch.Tensor]:
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.frame_id, model.end_id, 7, 9]])
    return {"input_ids": ids, "features": torch.randn(1, 2, DIM, generator=torch.manual_seed(3))}


def trained(model: OctopiForCausalLM) -> OctopiForCausalLM:
    """With an adapter that changes something, and a connector that no seed draws."""
    add_lora(model, LORA)
    for name, parameter in model.named_parameters():
        if "lora_B" in name or name.startswith("connector."):
            torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def digests(folder: Path) -> dict[str, str]:
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    return {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def test_what_is_saved_comes_back_to_the_bit_and_in_the_same_bytes(model: OctopiForCausalLM, tmp_path: Path) -> None:
    model = trained(model)
    expected = model(**call(model)).logits
    model.save_pretrained(tmp_path / "a")
    loaded = OctopiForCausalLM.from_pretrained(tmp_path / "a")
    assert not loaded.training
    assert torch.equal(loaded(**call(model)).logits, expected)
    loaded.save_pretrained(tmp_path / "b")
    model.save_pretrained(tmp_path / "c", {n: v.clone() for n, v in model.state_dict().items()})
    assert digests(tmp_path / "a") == digests(tmp_path / "b") == digests(tmp_path / "c")
    assert set(digests(tmp_path / "a")) == {
        *("config.json", "connector.safetensors", "adapter/adapter_config.json", "adapter/adapter_model.safetensors")
    }
    told = json.loads((tmp_path / "a" / "config.json").read_text())
    assert (told["architectures"], told["tactile_dim"], told["hidden_size"]) == (["OctopiForCausalLM"], DIM, 32)
    size = sum(f.stat().st_size for f in (tmp_path / "a").rglob("*"))
    assert size < 60_000, "the base stays where it is"


def test_plain_peft_loads_the_adapter(model: OctopiForCausalLM, language: LanguageConfig, tmp_path: Path) -> None:
    from peft import PeftModel
    from transformers import AutoModelForCausalLM

    model = trained(model)
    model.save_pretrained(tmp_path)
    plain = PeftModel.from_pretrained(AutoModelForCausalLM.from_pretrained(language.weights), tmp_path / "adapter")
    embeddings = model.embed(**call(model))
    assert torch.equal(plain(inputs_embeds=embeddings).logits, model.llm(inputs_embeds=embeddings).logits)


@pytest.mark.parametrize("tied", [True, False])
@pytest.mark.parametrize("heads", [4, 2, 1])
def test_tied_or_not_grouped_or_not(tied: bool, heads: int, tmp_path: Path) -> None:
    folder = write_llama(tmp_path / "base", tie_word_embeddings=tied, num_key_value_heads=heads)
    model = trained(OctopiForCausalLM.from_base(folder, DIM))
    words = model.llm.get_base_model()
    assert (words.get_input_embeddings().weight is words.get_output_embeddings().weight) == tied
    model.save_pretrained(tmp_path / "saved")
    again = OctopiForCausalLM.from_pretrained(tmp_path / "saved")
    assert torch.equal(again(**call(model)).logits, model(**call(model)).logits)


def test_sharded_weights_are_read_and_a_missing_shard_is_named(language: LanguageConfig, tmp_path: Path) -> None:
    folder = write_llama(tmp_path, shard="20KB")
    shards = sorted(folder.glob("model-*.safetensors"))
    assert len(shards) > 2
    whole, parts = (load_llm(Path(f), torch.float32).state_dict() for f in (language.weights, folder))
    assert all(torch.equal(value, parts[name]) for name, value in whole.items())
    shards[1].unlink()
    with pytest.raises(UserError, match=r"language.weights: .*model-00002-of"):
        load_llm(folder, torch.float32)
    write_llama(tmp_path, shard="20KB")
    shards[0].write_bytes(shards[0].read_bytes()[:-100])
    with pytest.raises(UserError, match=r"language.weights: .* cannot be loaded"):
        load_llm(folder, torch.float32)


@pytest.mark.parametrize("pad", ["<pad>", "</s>", "<unk>", None])
@pytest.mark.parametrize("bos", [True, False])
def test_any_padding_token_leaves_the_end_to_be_learnt(
    pad: str | None, bos: bool, questions: list[Question], store: EmbeddingStore, tmp_path: Path
) -> None:
    folder = write_llama(tmp_path, bos=bos, pad=pad)
    setting = LanguageConfig(weights=str(folder))
    model, data = assemble(material(setting, questions, store), 6, "test")
    assert model.tokenizer.pad_token == (pad or "<unk>")
    samples = [data[i] for i in range(len(data))]
    batch = ConversationCollator(int(model.tokenizer.pad_token_id))(samples)
    end = model.tokenizer.eos_token_id
    for row, sample in zip(batch["labels"], samples, strict=True):
        kept = row[row != IGNORE_INDEX]
        assert kept[-1] == end
        assert torch.equal(kept, sample["labels"][sample["labels"] != IGNORE_INDEX])
        opening = model.tokenizer.convert_ids_to_tokens(sample["input_ids"][:1].tolist())
        assert (opening[0] == "<s>") == bos
    one, many = (answer(model, store, questions, Opd.NEEDED, generation(size, 6)) for size in (1, 7))
    assert one == many
    assert all(p.tokens <= 6 * len(p.outputs) for p in one)


def test_without_unknown_token_the_end_pads(tmp_path: Path) -> None:
    folder = write_llama(tmp_path, pad=None)
    file = folder / "tokenizer_config.json"
    told = json.loads(file.read_text())
    told.pop("unk_token")
    file.write_text(json.dumps(told))
    assert load_tokenizer(folder).pad_token == "</s>"
    told.pop("eos_token")
    file.write_text(json.dumps(told))
    with pytest.raises(UserError, match=r"language.weights: .*names no eos_token"):
        load_tokenizer(folder)


def test_a_token_without_an_embedding_is_named(tmp_path: Path) -> None:
    folder = write_llama(tmp_path, vocab_size=255)
    with pytest.raises(UserError, match="the tokenizer .* has .*, of which the model has no embedding"):
        OctopiForCausalLM.from_base(folder, DIM)


def test_rows_that_no_token_has_are_no_matter(tmp_path: Path) -> None:
    """Many checkpoints round their matrix up: the tactile tokens' ids are then rows of it, which are never read."""
    folder = write_llama(tmp_path, vocab_size=320)
    model = OctopiForCausalLM.from_base(folder, DIM)
    assert model.frame_id < 320
    before = model.embed(**call(model))
    with torch.no_grad():
        model.llm.get_input_embeddings().weight[260:] = float("nan")
    assert torch.equal(model.embed(**call(model)), before)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_what_is_trained_stays_in_float32(
    dtype: str,
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    setting = language.model_copy(update={"dtype": dtype})
    model, data = assemble(material(setting, questions, store), 8, "test")
    config = LoraTrainConfig(**SMALL.model_dump(), rank=4, alpha=8, learning_rate=1e-3)
    add_lora(model, config)
    for name, parameter in model.named_parameters():
        assert (parameter.dtype == torch.float32) == parameter.requires_grad, name
    finetune_lora(model, data, config, RuntimeConfig(device="cpu"), Job("lora", dtype, 0))
    model.save_pretrained(tmp_path / "saved")
    saved = load_file(tmp_path / "saved" / "adapter" / "adapter_model.safetensors")
    assert {v.dtype for v in saved.values()} == {torch.float32}
    assert any(v.abs().max() > 0 for n, v in saved.items() if "lora_B" in n)
    again = OctopiForCausalLM.from_pretrained(tmp_path / "saved", dtype=dtype)  # type: ignore[arg-type]
    assert again.llm.get_input_embeddings().weight.dtype == getattr(torch, dtype)
    assert torch.equal(again(**call(model)).logits, model.eval()(**call(model)).logits)


@pytest.mark.skipif(torch.cuda.is_available(), reason="here four bits may well be had")
def test_four_bits_without_a_card_are_one_line(language: LanguageConfig) -> None:
    with pytest.raises(UserError, match=r"^language.quantization: nf4 needs .*CUDA device.*quantization=none$"):
        OctopiForCausalLM.from_base(language.weights, DIM, quantization="nf4")


def broken(folder: Path, what: str) -> str:
    """Break a saved model; what the message must say."""
    adapter, config = folder / "adapter", folder / "config.json"
    if what == "no config":
        config.unlink()
        return "config.json: no such file"
    if what == "foreign config":
        config.write_text('{"model_type": "llama"}')
        return r"config.json: base_model: Field required"
    if what == "pickled adapter":
        (adapter / "adapter_model.safetensors").unlink()
        torch.save({}, adapter / "adapter_model.bin")
        return r"adapter_model.safetensors: no such file \(pickled adapters are refused\)"
    if what == "cut adapter":
        file = adapter / "adapter_model.safetensors"
        file.write_bytes(file.read_bytes()[:300])
        return "adapter: its adapter is broken or of another language model"
    tensors = load_file(folder / "connector.safetensors")
    tensors["delimiters"][0, 0] = float("nan")
    save_file(tensors, folder / "connector.safetensors")
    return "connector.delimiters is not finite"


@pytest.mark.parametrize("what", ["no config", "foreign config", "pickled adapter", "cut adapter", "NaN"])
def test_a_broken_model_is_one_line(what: str, model: OctopiForCausalLM, tmp_path: Path) -> None:
    trained(model).save_pretrained(tmp_path)
    message = broken(tmp_path, what)
    with pytest.raises(UserError, match=message) as caught:
        OctopiForCausalLM.from_pretrained(tmp_path)
    assert "\n" not in str(caught.value)


def test_another_base_is_refused(model: OctopiForCausalLM, tmp_path: Path) -> None:
    model = trained(model)
    model.save_pretrained(tmp_path / "saved")
    wide = write_llama(tmp_path / "wide", hidden_size=64)
    with pytest.raises(UserError, match=r"made for word embeddings of 32, but .*wide has 64"):
        OctopiForCausalLM.from_pretrained(tmp_path / "saved", base=wide)
    heads = write_llama(tmp_path / "heads", num_key_value_heads=4)
    with pytest.raises(UserError, match="adapter is broken or of another language model .*size mismatch"):
        OctopiForCausalLM.from_pretrained(tmp_path / "saved", base=heads)


def test_embeddings_of_another_length_are_refused(
    tmp_path: Path, language: LanguageConfig, store: EmbeddingStore
) -> None:
    model = OctopiForCausalLM.from_base(language.weights, DIM + 1)
    with pytest.raises(UserError, match=f"embeddings of {DIM}, but the model reads {DIM + 1}"):
        answer(model, store, [], Opd.ALL, generation(1))

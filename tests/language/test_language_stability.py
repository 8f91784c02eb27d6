"""The language side at its edges: padding, empty and full rows, adapters, fewer bits, NaN."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pipeline.stability.language_ways import ALPHA, RANK
from torch.nn import functional as F

from pipeline.config import LanguageConfig, LoraTrainConfig
from pipeline.embeddings import INDEX_FILE, TENSOR, TENSOR_FILE, EmbeddingStore
from pipeline.errors import UserError
from pipeline.io import read_table, save_tensors
from pipeline.language.chat import IGNORE_INDEX, Encoded, encode
from pipeline.language.conversations import ConversationDataset
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import add_lora, assemble
from pipeline.records import Embedding, Opd, Question
from tests.language.shared import DIM, asking, language, material, model, questions, store

__all__ = ["language", "model", "questions", "store"]
"""Fixtures."""


# Embeddings in their places


def plainly(model: OctopiForCausalLM, ids: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """`embed` by the letter: token for token, with a counter of frames."""
    words, connector = model.llm.get_input_embeddings().weight, model.connector
    rows = []
    for row, given_features in zip(ids.tolist(), features, strict=True):
        frame, found = 0, []
        for token in row:
            if token == model.frame_id:
                first, last = connector.projection[0], connector.projection[2]
                hidden = F.gelu(first.weight @ given_features[frame] + first.bias)
                found.append(last.weight @ hidden + last.bias)
                frame += 1
            elif token in (model.start_id, model.end_id):
                found.append(connector.delimiters[int(token == model.end_id)])
            else:
                found.append(words[token])
        rows.append(torch.stack(found))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def steady(language: LanguageConfig) -> OctopiForCausalLM:
    """One model for all examples of a property."""
    torch.manual_seed(5)
    made = OctopiForCausalLM.from_base(language.weights, DIM).eval()
    torch.nn.init.normal_(made.connector.delimiters)
    return made


WORDS = st.integers(0, 259)
TACTILE = st.sampled_from(["start", "frame", "frame", "frame", "end"])
ROWS = st.integers(1, 12).flatmap(
    lambda length: st.lists(
        st.lists(st.one_of(WORDS, TACTILE), min_size=length, max_size=length), min_size=1, max_size=4
    )
)


@given(rows=ROWS, spare=st.integers(0, 2))
def test_embedding_equals_a_plain_one(steady: OctopiForCausalLM, rows: list[list[int | str]], spare: int) -> None:
    """Rows without any tactile token, all frames in one row, frames at the very ends, rows of nothing else."""
    special = {"start": steady.start_id, "frame": steady.frame_id, "end": steady.end_id}
    ids = torch.tensor([[special[t] if isinstance(t, str) else t for t in row] for row in rows])
    counts = (ids == steady.frame_id).sum(1)
    features = torch.full((len(rows), int(counts.max()) + spare, DIM), float("nan"))
    for row, count in enumerate(counts.tolist()):
        features[row, :count] = torch.randn(count, DIM, generator=torch.manual_seed(row))
    with torch.no_grad():
        torch.testing.assert_close(steady.embed(ids, features), plainly(steady, ids, features), atol=2e-6, rtol=0)


def test_frames_of_one_row_give_gradients_to_no_other(model: OctopiForCausalLM) -> None:
    ids = torch.tensor([[model.frame_id] * 7, [5] * 7])
    features = torch.randn(2, 7, DIM, requires_grad=True)
    model.embed(ids, features).square().sum().backward()
    assert features.grad is not None
    assert (features.grad[0].abs().sum(1) > 0).all()
    assert (features.grad[1] == 0).all()


# Rows with nothing to say


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_row_that_is_all_padding_spoils_nothing(side: str, model: OctopiForCausalLM) -> None:
    ids = torch.randint(4, 200, (3, 9), generator=torch.manual_seed(0))
    mask = torch.ones_like(ids)
    mask[1] = 0
    mask[2, slice(None, 4) if side == "left" else slice(5, None)] = 0
    labels = ids.masked_fill(mask == 0, IGNORE_INDEX)
    positions = torch.zeros(3, 0, DIM)
    output = model(ids, positions, mask, labels)
    output.loss.backward()
    assert output.loss.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_labels_that_are_all_ignored_weigh_nothing(model: OctopiForCausalLM) -> None:
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.end_id, 7]])
    features, labels = torch.randn(1, 1, DIM), torch.full_like(ids, IGNORE_INDEX)
    for count in (None, torch.tensor(0), torch.tensor(12)):
        model.zero_grad()
        loss = model(ids, features, labels=labels, num_items_in_batch=count).loss
        loss.backward()
        assert loss == 0
        assert all((p.grad == 0).all() for p in model.parameters() if p.grad is not None)
    labels[0, 0] = 5
    assert model(ids, features, labels=labels).loss == 0, "nothing foretells the first token"


def test_a_conversation_without_an_answer_is_named(
    questions: list[Question],
    store: EmbeddingStore,
    language: LanguageConfig,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "pipeline.language.conversations.encode",
        lambda rendered, tokenizer: Encoded((ids := encode(rendered, tokenizer).input_ids), (IGNORE_INDEX,) * len(ids)),
    )
    with pytest.raises(UserError, match=r"^[A-Z]+-train-\d+: has no answer to learn from"):
        assemble(material(language, questions, store), 3, "test")


def test_answers_of_one_token_are_learnt(model: OctopiForCausalLM) -> None:
    """The end token alone, in every column that a row's answer can be in."""
    end = model.tokenizer.eos_token_id
    ids = torch.randint(4, 200, (4, 6), generator=torch.manual_seed(0))
    labels = torch.full_like(ids, IGNORE_INDEX)
    for row, column in enumerate((1, 3, 5, 5)):
        ids[row, column] = labels[row, column] = end
    features = torch.zeros(4, 0, DIM)
    logits = model(ids, features).logits.double()
    expected = [-logits[row, column - 1].log_softmax(0)[end] for row, column in enumerate((1, 3, 5, 5))]
    found = model(ids, features, labels=labels).loss
    torch.testing.assert_close(found.double(), torch.stack(expected).mean(), atol=1e-6, rtol=0)


# Adapters

PAPER = LoraTrainConfig(samples=1, rank=RANK, alpha=ALPHA)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_fresh_adapter_of_the_papers_size_is_the_identity(dtype: torch.dtype, model: OctopiForCausalLM) -> None:
    """B = 0, whatever alpha and rank are: to the bit."""
    model.llm.to(dtype)
    ids = torch.randint(4, 200, (3, 40), generator=torch.manual_seed(0))
    before = model(ids, torch.zeros(3, 0, DIM)).logits
    add_lora(model, PAPER)
    assert torch.equal(model.eval()(ids, torch.zeros(3, 0, DIM)).logits, before)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_merged_adapter_is_the_sum_of_both(dtype: torch.dtype, model: OctopiForCausalLM) -> None:
    """W + alpha / rank B A, by hand; how near that comes in logits is among the hard cases."""
    add_lora(model, PAPER)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, std=0.02)
    model.eval().to(dtype)
    layer = model.llm.get_base_model().model.layers[1].self_attn.q_proj
    low, high = layer.lora_A["default"].weight.double(), layer.lora_B["default"].weight.double()
    expected = layer.base_layer.weight.double() + ALPHA / RANK * high @ low
    ids = torch.randint(4, 200, (3, 40), generator=torch.manual_seed(0))
    embeddings = model.embed(ids, torch.zeros(3, 0, DIM))
    apart = model.llm(inputs_embeds=embeddings).logits
    merged = copy.deepcopy(model.llm).merge_and_unload()
    sizes = layer.base_layer.weight.double().abs() + ALPHA / RANK * high.abs() @ low.abs()
    off = (merged.model.layers[1].self_attn.q_proj.weight.double() - expected).abs()
    assert (off <= (RANK + 2) * torch.finfo(dtype).eps * sizes).all()
    with model.llm.disable_adapter():
        assert not torch.allclose(model.llm(inputs_embeds=embeddings).logits, apart, atol=1e-3), "it does something"


# NaN


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_embedding_that_is_not_finite_is_named_by_its_video(
    value: float, store: EmbeddingStore, tmp_path: Path
) -> None:
    """Training and answering read embeddings through the store alone."""
    (tmp_path / INDEX_FILE).write_bytes((store.folder / INDEX_FILE).read_bytes())
    entry = read_table(store.folder / INDEX_FILE, Embedding)[-1]
    tensor = store.tensor.clone()
    tensor[entry.row, 2] = value
    save_tensors(tmp_path / TENSOR_FILE, {TENSOR: tensor})
    with pytest.raises(
        UserError, match=f"safetensors: {entry.video_id} has an embedding that is not finite.*dvc repro"
    ):
        EmbeddingStore(tmp_path)


def test_a_video_without_embeddings_is_named(
    questions: list[Question], store: EmbeddingStore, language: LanguageConfig, model: OctopiForCausalLM
) -> None:
    question = questions[0].model_copy(update={"videos": ("nowhere_3",) * len(questions[0].videos)})
    with pytest.raises(UserError, match="nowhere_3 has no embedding; run `dvc repro`"):
        answer(model, store, [question], Opd.ALL, asking(1))
    data: ConversationDataset = assemble(material(language, [question], store), 1, "test")[1]
    with pytest.raises(UserError, match="nowhere_3"):
        data[0]

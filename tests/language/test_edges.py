"""The language side at its edges: embeddings in any places, embeddings that lack or are not finite, no answer.

What rounding does to it is in tests/numerics.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import LanguageConfig
from pipeline.core.embeddings import EmbeddingStore
from pipeline.core.errors import UserError
from pipeline.core.io import read_table, save_tensors
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding, Opd, Question
from pipeline.language.chat import IGNORE_INDEX, Encoded, encode_turns
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Material, assemble
from tests.language.shared import DIM, FRAMES, embedded, generation, material, taking


@pytest.fixture(scope="module")
def steady(language: LanguageConfig) -> OctopiForCausalLM:
    """One model for all examples of a property."""
    torch.manual_seed(5)
    made = OctopiForCausalLM.from_base(language.weights, DIM).eval()
    torch.nn.init.normal_(made.connector.delimiters)
    return made


TOKENS = st.integers(0, 259) | st.sampled_from(["start", "frame", "frame", "frame", "end"])
ROWS = st.integers(1, 12).flatmap(
    lambda length: st.lists(st.lists(TOKENS, min_size=length, max_size=length), min_size=1, max_size=4)
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
    words, own = steady.llm.get_input_embeddings().weight, dict(steady.connector.named_parameters())
    with torch.no_grad():
        expected = [embedded(steady, row, f, words, own) for row, f in zip(ids.tolist(), features, strict=True)]
        torch.testing.assert_close(steady.embed(ids, features), torch.stack(expected), atol=2e-6, rtol=0)


def test_a_conversation_without_an_answer_is_named(held: Material, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "pipeline.language.conversations.encode_turns",
        lambda *given, **how: Encoded((ids := encode_turns(*given, **how).input_ids), (IGNORE_INDEX,) * len(ids)),
    )
    with pytest.raises(UserError, match=r"^[A-Z]+-train-\d+: has no answer to learn from"):
        assemble(held, taking(3), "test")


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
    wanted = f"safetensors: {entry.video_id} has an embedding that is not finite.*dvc repro"
    with pytest.raises(UserError, match=wanted):
        EmbeddingStore(tmp_path)


def test_a_video_without_embeddings_is_named(
    questions: list[Question], store: EmbeddingStore, language: LanguageConfig, model: OctopiForCausalLM
) -> None:
    question = questions[0].model_copy(update={"videos": ("nowhere_3",) * len(questions[0].videos)})
    with pytest.raises(UserError, match="nowhere_3 has no embedding; run `dvc repro`"):
        answer(model, store, [question], Opd.ALL, generation(1), FRAMES)
    _, data = assemble(material(language, [question], store), taking(1), "test")
    with pytest.raises(UserError, match="nowhere_3"):
        data[0]

"""Answers by hand, at the limits of tokens and positions, and of what cannot be asked."""

from __future__ import annotations

import copy
from pathlib import Path

import torch

from pipeline.config import LanguageConfig
from pipeline.core.records import Opd, Question
from pipeline.language.chat import encode, render
from pipeline.language.conversations import evaluation_features
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import assemble
from pipeline.training.embeddings import EmbeddingStore
from tests.checkpoints import write_llama
from tests.conftest import refused
from tests.language.conftest import DIM, FRAMES, generation, material, taking


def prompt(question: Question, opd: Opd, model: OctopiForCausalLM) -> list[int]:
    turns = question.dialogue(opd).turns
    text = render(turns, model.tokenizer, system_prompt="", frames=FRAMES, complete=False)
    return list(encode(text, model.tokenizer).input_ids)


def by_hand(model: OctopiForCausalLM, question: Question, store: EmbeddingStore, opd: Opd, count: int) -> list[int]:
    """The likeliest tokens, the whole sequence anew for each, without cache or padding."""
    said, features = prompt(question, opd, model), evaluation_features(question, store, FRAMES)[None]
    for _ in range(count):
        said.append(int(model(torch.tensor([said]), features).logits[0, -1].argmax()))
    return said[-count:]


def test_an_answer_at_the_limit(model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore) -> None:
    """A token that the model says after some others is made the end token."""
    asked = [q for q in questions if q.task == "OPD"][:3]
    assert all(p.truncated and p.tokens == 8 for p in answer(model, store, asked, Opd.ALL, generation(4, 8), FRAMES))
    question, new = next((q, new) for q in asked if len(set(new := by_hand(model, q, store, Opd.ALL, 8))) > 1)
    place = next(i for i in range(1, 8) if new[i] not in new[:i])
    other = copy.copy(model)
    other.tokenizer = copy.deepcopy(model.tokenizer)
    other.tokenizer.eos_token = other.tokenizer.convert_ids_to_tokens(new[place])
    whole, cut = (answer(other, store, [question], Opd.ALL, generation(1, n), FRAMES)[0] for n in (place + 1, place))
    assert (whole.truncated, whole.tokens) == (False, place + 1)
    assert (cut.truncated, cut.tokens) == (True, place)
    assert whole.outputs == cut.outputs, "the end token says nothing"


def test_an_answer_ends_where_positions_do(questions: list[Question], store: EmbeddingStore, tmp_path: Path) -> None:
    """Each row has its own limit; with the end token as padding, the cut must still be seen."""
    wide = OctopiForCausalLM.from_base(write_llama(tmp_path / "wide", pad="</s>"), DIM)
    asked = sorted((q for q in questions if q.task == "PSS"), key=lambda q: len(prompt(q, Opd.ALL, wide)))
    lengths = {q.question_id: len(prompt(q, Opd.ALL, wide)) for q in asked}
    most = max(lengths.values()) + 5
    folder = write_llama(tmp_path / "tight", pad="</s>", max_position_embeddings=most)
    tight = OctopiForCausalLM.from_base(folder, DIM)
    alone, together = (answer(tight, store, asked, Opd.ALL, generation(size, 40), FRAMES) for size in (1, 50))
    assert alone == together
    room = [min(40, most - lengths[p.question_id]) for p in together]
    assert len(set(room)) > 2
    assert all(p.tokens <= own and p.truncated == (p.tokens == own) for p, own in zip(together, room, strict=True))
    assert any(p.tokens == 5 for p in together)


def test_a_question_beyond_the_positions(questions: list[Question], store: EmbeddingStore, tmp_path: Path) -> None:
    setting = LanguageConfig(weights=str(write_llama(tmp_path, max_position_embeddings=60)))
    with refused(r"^[A-Z]+-train-\d+: takes \d+ tokens, .* 60 at once; lower frames.per_video"):
        assemble(material(setting, questions, store), taking(4), "test")

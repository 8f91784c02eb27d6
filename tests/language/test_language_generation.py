"""Answers at the limits: of tokens, of positions, of the cache, against transformers' own generation."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from transformers import DynamicCache, MistralConfig, MistralForCausalLM

from pipeline.config import LanguageConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.errors import UserError
from pipeline.language.cache import AHEAD, roomy_cache
from pipeline.language.chat import encode, render
from pipeline.language.conversations import evaluation_features
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import assemble
from pipeline.records import Opd, Question
from tests.checkpoints import write_llama
from tests.language.shared import DIM, FRAMES, generation, language, material, model, questions, store

__all__ = ["language", "model", "questions", "store"]
"""Fixtures."""


def test_one_row_answers_as_transformers_own_generation_does(
    model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore
) -> None:
    """By its own cache, without padding, over more tokens than room is made for at a time."""
    limit = 2 * AHEAD + 20
    for question in [q for q in questions if q.task != "PSR"][:4]:
        dialogue = question.dialogue(Opd.NEEDED)
        assert dialogue is not None
        text = render(dialogue.turns, system_prompt="", frames=FRAMES, eos="</s>", complete=False)
        ids = torch.tensor([encode(text, model.tokenizer).input_ids])
        features = evaluation_features(question, store, FRAMES)[None]
        new = model.llm.generate(
            inputs_embeds=model.embed(ids, features),
            attention_mask=torch.ones_like(ids),
            max_new_tokens=limit,
            do_sample=False,
            eos_token_id=model.tokenizer.eos_token_id,
            pad_token_id=0,
        )[0].tolist()
        prediction = answer(model, store, [question], Opd.NEEDED, generation(1, limit))[0]
        assert prediction.outputs == (model.tokenizer.decode(new, skip_special_tokens=True).strip(),)
        assert prediction.tokens == len(new)


@pytest.mark.parametrize("window", [None, 8])
def test_the_cache_gives_back_what_transformers_own_does(window: int | None) -> None:
    torch.manual_seed(0)
    shapes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    llm = MistralForCausalLM(
        MistralConfig(vocab_size=50, num_key_value_heads=2, sliding_window=window, **shapes)
    ).eval()
    own, other = roomy_cache(llm.config), DynamicCache(config=llm.config)
    for start, stop in ((0, 5), (5, 6), (6, 7), (7, 7 + AHEAD), (7 + AHEAD, 8 + AHEAD)):
        ids = torch.randint(0, 50, (3, stop - start), generator=torch.manual_seed(stop))
        with torch.no_grad():
            found, expected = (llm(ids, past_key_values=cache, use_cache=True).logits for cache in (own, other))
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
        assert own.get_seq_length() == other.get_seq_length() == stop


def test_an_answer_at_the_limit_is_whole_and_one_beyond_is_cut(
    model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore
) -> None:
    """The end token made the likeliest after some tokens: its column of the head is turned towards a later state."""
    asked = [q for q in questions if q.task == "OPD"][:3]
    free = {p.question_id: p for p in answer(model, store, asked, Opd.ALL, generation(4, 8))}
    assert all(p.truncated and p.tokens == 8 for p in free.values())
    for question in asked:
        dialogue = question.dialogue(Opd.ALL)
        assert dialogue is not None
        prompt = encode(
            render(dialogue.turns, system_prompt="", frames=FRAMES, eos="</s>", complete=False), model.tokenizer
        ).input_ids
        said = list(prompt)
        features = evaluation_features(question, store, FRAMES)[None]
        for _ in range(8):
            said.append(int(model(torch.tensor([said]), features).logits[0, -1].argmax()))
        new = said[len(prompt) :]
        place = next(i for i in range(1, 8) if new[i] not in new[:i]) if len(set(new)) > 1 else None
        if place is None:
            continue
        tokenizer = copy.deepcopy(model.tokenizer)
        tokenizer.eos_token = tokenizer.convert_ids_to_tokens(new[place])
        other = copy.copy(model)
        other.tokenizer = tokenizer
        whole, cut = (answer(other, store, [question], Opd.ALL, generation(1, limit))[0] for limit in (place + 1, place))
        assert (whole.truncated, whole.tokens) == (False, place + 1)
        assert (cut.truncated, cut.tokens) == (True, place)
        assert whole.outputs == cut.outputs, "the end token says nothing"
        return
    pytest.fail("no answer with two different tokens: the test has lost its subject")


def test_an_answer_ends_where_the_positions_do_whatever_its_neighbours(
    questions: list[Question], store: EmbeddingStore, tmp_path: Path
) -> None:
    """Each row has its own limit; with the end token as padding, the cut must still be seen."""
    asked = [q for q in questions if q.task in ("OPD", "PC", "PSS")]

    def lengths(model: OctopiForCausalLM) -> dict[str, int]:
        made = {}
        for question in asked:
            dialogue = question.dialogue(Opd.ALL)
            assert dialogue is not None
            text = render(dialogue.turns, system_prompt="", frames=FRAMES, eos="</s>", complete=False)
            made[question.question_id] = len(encode(text, model.tokenizer).input_ids)
        return made

    wide = OctopiForCausalLM.from_base(write_llama(tmp_path / "wide", pad="</s>"), DIM)
    prompts = lengths(wide)
    folder = write_llama(tmp_path / "tight", pad="</s>", max_position_embeddings=max(prompts.values()) + 5)
    torch.manual_seed(0)
    tight = OctopiForCausalLM.from_base(folder, DIM)
    alone, together = (answer(tight, store, asked, Opd.ALL, generation(size, 40)) for size in (1, 50))
    assert alone == together
    room = {name: min(40, max(prompts.values()) + 5 - length) for name, length in prompts.items()}
    assert len(set(room.values())) > 2
    for prediction in together:
        assert prediction.tokens <= room[prediction.question_id]
        assert prediction.truncated == (prediction.tokens == room[prediction.question_id])
    assert any(p.tokens == 5 for p in together)


def test_a_question_longer_than_the_positions_is_named_with_the_key(
    questions: list[Question], store: EmbeddingStore, tmp_path: Path
) -> None:
    setting = LanguageConfig(weights=str(write_llama(tmp_path, max_position_embeddings=60)))
    with pytest.raises(UserError, match=r"^[A-Z]+-train-\d+: takes \d+ tokens, .* 60 at once; lower frames.per_video"):
        assemble(material(setting, questions, store), 4, "test")
    model = OctopiForCausalLM.from_base(setting.weights, DIM)
    with pytest.raises(UserError, match=r"^[A-Z]+-train-\d+: .*language.system_prompt.*language.weights$"):
        answer(model, store, questions, Opd.ALL, generation(2))

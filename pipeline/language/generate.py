"""Answers: batched, greedy, in one or two turns."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from transformers import PreTrainedTokenizerBase

from pipeline.embeddings import TactileFeatures
from pipeline.errors import UserError
from pipeline.language.chat import encode, end_ids, render
from pipeline.language.conversations import check_length, evaluation_features
from pipeline.language.decoding import greedy
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.records import Opd, Prediction, Question, Turn
from pipeline.runtime import track


@dataclass(frozen=True)
class GenerationSettings:
    """How questions are put: the same for every variant."""

    system_prompt: str
    per_video: int
    """Frames a video; 0 asks without touch."""
    max_new_tokens: int
    batch_size: int


@dataclass(frozen=True)
class _Generated:
    text: str
    tokens: int
    truncated: bool


def answer(
    model: OctopiForCausalLM,
    store: TactileFeatures,
    questions: Sequence[Question],
    opd: Opd,
    settings: GenerationSettings,
) -> list[Prediction]:
    """Answer every question that has a dialogue in this OPD mode; later turns see the model's own earlier answers.

    Greedy, so the same model always says the same; in float32 the batch size changes nothing. An answer ends with the
    end token, or is cut (and marked so) after `max_new_tokens` or where the language model has no more positions.

    Raises:
        UserError: naming the question whose prompt alone has more tokens than the language model has positions.
    """
    if store.dim != model.octopi_config.tactile_dim:
        raise UserError(
            f"data/embeddings: embeddings of {store.dim}, but the model reads {model.octopi_config.tactile_dim}; run "
            "`dvc repro`"
        )
    model.eval()
    tokenizer = model.tokenizer
    asked = [(q, d) for q in questions if (d := q.dialogue(opd))]
    said: dict[str, list[_Generated]] = {q.question_id: [] for q, _ in asked}
    for number in range(max((len(d.turns) for _, d in asked), default=0)):
        waiting = []
        for question, dialogue in asked:
            if number < len(dialogue.turns):
                before = [s.text for s in said[question.question_id]]
                turns = [Turn(user=t.user, assistant=a) for t, a in zip(dialogue.turns, [*before, ""], strict=False)]
                prompt = _prompt(turns, tokenizer, settings)
                check_length(question.question_id, len(prompt) + 1, model.positions)
                waiting.append((question, prompt))
        # Neighbours of like length share a batch, so little is spent on padding.
        waiting.sort(key=lambda item: len(item[1]))
        starts = range(0, len(waiting), settings.batch_size)
        for start in track(starts, f"answers, turn {number + 1}", "batch"):
            batch = waiting[start : start + settings.batch_size]
            features = [evaluation_features(q, store, settings.per_video) for q, _ in batch]
            texts = _generate(model, [ids for _, ids in batch], features, settings.max_new_tokens)
            for (question, _), text in zip(batch, texts, strict=True):
                said[question.question_id].append(text)
    return [
        Prediction(
            question_id=q.question_id,
            task=q.task,
            outputs=tuple(s.text for s in said[q.question_id]),
            truncated=any(s.truncated for s in said[q.question_id]),
            tokens=sum(s.tokens for s in said[q.question_id]),
        )
        for q, _ in asked
    ]


def _prompt(turns: Sequence[Turn], tokenizer: PreTrainedTokenizerBase, settings: GenerationSettings) -> tuple[int, ...]:
    rendered = render(turns, tokenizer, system_prompt=settings.system_prompt, frames=settings.per_video, complete=False)
    return encode(rendered, tokenizer).input_ids


def _generate(
    model: OctopiForCausalLM, prompts: Sequence[Sequence[int]], features: Sequence[torch.Tensor], max_new_tokens: int
) -> list[_Generated]:
    """Generate one answer a prompt."""
    ends = end_ids(model.tokenizer)
    room = [
        max_new_tokens if model.positions is None else min(max_new_tokens, model.positions - len(p)) for p in prompts
    ]
    return [_said(tokens, ends, model.tokenizer) for tokens in greedy(model, prompts, features, ends, room)]


def _said(tokens: list[int], ends: Collection[int], tokenizer: PreTrainedTokenizerBase) -> _Generated:
    """What one row says, without its end token."""
    truncated = tokens[-1] not in ends
    text = tokenizer.decode(tokens if truncated else tokens[:-1], skip_special_tokens=True).strip()
    return _Generated(text=text, tokens=len(tokens), truncated=truncated)

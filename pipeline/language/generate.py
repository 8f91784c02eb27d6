"""Answers: batched, greedy, in one or two turns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, cast

import torch
from transformers import PreTrainedTokenizerBase, StoppingCriteria, StoppingCriteriaList

from pipeline.embeddings import TactileFeatures
from pipeline.errors import UserError
from pipeline.language.chat import encode, end_ids, render
from pipeline.language.conversations import check_length, evaluation_features, pad_features
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


class _Limits(StoppingCriteria):
    """Stops each row at its own number of new tokens, so that no row's limit depends on its neighbours."""

    def __init__(self, limits: torch.Tensor) -> None:
        self.limits = limits

    def __call__(self, input_ids: torch.Tensor, scores: Any, **_: Any) -> torch.Tensor:
        # With embeddings as input, these are the new tokens alone.
        return self.limits <= input_ids.shape[1]


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
    """Generate one answer a prompt; prompts are padded on the left, so that all answers start at one column."""
    tokenizer = model.tokenizer
    device = model.connector.delimiters.device
    longest = max(map(len, prompts))
    pad = cast(int, tokenizer.pad_token_id)
    ids = torch.tensor([[pad] * (longest - len(p)) + list(p) for p in prompts], device=device)
    lengths = torch.tensor([len(p) for p in prompts], device=device)
    mask = (torch.arange(longest, device=device) >= longest - lengths[:, None]).long()
    room = torch.full_like(lengths, max_new_tokens)
    if model.positions is not None:
        room = room.minimum(model.positions - lengths)
    new = model.generate(
        ids,
        pad_features(features).to(device),
        mask,
        max_new_tokens=max_new_tokens,
        stopping_criteria=StoppingCriteriaList([_Limits(room)]),
        do_sample=False,
        num_beams=1,
        eos_token_id=list(end_ids(tokenizer)),
        pad_token_id=pad,
    )
    return [_read(row[:most], tokenizer) for row, most in zip(new.tolist(), room.tolist(), strict=True)]


def _read(tokens: list[int], tokenizer: PreTrainedTokenizerBase) -> _Generated:
    """What one row says, up to its first end token; behind that is padding."""
    ends = end_ids(tokenizer)
    kept = list(takewhile(lambda token: token not in ends, tokens))
    truncated = len(kept) == len(tokens)
    text = tokenizer.decode(kept, skip_special_tokens=True).strip()
    return _Generated(text=text, tokens=len(kept) + (not truncated), truncated=truncated)

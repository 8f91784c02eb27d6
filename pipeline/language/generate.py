"""Answers: batched, greedy, turn by turn."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import torch
from transformers import PreTrainedTokenizerBase

from pipeline.config import LanguageConfig
from pipeline.core.records import Opd, Prediction, Question, Turn
from pipeline.core.runtime import DeviceName, DtypeName, Quantization, resolve_device
from pipeline.language.chat import encode, end_ids, render
from pipeline.language.conversations import check_length, evaluation_features
from pipeline.language.decoding import greedy, greedy_tokens
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_with
from pipeline.training.embeddings import EmbeddingStore


@dataclass(frozen=True)
class ModelSource:
    """Where a model lies; called, it loads it, in this process or in a cluster's worker."""

    folder: Path
    base: str
    dtype: DtypeName
    quantization: Quantization
    device: DeviceName
    run: float = 0.0
    """Start time of the stage: a worker may outlive a run, and the next has its model in the same folder."""

    def __call__(self) -> OctopiForCausalLM:
        """Load it."""
        model = OctopiForCausalLM.from_pretrained(
            self.folder, base=self.base, dtype=self.dtype, quantization=self.quantization
        )
        return model.to(resolve_device(self.device))


class Batch(NamedTuple):
    """Prompts that are answered at once, with the frames' features and the most new tokens of each."""

    prompts: list[Sequence[int]]
    features: list[torch.Tensor]
    limits: list[int]


@dataclass(frozen=True)
class Generated:
    """The answer to one prompt."""

    text: str
    tokens: int
    truncated: bool


def answer(
    model: OctopiForCausalLM,
    store: EmbeddingStore,
    questions: Sequence[Question],
    opd: Opd,
    language: LanguageConfig,
    per_video: int,
    source: ModelSource | None = None,
) -> list[Prediction]:
    """Answer every question that has a dialogue in this OPD mode; later turns see the model's own earlier answers.

    Greedy, so the same model always says the same; in float32 the batch size changes nothing. An answer ends with the
    end token, or is cut (and marked so) after `max_new_tokens` or where the language model has no more positions.

    Args:
        per_video: Frames a video.
        source: Of the model, for the workers of a cluster.

    Raises:
        UserError: naming the question whose prompt alone has more tokens than the language model has positions.
    """
    if store.dim != model.octopi_config.tactile_dim:
        raise UserError(
            f"data/embeddings: embeddings of {store.dim}, but the model reads {model.octopi_config.tactile_dim}; run "
            "`dvc repro`"
        )
    model.eval()
    asked = [(q, d) for q in questions if (d := q.dialogue(opd))]
    said: dict[str, list[Generated]] = {q.question_id: [] for q, _ in asked}
    for number in range(max((len(d.turns) for _, d in asked), default=0)):
        waiting = []
        for question, dialogue in asked:
            if number < len(dialogue.turns):
                own = [*(s.text for s in said[question.question_id]), ""]
                turns = [Turn(user=t.user, assistant=a) for t, a in zip(dialogue.turns, own, strict=False)]
                single = len(dialogue.turns) == 1
                prompt = write_prompt(turns, model.tokenizer, language, per_video, single=single)
                if (
                    number and model.positions is not None and len(prompt) >= model.positions
                ):  # What it said itself leaves no room.
                    said[question.question_id].append(Generated("", 0, truncated=True))
                    continue
                check_length(question.question_id, len(prompt) + 1, model.positions)
                waiting.append((question, prompt))
        features = [evaluation_features(q, store, per_video) for q, _ in waiting]
        texts = reply(model, [ids for _, ids in waiting], features, language, f"answers, turn {number + 1}", source)
        for (question, _), text in zip(waiting, texts, strict=True):
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


def write_prompt(
    turns: Sequence[Turn],
    tokenizer: PreTrainedTokenizerBase,
    language: LanguageConfig,
    per_video: int,
    *,
    single: bool | None = None,
) -> tuple[int, ...]:
    """Token ids of a conversation up to where its last answer is to be said; `single` as in `render`."""
    rendered = render(
        turns,
        tokenizer,
        system_prompt=language.system_prompt,
        frames=per_video,
        complete=False,
        chat=language.chat,
        single=single,
    )
    return encode(rendered, tokenizer, bos=language.bos).input_ids


def reply(
    model: OctopiForCausalLM,
    prompts: Sequence[Sequence[int]],
    features: Sequence[torch.Tensor],
    language: LanguageConfig,
    label: str = "answers",
    source: ModelSource | None = None,
) -> list[Generated]:
    """An answer to each prompt of `write_prompt`, whose frames have these features (frames x tactile_dim).

    Prompts are shorter than the language model has positions; `source` is of the model, for the workers of a cluster.
    """
    batches, places = [], list(_batches([len(prompt) for prompt in prompts], language.generation_batch_size))
    for own in places:
        limits = [_room(model, prompts[place], language) for place in own]
        batches.append(Batch([prompts[place] for place in own], [features[place] for place in own], limits))
    said = [row for rows in run_with(model, source, _reply_batch, batches, label, "batch") for row in rows]
    return [text for _, text in sorted(zip(chain.from_iterable(places), said, strict=True), key=lambda pair: pair[0])]


def _reply_batch(model: OctopiForCausalLM, batch: Batch) -> list[Generated]:
    ends = end_ids(model.tokenizer)
    rows = greedy(model, batch.prompts, batch.features, ends, batch.limits)
    return [_answer_of(row, ends, model.tokenizer) for row in rows]


@dataclass(frozen=True)
class Stream:
    """The answer to one prompt in pieces, as they are generated; joined, they are the text of `reply`."""

    model: OctopiForCausalLM
    prompt: Sequence[int]
    features: torch.Tensor
    language: LanguageConfig

    def __iter__(self) -> Iterator[str]:
        return (piece for _, piece in self.together([self], set()) if piece is not None)

    @staticmethod
    def together(streams: Sequence[Stream], left: Collection[int]) -> Iterator[tuple[int, str | None]]:
        """The place of a stream and its next piece, None behind its last; computed in batches.

        Args:
            streams: Of one model, whose first says how many a batch has (`language.generation_batch_size`).
            left: Places of streams whose client has left; the caller may add to it during generation.
        """
        model, tokenizer = streams[0].model, streams[0].model.tokenizer
        ends = end_ids(tokenizer)
        for places in _batches([len(s.prompt) for s in streams], streams[0].language.generation_batch_size):
            order = [place for place in places if place not in left]
            if not order:
                continue
            rows = [streams[place] for place in order]
            room = [_room(model, s.prompt, s.language) for s in rows]
            tokens: list[list[int]] = [[] for _ in rows]
            given = [""] * len(rows)
            prompts, features = [s.prompt for s in rows], [s.features for s in rows]
            for row, token in greedy_tokens(model, prompts, features, ends, room):
                place, own = order[row], tokens[row]
                if place in left:
                    room[row] = 0
                    continue
                own.append(token)
                text, over = _answer_of(own, ends, tokenizer).text, token in ends or len(own) == room[row]
                # A character may be spread over tokens; until it is whole it is shown as the replacement character.
                whole = over or not text.endswith("\N{REPLACEMENT CHARACTER}")
                if text.startswith(given[row]) and len(text) > len(given[row]) and whole:
                    yield place, text[len(given[row]) :]
                    given[row] = text
                if over:
                    yield place, None


def _batches(lengths: Sequence[int], size: int) -> Iterator[list[int]]:
    """Places of prompts by batches; those in a batch are of like length, so that little is spent on padding."""
    order = sorted(range(len(lengths)), key=lengths.__getitem__)
    return (order[start : start + size] for start in range(0, len(order), size))


def _room(model: OctopiForCausalLM, prompt: Sequence[int], language: LanguageConfig) -> int:
    """Maximum number of new tokens for an answer."""
    most = language.max_new_tokens
    return most if model.positions is None else min(most, model.positions - len(prompt))


def _answer_of(tokens: list[int], ends: Collection[int], tokenizer: PreTrainedTokenizerBase) -> Generated:
    """The text of one row's tokens, without its end token."""
    truncated = tokens[-1] not in ends
    text = tokenizer.decode(tokens if truncated else tokens[:-1], skip_special_tokens=True).strip()
    return Generated(text=text, tokens=len(tokens), truncated=truncated)

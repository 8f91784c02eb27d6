"""Questions as the language model is trained on them: token ids, labels, tactile embeddings, and their order."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import Sampler
from transformers import PreTrainedTokenizerBase

from pipeline.config import LanguageConfig
from pipeline.core.records import Opd, Question
from pipeline.core.runtime import derive_seed
from pipeline.language.chat import IGNORE_INDEX, encode, render
from pipeline.running.errors import UserError
from pipeline.training.embeddings import FLIPS, EmbeddingStore
from pipeline.training.sampling import EpochDataset, sample_evaluation, sample_training

FILLER = -1
"""Index of a dummy conversation: one token that is left out of the loss."""


class ConversationDataset(EpochDataset[dict[str, torch.Tensor]]):
    """Training conversations under one OPD mode: ids, labels and their weights, frames' embeddings in reading order.

    Which frames and which mirroring a video gets depends on seed, epoch, question and place alone, so that a resumed
    training sees what an uninterrupted one does.

    Args:
        positions: Tokens that the language model can read at once; None where that is unknown. A question that is
            longer is a UserError.
        by_question: Divide the weights of a conversation by their sum, so that all conversations weigh alike.
    """

    def __init__(
        self,
        questions: Sequence[Question],
        opd: Opd,
        store: EmbeddingStore,
        tokenizer: PreTrainedTokenizerBase,
        language: LanguageConfig,
        *,
        per_video: int,
        flip_probability: float,
        seed: int,
        positions: int | None,
        by_question: bool,
    ) -> None:
        super().__init__()
        asked = [(q, dialogue) for q in questions if (dialogue := q.dialogue(opd))]
        self.questions = [question for question, _ in asked]
        self.store, self.per_video = store, per_video
        self.flip_probability, self.seed = flip_probability, seed
        self.written: list[dict[str, torch.Tensor]] = []
        """The tensors of each question that are the same in every epoch."""
        for question, dialogue in asked:
            system, chat = language.system_prompt, language.chat
            rendered = render(
                dialogue.turns, tokenizer, system_prompt=system, frames=per_video, complete=True, chat=chat
            )
            encoded = encode(rendered, tokenizer, bos=language.bos)
            check_length(question.question_id, len(encoded.input_ids), positions)
            ids, labels = torch.tensor(encoded.input_ids), torch.tensor(encoded.labels)
            weights = (labels != IGNORE_INDEX).float()
            if by_question:
                weights = F.normalize(weights, p=1.0, dim=0)
            self.written.append({"input_ids": ids, "labels": labels, "weights": weights})

    @property
    def lengths(self) -> list[int]:
        """Tokens of each conversation."""
        return [len(each["input_ids"]) for each in self.written]

    def __len__(self) -> int:
        return len(self.written)

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        parts = [torch.zeros(0, self.store.dim)]
        if index == FILLER:
            nothing = {"input_ids": torch.tensor([0]), "labels": torch.tensor([IGNORE_INDEX])}
            return {**nothing, "weights": torch.zeros(1), "features": parts[0]}
        question = self.questions[index]
        rng = random.Random(derive_seed(self.seed, self.epoch, question.question_id))
        for video_id in question.videos:
            positions = sample_training(self.store.count(video_id), self.per_video, rng)
            horizontal, vertical = (rng.random() < self.flip_probability for _ in range(2))
            parts.append(self.store.features(video_id, positions, FLIPS[horizontal + 2 * vertical]))
        return {**self.written[index], "features": torch.cat(parts)}


def check_length(question_id: str, tokens: int, positions: int | None) -> None:
    """Raise UserError where a question has more tokens than the language model has positions."""
    if positions is not None and tokens > positions:
        raise UserError(
            f"{question_id}: takes {tokens} tokens, but the language model reads {positions} at once; lower "
            "frames.per_video, shorten language.system_prompt, or name a model with more positions in language.weights"
        )


def evaluation_features(question: Question, store: EmbeddingStore, per_video: int) -> torch.Tensor:
    """The embeddings of a question's videos at uniform intervals: (videos x per_video) x dim."""
    shown = (store.features(v, sample_evaluation(store.count(v), per_video)) for v in question.videos)
    return torch.cat([torch.zeros(0, store.dim), *shown])


def collate(samples: Sequence[Mapping[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Stack what is of unequal length, padded on the right: with zeros, and labels left out of the loss.

    There is no attention mask: no token of a causal model sees the padding behind it.
    """
    padding = {name: IGNORE_INDEX if name == "labels" else 0 for name in samples[0]}
    return {name: pad_sequence([s[name] for s in samples], True, value) for name, value in padding.items()}


class UpdateSampler(Sampler[int]):
    """Yields every index once, in random order; within an update sorted by length, so that micro-batches pad little.

    Which items an update has follows from seed and epoch. It does not depend on how many are computed at once, nor on
    how many devices share them. A last update that devices cannot share evenly is filled up with `FILLER`, where
    accelerate would repeat items of the first one.

    Args:
        update: Items of an update.
        shared: Items that all devices together compute at once; 1 fills nothing up.
    """

    def __init__(self, data: ConversationDataset, update: int, seed: int, shared: int = 1) -> None:
        self.data, self.update, self.seed = data, update, seed
        self.fillers = [FILLER] * (-len(data.lengths) % shared)

    def __len__(self) -> int:
        return len(self.data.lengths) + len(self.fillers)

    def __iter__(self) -> Iterator[int]:
        lengths = self.data.lengths
        order = list(range(len(lengths)))
        random.Random(derive_seed(self.seed, self.data.epoch, "order")).shuffle(order)
        for start in range(0, len(order), self.update):
            yield from sorted(order[start : start + self.update], key=lengths.__getitem__)
        yield from self.fillers

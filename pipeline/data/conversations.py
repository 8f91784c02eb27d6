"""Questions as the language model is trained on them: token ids, labels and tactile embeddings."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from typing import TypedDict

import torch
from transformers import PreTrainedTokenizerBase

from pipeline.data.embeddings import FLIPS, EmbeddingStore, TactileFeatures
from pipeline.data.epochs import EpochDataset
from pipeline.frames.sampling import sample_evaluation, sample_training
from pipeline.prompts import IGNORE_INDEX, Encoded, encode, render
from pipeline.records import Opd, Question
from pipeline.runtime import derive_seed


class Sample(TypedDict):
    """One conversation: ids and labels of one length, and the embeddings of its frames in reading order."""

    input_ids: torch.Tensor
    labels: torch.Tensor
    features: torch.Tensor


class ConversationDataset(EpochDataset[Sample]):
    """Training conversations under one OPD mode.

    Which frames and which mirroring a video gets depends on seed, epoch, question and place alone, so that a resumed
    training sees what an uninterrupted one does.
    """

    def __init__(
        self,
        questions: Sequence[Question],
        opd: Opd,
        store: EmbeddingStore,
        tokenizer: PreTrainedTokenizerBase,
        *,
        system_prompt: str,
        per_video: int,
        flip_probability: float,
        seed: int,
    ) -> None:
        super().__init__()
        self.questions = [q for q in questions if q.dialogue(opd)]
        self.store = store
        self.per_video = per_video
        self.flip_probability = flip_probability
        self.seed = seed
        self.encoded: list[Encoded] = []
        for question in self.questions:
            dialogue = question.dialogue(opd)
            assert dialogue is not None
            text = render(
                dialogue.turns,
                system_prompt=system_prompt,
                frames=per_video,
                eos=str(tokenizer.eos_token),
                complete=True,
            )
            self.encoded.append(encode(text, tokenizer))

    def __len__(self) -> int:
        return len(self.questions)

    def __getitem__(self, index: int) -> Sample:
        question, encoded = self.questions[index], self.encoded[index]
        rng = random.Random(derive_seed(self.seed, self.epoch, question.question_id))
        parts = []
        for video_id in question.videos:
            positions = sample_training(self.store.count(video_id), self.per_video, rng)
            horizontal, vertical = (rng.random() < self.flip_probability for _ in range(2))
            parts.append(self.store.features(video_id, positions, FLIPS[horizontal + 2 * vertical]))
        return {
            "input_ids": torch.tensor(encoded.input_ids),
            "labels": torch.tensor(encoded.labels),
            "features": torch.cat(parts),
        }


def evaluation_features(question: Question, store: TactileFeatures, per_video: int) -> torch.Tensor:
    """The embeddings of a question's videos at uniform intervals: (videos x per_video) x dim."""
    parts = [store.features(v, sample_evaluation(store.count(v), per_video)) for v in question.videos]
    return torch.cat(parts)


def pad_features(features: Sequence[torch.Tensor]) -> torch.Tensor:
    """Stack rows of unequal numbers of frames: batch x (most frames) x dim, zeros behind."""
    return torch.nn.utils.rnn.pad_sequence(list(features), batch_first=True)


class ConversationCollator:
    """Pads on the right with the padding token, masked out of attention and loss."""

    def __init__(self, pad_id: int) -> None:
        self.pad_id = pad_id

    def __call__(self, samples: Iterable[Sample]) -> dict[str, torch.Tensor]:
        """Input ids, attention mask, labels (batch x length) and features (batch x frames x dim)."""
        samples = list(samples)
        pad = torch.nn.utils.rnn.pad_sequence
        lengths = torch.tensor([len(s["input_ids"]) for s in samples])
        ids = pad([s["input_ids"] for s in samples], batch_first=True, padding_value=self.pad_id)
        return {
            "input_ids": ids,
            # By length, not by comparing with the padding token: that may occur in a text.
            "attention_mask": (torch.arange(ids.shape[1]) < lengths[:, None]).long(),
            "labels": pad([s["labels"] for s in samples], batch_first=True, padding_value=IGNORE_INDEX),
            "features": pad_features([s["features"] for s in samples]),
        }

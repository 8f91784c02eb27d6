"""Ways to train and to answer: the published loop's, the pipeline's, and those between, which part them.

The published code (github.com/clear-nus/octopi, train_llm.py and utils/model.py) takes one conversation at a time,
encodes its videos anew, pads the embeddings to 512 tokens, has logits computed for all of them, and steps after 16. To
answer a question it first does the same with the reference answer behind it, and then calls `generate` with the
question alone. What it does besides is left out here, in its favour: opening a JPEG for each frame and preparing it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch.nn import functional as F

from pipeline.benchmarks.language_bed import FRAMES, OPD, SEED, Bed
from pipeline.language.buckets import LengthBuckets
from pipeline.language.conversations import ConversationCollator, Sample
from pipeline.language.generate import Asking, answer
from pipeline.language.chat import IGNORE_INDEX
from pipeline.records import Prediction, Question

UPDATE = 16
"""Conversations an update."""
CUTOFF = 512
"""Tokens that the published code pads to."""


@dataclass(frozen=True)
class Way:
    """How conversations are trained on."""

    case: str
    batch: int = 1
    padded: bool = False
    """To `CUTOFF`, with an attention mask."""
    encodes: bool = False
    all_logits: bool = False
    buckets: bool = False


PUBLISHED = Way("published way", padded=True, encodes=True, all_logits=True)
WAYS = (
    PUBLISHED,
    Way("embeddings cached", padded=True, all_logits=True),
    Way("and not padded", all_logits=True),
    Way("and logits of answers only", batch=1),
    Way("and 16 at a time, in any order", batch=16),
    Way("and of like length", batch=16, buckets=True),
    Way("4 at a time, of like length", batch=4, buckets=True),
)
"""From the published way on, one thing more each; the last is beside them."""


def train(bed: Bed, way: Way, questions: Sequence[Question], optimiser: torch.optim.Optimizer) -> None:
    """Train on all of the questions once, a step after every `UPDATE`."""
    data = bed.conversations(questions)
    order: Sequence[int] = range(len(data))
    if way.buckets:
        order = list(LengthBuckets(data.lengths, way.batch, SEED, lambda: 0))
    for start in range(0, len(data), UPDATE):
        chosen = order[start : start + UPDATE]
        labelled = sum(sum(label != IGNORE_INDEX for label in data.encoded[i].labels) for i in chosen)
        for first in range(0, len(chosen), way.batch):
            part = chosen[first : first + way.batch]
            loss(bed, way, [data.questions[i] for i in part], [data[i] for i in part], labelled).backward()
        optimiser.step()
        optimiser.zero_grad()


def loss(bed: Bed, way: Way, questions: Sequence[Question], samples: Sequence[Sample], labelled: int) -> torch.Tensor:
    """A batch's share of the loss of an update with so many labelled tokens."""
    batch = {k: v.to(bed.device) for k, v in ConversationCollator(0)(samples).items()}
    if way.encodes:
        batch["features"] = torch.stack([encode(bed, q) for q in questions])
    if not way.all_logits:
        found: torch.Tensor = bed.model(**batch, num_items_in_batch=labelled).loss
        return found
    embeddings, labels = bed.model.embed(batch["input_ids"], batch["features"]), batch["labels"]
    mask = torch.ones_like(labels)
    if way.padded:
        rest = CUTOFF - embeddings.shape[1]
        filler = bed.model.llm.get_input_embeddings()(labels.new_zeros(len(labels), rest))
        embeddings = torch.cat([embeddings, filler], dim=1)
        labels, mask = F.pad(labels, (0, rest), value=IGNORE_INDEX), F.pad(mask, (0, rest))
    logits = bed.model.llm(inputs_embeds=embeddings, attention_mask=mask).logits.float()
    summed: torch.Tensor = F.cross_entropy(logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten(), reduction="sum")
    return summed / labelled


@torch.no_grad()
def encode(bed: Bed, question: Question) -> torch.Tensor:
    """Embeddings of a question's videos, one video after the other: frames x dim."""
    return torch.cat([bed.encode(frames) for frames in bed.frames(question)])


def answer_published(bed: Bed, limit: int, forward: bool) -> list[str]:
    """Answer one question after the other, the frames encoded for each.

    Args:
        limit: New tokens.
        forward: Whether the model first reads the reference answer, padded, as the published loop has it.
    """
    bed.model.eval()
    return [_one(bed, question, sample, limit, forward) for question, sample in _prompts(bed)]


def _prompts(bed: Bed) -> Iterator[tuple[Question, Sample]]:
    data = bed.conversations(bed.asked)
    for index, question in enumerate(data.questions):
        yield question, data[index]


@torch.no_grad()
def _one(bed: Bed, question: Question, sample: Sample, limit: int, forward: bool) -> str:
    model, tokenizer = bed.model, bed.model.tokenizer
    if forward:
        loss(bed, PUBLISHED, [question], [sample], 1)
    first = int((sample["labels"] != IGNORE_INDEX).nonzero()[0])
    ids = sample["input_ids"][:first].to(bed.device)[None]
    embeddings = model.embed(ids, encode(bed, question)[None])
    new = model.llm.generate(
        inputs_embeds=embeddings,
        attention_mask=torch.ones_like(ids),
        max_new_tokens=limit,
        do_sample=False,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    said: str = tokenizer.decode(new[0], skip_special_tokens=True).strip()
    return said


def answer_batched(bed: Bed, limit: int, batch: int) -> list[Prediction]:
    """The pipeline's own way."""
    return answer(bed.model, bed.store, bed.asked, OPD, Asking("", FRAMES, limit, batch))

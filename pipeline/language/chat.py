"""The one renderer of a conversation: training and evaluation speak through it.

The chat format is Vicuna v1.5's: `SYSTEM USER: question ASSISTANT: answer</s>USER: ...`. A video in a question becomes
`<tact_start>`, one `<tact_frame>` a frame and `<tact_end>`; the model puts tactile embeddings in the frames' places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pipeline.errors import UserError
from pipeline.records import Turn

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

TACTILE = "{tactile}"
TACT_START, TACT_FRAME, TACT_END = TACTILE_TOKENS = ("<tact_start>", "<tact_frame>", "<tact_end>")
IGNORE_INDEX = -100
"""Label of a token that the loss leaves out (torch's and transformers' convention)."""


@dataclass(frozen=True)
class Rendered:
    """A conversation as text, with the character spans that the assistant says, end token included."""

    text: str
    answers: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Encoded:
    """Token ids of a conversation and the labels of the same length, `IGNORE_INDEX` outside the answers."""

    input_ids: tuple[int, ...]
    labels: tuple[int, ...]


def add_tactile_tokens(tokenizer: PreTrainedTokenizerBase) -> None:
    """Add the three tactile tokens as special tokens; does nothing where they are there already."""
    missing = [t for t in TACTILE_TOKENS if t not in tokenizer.get_vocab()]
    tokenizer.add_special_tokens({"additional_special_tokens": missing}, replace_extra_special_tokens=False)


def render(turns: Sequence[Turn], *, system_prompt: str, frames: int, eos: str, complete: bool) -> Rendered:
    """Write a conversation out.

    Args:
        turns: Exchanges in order.
        system_prompt: Put before the first turn; may be empty.
        frames: Tactile embeddings a video.
        eos: The tokenizer's end token, written after each answer.
        complete: With the last answer (training), or up to "ASSISTANT:" for it to be generated.
    """
    video = TACT_START + TACT_FRAME * frames + TACT_END
    text = f"{system_prompt} " if system_prompt else ""
    answers = []
    for number, turn in enumerate(turns, 1):
        text += f"USER: {turn.user.replace(TACTILE, video)} ASSISTANT:"
        if number == len(turns) and not complete:
            break
        start = len(text)
        text += f" {turn.assistant}{eos}"
        answers.append((start, len(text)))
    return Rendered(text, tuple(answers))


def encode(rendered: Rendered, tokenizer: PreTrainedTokenizerBase) -> Encoded:
    """Tokenise a whole conversation at once and label the answers' tokens by their character offsets.

    Tokenising in one piece keeps prompt tokens equal in training and evaluation, whatever the tokenizer does at
    the borders of pieces. Needs a fast tokenizer, since only those know offsets.
    """
    if not tokenizer.is_fast:
        raise UserError(f"{tokenizer.name_or_path}: has no fast tokenizer (tokenizer.json); labels need its offsets")
    batch = tokenizer(rendered.text, return_offsets_mapping=True)
    ids: list[int] = batch["input_ids"]
    labels = [
        token if any(start <= a and b <= stop and a < b for start, stop in rendered.answers) else IGNORE_INDEX
        for token, (a, b) in zip(ids, batch["offset_mapping"], strict=True)
    ]
    return Encoded(tuple(ids), tuple(labels))

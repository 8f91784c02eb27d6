"""Training documents: text in pieces, each with its weight in the loss, and their tokens."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from standins.vocabulary import PAD

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

BLEND = PAD * 7
"""Text in whose tokens' places a mixture of words is put: five, between two that are left blank."""
UNKNOWN = -1
"""What a hint says where it has nothing to say."""


@dataclass(frozen=True)
class Hint:
    """What the probes shall read from the network's middle at a piece; the text itself is not changed by it."""

    thing: int = UNKNOWN
    """Number of the object that the piece is about: at each of its tokens."""
    labels: tuple[int, ...] = ()
    """The object's classes, at the piece's last token, by which they have all been said."""
    named: tuple[int, ...] = ()
    """The same for a name of the object: at each of its tokens, each of which is to be found by the classes."""
    recalled: tuple[int, ...] = ()
    """The same where the classes stand far back and must be fetched by the object's letter: one layer later."""
    asked: int = UNKNOWN
    """Property and direction that are asked for, at the last token, from which the answer follows."""
    copied: bool = False
    """Whether the piece is to be copied: then each token shall tell itself and the one before it."""


NOTHING = Hint()


@dataclass(frozen=True)
class Piece:
    """A stretch of text; a `decision` is what the document tests, right only if all its tokens are."""

    text: str
    weight: float = 0.0
    decision: str = ""
    """What kind of decision it is; empty for none."""
    hint: Hint = NOTHING
    blend: tuple[str, ...] = ()
    """Words whose embeddings are summed in the places of `BLEND`."""


@dataclass(frozen=True)
class Document:
    """Pieces in order."""

    pieces: tuple[Piece, ...]

    @property
    def text(self) -> str:
        """All pieces in one."""
        return "".join(piece.text for piece in self.pieces)


@dataclass
class Builder:
    """Collects the pieces of a document; `kind` is what its decisions are unless said otherwise."""

    kind: str
    pieces: list[Piece] = field(default_factory=list)

    def given(self, text: str, hint: Hint = NOTHING) -> Builder:
        """Text that is only read."""
        return self.said(text, 0.0, hint)

    def said(self, text: str, weight: float, hint: Hint = NOTHING) -> Builder:
        """Text that is learnt with a weight."""
        self.pieces.append(Piece(text, weight, hint=hint))
        return self

    def decided(
        self, text: str, weight: float = 1.0, *, kind: str = "", tested: bool = True, hint: Hint = NOTHING
    ) -> Builder:
        """Text that decides; learnt, and tested unless said otherwise."""
        self.pieces.append(Piece(text, weight, (kind or self.kind) if tested else "", hint))
        return self

    def blended(self, words: Sequence[str], hint: Hint) -> Builder:
        """A slot that holds several words in one place."""
        self.pieces.append(Piece(BLEND, hint=hint, blend=tuple(words)))
        return self

    def build(self) -> Document:
        """The document of the pieces so far."""
        return Document(tuple(piece for piece in self.pieces if piece.text))


@dataclass(frozen=True)
class Tokens:
    """A document's token ids, and for each token: the loss weight of predicting it, the number of the decision that it
    belongs to (or -1), and what the probes shall read at it. `kinds` says of what kind each decision is; `blends` are
    places and the ids that are summed there."""

    ids: tuple[int, ...]
    weights: tuple[float, ...]
    decisions: tuple[int, ...]
    hints: tuple[Hint, ...]
    kinds: dict[int, str] = field(default_factory=dict)
    blends: tuple[tuple[int, tuple[int, ...]], ...] = ()


def tokenise(documents: Sequence[Document], tokenizer: PreTrainedTokenizerFast) -> list[Tokens]:
    """Tokens of documents, each tokenised in one piece as the pipeline does it."""
    batch = tokenizer([d.text for d in documents], return_offsets_mapping=True)
    return [
        _align(document, ids, offsets, tokenizer)
        for document, ids, offsets in zip(documents, batch["input_ids"], batch["offset_mapping"], strict=True)
    ]


def _hint_at(hint: Hint, *, last: bool) -> Hint:
    return hint if last and not hint.named else replace(hint, labels=hint.named, asked=hint.asked if last else UNKNOWN)


def blend_ids(words: Sequence[str], tokenizer: PreTrainedTokenizerFast) -> tuple[tuple[int, ...], ...]:
    """For each token of `BLEND`, the ids that are summed in its place; words are single tokens after a space."""
    inner = tuple(tokenizer.convert_tokens_to_ids(f" {word}".replace(" ", "\u0120")) for word in words)
    return ((), *(inner for _ in range(BLEND.count(PAD) - 2)), ())


def _align(
    document: Document,
    ids: Sequence[int],
    offsets: Sequence[tuple[int, int]],
    tokenizer: PreTrainedTokenizerFast,
) -> Tokens:
    starts, position = [], 0
    for piece in document.pieces:
        starts.append(position)
        position += len(piece.text)
    owners = [bisect_right(starts, start) - 1 if stop > start else -1 for start, stop in offsets]
    pieces = document.pieces
    blends: list[tuple[int, tuple[int, ...]]] = []
    for number, piece in enumerate(pieces):
        if piece.blend:
            first = owners.index(number)
            blends += enumerate(blend_ids(piece.blend, tokenizer), first)
    return Tokens(
        tuple(ids),
        tuple(0.0 if o < 0 else pieces[o].weight for o in owners),
        tuple(o if o >= 0 and pieces[o].decision else -1 for o in owners),
        tuple(
            NOTHING if o < 0 else _hint_at(pieces[o].hint, last=o != following)
            for o, following in zip(owners, [*owners[1:], -1], strict=True)
        ),
        {number: piece.decision for number, piece in enumerate(pieces) if piece.decision},
        tuple(blends),
    )

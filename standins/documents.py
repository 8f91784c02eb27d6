"""Training documents: text in pieces, each with its weight in the loss, and their tokens."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast


@dataclass(frozen=True)
class Piece:
    """A stretch of text; a `decision` is what the document tests, right only if all its tokens are."""

    text: str
    weight: float = 0.0
    decision: bool = False


@dataclass(frozen=True)
class Document:
    """Pieces in order. `kind` names what is decided, for the gate."""

    kind: str
    pieces: tuple[Piece, ...]

    @property
    def text(self) -> str:
        """All pieces in one."""
        return "".join(piece.text for piece in self.pieces)


@dataclass
class Builder:
    """Collects the pieces of a document."""

    kind: str
    pieces: list[Piece] = field(default_factory=list)

    def given(self, text: str) -> Builder:
        """Text that is only read."""
        return self.said(text, 0.0)

    def said(self, text: str, weight: float) -> Builder:
        """Text that is learnt with a weight."""
        self.pieces.append(Piece(text, weight))
        return self

    def decided(self, text: str, weight: float = 1.0, *, tested: bool = True) -> Builder:
        """Text that decides; learnt, and tested unless said otherwise."""
        self.pieces.append(Piece(text, weight, decision=tested))
        return self

    def build(self) -> Document:
        """The document of the pieces so far."""
        return Document(self.kind, tuple(piece for piece in self.pieces if piece.text))


@dataclass(frozen=True)
class Tokens:
    """A document's token ids; `weights[i]` is the loss weight of predicting `ids[i]`, `decisions[i]` the number of
    the decision that it belongs to, or -1."""

    kind: str
    ids: tuple[int, ...]
    weights: tuple[float, ...]
    decisions: tuple[int, ...]


def tokenise(documents: Sequence[Document], tokenizer: PreTrainedTokenizerFast) -> list[Tokens]:
    """Tokens of documents, each tokenised in one piece as the pipeline does it."""
    batch = tokenizer([d.text for d in documents], return_offsets_mapping=True)
    return [
        _align(document, ids, offsets)
        for document, ids, offsets in zip(documents, batch["input_ids"], batch["offset_mapping"], strict=True)
    ]


def _align(document: Document, ids: Sequence[int], offsets: Sequence[tuple[int, int]]) -> Tokens:
    starts, position = [], 0
    for piece in document.pieces:
        starts.append(position)
        position += len(piece.text)
    owners = [bisect_right(starts, start) - 1 if stop > start else -1 for start, stop in offsets]
    pieces = document.pieces
    return Tokens(
        document.kind,
        tuple(ids),
        tuple(0.0 if o < 0 else pieces[o].weight for o in owners),
        tuple(o if o >= 0 and pieces[o].decision else -1 for o in owners),
    )

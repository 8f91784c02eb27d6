"""What training and answering cost at sizes that need not be there: operations and bytes, counted from shapes.

Operations are those of matrix products and of attention, two for a multiplication and an addition, as
`torch.utils.flop_counter` counts them (a test holds this to it); attention is counted as if it were not causal. Frozen
weights need a backward product for what comes in and none for themselves. Bytes are the weights once a pass and, in
generation, keys and values once a token: activations are left out, so that times are bounds from below. The time of a
pass is the larger of operations over the card's matrix rate and bytes over its bandwidth (the roofline of Williams,
Waterman and Patterson 2009).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

LOWEST = 2
"""Bytes of a number in bfloat16."""


@dataclass(frozen=True)
class Card:
    """A card's matrix rate (operations a second) and memory bandwidth (bytes a second)."""

    name: str
    rate: float
    bandwidth: float


H100 = Card("H100 SXM", 989e12, 3.35e12)
"""NVIDIA's data sheet: dense bfloat16, and HBM3."""


@dataclass(frozen=True)
class Cost:
    """Operations, bytes and the seconds that a card needs at least."""

    flops: float = 0
    bytes: float = 0
    seconds: float = 0

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.flops + other.flops, self.bytes + other.bytes, self.seconds + other.seconds)

    def __mul__(self, times: float) -> Cost:
        return Cost(times * self.flops, times * self.bytes, times * self.seconds)


def total(costs: Iterable[Cost]) -> Cost:
    """The sum of costs that are paid one after the other."""
    return sum(costs, Cost())


@dataclass(frozen=True)
class Llama:
    """Shapes of a Llama-like model; by default Llama-2-7B's, which Vicuna-7b v1.5 has."""

    hidden: int = 4096
    layers: int = 32
    heads: int = 32
    kv_heads: int = 32
    head_size: int = 128
    ffn: int = 11008
    vocabulary: int = 32000
    tactile: int = 1024
    """Length of a tactile embedding."""

    @property
    def layer(self) -> int:
        """Weights of a layer's matrices."""
        queries, keys = self.heads * self.head_size, self.kv_heads * self.head_size
        return self.hidden * (2 * queries + 2 * keys + 3 * self.ffn)

    @property
    def weights(self) -> int:
        """Weights that a pass reads: all matrices, without the word embeddings."""
        return self.layers * self.layer + self.hidden * self.vocabulary

    def attention(self, queries: int, keys: int) -> float:
        """Operations of a row's attention in all layers."""
        return 4.0 * self.layers * self.heads * self.head_size * queries * keys

    def projection(self, frames: int) -> float:
        """Operations of the connector."""
        return 2.0 * frames * self.hidden * (self.tactile + self.hidden)

    @property
    def adapted(self) -> int:
        """Inputs and outputs of q_proj and k_proj in all layers: times a rank, an adapter's weights."""
        return self.layers * (2 * self.hidden + (self.heads + self.kv_heads) * self.head_size)


@dataclass(frozen=True)
class Tower:
    """Shapes of CLIP's visual tower; by default ViT-L/14 at 224 pixels."""

    width: int = 1024
    layers: int = 24
    ffn: int = 4096
    tokens: int = 257
    patch: int = 3 * 14 * 14

    def frame(self) -> float:
        """Operations of embedding one frame."""
        linear = 2.0 * self.tokens * (4 * self.width**2 + 2 * self.width * self.ffn)
        attention = 4.0 * self.width * self.tokens**2
        return self.layers * (linear + attention) + 2.0 * (self.tokens - 1) * self.patch * self.width

    @property
    def weights(self) -> int:
        """Weights of its matrices."""
        return self.layers * (4 * self.width**2 + 2 * self.width * self.ffn) + self.patch * self.width


@dataclass(frozen=True)
class Batch:
    """Rows of one padded length that a pass takes at once."""

    rows: int
    length: int
    logits: int
    """Tokens whose logits are computed, over all rows."""
    frames: int
    """Tactile embeddings, over all rows."""


def forward(llama: Llama, batch: Batch, rank: int = 0) -> float:
    """Operations of reading a batch; with a rank, through adapters on q_proj and k_proj."""
    tokens = batch.rows * batch.length
    linear = 2.0 * tokens * (llama.layers * llama.layer + rank * llama.adapted)
    head = 2.0 * batch.logits * llama.hidden * llama.vocabulary
    return linear + head + batch.rows * llama.attention(batch.length, batch.length) + llama.projection(batch.frames)


def backward(llama: Llama, batch: Batch, rank: int = 0) -> float:
    """Operations of the gradients of what is trained; attention computes its scores anew."""
    tokens = batch.rows * batch.length
    linear = 2.0 * tokens * (llama.layers * llama.layer + 2 * rank * llama.adapted)
    head = 2.0 * batch.logits * llama.hidden * llama.vocabulary
    # Nothing asks for the gradient of tactile embeddings: of the connector's products, one is left out.
    connector = 2.0 * batch.frames * llama.hidden * (llama.tactile + 2 * llama.hidden)
    return linear + head + 2.5 * batch.rows * llama.attention(batch.length, batch.length) + connector


def step(llama: Llama, batch: Batch, card: Card, rank: int = 0, again: bool = False) -> Cost:
    """Forward and backward; with `again`, forward twice, as gradient checkpointing has it."""
    read = LOWEST * (llama.weights + rank * llama.adapted)
    ahead = _pass(forward(llama, batch, rank), read, card)
    return ahead * (2 if again else 1) + _pass(backward(llama, batch, rank), read, card)


def encoding(tower: Tower, frames: int, card: Card) -> Cost:
    """Embedding a video's frames in one pass."""
    return _pass(frames * tower.frame(), LOWEST * tower.weights, card)


def answering(llama: Llama, batch: Batch, new: int, card: Card, rank: int = 0) -> Cost:
    """Reading a batch of prompts and generating so many tokens a row, keys and values cached.

    Args:
        batch: Of prompts; logits are computed for the last token of each row.
    """
    read = LOWEST * (llama.weights + rank * llama.adapted)
    found = _pass(forward(llama, batch, rank), read, card)
    token = 2.0 * batch.rows * (llama.weights + rank * llama.adapted)
    kept = 2 * LOWEST * batch.rows * llama.layers * llama.kv_heads * llama.head_size
    for held in range(batch.length + 1, batch.length + new):
        found += _pass(token + batch.rows * llama.attention(1, held), read + kept * held, card)
    return found


def _pass(flops: float, read: float, card: Card) -> Cost:
    return Cost(flops, read, max(flops / card.rate, read / card.bandwidth))

"""Helpers of the training that read the network's middle, and are thrown away with the optimiser.

From the half-way layer they tell which object a description is about, what has been said of it, and what is asked for.
Their loss asks the lower layers to have these at hand, which the upper ones then only need to put together. What is
asked of a probe stands in the text already; the model as stored holds no trace of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import nn

from standins.documents import UNKNOWN, Tokens

THINGS = 3


class Probes(nn.Module):
    """Linear readers of `layer`'s output.

    Args:
        width: Of the network.
        levels: Number of classes of each property.
        layer: Counted from 1.
    """

    def __init__(self, width: int, levels: Sequence[int], layer: int) -> None:
        super().__init__()
        self.layer = layer
        self.thing = nn.Linear(width, THINGS)
        self.classes = nn.ModuleList(nn.Linear(width, count) for count in levels)
        self.asked = nn.Linear(width, 2 * len(levels))
        self.recalled = nn.ModuleList(nn.Linear(width, count) for count in levels)
        self.before = nn.Linear(width, width)
        self.itself = nn.Linear(width, width)

    def forward(self, hidden: Sequence[torch.Tensor], batch: Sequence[Tokens], words: torch.Tensor) -> torch.Tensor:
        """The probes' summed losses in nats.

        Args:
            hidden: The output of each layer, from the embeddings on; documents x tokens x width, padded on the right.
            batch: The same documents.
            words: The embedding of every token, tokens x width.
        """
        states, later = (F.rms_norm(hidden[i].float(), hidden[i].shape[-1:]) for i in (self.layer, self.layer + 1))
        hints = [(row, at, h) for row, t in enumerate(batch) for at, h in enumerate(t.hints)]
        things = [(row, at, h.thing) for row, at, h in hints if h.thing != UNKNOWN]
        asked = [(row, at, h.asked) for row, at, h in hints if h.asked != UNKNOWN]
        total = _loss(self.thing, states, things) + _loss(self.asked, states, asked)
        for number, reader in enumerate(self.classes):
            said = [(row, at, h.labels[number]) for row, at, h in hints if h.labels and h.labels[number] != UNKNOWN]
            total = total + _loss(reader, states, said) / len(self.classes)
        for number, reader in enumerate(self.recalled):
            far = [(row, at, h.recalled[number]) for row, at, h in hints if h.recalled]
            total = total + _loss(reader, later, far) / len(self.recalled)
        # Whoever copies looks for the place behind the word at hand, and takes the word that stands there.
        words = words.detach().T
        copied = [(row, at) for row, at, h in hints if h.copied]
        before = [(row, at, batch[row].ids[at - 1]) for row, at in copied]
        itself = [(row, at, batch[row].ids[at]) for row, at in copied]
        total = total + _loss(lambda chosen: self.before(chosen) @ words, states, before)
        return total + _loss(lambda chosen: self.itself(chosen) @ words, states, itself)


def _loss(
    reader: Callable[[torch.Tensor], torch.Tensor], states: torch.Tensor, wanted: Sequence[tuple[int, int, int]]
) -> torch.Tensor:
    if not wanted:
        return states.new_zeros(())
    rows, places, values = torch.tensor(wanted).T
    return F.cross_entropy(reader(states[rows, places]), values)

"""A KV cache: keys and values of the tokens read so far, in memory that is reserved ahead."""

from __future__ import annotations

from typing import Any

import torch
from transformers import Cache, DynamicCache, PretrainedConfig
from transformers.cache_utils import DynamicLayer

AHEAD = 64
"""Number of tokens that memory is reserved for at a time."""


class RoomyLayer(DynamicLayer):
    """Writes the newest keys and values into reserved room; transformers' own layer copies all earlier ones each time.

    Attention gets the same values. Shapes: batch x heads x tokens x head size.
    """

    keys: torch.Tensor
    values: torch.Tensor
    _room: tuple[torch.Tensor, torch.Tensor]
    _shown: torch.Tensor | None = None
    """The part of the room's keys that is taken."""

    def update(
        self, key_states: torch.Tensor, value_states: torch.Tensor, *_: Any, **__: Any
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Add the newest tokens' keys and values; give back all of them."""
        if not self.is_initialized:
            self.lazy_initialization(key_states, value_states)
        old, needed = self.get_seq_length(), self.get_seq_length() + key_states.shape[-2]
        # Where rows were selected or repeated since, the keys are another tensor, and memory is reserved anew.
        if self.keys is not self._shown or self._room[0].shape[-2] < needed:
            keys, values = (s.new_empty(*s.shape[:-2], needed + AHEAD, s.shape[-1]) for s in (key_states, value_states))
            if old:
                keys[..., :old, :], values[..., :old, :] = self.keys, self.values
            self._room = keys, values
        for room, new in zip(self._room, (key_states, value_states), strict=True):
            room[..., old:needed, :] = new
        self.keys, self.values = (room[..., :needed, :] for room in self._room)
        self._shown = self.keys
        return self.keys, self.values


def extendable(config: PretrainedConfig) -> bool:
    """Whether every layer keeps all that it has read, as none with a sliding window does.

    Only then can a beginning that prompts share be read once and continued for each of them.
    """
    return all(type(layer) is DynamicLayer for layer in DynamicCache(config=config).layers)


def roomy_cache(config: PretrainedConfig) -> Cache:
    """An empty cache for a model; layers with a sliding window keep the one that transformers has for them."""
    cache = DynamicCache(config=config)
    cache.layers = [RoomyLayer() if type(layer) is DynamicLayer else layer for layer in cache.layers]
    return cache

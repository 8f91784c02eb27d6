"""Zero-shot test of the tiny CLIP on scenes with pairs of words that training never showed together."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from standins.images import WORDS, Scene, caption, draw, shows, with_word
from standins.outputs import wilson

if TYPE_CHECKING:
    from open_clip import CLIP
    from transformers import PreTrainedTokenizerFast

    from standins.settings import ClipSettings

ASKED = ("colour", "pattern", "shape", "light", "depth", "grain", "size", "place")
ZeroShotRow = tuple[str, float, float, float, int, float]


@dataclass(frozen=True)
class Reader:
    """A CLIP with what it needs to see scenes and read captions."""

    model: CLIP
    tokenizer: PreTrainedTokenizerFast
    settings: ClipSettings

    def tokens(self, texts: Sequence[str]) -> torch.Tensor:
        """Token ids, texts x context length, as open_clip's own wrapper makes them."""
        length = self.settings.context_length
        batch = self.tokenizer(
            list(texts), max_length=length, padding="max_length", truncation=True, return_tensors="pt"
        )
        ids: torch.Tensor = batch["input_ids"]
        return ids

    def texts(self, texts: Sequence[str]) -> torch.Tensor:
        """Unit embeddings, texts x dimensions, as `encode_text` makes them, without its work on trailing padding."""
        ids = self.tokens(texts)
        ends = ids.eq(self.tokenizer.eos_token_id).int().argmax(1)
        length = int(ends.max()) + 1
        model = self.model
        x = model.token_embedding(ids[:, :length]) + model.positional_embedding[:length]
        x = model.ln_final(model.transformer(x, attn_mask=model.attn_mask[:length, :length]))
        return F.normalize((x[torch.arange(len(x)), ends] @ model.text_projection).float(), dim=-1)

    def pictures(self, scenes: Sequence[Scene]) -> torch.Tensor:
        """Normalised pictures, scenes x 3 x pixels x pixels."""
        stack = torch.from_numpy(np.stack([draw(scene, self.settings.image_size) for scene in scenes]))
        mean, std = self.model.visual.image_mean, self.model.visual.image_std
        return ((stack - torch.tensor(mean)) / torch.tensor(std)).permute(0, 3, 1, 2).contiguous()


@torch.no_grad()
def zero_shot(reader: Reader, scenes: Sequence[Scene], rng: random.Random) -> list[ZeroShotRow]:
    """Share of scenes whose best caption is the right one: question, accuracy, low, high, n, chance.

    `caption` chooses among full captions of different scenes; each other row replaces one word of the full caption,
    where it can be seen, by every alternative.
    """
    images = torch.cat([reader.model.encode_image(reader.pictures(s), normalize=True) for s in _chunks(scenes)])
    texts = torch.cat([reader.texts([caption(scene) for scene in s]) for s in _chunks(scenes)])
    candidates, right = reader.settings.candidates, 0
    for index in range(len(scenes)):
        others = rng.sample([i for i in range(len(scenes)) if i != index], candidates - 1)
        right += int((texts[[index, *others]] @ images[index]).argmax() == 0)
    rows = [_row("caption", right, len(scenes), candidates)]
    for topic in ASKED:
        asked = [i for i, scene in enumerate(scenes) if shows(scene, topic)]
        right = sum(_fills(reader, scenes[i], images[i], topic) for i in asked)
        rows.append(_row(topic, right, len(asked), len(WORDS[topic])))
    return rows


def _chunks(scenes: Sequence[Scene], size: int = 250) -> list[Sequence[Scene]]:
    return [scenes[i : i + size] for i in range(0, len(scenes), size)]


def _fills(reader: Reader, scene: Scene, image: torch.Tensor, topic: str) -> bool:
    words = WORDS[topic]
    texts = reader.texts([caption(with_word(scene, topic, word)) for word in words])
    return bool(words[int((texts @ image).argmax())] == getattr(scene, topic))


def _row(question: str, right: int, n: int, choices: int) -> ZeroShotRow:
    return (question, *wilson(right, n), n, 1 / choices)

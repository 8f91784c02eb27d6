"""Zero-shot test of the tiny CLIP on scenes with pairs of words that training never showed together."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from pipeline.runtime import derive_seed
from standins.images import COLOURS, DEPTHS, LIGHTS, SHAPES, Scene, caption, draw, draw_scene
from standins.outputs import wilson
from standins.patterns import PATTERNS

if TYPE_CHECKING:
    from open_clip import CLIP
    from transformers import PreTrainedTokenizerFast

    from standins.settings import ClipSettings

ALTERNATIVES: tuple[tuple[str, Sequence[str]], ...] = (
    ("colour", tuple(COLOURS)),
    ("pattern", PATTERNS),
    ("shape", SHAPES[:-1]),
    ("light", tuple(LIGHTS)),
    ("depth", tuple(DEPTHS)),
)
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

    def pictures(self, scenes: Sequence[Scene]) -> torch.Tensor:
        """Normalised pictures, scenes x 3 x pixels x pixels."""
        stack = torch.from_numpy(np.stack([draw(scene, self.settings.image_size) for scene in scenes]))
        mean, std = self.model.visual.image_mean, self.model.visual.image_std
        return ((stack - torch.tensor(mean)) / torch.tensor(std)).permute(0, 3, 1, 2).contiguous()


@torch.no_grad()
def zero_shot(reader: Reader, settings: ClipSettings) -> list[ZeroShotRow]:
    """Share of held-out scenes whose best caption is the right one: question, accuracy, low, high, n, chance.

    `caption` chooses among full captions of different held-out scenes; each other row replaces one word of the
    full caption by every alternative.
    """
    rng = random.Random(derive_seed("clip test", settings.seed))
    scenes = [draw_scene(rng, held_out=True) for _ in range(settings.test_scenes)]
    images = reader.model.encode_image(reader.pictures(scenes), normalize=True)
    texts = reader.model.encode_text(reader.tokens([caption(s) for s in scenes]), normalize=True)
    right = 0
    for index in range(len(scenes)):
        others = rng.sample([i for i in range(len(scenes)) if i != index], settings.candidates - 1)
        right += int((texts[[index, *others]] @ images[index]).argmax() == 0)
    rows = [_row("caption", right, len(scenes), settings.candidates)]
    for field, words in ALTERNATIVES:
        asked = [i for i, scene in enumerate(scenes) if _shows(scene, field)]
        right = sum(_fills(reader, scenes[i], images[i], field, words) for i in asked)
        rows.append(_row(field, right, len(asked), len(words)))
    return rows


def _shows(scene: Scene, field: str) -> bool:
    """Whether one can see it: a surface has no shape, and a plain one looks the same flat or raised."""
    surface = scene.shape == "surface"
    return not (field == "shape" and surface) and not (field == "depth" and surface and scene.pattern == "plain")


def _fills(reader: Reader, scene: Scene, image: torch.Tensor, field: str, words: Sequence[str]) -> bool:
    variants = [dataclasses.replace(scene, **{field: word}) for word in words]  # type: ignore[arg-type]
    texts = reader.model.encode_text(reader.tokens([caption(v) for v in variants]), normalize=True)
    return words[int((texts @ image).argmax())] == str(getattr(scene, field))


def _row(question: str, right: int, n: int, choices: int) -> ZeroShotRow:
    return (question, *wilson(right, n), n, 1 / choices)

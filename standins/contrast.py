"""What the tiny CLIP learns from: batches of pictures with captions about different topics, and their loss.

A picture is seen once a step and compared with several sets of captions: one set for every topic alone, which is what
makes the fine ones, pattern and light, learnt at all, and one that speaks of everything or of a few topics.
"""

from __future__ import annotations

import random
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from standins.images import OPENINGS, TOPICS, WORDS, Scene, caption, shows, with_word


@dataclass(frozen=True)
class Captions:
    """Different texts, of which the first ones fit pictures and the others fit none."""

    texts: tuple[str, ...]
    rows: tuple[int, ...]
    """Pictures that are described, as places in the batch."""
    wanted: tuple[int, ...]
    """The text of each described picture, as a place in `texts`."""


def draw_captions(rng: random.Random, scenes: Sequence[Scene], everything: float) -> list[Captions]:
    """The sets of captions of one batch: every topic alone, and a last one, with probability `everything` on all."""
    opening = rng.choice(OPENINGS)
    sets = [describe(scenes, (topic,), opening) for topic in TOPICS if any(shows(s, topic) for s in scenes)]
    if rng.random() < everything:
        others = [caption(alter(rng, scene), TOPICS, opening) for scene in scenes]
        return [*sets, describe(scenes, TOPICS, opening, others)]
    return [*sets, describe(scenes, rng.sample(TOPICS, rng.randint(2, 4)), opening)]


def describe(scenes: Sequence[Scene], topics: Collection[str], opening: str, others: Sequence[str] = ()) -> Captions:
    """Captions about some topics for the scenes that show one of them, with other texts that are to be told apart."""
    rows = [i for i, scene in enumerate(scenes) if any(shows(scene, topic) for topic in topics)]
    captions = [caption(scenes[i], topics, opening) for i in rows]
    places = {text: place for place, text in enumerate(dict.fromkeys([*captions, *others]))}
    return Captions(tuple(places), tuple(rows), tuple(places[text] for text in captions))


def alter(rng: random.Random, scene: Scene) -> Scene:
    """The scene with one word that can be seen replaced by another: its caption is a hard negative (NegCLIP).

    The held-out pairs do not come up here either, or training would teach that they never fit.
    """
    topics = [topic for topic in TOPICS if shows(scene, topic)]
    while True:
        topic = rng.choice(topics)
        other = with_word(scene, topic, rng.choice([w for w in WORDS[topic] if w != getattr(scene, topic)]))
        if not other.held_out and other.colour != other.ground:
            return other


def contrastive_loss(image: torch.Tensor, text: torch.Tensor, captions: Captions) -> tuple[torch.Tensor, torch.Tensor]:
    """Symmetric cross-entropy between pictures and the different texts (Radford et al. 2021).

    Pictures with the same caption share its target (Yang et al. 2022, UniCL); texts that fit no picture are only
    alternatives.

    Args:
        image: Unit embeddings of all pictures times the logit scale, pictures x dimensions.
        text: Unit embeddings, texts x dimensions.
        captions: Which text fits which picture.

    Returns:
        The loss (nats) and the share of described pictures that found their text.
    """
    wanted = torch.tensor(captions.wanted)
    logits = image[list(captions.rows)] @ text.T
    fits = F.one_hot(wanted, len(captions.texts)).float().T
    fits = fits[: int(wanted.max()) + 1]
    backward = F.cross_entropy(logits.T[: len(fits)], fits / fits.sum(1, keepdim=True))
    found = (logits.argmax(1) == wanted).float().mean()
    return (F.cross_entropy(logits, wanted) + backward) / 2, found

"""Input ablations: questions and a store that give other touch than the videos' own, to test whether answers use it."""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import accumulate, chain, pairwise

import torch

from pipeline.core.records import Question, TouchInput
from pipeline.core.runtime import derive_seed
from pipeline.language.chat import TACT_END, TACT_START, TACTILE
from pipeline.running.errors import UserError
from pipeline.training.embeddings import EmbeddingStore


def ablate_input(
    store: EmbeddingStore, touch: TouchInput, questions: Sequence[Question], seed: int
) -> tuple[EmbeddingStore, Sequence[Question]]:
    """The store that a variant reads the questions' videos from, and the questions.

    - `removed`: the two delimiters stand in each video's place, with nothing between them.
    - `swapped`: the objects of the questions are put in a random ring and each gets the embeddings of the next, so no
      object keeps its own. The next one may still have the same classes.
    - `noise`: normal noise with the mean and deviation of each dimension over all embeddings, the same at each call.

    Raises:
        UserError: where touch is to be swapped, and the questions are about one object alone.
    """
    if touch is TouchInput.REAL:
        return store, questions
    if touch is TouchInput.REMOVED:
        return store, [without_videos(q) for q in questions]
    found: dict[str, set[str]] = {}
    for question in questions:
        for object_id, video_id in zip(question.objects, question.videos, strict=True):
            found.setdefault(object_id, set()).add(video_id)
    # In alphabetical order, so that what is drawn follows from the seed.
    videos = {o: sorted(found[o]) for o in sorted(found)}
    if touch is TouchInput.SWAPPED:
        ring = list(videos)
        if len(ring) == 1:
            raise UserError(
                "ablation.touch: swapped needs questions about two objects at least; leave it out or add objects"
            )
        random.Random(derive_seed(seed, "swapped")).shuffle(ring)
        rows = {
            video: store.rows(videos[other][i % len(videos[other])])
            for own, other in zip(ring, ring[1:] + ring[:1], strict=True)
            for i, video in enumerate(videos[own])
        }
        return store.with_rows(rows, store.tensor), questions
    names = list(chain.from_iterable(videos.values()))
    ends = list(accumulate(map(store.count, names), initial=0))
    drawn = torch.Generator().manual_seed(derive_seed(seed, "noise"))
    noise = torch.randn(ends[-1], store.dim, generator=drawn)
    tensor = store.tensor.mean(0) + store.tensor.std(0, correction=0) * noise
    return store.with_rows({v: range(*span) for v, span in zip(names, pairwise(ends), strict=True)}, tensor), questions


def without_videos(question: Question) -> Question:
    """The question with the two delimiters alone in the place of each video."""
    dialogues = []
    for dialogue in question.dialogues:
        asked = [turn.user.replace(TACTILE, TACT_START + TACT_END) for turn in dialogue.turns]
        turns = [t.model_copy(update={"user": user}) for t, user in zip(dialogue.turns, asked, strict=True)]
        dialogues.append(dialogue.model_copy(update={"turns": tuple(turns)}))
    return question.model_copy(update={"videos": (), "dialogues": tuple(dialogues)})

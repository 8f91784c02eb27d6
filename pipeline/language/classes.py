"""Which questions follow from the classes that property heads predict, read from embeddings that are their logits."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import permutations

import torch

from pipeline.core.records import Question
from pipeline.training.embeddings import STATISTICS_FILE, EmbeddingStore, Statistics
from pipeline.videos.catalogue import Catalogue


def uncontradicted(questions: Sequence[Question], store: EmbeddingStore, catalogue: Catalogue) -> list[Question]:
    """Leave out comparisons whose right answer does not follow, by their task's rule, from the heads' logits.

    What touch contradicts cannot be learnt from touch: such questions teach to guess. Descriptions, which are about one
    video each, stay.

    The store has logits (`encoder.embedding=logits`); those of training objects are from heads that did not see the
    object, so they err as often as on new objects.
    """
    scaled = Statistics.load(store.folder / STATISTICS_FILE)
    sizes = [len(p.levels) for p in catalogue.properties]

    @cache
    def classes(video: str) -> list[tuple[int, float]]:
        logits = store.tensor[store.rows(video)].double() * scaled.scale + scaled.mean
        found = [part.softmax(1).mean(0) for part in logits.split(sizes, dim=1)]
        return [(int(p.argmax()), float(p @ torch.arange(len(p)).double())) for p in found]

    compared = ("PC", "PSS", "POM")
    return [q for q in questions if q.task not in compared or follows(q, [classes(v) for v in q.videos], catalogue)]


def follows(question: Question, seen: Sequence[Sequence[tuple[int, float]]], catalogue: Catalogue) -> bool:
    """Whether a comparison's right answer is the one that the tasks' rules draw from these classes.

    The rules (`TaskDefinition.conclude`) stand beside the graders. They are repeated here, starting from the right
    answer, so that a changed grader does not make every training run again; a test checks that both agree. `seen`
    holds, by video and property, the class and the expected class.
    """
    labels = question.gold.labels
    if question.task == "POM":

        def off(order: Sequence[int]) -> tuple[float, ...]:
            pairs = [pair for said, i in zip(seen, order, strict=True) for pair in zip(said, labels[i], strict=True)]
            return tuple(round(sum(abs(said[k] - label) for said, label in pairs), 9) for k in (0, 1))

        # Of equally near matchings the first one counts, in the order of object ids.
        return min(permutations(sorted(range(len(seen)), key=question.objects.__getitem__)), key=off) == (0, 1, 2)
    place = catalogue.property_index(question.gold.properties[0])
    own, said = [label[place] for label in labels], [video[place] for video in seen]
    if question.task == "PC":
        (first, _), (second, _) = said
        return (first > second, first < second) == (own[0] > own[1], own[0] < own[1])
    right = "abc".index(question.gold.choice)
    furthest = max if own[right] == max(own) else min
    return furthest(range(len(said)), key=said.__getitem__) == right

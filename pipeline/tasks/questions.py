"""Question sets: seeded, balanced over each task's strata and free of duplicates."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Mapping, Sequence

from pipeline.records import Assignment, Part, Question, Task
from pipeline.runtime import derive_seed
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.tasks.pom import with_facts
from pipeline.videos.catalogue import Catalogue

ATTEMPTS = 60
"""Draws a question before its stratum is given up for this round (a rare class may need many)."""


def pool_of(part: Part, assignments: Sequence[Assignment], catalogue: Catalogue) -> Pool:
    """The videos of one part of the split."""
    videos: dict[str, list[str]] = defaultdict(list)
    for assignment in assignments:
        if assignment.part == part:
            videos[assignment.object_id].append(assignment.video_id)
    return Pool(part, catalogue, dict(videos))


def build_questions(
    pool: Pool, counts: Mapping[Task, int], *, seed: int, distinct: bool, facts: bool = False
) -> list[Question]:
    """Build up to `counts[task]` questions of each task, in random order.

    Fewer come back where the pool has no more to ask (too few objects, a class without objects): strata that yield
    nothing after `ATTEMPTS` draws are left out, and with `distinct` no question is asked twice. With `facts` the same
    matching questions begin with what the named objects are like.
    """
    questions: list[Question] = []
    for task, count in counts.items():
        questions += _build_task(pool, task, count, seed, distinct, facts) if pool.objects else []
    random.Random(derive_seed(seed, pool.part, "order")).shuffle(questions)
    return questions


def _build_task(pool: Pool, task: Task, count: int, seed: int, distinct: bool, facts: bool) -> list[Question]:
    definition = TASKS[task]
    rng = random.Random(derive_seed(seed, pool.part, task))
    # A stream of its own: with facts and without, the same questions are drawn.
    order = random.Random(derive_seed(seed, pool.part, task, "facts"))
    live = list(range(definition.strata(pool.catalogue)))
    rng.shuffle(live)
    seen: set[tuple[object, ...]] = set()
    questions: list[Question] = []
    while live and len(questions) < count:
        for stratum in list(live):
            if len(questions) == count:
                break
            for _ in range(ATTEMPTS):
                draft = definition.draft(pool, stratum, rng)
                if draft is None:
                    continue
                # A template or a video more does not make a new question about the same videos and property.
                key = (draft.videos, draft.gold.properties, draft.dialogues[-1].turns[-1].assistant)
                if distinct and key in seen:
                    continue
                seen.add(key)
                if facts and task == Task.POM:
                    draft = with_facts(draft, pool.catalogue, order)
                questions.append(
                    Question(
                        question_id=f"{task}-{pool.part}-{len(questions):05d}",
                        task=task,
                        part=pool.part,
                        videos=draft.videos,
                        objects=draft.objects,
                        dialogues=draft.dialogues,
                        gold=draft.gold,
                    )
                )
                break
            else:
                live.remove(stratum)
    return questions

"""Question sets: seeded, balanced over each task's strata and free of duplicates."""

from __future__ import annotations

import random
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from typing import Literal

from pipeline.config import QuestionsConfig
from pipeline.core.records import Part, Question
from pipeline.core.runtime import derive_seed
from pipeline.running.errors import UserError, did_you_mean
from pipeline.tasks import TASKS
from pipeline.tasks.base import Draft, Pool, TaskDefinition, in_turns
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment

CHOICES = 2
"""Maximum number of questions of a multi-turn dialogue that are asked again in the form of a scenario question."""
ATTEMPTS = 60
"""Draws without a new question after which a stratum is left out; a rare class may need many."""


def pool_of(part: Part, assignments: Sequence[Assignment], catalogue: Catalogue) -> Pool:
    """The videos of one part of the split."""
    videos: dict[str, list[str]] = defaultdict(list)
    for assignment in assignments:
        if assignment.part == part:
            videos[assignment.object_id].append(assignment.video_id)
    return Pool(part, catalogue, dict(videos))


def counts_by_task(config: QuestionsConfig, section: Literal["train", "evaluation"]) -> dict[str, int]:
    """The questions that one section of the configuration wants of every registered task, in the registry's order.

    Raises:
        UserError: for a name that is no task, or training questions of a task that is for evaluation only.
    """
    wanted: dict[str, int] = getattr(config, section)
    keys = {name.lower(): name for name in TASKS}
    for key, count in wanted.items():
        if key not in keys:
            hint = did_you_mean(key, keys)
            raise UserError(f"questions.{section}.{key} is not a task; {hint}allowed here: {', '.join(keys)}")
        if section == "train" and count and not TASKS[keys[key]].trained:
            raise UserError(f"questions.train.{key} must be 0: {keys[key]} is for evaluation only")
    return {name: wanted.get(key, 0) for key, name in keys.items()}


def build_questions(
    pool: Pool,
    counts: Mapping[str, int],
    *,
    seed: int,
    distinct: bool,
    facts: bool = False,
    restate: bool = False,
    two_turns: float = 0.0,
    plainly: float = 0.0,
    fold: int | None = None,
) -> list[Question]:
    """Build up to `counts[task]` questions of each task, in random order.

    Fewer come back where the pool has no more to ask (too few objects, a class without objects): strata that yield
    nothing after `ATTEMPTS` draws are left out, and with `distinct` no question is asked twice.

    Args:
        facts: Whether questions first state what the objects that they name are like (`TaskDefinition.with_facts`).
        restate: Whether answers repeat the classes asked for before they conclude (`TaskDefinition.restated`).
        two_turns: Share of the questions about several videos that become a dialogue: descriptions first, then a turn
            for each of the task's questions about these videos (`in_turns`).
        plainly: Share of the other questions that are asked in everyday words (`TaskDefinition.plainly`).
        fold: Its number stands in the questions' ids, so that they are unique over all folds.
    """
    place = str(pool.part) if fold is None else f"{pool.part}-fold{fold}"
    questions: list[Question] = []
    for task, count in counts.items() if pool.objects else ():
        definition = TASKS[task]
        # Separate random streams, so that options of wording do not change which questions are drawn.
        rng, order, turns = (
            random.Random(derive_seed(seed, pool.part, task, *purpose)) for purpose in ((), ("facts",), ("turns",))
        )
        pools = (replace(pool, catalogue=pool.catalogue.telling(seed, pool.part, task, n)) for n in range(count))
        for number, (told, draft) in enumerate(islice(_drafts(definition, pools, rng, distinct), count)):
            asked_on = turns.random() < two_turns and len(draft.videos) > 1
            more = further(definition, told, draft, turns) if asked_on else []
            if not asked_on and turns.random() < plainly:
                draft = definition.plainly(draft, told.catalogue, turns)
            if restate:
                draft, *more = (definition.restated(d, told.catalogue) for d in (draft, *more))
            if asked_on:
                choices = (definition.as_choice(d, told.catalogue) for d in (draft, *more))
                # Shuffled among the turns: a choice may then follow the descriptions directly, as a scenario question
                # does.
                more += islice(filter(None, choices), CHOICES)
                draft = in_turns(draft, turns.sample(more, len(more)), told.catalogue)
            if facts:
                draft = definition.with_facts(draft, told.catalogue, order)
            questions.append(draft.numbered(f"{task}-{place}-{number:05d}", task, pool.part))
    random.Random(derive_seed(seed, pool.part, "order")).shuffle(questions)
    return questions


def further(definition: TaskDefinition, pool: Pool, draft: Draft, rng: random.Random) -> list[Draft]:
    """The task's other questions about the same videos in the same order of videos, shuffled."""
    few = replace(pool, videos={o: [v] for o, v in zip(draft.objects, draft.videos, strict=True)})
    found = {}
    for stratum in range(definition.strata(pool.catalogue)):
        drawn = (definition.draft(few, stratum, rng) for _ in range(ATTEMPTS // 4))
        same = next((d for d in drawn if d is not None and d.objects == draft.objects), draft)
        found[same.finding] = same
    more = [d for finding, d in found.items() if finding != draft.finding]
    return rng.sample(more, len(more))


def _drafts(
    definition: TaskDefinition, pools: Iterator[Pool], rng: random.Random, distinct: bool
) -> Iterator[tuple[Pool, Draft]]:
    """Questions of all strata by turns, each from its own pool, until no stratum yields one that is new."""
    pool = next(pools)
    live = list(range(definition.strata(pool.catalogue)))
    rng.shuffle(live)
    seen: set[tuple[object, ...]] = set()
    while live:
        for stratum in list(live):
            for draft in (definition.draft(pool, stratum, rng) for _ in range(ATTEMPTS)):
                if draft is None:
                    continue
                # The same videos and properties in other words are no new question; under another scenario they are.
                last = draft.dialogues[-1].turns[-1]
                situation = last.user if "{tactile}" not in last.user else ""
                key = (draft.videos, draft.gold, situation)
                if distinct and key in seen:
                    continue
                seen.add(key)
                yield pool, draft
                pool = next(pools)
                break
            else:
                live.remove(stratum)

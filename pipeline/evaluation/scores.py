"""Everything measured, as the rows of tidy tables: accuracies (scores.csv) and differences (effects.csv).

Every accuracy that a report shows is computed here; training computes its own on validation objects. A task appears
here by itself once it is registered: its chance, and with it its measures, come from its own module.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from statistics import fmean
from typing import NamedTuple

import numpy as np
from statsmodels.stats.multitest import multipletests

from pipeline.core.records import Encoder, Lora, Opd, Part, TouchInput
from pipeline.encoder.records import Classification
from pipeline.evaluation.intervals import Objects, accuracy_interval
from pipeline.evaluation.paired import Difference, paired
from pipeline.evaluation.records import ADAPTED, Graded, GradedVision, Shown
from pipeline.evaluation.rows import ALL_SEEDS, HEADS, RECALL, VALIDATION_HEADS, EffectRow, ScoreRow
from pipeline.tasks import TASKS
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue


class Setting(NamedTuple):
    """Who answered, and from what touch, apart from the seed; "" for what does not apply."""

    encoder: str
    """For a vision-only model, the model."""
    lora: str = ""
    opd: str = ""
    touch: str = TouchInput.REAL
    """For a vision-only model, what it was shown in place of touch."""


FULL = Setting(Encoder.FINETUNED, Lora.WITH, Opd.ALL)
RULES = Setting(Encoder.FINETUNED)
"""No language model: the property heads, or answers that follow by rule from the classes that they predict."""
CHANGES: tuple[tuple[str, Setting, Setting], ...] = (
    ("language", FULL, RULES),
    ("encoder", FULL, FULL._replace(encoder=Encoder.BASE)),
    ("lora", FULL, FULL._replace(lora=Lora.WITHOUT)),
    ("opd", FULL, FULL._replace(opd=Opd.NONE)),
    ("opd", FULL, FULL._replace(opd=Opd.NEEDED)),
    *(("touch", FULL, FULL._replace(touch=touch)) for touch in TouchInput if touch is not TouchInput.REAL),
)
"""The part, the full system, and what it is compared with."""


class Answer(NamedTuple):
    """A graded answer to one question, or the heads' classification of one video."""

    correct: bool
    objects: Objects
    parsed: bool = True
    strict: bool | None = None


Runs = Mapping[int, Mapping[str, Answer]]
"""By seed and question."""
Entry = tuple[tuple[str, str], Setting, int, str, Answer]
"""Task and measure, who answered, the seed, the question, and its answer."""
Table = Mapping[tuple[str, str], Mapping[Setting, Runs]]
"""By task and measure, then setting, seed and question."""


def score_rows(
    graded: Iterable[Graded],
    catalogue: Catalogue,
    classifications: Mapping[int, Sequence[Classification]] | None = None,
    vision: Iterable[GradedVision] = (),
    concluded: Mapping[int, Sequence[Score]] | None = None,
) -> list[ScoreRow]:
    """The rows of scores.csv: one a seed and one over all of them, for each measure and setting that has answers.

    Args:
        graded: All graded answers of a run; some variants or tasks may be absent.
        classifications: Of the property heads, by seed, those of its folds together; only test and validation count.
        vision: Graded answers of vision-only models.
        concluded: By seed, the scores that `pipeline.evaluation.grading.conclude` gives.
    """
    seen = _other(vision)
    chances, rows = {name: task.chance(catalogue) for name, task in TASKS.items()}, []
    for table in (_answers(graded, catalogue, concluded or {}), seen, _heads(classifications or {}, catalogue)):
        for (task, measure), settings in table.items():
            # The heads' chance is that of a description.
            chance = chances.get(task, chances["OPD"])[measure.partition(":")[0]]
            for setting, runs in settings.items():
                rows += _rows(runs, task=task, measure=measure, chance=chance, **setting._asdict())
    return rows


def effect_rows(
    graded: Iterable[Graded],
    catalogue: Catalogue,
    concluded: Mapping[int, Sequence[Score]] | None = None,
    vision: Iterable[GradedVision] = (),
) -> list[EffectRow]:
    """The rows of effects.csv: what each part of the full system brings, task by task, pooled over seeds.

    Only each task's measure of a whole answer, on questions and seeds that both settings have. Holm's adjustment is
    over all rows. Arguments are as `score_rows` takes them. Training stands beside each model as it is adapted by the
    most rated objects.
    """
    rows, table, other = [], _answers(graded, catalogue, concluded or {}), _other(vision)
    counts = defaultdict[str, set[int]](set)
    for setting in {setting for settings in other.values() for setting in settings}:
        name, adapted, count = setting.encoder.partition(ADAPTED)
        if adapted and setting.touch == Shown.TOUCH:
            counts[name].add(int(count))
    most = {name: Setting(f"{name}{ADAPTED}{max(counts[name])}", opd=Opd.ALL, touch=Shown.TOUCH) for name in counts}
    for part, full, less in (*CHANGES, *(("training", FULL, most[name]) for name in sorted(most))):
        for (task, measure), settings in table.items():
            beside = {**settings, **other.get((task, measure), {})}
            if measure == TASKS[task].measure and (gap := difference(beside.get(full, {}), beside.get(less, {}))):
                if less is RULES:
                    change = "full system - heads and rules"
                elif part == "training":
                    change = f"full system - {less.encoder} rated objects"
                else:
                    change = f"{getattr(full, part)} - {getattr(less, part)}"
                rows.append(EffectRow(part=part, change=change, task=task, measure=measure, **vars(gap)))
    return with_holm(rows)


def with_holm(rows: Sequence[EffectRow]) -> list[EffectRow]:
    """The rows with Holm's adjusted p (Holm 1979), all of them as one family; a row without p gets none."""
    tested = [row.p for row in rows if row.p is not None]
    adjusted = iter(multipletests(tested, method="holm")[1].tolist() if tested else [])
    return [row if row.p is None else row.model_copy(update={"p_holm": next(adjusted)}) for row in rows]


def difference(one: Runs, other: Runs) -> Difference | None:
    """How much more often the first is right, on the questions and seeds that both have; None where there are none."""
    seeds = sorted(one.keys() & other.keys())
    asked = [
        q
        for q in _shared([runs[seed] for runs in (one, other) for seed in seeds])
        # Where names are others, a matching question of one number is about other objects.
        if all(one[s][q].objects == other[s][q].objects for s in seeds)
    ]
    if not asked:
        return None
    gains = [[float(one[s][q].correct) - float(other[s][q].correct) for q in asked] for s in seeds]
    return paired(np.array(gains), [one[seeds[0]][q].objects for q in asked])


def _rows(runs: Runs, *, chance: float, **named: str) -> list[ScoreRow]:
    """A row a seed, and the last over all seeds, on the questions that all of them have answered.

    Where seeds are sets of different questions (`evaluate.repeats`), the last is on all of them.
    """
    # By seed, the answers to each question.
    given = {str(seed): [[a] for a in answers.values()] for seed, answers in sorted(runs.items())}
    if asked := _shared(runs.values()):
        given[ALL_SEEDS] = [[answers[q] for answers in runs.values()] for q in asked]
    else:
        given[ALL_SEEDS] = [questions for own in given.values() for questions in own]
    rows = []
    for seed, questions in given.items():
        right = [fmean(a.correct for a in answers) for answers in questions]
        compared = [a.strict for answers in questions for a in answers]
        about = [answers[0].objects for answers in questions]
        interval = accuracy_interval(np.array(right), about)
        row = ScoreRow(
            **{name: str(value) for name, value in named.items()},
            seed=seed,
            n=len(right),
            sets=len(set(map(frozenset, about))),
            right=sum(right),
            unread=sum(fmean(not a.parsed for a in answers) for answers in questions),
            accuracy=fmean(right),
            low=interval and interval.low,
            high=interval and interval.high,
            chance=chance,
            strict=None if None in compared else fmean(map(bool, compared)),
        )
        rows.append(row)
    return rows


def _other(vision: Iterable[GradedVision]) -> Table:
    """Answers of models that the chain did not train."""
    return _tabled(_entry(g, Setting(g.model, opd=Opd.ALL, touch=g.shown), g.seed) for g in vision)


def grouped(graded: Iterable[Graded], order: Iterable[tuple[str, str]] = (), ruled: Iterable[Entry] = ()) -> Table:
    """Answers by task and measure, then by setting; `order` and `ruled`, other answers, as `_answers` gives them."""
    own = (_entry(g, Setting(g.encoder, g.lora, g.opd, g.touch), g.seed) for g in graded)
    return _tabled(chain(own, ruled), order)


def _entry(s: Score, setting: Setting, seed: int) -> Entry:
    return (s.task, s.measure), setting, seed, s.question_id, Answer(s.correct, s.objects, s.parsed, s.strict)


def _tabled(entries: Iterable[Entry], order: Iterable[tuple[str, str]] = ()) -> Table:
    """A table of these answers; with an order, of these tasks and measures alone."""
    found: dict[tuple[str, str], dict[Setting, dict[int, dict[str, Answer]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(dict))
    )
    for key, setting, seed, question, answer in entries:
        found[key][setting][seed][question] = answer
    return {key: found[key] for key in order or found if key in found}


def _answers(graded: Iterable[Graded], catalogue: Catalogue, concluded: Mapping[int, Sequence[Score]]) -> Table:
    """In the order of the registered tasks and of what each calls its measures."""
    ruled = (_entry(score, RULES, seed) for seed, scores in concluded.items() for score in scores)
    order = [(task, measure) for task, definition in TASKS.items() for measure in definition.chance(catalogue)]
    return grouped(graded, order, ruled)


def _heads(classifications: Mapping[int, Sequence[Classification]], catalogue: Catalogue) -> Table:
    """The heads' test videos, validation videos, and test videos by class: each property, and `combined`, all of a
    video's."""
    kinds, entries = {Part.TEST: HEADS, Part.VALIDATION: VALIDATION_HEADS}, list[Entry]()
    levels = {p.name: p.levels for p in catalogue.properties}
    for seed, records in classifications.items():
        videos: dict[tuple[str, str], list[Classification]] = defaultdict(list)
        for c in records:
            if c.part in kinds:
                videos[kinds[c.part], c.video_id].append(c)
        for (kind, video), own in videos.items():
            right = {(kind, c.property): c.expected == c.predicted for c in own}
            right[kind, "combined"] = all(right.values())
            for c in own if kind == HEADS else ():
                right[RECALL, f"{c.property}: {levels[c.property][c.expected]}"] = c.expected == c.predicted
            about = (own[0].object_id,)
            entries += [(key, RULES, seed, video, Answer(correct, about)) for key, correct in right.items()]
    order = [(kind, measure) for kind in kinds.values() for measure in TASKS["OPD"].chance(catalogue)]
    order += [(RECALL, f"{p.name}: {level}") for p in catalogue.properties for level in p.levels]
    return _tabled(entries, order)


def _shared(answered: Iterable[Mapping[str, Answer]]) -> list[str]:
    """The questions that all have answered, sorted."""
    asked = [set(answers) for answers in answered]
    return sorted(set.intersection(*asked)) if asked else []

"""Everything measured, as the rows of tidy tables: accuracies (scores.csv) and differences (effects.csv).

Every accuracy that a report shows is computed here; training computes its own on validation objects. A task appears
here by itself once it is registered: its chance, and with it its measures, come from its own module.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from statistics import fmean
from typing import NamedTuple

import numpy as np
from statsmodels.stats.multitest import multipletests

from pipeline.core.records import (
    ADJECTIVES,
    ALL_SEEDS,
    HEADS,
    NEIGHBOURS,
    RECALL,
    VALIDATION_HEADS,
    Classification,
    EffectRow,
    Encoder,
    Graded,
    GradedVision,
    Lora,
    Opd,
    OutOfFold,
    Part,
    Score,
    ScoreRow,
    Touch,
)
from pipeline.evaluation.intervals import Objects, accuracy_interval
from pipeline.evaluation.paired import Difference, paired
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import Catalogue


class Setting(NamedTuple):
    """Who answered, and from what touch, apart from the seed."""

    encoder: Encoder
    lora: Lora | None
    """None where no language model answered."""
    opd: Opd | None
    touch: Touch


FULL = Setting(Encoder.FINETUNED, Lora.WITH, Opd.ALL, Touch.REAL)
RULES = Setting(Encoder.FINETUNED, None, None, Touch.REAL)
"""No language model: answers follow by rule from the classes that the property heads predict."""
CHANGES: tuple[tuple[str, Setting, Setting], ...] = (
    ("language", FULL, RULES),
    ("encoder", FULL, FULL._replace(encoder=Encoder.BASE)),
    ("encoder", FULL, FULL._replace(encoder=Encoder.WORDS)),
    ("lora", FULL, FULL._replace(lora=Lora.WITHOUT)),
    ("opd", FULL, FULL._replace(opd=Opd.NONE)),
    ("opd", FULL, FULL._replace(opd=Opd.NEEDED)),
    *(("touch", FULL, FULL._replace(touch=touch)) for touch in Touch if touch is not Touch.REAL),
)
"""The part, the full system, and what it is compared with."""


class Answer(NamedTuple):
    """A graded answer to one question, or the heads' classification of one video."""

    correct: bool
    objects: Objects
    parsed: bool = True
    strict: bool | None = None

    @classmethod
    def of(cls, score: Score) -> Answer:
        """From a graded measure."""
        return cls(score.correct, score.objects, score.parsed, score.strict)


Runs = Mapping[int, Mapping[str, Answer]]
"""By seed and question."""
Table = Mapping[tuple[str, str], Mapping[Setting, Runs]]
"""By task and measure, then setting, seed and question."""


def score_rows(
    graded: Iterable[Graded],
    catalogue: Catalogue,
    classifications: Mapping[int, Sequence[Classification]] | None = None,
    vision: Iterable[GradedVision] = (),
    concluded: Mapping[int, Sequence[Score]] | None = None,
    neighbours: Mapping[str, Sequence[OutOfFold]] | None = None,
    adjectives: Mapping[str, str] | None = None,
) -> list[ScoreRow]:
    """The rows of scores.csv: one a seed and one over all of them, for each measure and setting that has answers.

    Args:
        graded: All graded answers of a run; some variants or tasks may be absent.
        classifications: Of the property heads, by seed, those of its folds together; only test and validation count.
        vision: Graded answers of vision-only models.
        concluded: By seed, the scores that `pipeline.evaluation.grading.conclude` gives.
        neighbours: By encoder, the classes of each test video's nearest neighbour.
        adjectives: By question, the adjective that it asks by.
    """
    rows: list[ScoreRow] = []
    words, heads, embeddings = adjectives or {}, classifications or {}, neighbours or {}
    # Answers of the language model, and those that follow by rule; of both also each adjective's own.
    for (task, measure), settings in _table(graded, catalogue, concluded or {}).items():
        chance = TASKS[task].chance(catalogue)[measure]
        for setting, runs in settings.items():
            named = {axis: value for axis, value in setting._asdict().items() if value is not None}
            rows += _rows(runs, task=task, measure=measure, chance=chance, **named)
            for word in dict.fromkeys(words.values()) if setting in (FULL, RULES) else ():
                own = {seed: {q: a for q, a in found.items() if words.get(q) == word} for seed, found in runs.items()}
                if all(own.values()):
                    rows += _rows(own, task=ADJECTIVES, measure=f"{task}: {word}", chance=chance, **named)[-1:]
    # Vision-only models.
    by_model: dict[tuple[str, ...], dict[int, dict[str, Answer]]] = defaultdict(lambda: defaultdict(dict))
    for g in vision:
        by_model[g.task, g.measure, g.model, g.shown][g.seed][g.question_id] = Answer.of(g)
    for (task, measure, model, shown), runs in by_model.items():
        chance = TASKS[task].chance(catalogue)[measure]
        rows += _rows(runs, task=task, measure=measure, chance=chance, encoder=model, opd=Opd.ALL, touch=shown)
    # The property heads, whose chance is that of a description; then the recall of each class.
    chances = TASKS["OPD"].chance(catalogue)
    classes = [(place, p, level) for place, p in enumerate(catalogue.properties) for level in range(len(p.levels))]
    named = {"encoder": Encoder.FINETUNED, "touch": Touch.REAL}
    for kind, part in ((HEADS, Part.TEST), (VALIDATION_HEADS, Part.VALIDATION)):
        videos = {seed: _videos(records, part) for seed, records in heads.items()}
        for measure, chance in chances.items():
            runs = {seed: found[measure] for seed, found in videos.items() if measure in found}
            rows += _rows(runs, task=kind, measure=measure, chance=chance, **named)
    for _, p, level in classes:
        rated = {seed: [c for c in records if c.expected == level] for seed, records in heads.items()}
        videos = {seed: _videos(records, Part.TEST) for seed, records in rated.items()}
        runs = {seed: found[p.name] for seed, found in videos.items() if p.name in found}
        rows += _rows(runs, task=RECALL, measure=f"{p.name}: {p.levels[level]}", chance=chances[p.name], **named)
    # Encoders by nearest neighbours: only the rows over all repeats.
    for name, records in embeddings.items():
        for place, measure in enumerate(chances):
            predicted = repeats(records, place if place < len(catalogue.properties) else None)
            rows += _rows(predicted, task=NEIGHBOURS, measure=measure, chance=chances[measure], encoder=name)[-1:]
    for name, records in embeddings.items():
        for place, p, level in classes:
            predicted = repeats([r for r in records if r.expected[place] == level], place)
            measure = f"{p.name}: {p.levels[level]}"
            rows += _rows(predicted, task=NEIGHBOURS, measure=measure, chance=chances[p.name], encoder=name)[-1:]
    return rows


def effect_rows(
    graded: Iterable[Graded], catalogue: Catalogue, concluded: Mapping[int, Sequence[Score]] | None = None
) -> list[EffectRow]:
    """The rows of effects.csv: what each part of the full system brings, task by task, pooled over seeds.

    Only each task's measure of a whole answer, on questions and seeds that both settings have. Holm's adjustment is
    over all rows. Arguments are as `score_rows` takes them.
    """
    rows = []
    table = _table(graded, catalogue, concluded or {})
    for part, full, less in CHANGES:
        for (task, measure), settings in table.items():
            if measure == TASKS[task].measure and (gap := difference(settings.get(full, {}), settings.get(less, {}))):
                change = "full system - heads and rules"
                if less is not RULES:
                    change = f"{getattr(full, part)} - {getattr(less, part)}"
                rows.append(EffectRow(part=part, change=change, task=task, measure=measure, **vars(gap)))
    return with_holm(rows)


def candidate_rows(
    neighbours: Mapping[str, Sequence[OutOfFold]], reference: str, properties: Sequence[str]
) -> list[EffectRow]:
    """Each other encoder minus the reference: all properties of a video right, then each of `properties` alone.

    Computed as effects are, with repeats in place of seeds and a Holm adjustment of its own. Empty where the reference
    was not run.
    """
    rows = []
    for place, measure in [(None, "combined"), *enumerate(properties)]:
        runs = {name: repeats(records, place) for name, records in neighbours.items()}
        for name, videos in runs.items():
            if name != reference and (gap := difference(videos, runs.get(reference, {}))):
                change = f"{name} - {reference}"
                rows.append(EffectRow(part="encoder", change=change, task=NEIGHBOURS, measure=measure, **vars(gap)))
    return with_holm(rows)


def with_holm(rows: Sequence[EffectRow]) -> list[EffectRow]:
    """The rows with Holm's adjusted p (Holm 1979), all of them as one family; a row without p gets none."""
    tested = [row.p for row in rows if row.p is not None]
    adjusted = iter(multipletests(tested, method="holm")[1].tolist() if tested else [])
    return [row if row.p is None else row.model_copy(update={"p_holm": next(adjusted)}) for row in rows]


def difference(one: Runs, other: Runs) -> Difference | None:
    """How much more often the first is right, on the questions and seeds that both have; None where there are none."""
    seeds = sorted(one.keys() & other.keys())
    asked = _shared([runs[seed] for runs in (one, other) for seed in seeds])
    if not asked:
        return None
    gains = [[float(one[s][q].correct) - float(other[s][q].correct) for q in asked] for s in seeds]
    return paired(np.array(gains), [one[seeds[0]][q].objects for q in asked])


def repeats(records: Iterable[OutOfFold], place: int | None = None) -> dict[int, dict[str, Answer]]:
    """Whether one property, or with None every property, was predicted right; by repeat and video."""
    part = slice(None) if place is None else slice(place, place + 1)
    runs: dict[int, dict[str, Answer]] = defaultdict(dict)
    for r in records:
        runs[r.repeat][r.video_id] = Answer(r.expected[part] == r.predicted[part], (r.object_id,))
    return runs


def _rows(runs: Runs, **named: object) -> list[ScoreRow]:
    """A row a seed, and the last over all seeds, on the questions that all of them have answered."""
    asked = _shared(runs.values())
    found = [_row([[a] for a in answers.values()], seed=str(seed), **named) for seed, answers in sorted(runs.items())]
    if asked:
        found.append(_row([[answers[q] for answers in runs.values()] for q in asked], seed=ALL_SEEDS, **named))
    return found


def _row(questions: Sequence[Sequence[Answer]], **named: object) -> ScoreRow:
    """One accuracy from the answers to each question, one a seed."""
    right = [fmean(a.correct for a in answers) for answers in questions]
    compared = [a.strict for answers in questions for a in answers]
    about = [answers[0].objects for answers in questions]
    interval = accuracy_interval(np.array(right), about)
    return ScoreRow.model_validate(
        {
            **{name: str(value) if name != "chance" else value for name, value in named.items()},
            "n": len(right),
            "sets": len(set(map(frozenset, about))),
            "right": sum(right),
            "unread": sum(fmean(not a.parsed for a in answers) for answers in questions),
            "accuracy": fmean(right),
            "low": interval and interval.low,
            "high": interval and interval.high,
            "strict": None if None in compared else fmean(map(bool, compared)),
        }
    )


def grouped(graded: Iterable[Graded]) -> dict[tuple[str, str], dict[Setting, dict[int, dict[str, Answer]]]]:
    """Answers by task and measure, then by setting."""
    found: dict[tuple[str, str], dict[Setting, dict[int, dict[str, Answer]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(dict))
    )
    for g in graded:
        found[g.task, g.measure][Setting(g.encoder, g.lora, g.opd, g.touch)][g.seed][g.question_id] = Answer.of(g)
    return found


def _table(graded: Iterable[Graded], catalogue: Catalogue, concluded: Mapping[int, Sequence[Score]]) -> Table:
    """In the order of the registered tasks and of what each calls its measures."""
    found = grouped(graded)
    for seed, scores in concluded.items():
        for s in scores:
            found[s.task, s.measure][RULES][seed][s.question_id] = Answer.of(s)
    keys = [(task, measure) for task, definition in TASKS.items() for measure in definition.chance(catalogue)]
    return {key: found[key] for key in keys if key in found}


def _videos(records: Iterable[Classification], part: Part) -> dict[str, dict[str, Answer]]:
    """By property and `combined`, whether the heads were right about each video of a part."""
    found: dict[str, dict[str, Answer]] = defaultdict(dict)
    kept = sorted((r for r in records if r.part == part), key=lambda r: r.video_id)
    for video, group in groupby(kept, key=lambda r: r.video_id):
        said = {r.property: Answer(r.expected == r.predicted, (r.object_id,)) for r in group}
        for name, one in said.items():
            found[name][video] = one
        found["combined"][video] = Answer(all(s.correct for s in said.values()), next(iter(said.values())).objects)
    return found


def _shared(answered: Iterable[Mapping[str, Answer]]) -> list[str]:
    """The questions that all have answered, sorted."""
    asked = [set(answers) for answers in answered]
    return sorted(set.intersection(*asked)) if asked else []

"""The tables of a report: each an entry here, a selection of scores.csv or effects.csv.

To add one, add an entry to `TABLES`. A newly registered task is in all that its kind belongs to, without a change here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import pandas as pd

from pipeline.core.records import (
    ADJECTIVES,
    ALL_SEEDS,
    CROSS_VALIDATION,
    HEADS,
    NEIGHBOURS,
    RECALL,
    VALIDATION_HEADS,
    Shown,
)
from pipeline.report.load import DATASET, DATASETS, KEYS, Report, cells, published
from pipeline.tasks import TASKS

Select = Callable[[pd.DataFrame], "pd.Series[bool]"]
Cell = Callable[[dict[str, Any]], str]
FULL = {"encoder": "finetuned", "lora": "with", "opd": "all"}
CHOICE, COMBINED = "choice", "combined"
NOT_ANSWERED = (HEADS, VALIDATION_HEADS, RECALL, CROSS_VALIDATION, NEIGHBOURS, ADJECTIVES)
"""Tasks of scores.csv that no language model with touch answered."""
PUBLISHED_MODELS = ("7b", "13b", "CLIP", "PG-InstructBLIP")
SYSTEM_WORDS = {
    "base": "base encoder",
    "words": "told the heads' classes in words",
    "without": "without LoRA",
    "none": "without OPD",
    "needed": "OPD as needed",
}
SHOWN_WORDS = {"frames": "frames of the videos", "photos": "photos of the objects"}
"""What vision-only models were shown, in the place where others have their touch."""
ENCODERS = {"finetuned": "fine-tuned", "base": "base", "words": "fine-tuned, its classes in words"}
PARTS = {"language": "language model", "lora": "LoRA", "opd": "OPD"}
"""Parts of the full system that are called otherwise than in effects.csv."""


@dataclass(frozen=True)
class Table:
    """One table: a selection of rows and the columns that are shown of them."""

    key: str
    title: str
    caption: str
    """Plain sentences: what the rows are, and what to mind."""
    rows: Select
    """Of scores.csv it is given the rows over all seeds."""
    columns: tuple[str, ...]
    """Names of `COLUMNS`; "published" stands for a column a published model."""
    source: str = "scores"
    """`scores` or `effects`."""
    folded: bool = True
    """Whether the page shows it only when asked."""

    def select(self, report: Report) -> pd.DataFrame:
        """The rows of the table as the CSV has them, in the order of tasks, measures and systems."""
        frame = report.effects if self.source == "effects" else over_seeds(report.scores)
        return ordered(frame[self.rows(frame).astype(bool)]) if len(frame) else frame

    def build(self, report: Report) -> pd.DataFrame:
        """The table as it is shown: text in every cell, headings as column names; no row where nothing was measured.

        What is published is joined by `KEYS`, in columns of their own.
        """
        rows = self.select(report)
        shown: dict[str, list[str]] = {}
        for name in self.columns:
            if name == "published":
                shown |= _beside(rows, report.published)
            else:
                heading, cell = COLUMNS[name]
                shown[heading] = [cell(row) for row in rows.to_dict("records")]
        return pd.DataFrame(shown, index=rows.index, dtype=object)


def over_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """The rows of scores.csv that are over all seeds."""
    return scores[scores["seed"] == ALL_SEEDS]


def headline(scores: pd.DataFrame) -> pd.DataFrame:
    """The full system's rows of scores.csv, a row a task that was asked."""
    rows = over_seeds(scores)
    return ordered(rows[answers(rows) & whole(rows) & _differs(rows)])


def side_by_side(reports: Mapping[str, Report], *, every: bool) -> pd.DataFrame:
    """The paper's rows: what is published and what each report measured, a column each; text in every cell.

    Args:
        reports: by what their columns are called; the paper's figures are joined by what data a report is about.
        every: also the ablations, single properties and the encoder's heads, and not only whole answers of the
            full system.
    """
    about = {r.provenance["dataset"]: r.published for r in reports.values()}
    if every and DATASET in about:
        about |= {dataset: published(dataset) for dataset in DATASETS}
    place, blocks = [*KEYS, "touch"], []
    for dataset, printed in sorted(about.items(), key=lambda pair: pair[0] != DATASET):
        rows = ordered(printed[printed["model"].isin(PUBLISHED_MODELS)].assign(touch="real").drop_duplicates(place))
        rows = rows if every else rows[whole(rows) & _differs(rows)]
        other = "" if dataset == DATASET else f", {dataset}"
        shown = {"Task": [task_title(task) + other for task in rows["task"]]}
        if every:
            named = [(row, COLUMNS["measure"][1](row)) for row in rows.to_dict("records")]
            shown["System"] = [system(row) + (f": {part}" if part != CHOICE else "") for row, part in named]
        shown |= _beside(rows, printed)
        for name, report in reports.items():
            own = over_seeds(report.scores).to_dict("records") if report.provenance["dataset"] == dataset else []
            known = {tuple(row[k] for k in place): f"{measured(row)} ({row['n']:.0f})" for row in own}
            keys = rows[place].itertuples(index=False, name=None)
            shown[f"Measured {name} % [95 %] (n)"] = [known.get(key, "") for key in keys]
        blocks.append(pd.DataFrame(shown, dtype=object))
    table = pd.concat(blocks, ignore_index=True).fillna("")
    return table[sorted(table, key=lambda name: name.startswith("Measured"))]


def number(value: float, digits: int = 1, scale: float = 1.0) -> str:
    """A number with fixed digits; nothing for NaN."""
    return "" if pd.isna(value) else f"{value * scale:.{digits}f}"


def measured(row: dict[str, Any]) -> str:
    """Percent with the 95 % interval, such as "60.6 [39.7, 78.3]"."""
    span = "" if pd.isna(row["low"]) else f" [{number(row['low'], scale=100)}, {number(row['high'], scale=100)}]"
    return number(row["accuracy"], scale=100) + span


def difference(row: dict[str, Any]) -> str:
    """Percentage points with a sign and the 95 % interval."""
    span = "" if pd.isna(row["low"]) else f" [{100 * row['low']:+.1f}, {100 * row['high']:+.1f}]"
    return f"{100 * row['difference']:+.1f}{span}"


def task_title(task: str) -> str:
    """What a task is called in words, such as "Property comparison (PC)"."""
    titles = {
        HEADS: "Property heads",
        VALIDATION_HEADS: "Property heads, validation videos",
        RECALL: "Property heads, class by class",
        CROSS_VALIDATION: "Cross-validation",
        NEIGHBOURS: "Nearest neighbour",
        ADJECTIVES: "By adjective",
        **{name: task.title for name, task in TASKS.items()},
    }
    return f"{titles[task]} ({task})" if task in TASKS else titles.get(task, task)


def system(row: dict[str, Any]) -> str:
    """A variant by what it leaves out of the full system; another model by its name."""
    task, encoder, touch = row["task"], row["encoder"], row["touch"]
    # Rules on the heads' classes are told of some questions what the language model is not.
    told = f", {TASKS[task].told}" if task in TASKS and TASKS[task].told else ""
    others: dict[str, str] = {
        Shown.TOUCH: f"{encoder}, as it is shipped",
        Shown.CLASSES: f"its heads and rules alone{told}",
        Shown.STANDARDISED: f"{encoder}, embeddings standardised by these videos",
        **{shown: f"{encoder}, {words}" for shown, words in SHOWN_WORDS.items()},
    }
    if touch in others:
        return others[touch]
    if task in (HEADS, VALIDATION_HEADS, RECALL):
        return "property heads, no language model"
    if task in (CROSS_VALIDATION, NEIGHBOURS):
        return str(encoder)
    if not row["lora"]:
        return f"heads and rules, no language model{told}"
    words = [SYSTEM_WORDS[row[axis]] for axis in FULL if row[axis] in SYSTEM_WORDS]
    return ", ".join(words) or "Octopi (full system)"


COLUMNS: dict[str, tuple[str, Cell]] = {
    "task": ("Task", lambda row: task_title(row["task"])),
    "measure": ("Measure", lambda row: "all properties right" if row["measure"] == COMBINED else row["measure"]),
    "system": ("System", system),
    "encoder": ("Encoder", lambda row: str(ENCODERS.get(row["encoder"], row["encoder"]))),
    "lora": ("LoRA", itemgetter("lora")),
    "opd": ("OPD", itemgetter("opd")),
    "touch": ("Touch", itemgetter("touch")),
    "measured": ("Measured % [95 %]", measured),
    "strict": ("As published %", lambda row: number(row["strict"], scale=100)),
    "chance": ("Chance %", lambda row: number(row["chance"], scale=100)),
    "unread": ("Unread %", lambda row: number(row["unread"] / row["n"], scale=100)),
    "part": ("Part", itemgetter("part")),
    "change": ("Change", itemgetter("change")),
    "difference": ("Difference, points [95 %]", difference),
    "p": ("p", lambda row: number(row["p"], 3)),
    "p_holm": ("p, Holm", lambda row: number(row["p_holm"], 3)),
    "smallest": ("Smallest that could be found, before Holm", lambda row: number(row["smallest_effect"], scale=100)),
    "n": ("n", lambda row: number(row["n"], 0)),
    "asked": ("n (sets of objects)", lambda row: f"{number(row['n'], 0)} ({number(row['sets'], 0)})"),
    "objects": ("Objects", lambda row: number(row["objects"], 0)),
    "seeds": ("Seeds", lambda row: number(row["seeds"], 0)),
}
"""Heading of a column, and how its cell is written."""


def ordered(frame: pd.DataFrame) -> pd.DataFrame:
    """Tasks in the registry's order, whole answers before parts, the full system before what lacks something."""
    tasks = [*TASKS, *NOT_ANSWERED]
    rank = pd.DataFrame(index=frame.index)
    rank["task"] = frame["task"].map(lambda task: tasks.index(task) if task in tasks else len(tasks))
    rank["measure"] = frame["measure"].map(lambda measure: measure != COMBINED).astype(int)
    rank["named"] = pd.factorize(frame["measure"])[0]
    for axis in (axis for axis in FULL if axis in frame):
        rank[axis] = (frame[axis] != FULL[axis]).astype(int)
    return frame.loc[rank.sort_values(list(rank.columns), kind="stable").index]


def _beside(rows: pd.DataFrame, published: pd.DataFrame) -> dict[str, list[str]]:
    """The published cells of these rows, a column a model that has any."""
    printed, columns = cells(published), {}
    for model in PUBLISHED_MODELS:
        found = [printed.get((*key, model)) for key in zip(*(rows[k] for k in KEYS), strict=True)]
        if any(found):
            columns[f"Published {model} % (n)"] = [f"{cell[0]:.2f} ({cell[1]:.0f})" if cell else "" for cell in found]
    return columns


def answers(frame: pd.DataFrame) -> pd.Series[bool]:
    """Answers of the language model to real touch."""
    return ~frame["task"].isin(NOT_ANSWERED) & (frame["touch"] == "real") & (frame["lora"] != "")


def rules(frame: pd.DataFrame) -> pd.Series[bool]:
    """What follows by rule from the property heads' classes."""
    return ~frame["task"].isin(NOT_ANSWERED) & (frame["touch"] == "real") & (frame["lora"] == "")


def whole(frame: pd.DataFrame) -> pd.Series[bool]:
    """Measures that say that an answer is right, not only a part of it."""
    return frame["measure"].isin({CHOICE, COMBINED, *(task.measure for task in TASKS.values())})


def _differs(frame: pd.DataFrame, *axes: str) -> pd.Series[bool]:
    """Variants that are the full system but for these axes. OPD as needed is left out: the paper's tables lack it."""
    same = frame["opd"] != "needed"
    for axis, value in FULL.items():
        same &= (frame[axis] == value) | (axis in axes)
    return same


def _variants(*axes: str, described: bool, trained: bool | None = None) -> Select:
    """Rows of variants that are the full system but for these axes, and of vision-only models.

    Of descriptions only, or of choices only; choices come with what follows by rule. `trained` keeps only tasks that
    are trained on, or only those that are not.
    """

    def select(frame: pd.DataFrame) -> pd.Series[bool]:
        rows = answers(frame) & _differs(frame, *axes) | frame["touch"].isin(SHOWN_WORDS)
        if not described:
            rows |= rules(frame)
        if trained is not None:
            rows &= frame["task"].isin([name for name, task in TASKS.items() if not task.trained]) != trained
        return rows & ((frame["measure"] != CHOICE) == described)

    return select


def _ablated(axis: str, *, described: bool) -> Select:
    """Rows of variants that are the full system but for one axis, without vision-only models; none where the run varied
    nothing in it."""

    def select(frame: pd.DataFrame) -> pd.Series[bool]:
        rows = _variants(axis, described=described)(frame) & ~frame["touch"].isin(SHOWN_WORDS)
        return rows & (frame.loc[rows & answers(frame), axis].nunique() > 1)

    return select


SHOWN = ("system", "measured", "asked", "chance", "unread")
PAPER, PROPERTIES = ("task", *SHOWN, "published"), ("measure", *SHOWN, "published")

FIVE_TASKS = Table(
    "five_tasks",
    "The full system",
    "Whole answers to real touch, over all seeds; below each, what follows by rule from the property heads.",
    lambda f: (answers(f) & _differs(f) | rules(f)) & whole(f),
    ("task", "system", "measured", "asked", "unread", "chance", "published"),
)
"""A report's first table, two rows a task that was asked."""
SHIPPED_TABLE = Table(
    "shipped",
    "The model that is shipped, on these videos",
    "It was trained on synthetic touches of invented objects, and has met none of these objects.",
    lambda f: f["touch"].isin({Shown.TOUCH, Shown.STANDARDISED, Shown.CLASSES}) & whole(f),
    ("task", "system", "measured", "asked", "unread", "chance"),
)
"""Before all else where it was asked."""
TABLES: tuple[Table, ...] = (
    Table(
        "understanding",
        "Physical understanding",
        "Questions about what was touched, with descriptions before the conclusion (OPD) and without.",
        _variants("opd", described=False, trained=True),
        PAPER,
        folded=False,
    ),
    Table(
        "reasoning",
        "Scenario reasoning",
        "Which of two objects fits a scenario: asked of every system, never trained.",
        _variants("opd", described=False, trained=False),
        PAPER,
        folded=False,
    ),
    Table(
        "description",
        "Object property description",
        "Describing one object, as a language model's answer and by the encoder's property heads on the same videos.",
        lambda f: _variants(described=True)(f) | f["task"].eq(HEADS),
        PROPERTIES,
        folded=False,
    ),
    *(
        Table(
            f"{axis}_{kind}",
            f"Ablation of {name}: {title}",
            caption,
            _ablated(axis, described=kind == "properties"),
            columns,
            folded=False,
        )
        for axis, name, caption in (
            (
                "encoder",
                "the encoder",
                "The tactile encoder fine-tuned on properties, or as it was before. Told in words, a language model is "
                "trained and asked with the classes of the fine-tuned one's heads as text, and reads no touch.",
            ),
            ("lora", "LoRA", "With end-to-end fine-tuning of the language model, or after alignment alone."),
        )
        for kind, title, columns in (
            ("properties", "property description", PROPERTIES),
            ("understanding", "understanding and reasoning", PAPER),
        )
    ),
    Table(
        "effects",
        "What each part brings",
        "The full system minus the system that lacks one part, on the same questions. p is of a test by sign flips "
        "over objects; p, Holm is corrected for all comparisons of the report.",
        lambda f: f["part"] != "touch",
        ("part", "change", "task", "measure", "difference", "p", "p_holm", "smallest", "n", "objects", "seeds"),
        source="effects",
        folded=False,
    ),
    Table(
        "touch_effects",
        "Is touch used?",
        "What the full system loses where its touch is replaced. No loss means that answers do not depend on touch.",
        lambda f: f["part"] == "touch",
        ("change", "task", "measure", "difference", "p", "p_holm", "smallest", "n", "objects", "seeds"),
        source="effects",
    ),
    Table(
        "touch",
        "Input ablations",
        "The full system with its touch, and with another object's (swapped), none (removed) or noise.",
        lambda f: ~f["task"].isin(NOT_ANSWERED) & whole(f) & _differs(f),
        ("task", "touch", "measured", "asked", "chance", "unread"),
    ),
    Table(
        "variants",
        "All variants",
        "Every combination of encoder, LoRA and OPD that was trained.",
        lambda f: answers(f) & whole(f),
        ("task", "encoder", "lora", "opd", "measured", "asked", "chance", "unread", "published"),
    ),
    Table(
        "strict",
        "How answers are read",
        "Measured: by rules. As published: the right text must stand there. Scenarios were graded by hand.",
        lambda f: answers(f) & _differs(f, *FULL) & f["strict"].notna(),
        ("task", "measure", "system", "measured", "strict", "asked"),
    ),
    Table(
        "heads",
        "Property heads of the tactile encoder",
        "What the encoder's heads say of test and validation videos, without a language model.",
        lambda f: f["task"].isin((HEADS, VALIDATION_HEADS)),
        ("task", "measure", "encoder", "measured", "asked", "chance", "published"),
    ),
    Table(
        "recall",
        "Recall of the property heads",
        "Of the test videos of each class, the share that the heads take for it; figures/confusion.png has the others.",
        lambda f: f["task"].eq(RECALL),
        ("measure", "measured", "asked", "chance"),
    ),
    Table(
        "cross_validation",
        "Encoders and baselines over all objects",
        "Grouped cross-validation: a model judges only videos of objects that it never saw. With few test objects this "
        "is the main evidence about encoders. backbone-10: learnt from ten objects a fold.",
        lambda f: f["task"].eq(CROSS_VALIDATION),
        ("measure", "system", "measured", "asked", "chance"),
    ),
    Table(
        "adjectives",
        "Adjective by adjective",
        "The full system's comparisons and superlatives, and what follows by rule, counted by the word asked by: "
        "whether a property, or a direction of it, is the harder one.",
        lambda f: f["task"].eq(ADJECTIVES),
        ("measure", "system", "measured", "asked", "chance"),
    ),
    Table(
        "neighbours",
        "What embeddings tell by themselves",
        "Of the test videos, the share whose nearest neighbour among other objects' videos has their class, by the "
        "embeddings of the fine-tuned encoder and of the base one (mean over frames); then those of each class alone, "
        "which say what the map shows: classes that overlap have few of their own about them. Paired differences are "
        "in encoder_effects.csv.",
        lambda f: f["task"].eq(NEIGHBOURS),
        ("measure", "encoder", "measured", "asked", "chance"),
    ),
)

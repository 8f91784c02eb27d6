"""The tables of a report: each an entry in tables.yaml, a selection of scores.csv or effects.csv.

A newly registered task is in all that its kind belongs to, without a change here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from pipeline.core.records import TouchInput
from pipeline.evaluation.records import ADAPTED, Shown
from pipeline.evaluation.rows import ALL_SEEDS, HEADS, RECALL, VALIDATION_HEADS
from pipeline.report.load import DATASET, DATASETS, KEYS, Report, published
from pipeline.report.render import WORDS, Block
from pipeline.tasks import TASKS

FULL = {"encoder": "finetuned", "lora": "with", "opd": "all"}
CHOICE, COMBINED = "choice", "combined"
PUBLISHED_MODELS = ("7b", "13b", "CLIP", "PG-InstructBLIP")


@dataclass(frozen=True)
class Table:
    """One table, as tables.yaml has it and says what its entries mean."""

    key: str
    title: str
    caption: str
    rows: str
    columns: list[str]
    source: str = "scores"
    varied: str = ""
    open: bool = False

    def build(self, report: Report) -> pd.DataFrame:
        """The table as it is shown: text in every cell, headings as column names; no row where nothing was measured.

        Rows are in the order of tasks, measures and systems. What is published is joined by `KEYS`, in columns of their
        own.
        """
        frame = report.effects if self.source == "effects" else marked(over_seeds(report.scores))
        rows = ordered(frame.query(self.rows, engine="python"))
        if self.varied and rows.loc[rows["by"] == "model", self.varied].nunique() < 2:
            rows = rows.iloc[:0]
        if self.key == "shipped":  # They are full systems, too.
            rows = rows.assign(moves=moves(report.scores, rows))
        shown: dict[str, list[str]] = {}
        for name in self.columns:
            if name == "published":
                full = rows.assign(**FULL).where(rows["touch"] == Shown.TOUCH, rows) if self.key == "shipped" else rows
                shown |= _beside(full, report.published)
            elif name != "moves" or rows["moves"].any():
                heading, cell = COLUMNS[name]
                shown[heading] = [cell(row) for row in rows.to_dict("records")]
        return pd.DataFrame(shown, index=rows.index, dtype=object)

    def block(self, report: Report) -> Block | None:
        """The table with its words; None where it has no row."""
        frame = self.build(report)
        return Block(self.key, self.title, self.caption, frame, f"{self.source}.csv", self.open) if len(frame) else None


def over_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """The rows of scores.csv that are over all seeds."""
    return scores[scores["seed"] == ALL_SEEDS]


def marked(scores: pd.DataFrame) -> pd.DataFrame:
    """Rows of scores.csv with the columns by which tables choose among them.

    `by` says what answered: the language model given real touch (`model`) or an input ablation (`other touch`), `rules`
    on the heads' classes, the `shipped` model, a `vision`-only model, or the task's name where nothing was answered.
    `lacks` names the axes on which a variant differs from the full system, or `needed` for that OPD mode, which the
    paper's tables lack. `whole`: whether the measure is about the whole answer; `trained`: whether the task is trained;
    `rated`: by how many rated objects a model was adapted, NaN where none was.
    """

    def by(task: str, lora: str, touch: str) -> str:
        if task in WORDS["tasks"]:
            return task
        if touch == TouchInput.REAL:
            return "model" if lora else "rules"
        return "vision" if touch in WORDS["shown"] else "shipped" if touch in {*Shown} else "other touch"

    def lacks(*axes: str) -> str:
        own = zip(FULL.items(), axes, strict=True)
        return " ".join("needed" if value == "needed" else axis for (axis, full), value in own if value != full)

    untrained = [name for name, task in TASKS.items() if not task.trained]
    return scores.assign(
        by=[*map(by, scores["task"], scores["lora"], scores["touch"])],
        lacks=[*map(lacks, *(scores[axis] for axis in FULL))],
        whole=scores["measure"].isin({CHOICE, COMBINED, *(task.measure for task in TASKS.values())}),
        trained=~scores["task"].isin(untrained),
        rated=scores["encoder"].str.extract(rf"{ADAPTED}(\d+)$", expand=False).astype(float),
    )


def moves(scores: pd.DataFrame, rows: pd.DataFrame) -> list[str]:
    """Of rows over all seeds, the lowest and highest accuracy of one seed; nothing where there is only one."""
    own = scores[scores["seed"] != ALL_SEEDS].groupby([*KEYS, "touch"])["accuracy"]
    found = own.agg(["min", "max", "count"]).to_dict("index")
    sets = [found[tuple(row)] for row in rows[[*KEYS, "touch"]].itertuples(index=False, name=None)]
    return [f"{100 * s['min']:.1f} to {100 * s['max']:.1f} ({s['count']})" if s["count"] > 1 else "" for s in sets]


def headline(scores: pd.DataFrame) -> pd.DataFrame:
    """The full system's rows of scores.csv, a row a task that was asked."""
    return ordered(marked(over_seeds(scores)).query("whole and by == 'model' and lacks == ''"))


def ordered(frame: pd.DataFrame) -> pd.DataFrame:
    """Tasks in the registry's order, whole answers before parts, the full system before what lacks something."""
    tasks = {task: place for place, task in enumerate((*TASKS, *WORDS["tasks"]))}
    rank = pd.DataFrame({"task": frame["task"].map(lambda task: tasks.get(task, len(tasks)))}, index=frame.index)
    rank["measure"] = frame["measure"] != COMBINED
    rank["named"] = pd.factorize(frame["measure"])[0]
    rank["rated"] = frame["rated"].fillna(-1) if "rated" in frame else -1
    for axis in FULL:
        rank[axis] = frame[axis] != FULL[axis] if axis in frame else False
    return frame.loc[rank.sort_values(list(rank.columns), kind="stable").index]


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
        rows = printed[printed["model"].isin(PUBLISHED_MODELS)].assign(touch=str(TouchInput.REAL))
        if not len(printed) and not every and any(map(len, about.values())):
            # Nothing is published about such data: below the paper's rows stand the reports' own.
            rows = pd.concat([headline(r.scores) for r in reports.values() if r.provenance["dataset"] == dataset])
        rows = rows.drop_duplicates(place)
        rows = ordered(rows if every else marked(rows).query("whole and lacks == ''"))
        other = "" if dataset == DATASET else f", {dataset}"
        shown = {"Task": [task_title(task) + other for task in rows["task"]]}
        if every:
            named = [(row, COLUMNS["measure"][1](row)) for row in rows.to_dict("records")]
            shown["System"] = [system(row) + (f": {part}" if part != CHOICE else "") for row, part in named]
        shown |= _beside(rows, printed)
        for name, report in reports.items():
            same = over_seeds(report.scores).to_dict("records") if report.provenance["dataset"] == dataset else []
            known = {tuple(row[k] for k in place): f"{measured(row)} ({row['n']:.0f})" for row in same}
            keys = rows[place].itertuples(index=False, name=None)
            shown[f"Measured {name} % [95 %] (n)"] = [known.get(key, "") for key in keys]
        blocks.append(pd.DataFrame(shown, dtype=object))
    table = pd.concat(blocks, ignore_index=True).fillna("")
    table = table.loc[:, (table != "").any()]  # Without a report that has none of these rows.
    return table[sorted(table, key=lambda name: name.startswith("Measured"))]


def _beside(rows: pd.DataFrame, published: pd.DataFrame) -> dict[str, list[str]]:
    """The published cells of these rows, a column a model that has any."""
    columns = {}
    for model in PUBLISHED_MODELS:
        cells = rows[[*KEYS]].merge(published[published["model"] == model], "left", [*KEYS])
        if cells["value"].notna().any():
            both = zip(cells["value"], cells["n"], strict=True)
            columns[f"Published {model} % (n, ~ inferred)"] = ["" if pd.isna(v) else f"{v:.2f} ({n})" for v, n in both]
    return columns


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
    return f"{TASKS[task].title} ({task})" if task in TASKS else WORDS["tasks"].get(task, task)


def told(task: str) -> str:
    """What rules on the heads' classes are told of a task's questions, and the language model is not."""
    return f", {TASKS[task].told}" if task in TASKS and TASKS[task].told else ""


def system(row: dict[str, Any]) -> str:
    """A variant by what it leaves out of the full system; another model by its name."""
    task, encoder, touch = row["task"], row["encoder"], row["touch"]
    others: dict[str, str] = {
        Shown.TOUCH: f"{encoder}, as it is",
        Shown.CLASSES: f"its heads and rules alone{told(task)}",
        **{shown: f"{encoder}, {words}" for shown, words in WORDS["shown"].items()},
    }
    if ADAPTED in encoder:
        others |= {Shown.TOUCH: encoder.partition(ADAPTED)[0]}
    if touch in others:
        return others[touch]
    if task in (HEADS, VALIDATION_HEADS, RECALL):
        return "property heads, no language model"
    if not row["lora"]:
        return f"heads and rules, no language model{told(task)}"
    words = [WORDS["lacks"][row[axis]] for axis in FULL if row[axis] in WORDS["lacks"]]
    return ", ".join(words) or "Octopi (full system)"


COLUMNS: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "task": ("Task", lambda row: task_title(row["task"])),
    "measure": ("Measure", lambda row: "all properties right" if row["measure"] == COMBINED else row["measure"]),
    "system": ("System", system),
    "rated": ("Rated objects", lambda row: number(row["rated"], 0)),
    "encoder": ("Encoder", lambda row: str(WORDS["encoders"].get(row["encoder"], row["encoder"]))),
    "lora": ("LoRA", itemgetter("lora")),
    "opd": ("OPD", itemgetter("opd")),
    "touch": ("Touch", itemgetter("touch")),
    "measured": ("Measured % [95 %]", measured),
    "moves": ("From set to set % (sets)", itemgetter("moves")),
    "strict": ("As published %", lambda row: number(row["strict"], scale=100)),
    "chance": ("Chance %", lambda row: number(row["chance"], scale=100)),
    "unread": ("Unread %", lambda row: number(row["unread"] / row["n"], scale=100)),
    "part": ("Part", itemgetter("part")),
    "change": ("Change", lambda row: row["change"] + (told(row["task"]) if row["part"] == "language" else "")),
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

_ENTRIES = yaml.safe_load(Path(__file__).with_name("tables.yaml").read_text(encoding="utf-8"))
FIVE_TASKS, SHIPPED_TABLE, *TABLES = [Table(key, **entry) for key, entry in _ENTRIES.items()]
"""A report's first table, two rows per task that was asked; the table that stands before it where the shipped model was
asked; the others."""

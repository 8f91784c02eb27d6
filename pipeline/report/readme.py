"""README.md of a report: the finding first, then what it stands on, then the paper's tables, in at most 150 lines.

Every sentence is put together by rule from the report's own files; those about its origin stand in templates/*.md.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import pandas as pd

from pipeline.core.errors import counted
from pipeline.core.records import Shown, Touch
from pipeline.report.load import Report
from pipeline.report.render import Block, render, size
from pipeline.report.tables import FIVE_TASKS, PARTS, SHIPPED_TABLE, SHOWN_WORDS, TABLES, headline, measured, number
from pipeline.weights import is_random

MOST_LINES = 150
CHANCE = (
    "The base models are tiny and random, drawn from a seed and taught nothing: these figures are chance and prove "
    "only that the chain runs."
)
PLUMBING = "The chain's own models at this scale are random ones: a test of the plumbing"
ALPHA = 0.05
VICUNA = 5e9
"""Parameters below which a language model is no Vicuna 7b."""
OTHER_MODELS = (
    "Published figures are the paper's, of Octopi with Vicuna 7b and 13b (and of CLIP ViT-L/14 where no language model "
    "answers): other models on other questions about other objects. They are no target that was met or missed."
)


def render_readme(report: Report, figures: Sequence[str]) -> str:
    """The text of README.md; `figures` are names of the files in figures/ that were drawn."""
    told, shown, text = sections(report), list[Block](), ""
    files = [p.name for pattern in ("*.csv", "samples.json") for p in sorted(report.folder.glob(pattern))]
    # Each table that still fits in, and the names of the others.
    for table in [None, *(table for table in told["tables"] if table.open)]:
        more = [*shown, table] if table else []
        elsewhere = [other.title for other in told["tables"] if other.key not in {block.key for block in more}]
        longer = render("readme.md", **told, shown=more, elsewhere=elsewhere, figures=figures, files=files)
        if not text or longer.count("\n") <= MOST_LINES:
            text, shown = longer, more
    return text


def sections(report: Report) -> dict[str, Any]:
    """What the README and the page say of a report.

    Returns:
        `name`; `shipped`, how the shipped model answers about the run's videos, and `tasks`, the full system's answers:
        a `Block` each, or None; `tables`, the other blocks of the registry; `finding`; `plumbing`, a warning where a
        base model is a random one; `looked_at`, how recipes were chosen by the test objects, if these are the
        development split's; `other_models`, where published figures stand beside; `stands_on`, what a figure is worth:
        models with their size, test objects, seeds; `beyond`, the settings that its last fact counts; `origin`:
        command, commit, data, base models by hash, packages.
    """
    said, shipped, tasks = report.provenance, SHIPPED_TABLE.block(report), FIVE_TASKS.block(report)
    if shipped:
        rows = SHIPPED_TABLE.select(report)
        against = _against_chance(rows[rows["touch"] == Shown.TOUCH], f"`{rows['encoder'].iloc[0]}`'s")
        shipped = shipped._replace(caption=f"{shipped.caption} {against}")
    if tasks:
        # The table of the first screen says whose figures these are in its heads.
        heads = tasks.frame.columns.str.replace(
            "Measured", f"Measured here ({size(said['base_models']['language']['parameters'])} model)"
        )
        tasks.frame.columns = heads.str.replace(r"Published (\d+b)", r"Published (Vicuna \1)", regex=True)
    return {
        "name": report.folder.name,
        "shipped": shipped,
        "tasks": tasks,
        "tables": [block for table in TABLES if (block := table.block(report))],
        "finding": finding(report),
        "plumbing": PLUMBING if at_random(said) else "",
        "looked_at": said["settings"] if said["split"] == "development" else "",
        "other_models": OTHER_MODELS if len(report.published) else "",
        "stands_on": render("stands_on.md", said=said, shown=SHOWN_WORDS).splitlines(),
        "beyond": render("beyond.md", said=said).strip(),
        "origin": render("origin.md", said=said).splitlines(),
    }


def finding(report: Report) -> list[str]:
    """Three paragraphs: what made the figures; how far from chance; whether touch is used and what parts bring.

    Where a base model is a random one, the first sentence says so.
    """
    rows, effects = headline(report.scores), report.effects
    solved = set(rows.loc[rows["low"] > rows["chance"], "task"])
    chance = CHANCE if at_random(report.provenance) else ""
    who = render("who.md", said=report.provenance, vicuna=VICUNA).strip()
    of = effects["part"].where(effects["part"].isin(("touch", "language")), "parts")
    rest = (
        _touch(effects[of == "touch"], solved, _impossible(effects)),
        _rules(effects[of == "language"]),
        _parts(effects[of == "parts"], solved, _impossible(effects)),
    )
    return [" ".join(filter(None, sentences)) for sentences in ((chance, who), (_against_chance(rows),), rest)]


def at_random(said: dict[str, Any]) -> bool:
    """Whether a base model is a random one, so that figures are chance."""
    return any(is_random(model["folder"]) for model in said["base_models"].values())


def _against_chance(rows: pd.DataFrame, whose: str = "The full system's") -> str:
    """In which tasks the interval lies above or below chance, and where accuracy is farthest from it."""
    if not len(rows):
        return "No answer of the full system was graded."
    over = rows["accuracy"] - rows["chance"]
    above, below = (rows.loc[side, "task"] for side in (rows["low"] > rows["chance"], rows["high"] < rows["chance"]))
    text = f"{whose} interval lies above chance in {len(above)} of {counted(len(rows), 'task')}"
    text += f" ({', '.join(above)})" if len(above) else ""
    text += f" and below it in {', '.join(below)}" if len(below) else ""
    # Nothing is best that is no better than a guess.
    if len(rows) > 1 and over.max() > 0:
        extremes = (
            f"{kind} in {row['task']} with {measured(row.to_dict())} % (chance {number(row['chance'], scale=100)})"
            for kind, row in (("best", rows.loc[over.idxmax()]), ("worst", rows.loc[over.idxmin()]))
        )
        text += f". Against chance it is {' and '.join(extremes)}"
    return f"{text}."


def _touch(rows: pd.DataFrame, solved: Collection[str], impossible: str) -> str:
    """Whether answers use touch. In a task no better than chance (not in `solved`) a difference cannot show it.

    Nor can one from touch that was removed: answers may need frames, and be the same with another object's. Without
    touch they may also lose their form; unreadable ones count as wrong, which makes a difference of its own.
    """
    if not len(rows):
        return "Whether answers depend on touch was not tested."
    *others, last = instead = [change.partition(" - ")[2] for change in dict.fromkeys(rows["change"])]
    named = f"{', '.join(others)} or {last}" if others else last
    fact = f"with real touch, against touch that was {named}, accuracy differs by {_span(rows)}, task by task"
    change = f"real - {Touch.SWAPPED if Touch.SWAPPED in instead else Touch.NOISE}"
    better = rows[(rows["p_holm"] < ALPHA) & (rows["difference"] > 0)]
    shown, tasks = {*better.loc[better["change"] == change, "task"]}, dict.fromkeys(better["task"])
    sure = ", ".join(task for task in tasks if task in solved and task in shown)
    needed = ", ".join(task for task in tasks if task in solved and task not in shown)
    likely = rows[(rows["low"] > 0) & rows["task"].isin(solved) & (rows["change"] == change)]
    frames = f" In {needed} answers need frames; that they depend on which touch is not shown." if needed else ""
    if sure:
        rest = " and ".join(task for task in tasks if task not in solved)
        none = f" In {rest} real touch brings no more than chance, so the difference shows nothing."
        return f"Answers use touch in {sure}: {fact}.{none if rest else ''}{frames}"
    if len(likely):
        of = f"{len(likely)} of {rows['change'].eq(change).sum()} intervals of `{change}` lie above 0"
        return f"Answers may use touch: {fact}; {of}, none is significant after Holm's adjustment{impossible}.{frames}"
    none = ", none significant after Holm's adjustment where real touch brings more than chance"
    return f"That answers use touch is not shown: {fact}{'' if needed else none}{impossible}.{frames}"


def _span(rows: pd.DataFrame) -> str:
    return f"{100 * rows['difference'].min():+.1f} to {100 * rows['difference'].max():+.1f} points"


def _impossible(effects: pd.DataFrame) -> str:
    """A note where too few objects rule out significance: the p of a sign-flip test is at least 2 / 2**objects, and
    Holm's adjustment multiplies the smallest p by the number of tests."""
    objects = effects["objects"].max()
    few = effects["p"].count() * 2.0 ** (1 - objects) >= ALPHA
    return f" ({objects:.0f} objects are too few for that)" if few else ""


def _rules(rows: pd.DataFrame) -> str:
    """The full system compared with plain rules on its encoder's heads, without a language model."""
    if not len(rows):
        return ""
    sure = rows[rows["p_holm"] < ALPHA]
    sides = {"ahead": sure.loc[sure["difference"] > 0, "task"], "behind": sure.loc[sure["difference"] < 0, "task"]}
    said = [f"{side} in {', '.join(tasks)}" for side, tasks in sides.items() if len(tasks)]
    return (
        "The encoder's property heads and plain rules answer the same questions without a language model; the full "
        f"system differs from them by {_span(rows)}, task by task, and is "
        f"{' and '.join(said) or 'in no task ahead or behind'} (Holm)."
    )


def _parts(rows: pd.DataFrame, solved: Collection[str], impossible: str) -> str:
    """What encoder, LoRA and OPD bring; a gain that only reaches chance is one of form, not of right answers."""
    if not len(rows):
        return ""
    form = rows["difference"].gt(0) & ~rows["task"].isin(solved)
    parts = rows["part"].replace(PARTS)
    gains = parts + " in " + rows["task"] + (100 * rows["difference"]).map(" {:+.1f}".format)
    words, only = (", ".join(gains[rows["p_holm"].lt(ALPHA) & kind]) for kind in (~form, form))
    *others, last = dict.fromkeys(parts)
    all_of_them = f"{len(rows)} effects of {', '.join(others)}{' and ' if others else ''}{last}"
    also = f" Significant too, but answers are no better than chance even so: {only} points." if only else ""
    if words:
        return f"Of {all_of_them} these hold up (Holm): {words} points.{also}"
    if only:
        return f"None of {all_of_them} holds up.{also}"
    smallest, found = rows["smallest_effect"].min(), ""
    if smallest <= 1:
        least = f"{100 * smallest:.0f} points"
        found = f"; before it, the smallest effect that any of them detects with 80 % power is {least}"
    return f"None of {all_of_them} is significant after Holm's adjustment{impossible or found}."

"""README.md of a report: the finding first, then what it stands on, then the paper's tables.

Its sentences stand in templates/*.md and are filled in from the report's own files.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.report.load import Report
from pipeline.report.render import WORDS, render, size
from pipeline.report.tables import FIVE_TASKS, SHIPPED_TABLE, TABLES, headline
from pipeline.weights import is_random

ALPHA = 0.05
VICUNA = 5e9
"""Parameters below which a language model is no Vicuna 7b."""


def render_readme(report: Report, figures: Sequence[str]) -> str:
    """The text of README.md; `figures` are names of the files in figures/ that were drawn."""
    told = sections(report)
    files = [p.name for pattern in ("*.csv", "samples.json") for p in sorted(report.folder.glob(pattern))]
    return render("readme.md", **told, figures=figures, files=files)


def sections(report: Report) -> dict[str, Any]:
    """What the README and the page say of a report.

    Returns:
        `name`; `trained`, whether the run has models of its own; `shipped`, how models that were trained before answer
        about its videos, and `tasks`, the full system's answers: a `Block` each, or None; `tables`, the other blocks of
        the registry; `finding`; `plumbing`, a warning where a base model is a random one; `other_models`, where
        published figures stand beside; `stands_on`, what a figure is worth: models with their size, test objects,
        seeds; `beyond`, the settings that its last fact counts; `origin`: command, hash of the code, data, models by
        hash, packages.
    """
    said, shipped = report.provenance, SHIPPED_TABLE.block(report)
    trained = bool(said["base_models"])
    tasks = FIVE_TASKS.block(report) if trained else None
    if trained and shipped:  # The paper's figures stand beside the models of this run.
        shipped.frame.drop(columns=[c for c in shipped.frame if c.startswith("Published")], inplace=True)
    if tasks:
        # The table of the first screen says whose figures these are in its heads.
        heads = tasks.frame.columns.str.replace(
            "Measured", f"Measured here ({size(said['base_models']['language']['parameters'])} model)"
        )
        tasks.frame.columns = heads.str.replace(r"Published (\d+b)", r"Published (Vicuna \1)", regex=True)
    return {
        "name": report.folder.name,
        "trained": trained,
        "shipped": shipped,
        "tasks": tasks,
        "tables": [block for table in TABLES if (block := table.block(report))],
        "finding": finding(report),
        "plumbing": WORDS["plumbing"] if at_random(said) else "",
        "other_models": WORDS["other_models" if trained else "other_questions"] if len(report.published) else "",
        "stands_on": render("stands_on.md", said=said, shown=WORDS["shown"]).splitlines(),
        "beyond": render("beyond.md", said=said).strip(),
        "origin": render("origin.md", said=said).splitlines(),
    }


def finding(report: Report) -> list[str]:
    """Three paragraphs: what made the figures; in which tasks they differ from chance; which differences hold up.

    A gain in a task that is no better than chance even so is one of form, not of right answers, and is left out.
    """
    rows, effects = headline(report.scores), report.effects
    above = rows.loc[rows["low"] > rows["chance"], "task"]
    sure = effects[(effects["p_holm"] < ALPHA) & (effects["difference"].lt(0) | effects["task"].isin(above))]
    # The p of a sign-flip test is at least 2 / 2**objects, and Holm's adjustment multiplies it by the number of tests.
    few = effects["p"].count() * 2.0 ** (1 - effects["objects"].max()) >= ALPHA
    text = render(
        "finding.md",
        said=report.provenance,
        at_random=at_random(report.provenance),
        vicuna=VICUNA,
        tasks=len(rows),
        above=list(above),
        below=list(rows.loc[rows["high"] < rows["chance"], "task"]),
        effects=effects.assign(part=effects["part"].replace(WORDS["parts"])).to_dict("records"),
        sure=sure.to_dict("records"),
        few=effects["objects"].max() if few else 0,
    )
    return text.strip().split("\n\n")


def at_random(said: dict[str, Any]) -> bool:
    """Whether a base model is a random one, so that figures are chance."""
    return any(is_random(model["folder"]) for model in said["base_models"].values())

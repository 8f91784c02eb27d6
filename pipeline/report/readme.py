"""README.md of a report: the finding first, then what it stands on, then the paper's tables, in at most 150 lines.

Every sentence is put together by rule from the report's own files.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import pandas as pd

from pipeline.core.records import Shown
from pipeline.report.load import Report
from pipeline.report.tables import (
    FIVE_TASKS,
    SHIPPED_TABLE,
    SHOWN_WORDS,
    TABLES,
    headline,
    measured,
    number,
    ordered,
)
from pipeline.weights import is_tiny

MOST_LINES = 150
MOST_NAMED = 12
"""Test objects that are named; dataset.csv has all."""
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
WORDS = {"lora": "LoRA", "opd": "OPD"}


def render_readme(report: Report, figures: Sequence[str]) -> str:
    """The text of README.md; `figures` are names of the files in figures/ that were drawn."""
    said = report.provenance
    # Figures that are no evidence are no headline.
    spoilt = [f"## On test objects that were looked at\n\n{said['settings']}\n"] if looked_at(said) else []
    tasks = [five_tasks(report), *([f"{OTHER_MODELS}\n"] if len(report.published) else []), *_pictures(figures)]
    first = shipped_first(report)
    own = ["\n\n".join(finding(report)) + "\n", *([] if spoilt else tasks)]
    sections = [
        f"# {report.name}: what was measured\n",
        *([first] if first else []),
        *([f"<details><summary>{PLUMBING}</summary>\n", *own, "</details>\n"] if first and at_random(said) else own),
        "## What the figures stand on\n\n" + "".join(f"- {fact}\n" for fact in stands_on(said)),
        "## Where it comes from\n\n" + "".join(f"- {fact}\n" for fact in origin(said)),
        *([*spoilt, *tasks] if spoilt else []),
    ]
    lines = "\n".join(sections).count("\n") + 1
    elsewhere = []
    for table in TABLES:
        shown = table.build(report.scores, report.effects, report.published)
        text = f"## {table.title}\n\n{table.caption}\n\n{markdown(shown)}"
        if not table.folded and len(shown) and lines + text.count("\n") + 6 <= MOST_LINES:
            sections.append(text)
            lines += text.count("\n") + 1
        elif len(shown):
            elsewhere.append(table.title)
    more = f"On the page [index.html](../index.html): {'; '.join(elsewhere)}.\n" if elsewhere else ""
    files = (path.name for pattern in ("*.csv", "samples.json") for path in sorted(report.folder.glob(pattern)))
    links = ", ".join(f"[{name}]({name})" for name in files)
    return "\n".join([*sections, f"## More\n\n{more}All figures: {links}."]) + "\n"


def shipped_first(report: Report) -> str:
    """How the shipped model answers about the run's videos, with its table; empty where it was not asked."""
    rows = ordered(report.scores[SHIPPED_TABLE.rows(report.scores)])
    if not len(rows):
        return ""
    name, table = rows["encoder"].iloc[0], SHIPPED_TABLE.build(report.scores, report.effects, report.published)
    said = " ".join(_against_chance(rows[rows["touch"] == Shown.TOUCH], f"`{name}`'s"))
    return f"## {SHIPPED_TABLE.title}\n\n{SHIPPED_TABLE.caption} {said}\n\n{markdown(table)}"


def finding(report: Report) -> list[str]:
    """Three paragraphs: what made the figures; how far from chance; whether touch is used and what parts bring.

    Where a base model is a random one, the first sentence says so.
    """
    rows = headline(report.scores)
    solved = set(rows.loc[rows["low"] > rows["chance"], "task"])
    rest = [*_touch(report.effects, solved), *_rules(report.effects), *_parts(report.effects, solved)]
    return [" ".join(sentences) for sentences in (_who(report), _against_chance(rows), rest)]


def looked_at(said: dict[str, Any]) -> bool:
    """Whether the test objects are those of the development split, which recipes were chosen by."""
    return bool(said["split"] == "development" and said["settings"])


def at_random(said: dict[str, Any]) -> bool:
    """Whether a base model is a random one, so that figures are chance."""
    return any(is_tiny(model["folder"]) for model in said["base_models"].values())


def five_tasks(report: Report) -> str:
    """The table of the first screen: a row a task, the full system."""
    shown = FIVE_TASKS.build(report.scores, report.effects, report.published)
    size = size_words(report.provenance["base_models"]["language"]["parameters"])
    shown["Measured % [95 %]"] = "**" + shown["Measured % [95 %]"] + "**"
    shown.columns = shown.columns.str.replace("Measured", f"Measured here ({size} model)")
    shown.columns = shown.columns.str.replace(r"Published (\d+b)", r"Published (Vicuna \1)", regex=True)
    return markdown(shown) if len(shown) else "No answer of the full system was graded.\n"


def stands_on(said: dict[str, Any]) -> list[str]:
    """What a figure is worth: models with their size, test objects, seeds, whether they were looked at before."""
    language, encoder = said["base_models"]["language"], said["base_models"]["encoder"]
    objects = said["test_objects"]
    named = f" ({', '.join(objects)})" if 0 < len(objects) <= MOST_NAMED else ""
    facts = [
        f"**Language model:** {model_words(language)}.",
        f"**Tactile encoder:** {said['encoder']}. Base encoder of the ablation: {model_words(encoder)}.",
        f"**Test objects:** {len(objects)}{named}, {said['test_videos']} videos, split `{said['split']}`.",
        f"**Seeds:** {len(said['seeds'])} ({', '.join(map(str, said['seeds']))}).{_folds(said)}",
        f"**Chosen on these objects before?** {said['settings'] or 'Nothing is noted in pipeline/report/notes.yaml.'}",
        "**Intervals** are Wilson's with the effective number of questions, since questions share objects. "
        f"{said['intervals']}".rstrip(),
    ]
    if said["facts_told"]:
        facts.append(
            "**Matching questions** say what the named objects are like: they ask for touch, not for knowledge."
        )
    if beyond := said.get("beyond_paper"):
        settings = ", ".join(f"`{key}={value}`" for key, value in beyond.items())
        facts.append(f"**Trained in ways that the paper has not**, for a small model (docs/language.md): {settings}.")
    return facts + [vision_words(source) for source in said.get("vision", ())]


def vision_words(source: dict[str, Any]) -> str:
    """A vision-only model: what it was shown, where and when it was asked, how its replies ended."""
    served = ", ".join(name for name in source["served_as"] if name not in ("", source["model"]))
    named = f"`{source['model']}`{f' (there {served})' if served else ''} at `{source['endpoint']}`"
    ended = ", ".join(f"{how} {count}" for how, count in source["ended"].items())
    return (
        f"**Vision alone:** {named} saw up to {source['per_video']} {SHOWN_WORDS[source['shown']]} in place of each "
        f"video ({source['first']} to {source['last']}, temperature {source['temperature']:g}). It was told the "
        f"classes and, where a task is trained, up to three training questions. How its replies ended: {ended}."
    )


def origin(said: dict[str, Any]) -> list[str]:
    """Command, commit, data, base models by hash, packages."""
    models = said["base_models"].values()
    changed = " with uncommitted changes" if said["changed"] else ""
    return [
        f"`{said['command']}` with [params.yaml](params.yaml) at commit `{said['commit'][:12]}`{changed}",
        f"data: {said['videos']} videos ({said['source']}, {said['dataset'] or 'unnamed catalogue'}), sha256 "
        f"`{said['data_sha256'][:16]}` over their hashes",
        "base models: " + ", ".join(f"`{m['folder']}` sha256 `{m['sha256'][:16]}`" for m in models),
        f"Python {said['python']}; " + ", ".join(f"{name} {version}" for name, version in said["packages"].items()),
        "in full: [provenance.json](provenance.json)",
    ]


def model_words(model: dict[str, Any]) -> str:
    """A base model as a person would name it, such as "a 2.1 M-parameter Llama, trained on ..."."""
    taught = model["taught"] or "what it was taught is not noted here"
    return f"`{model['folder']}`, a {size_words(model['parameters'])} {model['kind']}, {taught}"


def size_words(parameters: int) -> str:
    """A number of parameters in words, such as "2.1 M-parameter"."""
    if not parameters:
        return "model of unknown size:"
    value, unit = next(
        (parameters / u, name) for u, name in ((1e9, "B"), (1e6, "M"), (1e3, "k"), (1, "")) if parameters >= u
    )
    return f"{value:.1f} {unit}-parameter"


def markdown(frame: pd.DataFrame) -> str:
    """A table in Markdown, of cells that are text; bars in cells are escaped."""
    rows = [list(frame.columns), ["---"] * len(frame.columns), *frame.to_numpy().tolist()]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |\n" for row in rows)


def _who(report: Report) -> list[str]:
    said = report.provenance
    language = said["base_models"]["language"]
    maker = f"A {size_words(language['parameters'])} {language['kind']}"
    maker += f", {language['taught']}," if language["taught"] else ""
    maker += " made these figures"
    maker += " in place of the paper's Vicuna" if language["parameters"] < VICUNA else ""
    if start := said.get("beyond_paper", {}).get("language.start"):
        maker += f"; its training went on from `{start.rpartition('/')[2]}`, which was trained before"
    clip = said["base_models"]["encoder"]
    encoder = said["encoder"].replace("the base CLIP", f"a {size_words(clip['parameters'])} {clip['kind']}")
    source = {"scenes": "synthetic", "videos": "real"}.get(said["source"], "")
    objects, seeds = _count(len(said["test_objects"]), "test object"), _count(len(said["seeds"]), "seed")
    under = f"under {seeds}"
    if folds := said.get("folds"):
        tested = len(folds["tested"])
        under = f"each of them in one of {tested} folds that were" if tested > 1 else "all of them in one fold that was"
        under += " not trained on"
        under += f", {said['replicates']} times" if said["replicates"] > 1 else ""
        if left := folds["of"] - len(folds["tested"]):
            under += f" ({left} of {folds['of']} folds {'is' if left == 1 else 'are'} still to be run)"
    about = f"Its tactile encoder was {encoder}; it answered about {source} videos of {objects}, {under}."
    chance = [CHANCE] if at_random(said) else []
    return [*chance, f"{maker}.", about, *([said["settings"]] if said["settings"] else [])]


def _against_chance(rows: pd.DataFrame, whose: str = "The full system's") -> list[str]:
    if not len(rows):
        return ["No answer of the full system was graded."]
    over = rows["accuracy"] - rows["chance"]
    best, worst = rows.loc[over.idxmax()], rows.loc[over.idxmin()]
    above = rows[rows["low"] > rows["chance"]]
    below = rows[rows["high"] < rows["chance"]]
    named = f" ({', '.join(above['task'])})" if len(above) else ""
    extremes = " and ".join(
        f"{kind} {row['task']} with {measured(row.to_dict())} % (chance {number(row['chance'], scale=100)})"
        for kind, row in (("best in", best), ("worst in", worst))
    )
    tasks = f"{len(above)} of {_count(len(rows), 'task')}{named}"
    text = f"{whose} interval lies above chance in {tasks}"
    text += f" and below it in {', '.join(below['task'])}" if len(below) else ""
    # Nothing is best that is no better than a guess.
    return [f"{text}. Against chance it is {extremes}." if len(rows) > 1 and over.max() > 0 else f"{text}."]


def _touch(effects: pd.DataFrame, solved: Collection[str]) -> list[str]:
    """Whether answers use touch. Where a task is not `solved`, no better than chance, a difference cannot show it.

    An answer that is no choice at all counts as wrong, and without touch answers may lose their form.
    """
    rows = effects[effects["part"] == "touch"]
    if not len(rows):
        return ["Whether answers depend on touch was not tested."]
    *others, last = [change.partition(" - ")[2] for change in dict.fromkeys(rows["change"])]
    span = f"{100 * rows['difference'].min():+.1f} to {100 * rows['difference'].max():+.1f} points"
    instead = f"{', '.join(others)} or {last}" if others else last
    fact = f"with real touch, against touch that was {instead}, accuracy differs by {span}, task by task"
    better = rows[(rows["p_holm"] < ALPHA) & (rows["difference"] > 0)]
    sure, likely = better[better["task"].isin(solved)], rows[(rows["low"] > 0) & rows["task"].isin(solved)]
    if len(sure):
        rest = [task for task in dict.fromkeys(better["task"]) if task not in solved]
        none = f" In {' and '.join(rest)} real touch brings no more than chance, so the difference shows nothing."
        return [f"Answers use touch in {', '.join(dict.fromkeys(sure['task']))}: {fact}.{none if rest else ''}"]
    if len(likely):
        some = f"{len(likely)} of {len(rows)} intervals lie above 0, none is significant after Holm's adjustment"
        return [f"Answers may use touch: {fact}; {some}{_impossible(effects)}."]
    none = "none significant after Holm's adjustment where real touch brings more than chance"
    return [f"That answers use touch is not shown: {fact}, {none}{_impossible(effects)}."]


def _impossible(effects: pd.DataFrame) -> str:
    """Whether so few objects could show anything at all: a sign flip's p is at least 2 / 2**objects."""
    objects = int(effects["objects"].max())
    return f" ({objects} objects are too few for that)" if effects["p"].count() * 2.0 ** (1 - objects) >= ALPHA else ""


def _rules(effects: pd.DataFrame) -> list[str]:
    """How the full system stands to what its encoder's heads and plain rules answer without a language model."""
    rows = effects[effects["part"] == "language"]
    if not len(rows):
        return []
    sure = rows[rows["p_holm"] < ALPHA]
    ahead, behind = (", ".join(sure.loc[kind, "task"]) for kind in (sure["difference"] > 0, sure["difference"] < 0))
    said = [*([f"ahead in {ahead}"] if ahead else []), *([f"behind in {behind}"] if behind else [])]
    stands = " and ".join(said) or "in no task ahead or behind"
    span = f"{100 * rows['difference'].min():+.1f} to {100 * rows['difference'].max():+.1f} points"
    return [
        "The encoder's property heads and plain rules answer the same questions without a language model; the full "
        f"system differs from them by {span}, task by task, and is {stands} (Holm)."
    ]


def _parts(effects: pd.DataFrame, solved: Collection[str]) -> list[str]:
    """What encoder, LoRA and OPD bring; a gain that ends no better than chance is one of form, not of right answers."""
    rows = effects[~effects["part"].isin(("touch", "language"))]
    if not len(rows):
        return []
    form = rows["difference"].gt(0) & ~rows["task"].isin(solved)
    sure, formal = (rows[rows["p_holm"].lt(ALPHA) & kind] for kind in (~form, form))
    words, only = (
        ", ".join(
            f"{WORDS.get(r['part'], r['part'])} in {r['task']} {100 * r['difference']:+.1f}"
            for r in part.to_dict("records")
        )
        for part in (sure, formal)
    )
    *others, last = [WORDS.get(part, part) for part in dict.fromkeys(rows["part"])]
    all_of_them = f"{len(rows)} effects of {', '.join(others)}{' and ' if others else ''}{last}"
    also = f" Significant too, but answers are no better than chance even so: {only} points." if only else ""
    if words:
        return [f"Of {all_of_them} these hold up (Holm): {words} points.{also}"]
    if only:
        return [f"None of {all_of_them} holds up.{also}"]
    smallest = rows["smallest_effect"].min()
    found = ""
    if smallest <= 1:
        found = f"; even before it the smallest that this design could have found is {100 * smallest:.0f} points"
    return [f"None of {all_of_them} is significant after Holm's adjustment{_impossible(effects) or found}."]


def _folds(said: dict[str, Any]) -> str:
    folds = said.get("folds")
    if not folds:
        return ""
    times = "once" if said["replicates"] == 1 else f"{said['replicates']} times"
    return (
        f" Each seed trains without one fold of objects and tests on it: {len(folds['tested'])} of {folds['of']} folds "
        f"({', '.join(map(str, folds['tested']))}) are in, each object of theirs was tested {times}, and answers are "
        "pooled over folds."
    )


def _pictures(figures: Sequence[str]) -> list[str]:
    shown = {
        "effects.png": "What encoder, LoRA, OPD and touch bring: differences in points with intervals; full dots are "
        "significant after Holm's adjustment"
    }
    rest = [f"[{name.removesuffix('.png')}](figures/{name})" for name in figures if name not in shown]
    drawn = [f"![{alt}](figures/{name})\n" for name, alt in shown.items() if name in figures]
    return [*drawn, f"Further figures: {', '.join(rest)}.\n"] if rest else drawn


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"

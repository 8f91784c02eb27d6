"""The table of choices says what the code does, and what the paper's source does."""

import hashlib
import re
from typing import Any

import pytest

from pipeline.scales import compose
from tests.closure import ROOT
from tests.report.conftest import rows_of

HEADER = ["Element", "Paper", "Published code", "Here", "Why"]
LINES = [line for line in (ROOT / "docs" / "choices.md").read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
CELLS = [[cell.strip() for cell in line.strip("|").split("|")] for line in LINES]
ROWS = [dict(zip(HEADER, row, strict=True)) for row in CELLS if row != HEADER and set(row[0]) != {"-"}]


def values(*overrides: str) -> dict[str, Any]:
    """What the paper's scale sets, by key."""
    sections = compose("paper-7b", overrides, conf=ROOT / "conf").model_dump().items()
    return {f"{name}.{key}": own[key] for name, own in sections if isinstance(own, dict) for key in own}


PAPER, RELEASE = values(), values("encoder.recipe=release")


def settings(column: str) -> list[tuple[str, str]]:
    """The `key=value` of a column."""
    return [pair for row in ROWS for pair in re.findall(r"`([a-z_]+\.[a-z_]+)=([^`]+)`", row[column])]


@pytest.mark.parametrize(("column", "own"), [("Here", PAPER), ("Published code", RELEASE)])
def test_what_the_table_says_is_what_the_papers_scale_and_the_recipe_set(column: str, own: dict[str, Any]) -> None:
    stated = settings(column)
    assert [(key, str(own[key])) for key, _ in stated] == stated != []


def test_no_setting_of_the_recipe_is_left_out() -> None:
    differing = {key for key in PAPER if PAPER[key] != RELEASE[key]} - {"encoder.recipe"}
    assert {"encoder.epochs", "align.max_grad_norm", "lora.projection_schedule", "language.bos"} < differing
    assert differing <= {key for key, _ in settings("Published code")}


SOURCE = ROOT.parent / "shared" / "paper" / "octopi.tex"
TEX = SOURCE.read_text(encoding="utf-8") if SOURCE.is_file() else ""
beside = pytest.mark.skipif(not TEX, reason="needs the paper's source")


def plain(text: str) -> str:
    """LaTeX as one line of text, with numbers as the table of choices writes them."""
    text = text.replace("no weight", "0 weight").replace("\\times 10^", "e").replace("$10^", "1e")
    text = re.sub(r"\\cite\{.*?\}|\\hspace\{.*?\}|\\(edit|textbf|hline|\\)|(?<!\\)[{}$~]", "", text)
    return " ".join(re.sub(r"\b(\d)k\b", r"\1,000", re.sub(r"\\([_%])", r"\1", text)).split())


def table(label: str) -> list[tuple[str, ...]]:
    """The cells of the tables of this label, row by row."""
    every = [t for t in re.findall(r"\\begin\{table.*?\\end\{table", TEX, re.DOTALL) if f"{{table:{label}}}" in t]
    bodies = [re.split(r"\\(?:begin|end)\{tabular\}(?:\{.*?\})?", t)[1] for t in every]
    return [tuple(map(plain, row.split("&"))) for body in bodies for row in body.split(r"\\") if "&" in row]


@beside
def test_published_csv_is_every_figure_of_the_papers_tables() -> None:
    assert hashlib.sha256(TEX.encode()).hexdigest().startswith("da5a076f847d99d30761cdcae99b10f0"), "another version"
    found, systems = set(), list[str]()
    for place in re.findall(r"label\{table:(\w+)", TEX)[5:13]:  # The tables of results.
        for name, *cells in table(place):
            systems = systems if name else cells
            short = "RIPE" if name.startswith("Ripe") else name[:3].strip()
            part = "combined" if "Prediction" in name else name.lower()
            task, measure = (short, "choice") if short.isupper() else ("OPD", part)
            for system, value in zip(systems, cells, strict=True):
                how = ("base" if "base" in system else "finetuned", "without" if "w/o" in system else "with")
                how += ("none" if "OPD" in system + name else "all", re.sub(r".method-|\s*\(.*", "", system))
                own = (task, measure, *(("", "", "", "chance") if system.startswith("Rand") else how))
                own = ("heads", measure, "finetuned", "", "", "CLIP") if system == "FT CLIP" else own
                found.add((*own, value, "avocados" if "robot" in place else "PhysiCLeAR"))
    rows = rows_of(ROOT / "pipeline" / "report" / "published.csv")
    printed = {row for row in found if re.fullmatch(r"[\d.]+", row[-2])}
    assert {tuple(v for k, v in row.items() if k != "n") for row in rows if row["model"]} == printed
    told = dict(zip(("average", "minimum", "maximum"), table("video_stats")[1], strict=True))
    told |= {row[0].lower(): row[1] for key in ("count", "combo_count") for row in table(f"property_{key}")[1:]}
    told |= {name: value for value, name in re.findall(r"(0\.\d+) \((\w+)\)", plain(TEX))}
    assert {row["measure"]: row["value"] for row in rows if not row["model"]} == told


@beside
def test_objects_are_the_papers_but_for_one_in_two_parts() -> None:
    objects, properties = rows_of(ROOT / "pipeline/physiclear/objects.csv"), ("hardness", "roughness", "bumpiness")
    listed = {*table("objects_training")[1:], *table("objects_val_test")[1:]}
    ours = {(o["name"], o["object_id"], o["split_paper"].replace("validation", "val")) for o in objects}
    assert (ours < listed, {row[1] for row in listed - ours}) == (True, {"hairbrush_bristles"})
    ours = {(o["object_id"], *(f"[{o[p].replace(' ', ', ')}]" for p in properties)) for o in objects}
    assert ours == {(o.replace("aluminum", "aluminium"), *r) for o, *r in table("annotation_ratings")[1:]}
    for place, columns in (("materials", ["material"]), ("object_parts", ["part_of", "part"])):
        above, ours = "", {(*(o[c].lower() for c in columns), o["object_id"]) for o in objects if o[columns[0]]}
        rows = [(above := first.lower() or above, *map(str.lower, rest)) for first, *rest in table(place)[1:]]
        assert {*rows} == ours

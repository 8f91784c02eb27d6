"""The report's page: every table and figure in Markdown, with what they mean and where they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from pipeline.reporting.inputs import Inputs
from pipeline.reporting.provenance import Provenance
from pipeline.reporting.table import Table

READING = """\
- **Measured %** is k/n. With several seeds every question counts once, with the share of its answers that are right:
  the value is the mean over seeds, n stays the number of questions, and *Seeds* gives mean ± standard deviation and all
  values.
- **95 % Wilson** treats questions as independent, which they are not: they reuse videos and objects. A k that is not
  whole is rounded for it.
- **95 % over objects** is Wilson's with the number of independent questions that would be as sure of their mean as
  these are, which share objects; Student's t over the objects makes up for how few these are. Simulated, it covers
  what it says but for some designs with few objects, or with questions about two or three that depend strongly on
  them: reports/bench/coverage.md names them.
- `resampled_low` and `resampled_high`, in the CSV alone, are the same by drawing objects anew instead: with up to eight
  objects from all ways to draw them (1716 with seven), beyond from 10 000. With few objects that is **optimistic**:
  simulated with seven and questions about one, it covers 85 to 88 % of middling accuracies and less near 0 and 100.
- **Chance** is a uniform guess; **Majority** the best constant answer in hindsight, on the same questions.
- **Unparsed %** are answers that no choice could be read from; they count as wrong. **Truncated %** ran into the
  limit of `language.max_new_tokens`.
{published}- An empty cell was not measured; *Note* says why.
"""
PUBLISHED = """\
- **Published** are the paper's figures with the n that they fit and its Wilson interval. They were measured with other
  models on other questions: they stand beside the measured figures and are no part of them.
"""
ENCODERS = "Encoders over all objects"
ELSEWHERE = """\
Encoders and their rivals, cross-validated over all objects: [encoder/README.md](encoder/README.md), which a stage of
its own writes, with its own provenance.
"""
NOTHING = "Nothing: no model of `cross_validation.models` has been cross-validated.\n"
SMOKE = "\n> **Scale `smoke`: its figures prove nothing but that the chain runs.**\n"


@dataclass(frozen=True)
class Picture:
    """A figure on the page."""

    file: str
    title: str
    alt: str
    """What it shows, for those who cannot see it."""
    caption: str
    missing: str = ""
    """Why it was not drawn; empty where it was."""

    def without(self, reason: str) -> Self:
        """The same figure, not drawn."""
        return replace(self, missing=reason)


def render_page(inputs: Inputs, origin: Provenance, tables: Sequence[Table], pictures: Sequence[Picture]) -> str:
    """README.md of the report's folder."""
    sections = [
        *(t.section for t in tables),
        *(f"## {p.title}\n\n{_picture(p)}" for p in pictures),
        *([f"## {ENCODERS}\n\n{ELSEWHERE}"] if inputs.params.plan.cross_validation else []),
    ]
    titles = [section.splitlines()[0].removeprefix("## ") for section in sections]
    contents = "".join(f"- [{title}](#{_anchor(title)})\n" for title in titles)
    smoke = SMOKE if inputs.params.scale == "smoke" else ""
    return "\n".join(
        [
            f"# Report: scale {origin.scale}, source {origin.source}, split {origin.split}\n{smoke}",
            _test_set(inputs),
            f"## Contents\n\n{contents}",
            f"## How to read it\n\n{READING.format(published=PUBLISHED if inputs.of_paper else '')}",
            *sections,
            f"## Provenance\n\n{_origin(origin)}- headline accuracies: [metrics.json](metrics.json)\n",
        ]
    )


def render_encoder_page(origin: Provenance, tables: Sequence[Table]) -> str:
    """README.md of the folder of encoders."""
    sections = [table.section for table in tables] or [NOTHING]
    title = f"# {ENCODERS}: scale {origin.scale}, source {origin.source}\n"
    return "\n".join([title, *sections, f"## Provenance\n\n{_origin(origin)}"])


def _test_set(inputs: Inputs) -> str:
    videos = sum(a.part == "test" for a in inputs.assignments)
    present = ", ".join(inputs.test_objects) or "none"
    absent = f" Test objects without videos: {', '.join(inputs.missing)}." if inputs.missing else ""
    seeds = ", ".join(map(str, inputs.params.ablation.seeds))
    return (
        f"Tested on {videos} videos of {len(inputs.test_objects)} objects ({present}).{absent} "
        f"Plan `{inputs.params.ablation.plan}`, seeds {seeds}, encoder `{inputs.params.encoder.weights}`, language "
        f"model `{inputs.params.language.weights}`.\n"
    )


def _picture(picture: Picture) -> str:
    if picture.missing:
        return f"{picture.caption}\n\nNot drawn: {picture.missing}.\n"
    return f"![{picture.alt}](figures/{picture.file})\n\n{picture.caption}\n"


def _origin(origin: Provenance) -> str:
    changed = " (with uncommitted changes)" if origin.dirty else ""
    weights = ", ".join(f"`{w.folder}` sha256 `{w.sha256}`" for w in origin.weights)
    packages = ", ".join(f"{name} {version}" for name, version in origin.packages.items())
    return (
        f"- code: revision `{origin.revision}`{changed}\n"
        f"- parameters: [params.yaml](params.yaml), sha256 `{origin.params_sha256}`\n"
        f"- videos: sha256 `{origin.data_sha256}` over their hashes\n"
        f"- weights: {weights}\n"
        f"- Python {origin.python}, {packages}\n"
        "- all of it as JSON: [provenance.json](provenance.json)\n"
    )


def _anchor(title: str) -> str:
    """The anchor that GitHub gives a heading."""
    return "".join(c for c in title.lower().replace(" ", "-") if c.isalnum() or c in "-_")

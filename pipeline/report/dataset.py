"""The paper's tables about its data set: what objects are like, how long videos are, whether annotators agree."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any

import pandas as pd

from pipeline.core.records import Assignment, Part, Video
from pipeline.report.load import published, read_frame
from pipeline.videos.catalogue import Catalogue

SPLIT_PARTS = (Part.TRAIN, Part.VALIDATION, Part.TEST)
COLUMNS = ("table", "row", "objects", "with_videos", "train", "validation", "test", "frames", "published")
AUDIT = ("check", "item", "measured", "expected", "severity")
AGREEMENT = "agreement, ICC(3,k)"
"""What the audit calls its check of the annotators."""
TITLES = {
    "property_counts": "Property categories: objects a class",
    "property_combinations": "Property combinations: objects each",
    "video_lengths": "Video lengths, in frames that decode",
    "annotator_agreement": "Annotator agreement, ICC(3,k) with its 95 % interval",
    "audit": "Data audit",
}
HEADINGS = {"row": "", "with_videos": "With videos"}


def dataset_frame(
    catalogue: Catalogue, videos: Sequence[Video], splits: Sequence[Sequence[Assignment]]
) -> pd.DataFrame:
    """The content of dataset.csv, with `COLUMNS`: a row a class, a combination of classes that an object has or
    the paper counts, and a figure of lengths.

    Of several splits, an object counts in each part that any of them puts it in.
    Published figures stand beside where the catalogue is the paper's, joined by (table, row).
    """
    printed = published(catalogue.language.dataset)
    values = {(row["task"], row["measure"]): row["value"] for row in printed.to_dict("records") if not row["model"]}
    levels = [p.levels for p in catalogue.properties]
    classes = {
        o: tuple(names[n] for names, n in zip(levels, catalogue.labels(o), strict=True)) for o in catalogue.objects
    }
    groups = [
        ("property_counts", f"{p.name}: {level}", level, {o for o, own in classes.items() if own[place] == level})
        for place, p in enumerate(catalogue.properties)
        for level in p.levels
    ]
    for labels in itertools.product(*levels):
        words, members = ", ".join(labels), {o for o, own in classes.items() if own == labels}
        if members or ("property_combinations", words) in values:
            groups.append(("property_combinations", words, words, members))
    filmed = {v.object_id for v in videos}
    parts = {(a.object_id, a.part) for assignments in splits for a in assignments}
    rows: list[dict[str, Any]] = [
        {
            "table": table,
            "row": row,
            "objects": len(members),
            "with_videos": len(members & filmed),
            **{str(part): sum((o, part) in parts for o in members) for part in SPLIT_PARTS},
            "published": values.get((table, printed_as)),
        }
        for table, row, printed_as, members in groups
    ]
    if lengths := [v.frames for v in videos]:
        table = "video_lengths"
        for row, f in (("average", fmean), ("median", median), ("minimum", min), ("maximum", max)):
            rows.append({"table": table, "row": row, "frames": f(lengths), "published": values.get((table, row))})
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype(dict.fromkeys(COLUMNS[2:7], "Int64"))


def dataset_tables(folder: Path, dataset: str) -> Iterator[tuple[str, str, str, pd.DataFrame, str]]:
    """The tables of a report's dataset.csv and audit.csv, where there are such: text in every cell.

    Yields:
        Key, title, caption, table and the name of its file.
    """
    if (folder / "dataset.csv").is_file():
        frame = pd.read_csv(folder / "dataset.csv", dtype=str).fillna("")
        for key, rows in frame.groupby("table", sort=False):
            shown = rows.drop(columns="table").loc[:, lambda f: (f != "").any()]
            shown = shown.rename(columns=lambda c: HEADINGS.get(c, c.capitalize()))
            yield str(key), TITLES[str(key)], "", shown, "dataset.csv"
    audit = read_frame(folder / "audit.csv", AUDIT)
    rows = audit[audit["check"] == AGREEMENT]
    if len(rows):
        printed = published(dataset)
        values = printed[printed["task"] == "annotator_agreement"].set_index("measure")["value"].map("{:.3f}".format)
        shown = pd.DataFrame(
            {"": rows["item"], "Measured": rows["measured"].astype(str), "Published": rows["item"].map(values)}
        ).dropna(axis="columns", how="all")
        yield "annotator_agreement", TITLES["annotator_agreement"], "", shown, "audit.csv"
    if len(audit):
        # Counted by check, with what needs attention first.
        rank = {"error": 0, "warning": 1, "info": 2}
        audit = audit.sort_values("severity", key=lambda s: s.map(rank).fillna(3), kind="stable")
        audit["first"] = audit["item"] + ": " + audit["measured"].astype(str)
        checks = audit.groupby(["severity", "check"], sort=False)["first"]
        columns = {"Findings": checks.size().astype(str), "The first of them": checks.first()}
        counts = ", ".join(f"{n} {severity}" for severity, n in audit["severity"].value_counts(sort=False).items())
        shown = pd.DataFrame(columns).reset_index().rename(columns=str.capitalize)
        yield "audit", TITLES["audit"], f"{counts}; counted by check.", shown, "audit.csv"

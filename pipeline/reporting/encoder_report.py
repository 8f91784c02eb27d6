"""The cross-validation of encoders to a folder of tables of its own.

It takes hours where the rest of a report takes minutes, and neither needs the other: each says where it comes from.
"""

from __future__ import annotations

from pathlib import Path

from pipeline.io import read_json, read_table, write_json, write_text
from pipeline.params import PARAMS_FILE, Params
from pipeline.videos.catalogue import load_catalogue
from pipeline.records import Judged, Video
from pipeline.reporting.encoders import COMBINED, FOLDER, AccuracyRow, encoder_tables
from pipeline.reporting.page import render_encoder_page
from pipeline.reporting.provenance import provenance
from pipeline.reporting.table import write_tables

COSTS = Path("reports") / "bench" / "encoder.json"
MODEL = "model, "
"""Begins the cases of that file that are contestants of the cross-validation."""


def write_encoder_report(params: Params, root: Path) -> dict[str, float]:
    """Write reports/<scale>-<source>/encoder/ below `root` and return each model's combined accuracy (0 to 1).

    The same input gives the same bytes. Models without results are left out.

    Raises:
        UserError: where the videos are missing, or a file is broken.
    """
    found = root / "data" / "cross_validation"
    files = {name: found / name / "judged.parquet" for name in params.plan.cross_validation}
    judged = {name: read_table(file, Judged) for name, file in files.items() if file.is_file()}
    catalogue = load_catalogue(root / params.data.catalogue)
    videos = read_table(root / "data" / "videos.parquet", Video)
    origin = provenance(params, videos, [params.encoder.weights], root)
    tables = encoder_tables(judged, catalogue, _costs(root), params.cross_validation.folds)
    folder = root / "reports" / params.report_name / FOLDER
    write_tables(tables, folder)
    write_text(folder / "README.md", render_encoder_page(origin, tables))
    write_text(folder / "params.yaml", (root / PARAMS_FILE).read_text(encoding="utf-8"))
    write_json(folder / "provenance.json", origin.model_dump())
    rows = [row for table in tables for row in table.rows if isinstance(row, AccuracyRow)]
    return {f"{row.model}.combined": round(row.accuracy, 6) for row in rows if row.property == COMBINED}


def _costs(root: Path) -> dict[str, float]:
    """Milliseconds a video that the benchmark has measured, by model."""
    file = root / COSTS
    rows = read_json(file) if file.is_file() else []
    return {row["case"].removeprefix(MODEL): row["cost"] for row in rows if row["case"].startswith(MODEL)}

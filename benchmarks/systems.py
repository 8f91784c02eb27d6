"""The shipped model against its own heads and rules, and its tokens a second, alone and in a batch."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import fmean

import torch

from benchmarks.table import Error, Row, machine, make_rows, timed
from pipeline.config.params import load_params
from pipeline.core.io import read_csv
from pipeline.core.layout import SHIPPED
from pipeline.evaluation.records import Shown
from pipeline.evaluation.rows import ALL_SEEDS, ScoreRow
from pipeline.running.errors import UserError
from pipeline.use.model import Octopi
from pipeline.videos.files import video_files

COMPARING = ("PC", "PSS", "POM", "PSR")
QUESTION = "Which is the softest? a) {tactile}, b) {tactile}, c) {tactile}. Describe each object before answering."
DESCRIBE = "Describe the touch. {tactile}"
MODEL = "the shipped model"
RULES = "its heads and rules alone"
"""They are told the classes of POM's objects and of PSR's scenarios."""
SHOWN = {MODEL: Shown.TOUCH, RULES: Shown.CLASSES}


def measure(root: Path, triples: int = 12, batch: int = 32) -> list[Row]:
    """Milliseconds to compare three videos, from the files on; milliseconds of a token, alone and in a batch.

    Raises:
        UserError: where the chain has not asked the shipped model.
    """
    params = load_params(root / "params.yaml")
    file = root / "reports" / params.report_name / "scores.csv"
    scores = read_csv(file, ScoreRow) if file.is_file() else []
    scores = [r for r in scores if r.encoder == SHIPPED.name and r.seed == ALL_SEEDS]
    rows = [r for r in scores if r.task in COMPARING and r.measure == "choice"]
    own = {name: [Error.of(r) for r in rows if r.touch == shown] for name, shown in SHOWN.items()}
    if not all(own.values()):
        raise UserError(f"{file}: has no answers of the shipped model; run `make repro` first")
    videos = video_files(root / params.data.dir)[0]
    octopi = Octopi.from_pretrained(SHIPPED, device="cpu", dtype="float32")
    groups = [videos[i : i + 3] for i in range(0, len(videos) - 2, 3)][: triples + 1]
    costs: dict[str, list[float]] = {RULES: [], MODEL: []}
    for group in groups:
        seen = timed(partial(list, map(octopi.encoder.encode, group)))[1]
        costs[RULES].append(seen + timed(partial(list, map(octopi.encoder.classify, group)))[1])
        costs[MODEL].append(seen + timed(partial(octopi.ask, QUESTION, group))[1])
    compared = make_rows(
        "comparing three touches",
        {name: times[1:] for name, times in costs.items()},  # The first one loads and warms up.
        unit="ms a question",
        baseline=MODEL,
        errors={
            name: Error(
                fmean(e.error for e in es),
                fmean(e.low or 0.0 for e in es),
                fmean(1.0 if e.high is None else e.high for e in es),
                sum(e.n or 0 for e in es),
            )
            for name, es in own.items()
        },
        error_of=f"mean over {', '.join(COMPARING)} (of the ends, too)",
        machine=machine(f"{torch.get_num_threads()} threads"),
    )
    return [*compared, *tokens(octopi, videos, batch)]


def tokens(octopi: Octopi, videos: list[Path], batch: int) -> list[Row]:
    """Milliseconds per token, including its share of reading the question."""
    asked = [(DESCRIBE, videos[i % len(videos)]) for i in range(batch)]
    octopi.ask_all(asked)  # So that all videos are encoded.
    costs = {}
    for count in (1, batch):
        taken = []
        for start in range(0, batch, count):
            said, ms = timed(partial(octopi.ask_all, asked[start : start + count]))
            taken.append(ms / sum(len(octopi.llm.tokenizer(text).input_ids) + 1 for text in said))
        costs[f"{count} at a time"] = taken if count == 1 else taken * batch
    return make_rows(
        "a token of the shipped model",
        costs,
        unit="ms a token",
        baseline="1 at a time",
        machine=machine(f"{torch.get_num_threads()} threads"),
    )

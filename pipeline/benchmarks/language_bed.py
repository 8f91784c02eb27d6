"""What the language side is measured on: the stand-ins, real wording, pictures of noise, and turns that are fair.

Questions are the pipeline's own, about objects of the catalogue, so that lengths are what they are in earnest. Videos
are noise: no cost depends on what a picture shows. They lie decoded in memory, at the encoder's size, for both ways.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from time import perf_counter
from typing import Literal

import numpy as np
import torch

from pipeline.io import save_tensors, write_table
from pipeline.benchmarks import BenchRow
from pipeline.language.conversations import ConversationDataset
from pipeline.embeddings import FLIPS, INDEX_FILE, TENSOR, TENSOR_FILE, EmbeddingStore
from pipeline.sampling import sample_evaluation
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.videos.catalogue import load_catalogue
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.records import Assignment, Embedding, Opd, Part, Question, Task
from pipeline.runtime import seed_everything
from pipeline.statistics import Outcome, clustered

SEED = 0
FRAMES = 5
KEPT = 6
"""Frames that lie there of each video."""
OPD = Opd.ALL
TASKS = (Task.OPD, Task.PC, Task.PSS, Task.POM)

Encode = Callable[[torch.Tensor], torch.Tensor]
"""Frames, uint8, batch x side x side x RGB, to embeddings, batch x dim."""
Rates = Mapping[str, Sequence[float]]
"""Of each case, one figure a repeat."""


class LanguageRow(BenchRow):
    """A case's rate in `unit`: here more is better, and `ratio` says how many times the baseline's rate it is.

    `low` and `high` are the range of the repeats; `error`, where there is one, is the share of answers that differ from
    the baseline's.
    """

    error_low: float | None = None
    """Ends of the error's object-clustered 95 % interval."""
    error_high: float | None = None
    ratio_low: float | None = None
    """Range of the ratios within a repeat."""
    ratio_high: float | None = None
    samples: int | None = None
    """Conversations trained on or answered in a repeat."""
    tokens: int | None = None
    """Of these: tokens that are no padding (training), or that were generated."""
    flops: float | None = None
    """Floating-point operations of matrix products and attention in a repeat (attention as if it were not causal)."""
    gigabytes: float | None = None
    """10^9 bytes of weights, keys and values that are read, where the row is counted."""
    megabytes: float | None = None
    """Peak memory in 10^6 bytes: of a fresh process, of torch on a CUDA device, or counted (a bound from below)."""
    share: float | None = None
    """Of the card's matrix rate: the measured one, and in a counted row that of its data sheet."""
    logit_error: float | None = None
    """Largest difference between logits, over the largest logit."""
    source: Literal["measured", "counted"] = "measured"


@dataclass(frozen=True)
class Bed:
    """Model, encoder and questions of one run."""

    model: OctopiForCausalLM
    encode: Encode
    store: EmbeddingStore
    pictures: Mapping[str, torch.Tensor]
    """Of each video its frames: uint8, frames x side x side x RGB."""
    training: Sequence[Question]
    asked: Sequence[Question]
    device: torch.device

    def conversations(self, questions: Sequence[Question]) -> ConversationDataset:
        """As the training stages make them."""
        return ConversationDataset(
            questions,
            OPD,
            self.store,
            self.model.tokenizer,
            system_prompt="",
            per_video=FRAMES,
            flip_probability=0.5,
            seed=SEED,
            positions=self.model.positions,
        )

    def frames(self, question: Question) -> list[torch.Tensor]:
        """The frames of each of a question's videos, at uniform intervals."""
        return [self.pictures[v][list(sample_evaluation(KEPT, FRAMES))].to(self.device) for v in question.videos]


def make_bed(
    model: Callable[[int], OctopiForCausalLM],
    encode: Encode,
    side: int,
    counts: tuple[int, int],
    folder: Path,
    catalogue: Path,
    device: torch.device,
) -> Bed:
    """Questions, videos and their embeddings.

    Args:
        model: Makes the model for embeddings of a length.
        side: Of a picture, in pixels.
        counts: Training questions and questions to answer, in equal parts of `TASKS`.
        folder: Where the embeddings are kept.
        catalogue: Folder of the objects.
    """
    known = load_catalogue(catalogue)
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TRAIN) for o in list(known.objects)[::3]]
    pool = pool_of(Part.TRAIN, videos, known)
    training, asked = (
        build_questions(pool, {t: -(-n // len(TASKS)) for t in TASKS}, seed=SEED + i, distinct=False)[:n]
        for i, n in enumerate(counts)
    )
    names = sorted({v for q in (*training, *asked) for v in q.videos})
    rng = np.random.default_rng(SEED)
    pictures = {v: torch.from_numpy(rng.integers(0, 256, (KEPT, side, side, 3), dtype=np.uint8)) for v in names}
    rows = [Embedding(video_id=v, frame_index=f, flip=x, row=0) for v in names for x in FLIPS for f in range(KEPT)]
    with torch.inference_mode():
        # Mirrored noise is noise: one embedding serves all four.
        blocks = [encode(pictures[v].to(device)).float().repeat(len(FLIPS), 1) for v in names]
        tensor = torch.cat(blocks)
        mean, deviation = tensor.mean(0), tensor.std(0).clamp(min=1e-6)
    save_tensors(folder / TENSOR_FILE, {TENSOR: (tensor - mean) / deviation})
    write_table(
        folder / INDEX_FILE, Embedding, [row.model_copy(update={"row": number}) for number, row in enumerate(rows)]
    )
    store = EmbeddingStore(folder)
    seed_everything(SEED)

    def standardised(frames: torch.Tensor) -> torch.Tensor:
        return (encode(frames).float() - mean) / deviation

    return Bed(model(store.dim).to(device), standardised, store, pictures, training, asked, device)


def take_turns(
    cases: Mapping[str, Callable[[], object]], amounts: Mapping[str, float], repeats: int
) -> dict[str, list[float]]:
    """Rates of each case, its amount a second, one figure a repeat.

    Within a repeat all have their turn, so that a busy machine slows all alike.
    """
    found: dict[str, list[float]] = {case: [] for case in cases}
    for _ in range(repeats):
        for case, run in cases.items():
            gc.collect()
            started = perf_counter()
            run()
            found[case].append(amounts[case] / (perf_counter() - started))
    return found


def differing(said: Sequence[str], reference: Sequence[str], questions: Sequence[Question]) -> dict[str, float | None]:
    """The columns of the share of answers that differ from others, one a question."""
    apart = [
        Outcome(float(a != b), question.objects) for a, b, question in zip(said, reference, questions, strict=True)
    ]
    interval = clustered(apart)
    return {
        "error": fmean(outcome.correct for outcome in apart),
        "error_low": round(interval.low, 4) if interval else None,
        "error_high": round(interval.high, 4) if interval else None,
    }


def make_row(case: str, unit: str, rates: Rates, baseline: str, **columns: object) -> LanguageRow:
    """A row with the median rate, and the median of the ratios to the baseline's within a repeat."""
    own = rates[case]
    ratios = [rate / other for rate, other in zip(own, rates[baseline], strict=True)]
    values = {"cost": median(own), "low": min(own), "high": max(own)}
    values |= {"ratio": median(ratios), "ratio_low": min(ratios), "ratio_high": max(ratios)}
    rounded = {name: round(value, 3) for name, value in values.items()}
    return LanguageRow.model_validate({"case": case, "unit": unit, "baseline": baseline, **rounded, **columns})

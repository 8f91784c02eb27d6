"""The language side: what each part of the pipeline's way brings against the published loop's, in one run.

**Measured** on the stand-ins, on one core: training (useful tokens a second, those that are no padding) and answering
(samples a second), the same model and questions for all cases (`pipeline.benchmarks.language_ways`), in turns; peak
memory of fresh processes. The model is aligned a little first, so that answers are as long as answers are. Frames are
five a video. Alignment is what is trained: projection and new tokens.

**Counted** at the true shapes of paper-7b (`pipeline.benchmarks.language_counts`, and the memory in
`pipeline.benchmarks.language_memory`), from the lengths that the same questions have in the stand-in's tokens: Vicuna's
are some more, for both ways alike.

**On a CUDA device**, where one is there, the same is measured with random weights of those shapes
(`pipeline.benchmarks.language_device`).
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from pipeline.benchmarks.language_bed import SEED, Bed, Encode, LanguageRow, differing, make_bed, make_row, take_turns
from pipeline.benchmarks.language_device import device_rows
from pipeline.benchmarks.language_formats import format_rows
from pipeline.benchmarks.language_paper import counted_rows
from pipeline.benchmarks.language_ways import PUBLISHED, UPDATE, WAYS, Way, answer_batched, answer_published, train
from pipeline.benchmarks.operations import counted
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.encoder.recipes import base_encoder
from pipeline.encoder.model import TactileEncoder
from pipeline.config import EncoderConfig, RuntimeConfig, TrainConfig
from pipeline.language.training import Job, align

REPEATS = 5
TRAINED, ASKED = 64, 64
"""Conversations that are trained on and answered in each repeat."""
WARM = 192
"""Conversations that the model is aligned on before."""
LIMIT = 160
"""New tokens."""
RATE = 3e-3
MICRO = 4
"""Conversations at a time in the Trainer, as every scale has it."""
BATCHES = (1, 8, 32)
"""Questions answered at a time."""
CPU = torch.device("cpu")
TOKENS, SAMPLES = "useful tokens a second", "samples a second"
TRAINER = "training, the pipeline's Trainer"
FIRST = f"training, {PUBLISHED.case}"
ASKED_PUBLISHED = "answering, published way"
LEAN = "answering, without the published loop's forward pass"


def measure(root: Path) -> list[LanguageRow]:
    """All rows, in the order in which the module's text names them."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with TemporaryDirectory() as folder:
            bed = stand_ins(root, Path(folder), (max(WARM, TRAINED), ASKED))
            _align(bed, WARM)
            rows = [*training(bed), *answering(bed), *format_rows(bed, LIMIT)]
            lengths = lengths_of(bed)
        peaks = {
            case: _in_fresh_process(root, case) for case in (FIRST, TRAINER, ASKED_PUBLISHED, batched(BATCHES[-1]))
        }
        rows = [row.model_copy(update={"megabytes": peaks.get(row.case)}) for row in rows]
        rows += counted_rows(lengths)
        return rows + (device_rows(root) if torch.cuda.is_available() else [])
    finally:
        torch.set_num_threads(before)


def stand_ins(root: Path, folder: Path, counts: tuple[int, int]) -> Bed:
    """The stand-ins, with so many questions to train on and to answer."""
    encoder = base_encoder(EncoderConfig(weights=str(root / "standins" / "clip"))).eval()
    catalogue = root / "pipeline" / "physiclear"
    return make_bed(
        lambda dim: OctopiForCausalLM.from_base(root / "standins" / "llama", dim),
        _embed(encoder),
        encoder.image.size,
        counts,
        folder,
        catalogue,
        CPU,
    )


def _embed(encoder: TactileEncoder) -> Encode:
    def encode(frames: torch.Tensor) -> torch.Tensor:
        embedded: torch.Tensor = encoder(frames, torch.zeros(len(frames)))
        return embedded

    return encode


def _align(bed: Bed, count: int, rate: float = RATE) -> None:
    """By the stage's own function, Trainer and all."""
    samples = len(bed.training[:count])
    config = TrainConfig(samples=samples, batch_size=UPDATE, micro_batch_size=MICRO, projection_learning_rate=rate)
    align(
        bed.model, bed.conversations(bed.training[:count]), config, RuntimeConfig(device="cpu"), Job("bench", "x", SEED)
    )


def _trainings(bed: Bed, count: int) -> dict[str, Callable[[], object]]:
    optimiser = torch.optim.AdamW(bed.model.connector.parameters(), lr=1e-6)

    def run(way: Way) -> Callable[[], object]:
        return lambda: train(bed, way, bed.training[:count], optimiser)

    cases = {f"training, {way.case}": run(way) for way in WAYS}
    # All that there are: a training starts but once, and stages train on thousands.
    return cases | {TRAINER: lambda: _align(bed, len(bed.training), 1e-6)}


def training(bed: Bed) -> list[LanguageRow]:
    """Useful tokens a second of every way."""
    cases = _trainings(bed, TRAINED)
    tokens = dict.fromkeys(cases, sum(bed.conversations(bed.training[:TRAINED]).lengths))
    tokens[TRAINER] = sum(bed.conversations(bed.training).lengths)
    flops = {case: counted(run) for case, run in cases.items()}
    rates = take_turns(cases, tokens, REPEATS)
    return [
        make_row(
            case,
            TOKENS,
            rates,
            FIRST,
            samples=len(bed.training) if case == TRAINER else TRAINED,
            tokens=tokens[case],
            flops=float(flops[case]),
        )
        for case in cases
    ]


def batched(size: int) -> str:
    """The name of answering so many at a time."""
    return f"answering, the pipeline's way, {size} at a time"


def _answerings(bed: Bed) -> dict[str, Callable[[], list[str]]]:
    def run(size: int) -> Callable[[], list[str]]:
        return lambda: [p.outputs[0] for p in answer_batched(bed, LIMIT, size)]

    return {
        ASKED_PUBLISHED: lambda: answer_published(bed, LIMIT, forward=True),
        LEAN: lambda: answer_published(bed, LIMIT, forward=False),
        **{batched(size): run(size) for size in BATCHES},
    }


def answering(bed: Bed) -> list[LanguageRow]:
    """Samples a second of every way, and whether they answer alike."""
    cases = _answerings(bed)
    tokens = sum(p.tokens for p in answer_batched(bed, LIMIT, BATCHES[-1]))
    said, flops = {}, {}
    for case, run in cases.items():
        flops[case] = counted(lambda case=case, run=run: said.update({case: run()}))  # type: ignore[misc]
    count = len(bed.asked)
    rates = take_turns(cases, dict.fromkeys(cases, count), REPEATS)
    return [
        make_row(
            case,
            SAMPLES,
            rates,
            ASKED_PUBLISHED,
            samples=count,
            tokens=tokens,
            flops=float(flops[case]),
            **differing(said[case], said[ASKED_PUBLISHED], bed.asked),
        )
        for case in cases
    ]


def lengths_of(bed: Bed) -> list[tuple[int, int, int]]:
    """Of each conversation its tokens, those of the answer, and the videos."""
    data = bed.conversations(bed.training)
    return [
        (len(e.input_ids), sum(label >= 0 for label in e.labels), len(q.videos))
        for q, e in zip(data.questions, data.encoded, strict=True)
    ]


def _in_fresh_process(root: Path, case: str) -> float:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_peak, args=(sender, root, case, (TRAINED, ASKED)))
    process.start()
    sender.close()
    peak: float = receiver.recv()
    process.join()
    return peak


def _peak(sender: multiprocessing.connection.Connection, root: Path, case: str, counts: tuple[int, int]) -> None:
    """Run one case once; its process's peak memory meanwhile in 10^6 bytes, all that it has loaded included."""
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        bed = stand_ins(root, Path(folder), counts)
        run = (_trainings(bed, counts[0]) | _answerings(bed))[case]
        status = Path("/proc/self/status")
        if status.is_file():
            # What getrusage says began with the parent's memory; this begins here.
            Path("/proc/self/clear_refs").write_text("5")
        run()
    if status.is_file():
        high = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        sender.send(round(int(high.split()[1]) * 1024 / 1e6, 1))
    else:
        unit = 1 if sys.platform == "darwin" else 1024
        sender.send(round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6, 1))

"""True shapes with random weights on a CUDA device: training by stages' own functions, answers, memory, share of peak.

Nothing is asked of what such a model says: it runs to the limit of new tokens. A share is of the matrix rate that the
card itself shows in one large product; operations of training are those that torch counts in an update.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import AutoModelForCausalLM, LlamaConfig

from pipeline.benchmarks.language_bed import SEED, Bed, LanguageRow, make_bed
from pipeline.benchmarks.language_counts import H100, Cost, Tower
from pipeline.benchmarks.language_paper import Length, pipeline_answers, published_answers
from pipeline.benchmarks.language_random import matrix_rate, random_tower, shapes_of, timed
from pipeline.benchmarks.language_ways import PUBLISHED, UPDATE, answer_batched, answer_published, train
from pipeline.language.base import load_tokenizer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.records import Question
from pipeline.runtime import DeviceName, DtypeName, resolve_device, resolve_dtype, seed_everything
from pipeline.config import LoraTrainConfig, RuntimeConfig, TrainConfig
from pipeline.language.training import Job, add_lora, align, finetune_lora

COUNTED = 1
"""Updates in which operations are counted, and which warm the device up."""


@dataclass(frozen=True)
class Size:
    """What is run, and how much of it."""

    name: str
    llama: LlamaConfig
    tower: str
    """open_clip's name."""
    frames: Tower = field(default_factory=Tower)
    """The tower's shapes, to count with."""
    side: int = 224
    device: DeviceName = "cuda"
    dtype: DtypeName = "bfloat16"
    updates: int = 50
    published_updates: int = 3
    micro: int = 4
    rank: int = 128
    asked: int = 64
    published_asked: int = 6
    batch: int = 16
    limit: int = 128
    product: int = 8192
    """Side of the matrices whose product shows the card's rate."""
    runtime: RuntimeConfig = field(default_factory=RuntimeConfig)


PAPER = Size(
    name="paper-7b",
    llama=LlamaConfig(
        hidden_size=4096,
        intermediate_size=11008,
        num_hidden_layers=32,
        num_attention_heads=32,
        num_key_value_heads=32,
        max_position_embeddings=4096,
        vocab_size=32000,
    ),
    tower="ViT-L-14-quickgelu",
)


@dataclass(frozen=True)
class Spent:
    """What a case took."""

    seconds: float
    megabytes: float | None
    samples: int
    tokens: int
    flops: float


def device_rows(root: Path, size: Size = PAPER) -> list[LanguageRow]:
    """Alignment, LoRA and answering, each the pipeline's way and the published one."""
    device = resolve_device(size.device)
    rate = matrix_rate(device, resolve_dtype(size.dtype), size.product)
    rows: list[LanguageRow] = []
    with TemporaryDirectory() as folder:
        bed = random_bed(root, size, Path(folder), device)
        for name, rank in (("alignment", 0), ("LoRA", size.rank)):
            if rank:
                add_lora(bed.model, _lora(size, 1))
            spent = {
                "published way": _spend(bed, size, size.published_updates, _published(bed)),
                "pipeline's way": _spend(bed, size, size.updates, _pipeline(bed, size, rank)),
            }
            rows += _rows(f"{size.name} measured, {name}", spent, "useful tokens a second", rate)
        llama = shapes_of(size.llama, bed.store.dim)
        few, all_ = (replace(bed, asked=bed.asked[:n]) for n in (size.published_asked, size.asked))
        spent = {
            "published way": _asked(
                few,
                lambda: answer_published(few, size.limit, forward=True),
                published_answers(_lengths(few, size), llama, size.frames, H100, forward=True),
            ),
            "pipeline's way": _asked(
                all_,
                lambda: answer_batched(all_, size.limit, size.batch),
                pipeline_answers(_lengths(all_, size), size.batch, llama, H100),
            ),
        }
    return rows + _rows(f"{size.name} measured, answering", spent, "samples a second", rate)


def random_bed(root: Path, size: Size, folder: Path, device: torch.device) -> Bed:
    """A model and a tower with random weights, made where they stay; the stand-in's tokenizer."""
    tokenizer = load_tokenizer(root / "standins" / "llama")

    def make(dim: int) -> OctopiForCausalLM:
        seed_everything(SEED)
        with device:
            llm = AutoModelForCausalLM.from_config(size.llama, dtype=resolve_dtype(size.dtype))
        return OctopiForCausalLM(llm.requires_grad_(False).eval(), tokenizer, dim)

    counts = (size.updates * UPDATE, size.asked)
    catalogue = root / "pipeline" / "physiclear"
    return make_bed(
        make, random_tower(size.tower, resolve_dtype(size.dtype), device), size.side, counts, folder, catalogue, device
    )


def _lora(size: Size, samples: int) -> LoraTrainConfig:
    return LoraTrainConfig(
        samples=samples, batch_size=UPDATE, micro_batch_size=size.micro, rank=size.rank, alpha=2 * size.rank
    )


def _pipeline(bed: Bed, size: Size, rank: int) -> Callable[[list[Question]], object]:
    def run(questions: list[Question]) -> object:
        data, job = bed.conversations(questions), Job("bench", f"{size.name}{rank}", SEED)
        if rank:
            return finetune_lora(bed.model, data, _lora(size, len(questions)), size.runtime, job)
        config = TrainConfig(samples=len(questions), batch_size=UPDATE, micro_batch_size=size.micro)
        return align(bed.model, data, config, size.runtime, job)

    return run


def _published(bed: Bed) -> Callable[[list[Question]], object]:
    def run(questions: list[Question]) -> None:
        # The published code keeps all activations.
        bed.model.llm.gradient_checkpointing_disable()
        trained = [p for p in bed.model.train().parameters() if p.requires_grad]
        train(bed, PUBLISHED, questions, torch.optim.AdamW(trained, lr=1e-6))

    return run


def _spend(bed: Bed, size: Size, updates: int, run: Callable[[list[Question]], object]) -> Spent:
    few, questions = list(bed.training[: COUNTED * UPDATE]), list(bed.training[: updates * UPDATE])
    with FlopCounterMode(display=False) as counter:
        run(few)
    seconds, megabytes = _with_memory(bed, lambda: run(questions))
    tokens, counted = (sum(bed.conversations(some).lengths) for some in (questions, few))
    return Spent(seconds, megabytes, len(questions), tokens, counter.get_total_flops() * tokens / counted)


def _asked(bed: Bed, run: Callable[[], object], cost: Cost) -> Spent:
    """Operations are counted from shapes, without the adapters' hundredth part."""
    seconds, megabytes = _with_memory(bed, run)
    return Spent(seconds, megabytes, len(bed.asked), 0, cost.flops)


def _lengths(bed: Bed, size: Size) -> list[Length]:
    data = bed.conversations(bed.asked)
    prompts = [next(i for i, label in enumerate(e.labels) if label >= 0) for e in data.encoded]
    return [(n + size.limit, size.limit, len(q.videos)) for q, n in zip(data.questions, prompts, strict=True)]


def _with_memory(bed: Bed, run: Callable[[], object]) -> tuple[float, float | None]:
    if bed.device.type != "cuda":
        return timed(run, bed.device), None
    torch.cuda.reset_peak_memory_stats()
    seconds = timed(run, bed.device)
    return seconds, round(torch.cuda.max_memory_allocated() / 1e6, 1)


def _rows(what: str, spent: dict[str, Spent], unit: str, rate: float) -> list[LanguageRow]:
    rates = {case: (s.tokens or s.samples) / s.seconds for case, s in spent.items()}
    baseline = next(iter(spent))
    return [
        LanguageRow(
            case=f"{what}, {case}",
            cost=round(rates[case], 3),
            low=round(rates[case], 3),
            high=round(rates[case], 3),
            unit=unit,
            baseline=f"{what}, {baseline}",
            ratio=round(rates[case] / rates[baseline], 3),
            samples=s.samples,
            tokens=s.tokens or None,
            flops=s.flops,
            megabytes=s.megabytes,
            share=round(s.flops / s.seconds / rate, 4),
        )
        for case, s in spent.items()
    ]

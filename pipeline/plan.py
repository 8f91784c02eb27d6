"""The ablation plan: which variants a scale trains, and which stages that needs.

Axes (the paper's ablations): encoder {base, finetuned} x LoRA {without, with} x OPD {none, needed, all} x seed. Each
stage is keyed by only the axes that it uses, so nothing is trained twice: the base encoder's embeddings have no seed,
and a variant without LoRA is the alignment checkpoint, answered.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict

from pipeline.records import Opd, Touch

NOTHING = "data/videos.parquet"
"""Stands where a stage needs nothing: DVC has no optional dependencies, and every stage comes after this table."""
PRETRAINED = "data/pretrained/scenes"
PlanName = Literal["paper", "factorial", "single"]


class Encoder(StrEnum):
    """Which visual encoder a variant uses."""

    BASE = "base"
    FINETUNED = "finetuned"


class Lora(StrEnum):
    """Whether the language model was fine-tuned end to end."""

    WITHOUT = "without"
    WITH = "with"


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class EmbeddingJob(_Entry):
    """One set of embeddings: `encoder_dir` is what the encoder is loaded from besides the base weights."""

    encoder: Encoder
    encoder_dir: str


class TrainingJob(_Entry):
    """One alignment, and the end-to-end fine-tuning of the same name that may follow it."""

    encoder: Encoder
    embeddings: str
    """Key of the embeddings."""
    opd: Opd
    seed: int


class CrossValidationJob(_Entry):
    """One model that is cross-validated."""

    pretrained: str
    """As the plan's."""


class Variant(_Entry):
    """One answering system: a row or column of the paper's tables."""

    encoder: Encoder
    lora: Lora
    opd: Opd
    seed: int
    embeddings: str
    model_dir: str
    """Folder of its trained part: the alignment's, or the end-to-end fine-tuning's."""
    touch: Touch = Touch.REAL
    """Anything else makes it a counterfactual of the variant with the same axes."""


class Plan(_Entry):
    """Everything that DVC makes a stage of; keys are the stages' names behind the @."""

    scenes: tuple[str, ...]
    """One entry where scenes are the source, none otherwise."""
    pretrain: tuple[str, ...]
    """One entry where the encoder's recipe begins with a pretraining, none otherwise."""
    pretrained: str
    """What fine-tuning the encoder starts from besides CLIP's weights; where there is nothing, the table of videos."""
    cross_validation: dict[str, CrossValidationJob]
    """Models that are cross-validated over all objects, by name."""
    encoder_seeds: tuple[int, ...]
    embeddings: dict[str, EmbeddingJob]
    align: dict[str, TrainingJob]
    lora: dict[str, TrainingJob]
    variants: dict[str, Variant]


FULL = (Encoder.FINETUNED, Lora.WITH, Opd.ALL)
"""The system as the paper proposes it; the counterfactuals are put to it."""


def variant_axes(plan: PlanName) -> list[tuple[Encoder, Lora, Opd]]:
    """The variants of a plan, without seeds.

    `paper`: the full system and, one at a time, without OPD, without the fine-tuned encoder, without LoRA.
    `single`: the full system alone. `factorial`: every combination.
    """
    if plan == "factorial":
        return list(itertools.product(Encoder, Lora, Opd))
    if plan == "single":
        return [FULL]
    return [
        FULL,
        (Encoder.FINETUNED, Lora.WITH, Opd.NONE),
        (Encoder.BASE, Lora.WITH, Opd.ALL),
        (Encoder.FINETUNED, Lora.WITHOUT, Opd.ALL),
    ]


def resolve_plan(
    source: Literal["scenes", "videos"],
    plan: PlanName,
    seeds: Sequence[int],
    *,
    pretrained: bool = False,
    compared: Mapping[str, bool] | None = None,
    counterfactuals: Sequence[Touch] = (),
) -> Plan:
    """Unfold a plan over seeds into the stages that it needs.

    Args:
        pretrained: Whether the encoder's recipe begins with a pretraining.
        compared: Models to cross-validate, each with whether it begins with a pretraining.
        counterfactuals: What the full system also answers on in place of its videos.
    """
    compared = compared or {}
    embeddings: dict[str, EmbeddingJob] = {}
    align: dict[str, TrainingJob] = {}
    lora: dict[str, TrainingJob] = {}
    variants: dict[str, Variant] = {}
    for seed, (encoder, adapter, opd) in itertools.product(seeds, variant_axes(plan)):
        embedding_key = encoder.value if encoder is Encoder.BASE else f"{encoder}-{seed}"
        # The base encoder is loaded from its weights alone.
        encoder_dir = NOTHING if encoder is Encoder.BASE else f"data/encoder/{seed}"
        embeddings[embedding_key] = EmbeddingJob(encoder=encoder, encoder_dir=encoder_dir)
        job_key = f"{encoder}-{opd}-{seed}"
        job = TrainingJob(encoder=encoder, embeddings=embedding_key, opd=opd, seed=seed)
        align[job_key] = job
        if adapter is Lora.WITH:
            lora[job_key] = job
        variant = Variant(
            encoder=encoder,
            lora=adapter,
            opd=opd,
            seed=seed,
            embeddings=embedding_key,
            model_dir=f"data/{'lora' if adapter is Lora.WITH else 'align'}/{job_key}",
        )
        key = f"{encoder}-{adapter}-{opd}-{seed}"
        variants[key] = variant
        if (encoder, adapter, opd) == FULL:
            variants |= {f"{key}-{touch}": variant.model_copy(update={"touch": touch}) for touch in counterfactuals}
    return Plan(
        scenes=("scenes",) if source == "scenes" else (),
        pretrain=("scenes",) if pretrained or any(compared.values()) else (),
        pretrained=PRETRAINED if pretrained else NOTHING,
        cross_validation={
            name: CrossValidationJob(pretrained=PRETRAINED if wanted else NOTHING) for name, wanted in compared.items()
        },
        encoder_seeds=_seeds(job for job in align.values()),
        embeddings=embeddings,
        align=align,
        lora=lora,
        variants=variants,
    )


def _seeds(jobs: Iterable[TrainingJob]) -> tuple[int, ...]:
    return tuple(dict.fromkeys(job.seed for job in jobs if job.encoder is Encoder.FINETUNED))

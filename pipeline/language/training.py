"""Training of the language side: alignment of the projection, then end-to-end fine-tuning with LoRA."""

from __future__ import annotations

import logging
import os
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from transformers import TrainerCallback

from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig, TrainConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.errors import UserError
from pipeline.language.buckets import LengthBuckets
from pipeline.language.conversations import ConversationCollator, ConversationDataset
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.records import Opd, Question
from pipeline.runtime import derive_seed, seed_everything
from pipeline.training import (
    TrainableTrainer,
    Trained,
    TrainingMonitor,
    checkpoint_dir,
    fingerprint,
    train,
    training_arguments,
)

logger = logging.getLogger(__name__)


def add_lora(model: OctopiForCausalLM, config: LoraTrainConfig) -> None:
    """Put fresh low-rank adapters (float32) on the language model's linear layers."""
    from peft import LoraConfig, get_peft_model

    names = {name.rsplit(".", 1)[-1] for name, _ in model.llm.named_modules()}
    unknown = [module for module in config.target_modules if module not in names]
    if unknown:
        raise UserError(f"lora.target_modules: the language model has no layer {unknown[0]}; it has {_linear(names)}")
    lora = LoraConfig(
        r=config.rank,
        lora_alpha=config.alpha,
        lora_dropout=config.dropout,
        target_modules=list(config.target_modules),
        task_type="CAUSAL_LM",
    )
    model.llm = get_peft_model(model.llm, lora)


@dataclass(frozen=True)
class Material:
    """What a variant's language training is made of."""

    questions: Sequence[Question]
    store: EmbeddingStore
    opd: Opd
    language: LanguageConfig
    per_video: int
    flip_probability: float
    seed: int

    def mark(self, config: TrainConfig, *inputs: Path) -> str:
        """A fingerprint of all that a training depends on; `inputs` are the files of questions and embeddings, and
        what was trained before."""
        weights = Path(self.language.weights)
        return fingerprint(
            config, self.language, self.opd, self.per_video, str(self.flip_probability), self.seed, weights, *inputs
        )


def assemble(
    material: Material, samples: int, purpose: str, aligned: Path | None = None
) -> tuple[OctopiForCausalLM, ConversationDataset]:
    """A model and its training conversations: `samples` questions, drawn by seed and purpose.

    Each OPD mode draws as many, from the questions that have a dialogue in it.

    Args:
        aligned: Folder of a model to go on with; by default a fresh one.
    """
    seed_everything(material.seed)
    language = material.language
    if aligned is None:
        model = OctopiForCausalLM.from_base(
            language.weights, material.store.dim, dtype=language.dtype, quantization=language.quantization
        )
    else:
        model = OctopiForCausalLM.from_pretrained(
            aligned, base=language.weights, dtype=language.dtype, quantization=language.quantization
        )
    usable = [q for q in material.questions if q.dialogue(material.opd)]
    random.Random(derive_seed(material.seed, purpose)).shuffle(usable)
    if not usable:
        raise UserError(f"no training question has OPD mode {material.opd}; raise questions.train in params.yaml")
    if len(usable) < samples:
        logger.warning("%s: only %d training questions for %d samples", purpose, len(usable), samples)
    data = ConversationDataset(
        usable[:samples],
        material.opd,
        material.store,
        model.tokenizer,
        system_prompt=language.system_prompt,
        per_video=material.per_video,
        flip_probability=material.flip_probability,
        seed=material.seed,
        positions=model.positions,
    )
    return model, data


@dataclass(frozen=True)
class Job:
    """One training: its name and fingerprint (where its checkpoints lie), its seed, further callbacks."""

    stage: str
    mark: str
    seed: int
    callbacks: Sequence[TrainerCallback] = ()


def align(
    model: OctopiForCausalLM, data: ConversationDataset, config: TrainConfig, runtime: RuntimeConfig, job: Job
) -> Trained:
    """Train the projection and the two new tokens; the language model stays frozen."""
    return _fit(model, data, config, runtime, job, {"connector": config.projection_learning_rate})


def finetune_lora(
    model: OctopiForCausalLM, data: ConversationDataset, config: LoraTrainConfig, runtime: RuntimeConfig, job: Job
) -> Trained:
    """Train adapters, projection and new tokens, each at its own rate."""
    rates = {"connector": config.projection_learning_rate, "llm": config.learning_rate}
    return _fit(model, data, config, runtime, job, rates)


def _fit(
    model: OctopiForCausalLM,
    data: ConversationDataset,
    config: TrainConfig,
    runtime: RuntimeConfig,
    job: Job,
    rates: Mapping[str, float],
) -> Trained:
    if runtime.gradient_checkpointing:
        model.llm.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    seed_everything(job.seed)
    steps = config.epochs * -(-len(data) // config.batch_size)
    arguments = training_arguments(
        checkpoint_dir(job.stage, job.mark),
        runtime,
        job.seed,
        num_train_epochs=config.epochs,
        per_device_train_batch_size=config.micro_batch_size,
        gradient_accumulation_steps=_accumulation(config),
        weight_decay=config.weight_decay,
        warmup_steps=round(config.warmup_ratio * steps),
        max_grad_norm=config.max_grad_norm,
        logging_steps=max(1, steps // 50),
    )
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=data,
        data_collator=ConversationCollator(int(model.tokenizer.pad_token_id)),
        callbacks=[TrainingMonitor(), *job.callbacks],
        rates=rates,
        sampler=LengthBuckets(data.lengths, config.micro_batch_size, job.seed, lambda: data.epoch),
    )
    return train(trainer)


def _accumulation(config: TrainConfig) -> int:
    """Micro-batches an update on each device, so that an update sees `batch_size` questions over all devices."""
    devices = int(os.environ.get("WORLD_SIZE", "1"))
    if config.batch_size % (config.micro_batch_size * devices):
        raise UserError(
            f"batch_size {config.batch_size} cannot be shared by {devices} devices at micro_batch_size "
            f"{config.micro_batch_size}; lower micro_batch_size"
        )
    return config.batch_size // (config.micro_batch_size * devices)


def _linear(names: Iterable[str]) -> str:
    return ", ".join(sorted(n for n in names if n.endswith(("_proj", "lm_head"))))

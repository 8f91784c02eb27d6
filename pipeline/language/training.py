"""Training of the language side: alignment of the projection, then end-to-end fine-tuning with LoRA."""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from transformers import TrainerCallback

from pipeline.config import LANGUAGE_DIR, LanguageConfig, LoraTrainConfig, Params, RuntimeConfig, TrainConfig
from pipeline.core.io import fingerprint, read_jsonl
from pipeline.core.layout import embeddings_dir, questions_file
from pipeline.core.records import Encoder, Opd, Question
from pipeline.core.runtime import derive_seed, name_dtype, seed_everything
from pipeline.language.base import ADAPTER_WEIGHTS
from pipeline.language.conversations import ConversationDataset, UpdateSampler, collate
from pipeline.language.octopi import ADAPTER_DIR, CONFIG_FILE, OctopiForCausalLM, read_config
from pipeline.running.errors import UserError
from pipeline.training.card import write_card
from pipeline.training.embeddings import EmbeddingStore
from pipeline.training.trainer import TrainableTrainer, Trained, checkpoint_dir, train, training_arguments
from pipeline.videos.catalogue import OBJECTS, PROPERTIES, Catalogue, load_catalogue

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Material:
    """What a variant's language training is made of."""

    questions: Sequence[Question]
    store: EmbeddingStore
    catalogue: Catalogue
    opd: Opd
    language: LanguageConfig
    per_video: int
    flip_probability: float
    seed: int
    source: str = "videos"
    """`data.source`: whether the videos are synthetic."""
    files: tuple[Path, ...] = ()
    """Input files, and folders of such: questions, embeddings, objects, properties, the model that it starts from."""
    adapter: Path | None = None
    """Folder of the adapter of `language.start`, which alignment leaves as it is."""

    @classmethod
    def load(cls, params: Params, encoder: Encoder, opd: Opd, seed: int) -> Self:
        """Read the questions and one encoder's embeddings from the chain's data folder."""
        dtype, start = name_dtype(params.language.dtype, params.runtime.device), params.language.start
        asked, embedded = questions_file(seed, "train"), embeddings_dir(encoder, seed)
        begun = Path(start) / LANGUAGE_DIR / ADAPTER_DIR
        adapter = begun if start and begun.is_dir() else None
        catalogue = Path(params.data.catalogue)
        files = [asked, embedded, catalogue / OBJECTS, catalogue / PROPERTIES]
        if start:
            files.append(Path(start) / CONFIG_FILE)
        if adapter:
            files.append(adapter / ADAPTER_WEIGHTS)
        return cls(
            questions=read_jsonl(asked, Question),
            store=EmbeddingStore(embedded),
            catalogue=load_catalogue(catalogue),
            opd=opd,
            language=params.language.model_copy(update={"dtype": dtype}),
            per_video=params.frames.per_video,
            flip_probability=params.encoder.flip_probability,
            seed=params.seed + seed,
            source=params.data.source,
            files=tuple(files),
            adapter=adapter,
        )

    def fingerprint(self, config: TrainConfig, *inputs: Path) -> str:
        """A short hash of all that a training depends on; `inputs` are files of what was trained before."""
        settings = (config, self.language, self.opd, self.per_video, str(self.flip_probability), self.seed)
        return fingerprint(*settings, Path(self.language.weights), *self.files, *inputs)


def assemble(
    material: Material, config: TrainConfig, purpose: str, aligned: Path | None = None
) -> tuple[OctopiForCausalLM, ConversationDataset]:
    """A model and its training conversations: `config.samples` questions, drawn by seed and purpose.

    Each OPD mode draws as many, from the questions that have a dialogue in it. The model is the one in the folder
    `aligned`, else that of `language.start`, else a fresh one.
    """
    seed_everything(material.seed)
    language = material.language
    how: dict[str, Any] = {"dtype": language.dtype, "quantization": language.quantization}
    if aligned is None and language.start:
        aligned = Path(language.start) / LANGUAGE_DIR
        dim, own = read_config(aligned).tactile_dim, material.store.dim
        if dim != own:
            raise UserError(
                f"language.start: {language.start} reads embeddings of {dim}, but the encoder gives {own}; set "
                "encoder.backbone and encoder.embedding as its config.json has them"
            )
    if aligned is None:
        how["normalize"] = language.normalize_touch
        model = OctopiForCausalLM.from_base(language.weights, material.store.dim, **how)
    else:
        model = OctopiForCausalLM.from_pretrained(aligned, base=language.weights, **how)
    usable = [q for q in material.questions if q.dialogue(material.opd)]
    random.Random(derive_seed(material.seed, purpose)).shuffle(usable)
    if not usable:
        raise UserError(f"no training question has OPD mode {material.opd}; raise questions.train in params.yaml")
    if len(usable) < config.samples:
        logger.warning("%s: only %d training questions for %d samples", purpose, len(usable), config.samples)
    data = ConversationDataset(
        usable[: config.samples],
        material.opd,
        material.store,
        model.tokenizer,
        language,
        per_video=material.per_video,
        flip_probability=material.flip_probability,
        seed=material.seed,
        positions=model.positions,
        by_question=config.weighting == "question",
    )
    return model, data


@dataclass(frozen=True)
class Job:
    """One training: its name and fingerprint (where its checkpoints lie), its seed, further callbacks."""

    stage: str
    fingerprint: str
    seed: int
    callbacks: Sequence[TrainerCallback] = ()


def fit(
    model: OctopiForCausalLM, data: ConversationDataset, config: TrainConfig, runtime: RuntimeConfig, job: Job
) -> Trained:
    """Train the projection, the two new tokens' vectors, word embeddings where `model.words` is set, and adapters."""
    # The new tokens' vectors are word embeddings, wherever they are kept.
    trained = ("connector.projection", "connector.delimiters", *(("words",) if model.words is not None else ()))
    adapters = {"llm": config.learning_rate} if isinstance(config, LoraTrainConfig) else {}
    if runtime.gradient_checkpointing:
        model.llm.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    seed_everything(job.seed)
    # Rounded up, since the last update of an epoch may be smaller.
    steps = config.epochs * -(-len(data) // config.batch_size)
    arguments = training_arguments(
        checkpoint_dir(job.stage, job.fingerprint),
        runtime,
        job.seed,
        config,
        num_train_epochs=config.epochs,
        weight_decay=config.weight_decay,
        warmup_steps=round(config.warmup_ratio * steps),
        logging_steps=max(1, steps // 50),
    )
    # Number of questions that all devices compute at once. Each needs equally many, or the others would wait for it.
    shared = config.micro_batch_size * arguments.world_size if arguments.world_size > 1 else 1
    trainer = TrainableTrainer(
        model=model,
        args=arguments,
        train_dataset=data,
        data_collator=collate,
        callbacks=job.callbacks,
        rates={**dict.fromkeys(trained, config.projection_learning_rate), **adapters},
        constant=("connector.projection",) if config.projection_schedule == "constant" else (),
        sampler=UpdateSampler(data, config.batch_size, job.seed, shared),
    )
    return train(trainer)


def write_model_card(folder: Path, material: Material, data: ConversationDataset, config: TrainConfig) -> None:
    """Write the card of a model that was aligned, or fine-tuned with LoRA, beside it."""
    tasks = Counter(str(question.task) for question in data.questions)
    lora = isinstance(config, LoraTrainConfig)
    write_card(
        folder,
        f"Octopi: a language model with touch, {'fine-tuned with LoRA' if lora else 'aligned'}",
        bases={"language model": Path(material.language.weights)},
        data={
            "tactile embeddings": f"{material.store.folder.name}, {material.per_video} frames a video",
            "questions": ", ".join(f"{count} {task}" for task, count in sorted(tasks.items())),
            "objects": len({o for q in data.questions for o in q.objects}),
            f"videos ({material.source})": len({v for q in data.questions for v in q.videos}),
            "OPD": material.opd,
        },
        settings={
            **config.model_dump(),
            "flip_probability": material.flip_probability,
            "number format": f"{material.language.dtype}, quantization {material.language.quantization}",
            "trained word embeddings": read_config(folder).trained_embeddings,
            "seed": material.seed,
        },
        limits=(
            "It reads embeddings of the one encoder above; those of another mean nothing to it.",
            "It was trained on templates of "
            + ", ".join(sorted(tasks))
            + " alone: other questions, and scenarios (PSR), were not trained on.",
            "It knows objects and sensors only as its training videos show them.",
            "The language model's own weights are not in this folder and have limits of their own.",
        ),
    )

"""What a run may be told: the validated shape of params.yaml, and its only reader.

`conf/` holds the scales, `octopi scale` composes one of them into params.yaml, and every stage loads that file
through `load_params` and passes on only the section that a function needs.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from pipeline.errors import UserError
from pipeline.plan import Plan, PlanName, resolve_plan
from pipeline.records import Task
from pipeline.runtime import DeviceName, DtypeName

PARAMS_FILE = Path("params.yaml")

Fraction = Annotated[float, Field(gt=0, le=1)]
Positive = Annotated[int, Field(ge=1)]
Rate = Annotated[float, Field(gt=0, lt=10)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]


class Section(BaseModel):
    """A frozen part of the configuration; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


S = TypeVar("S", bound=Section)


class DataConfig(Section):
    """Where the videos come from."""

    source: Literal["scenes", "videos"]
    """`scenes`: synthetic, made by the chain. `videos`: files named `<object>_<number>` in `dir`."""
    dir: str = Field(min_length=1)
    """Folder of the videos; for scenes, where the chain puts them."""
    catalogue: str = "pipeline/physiclear"
    """Folder with objects.csv and properties.yaml."""


class ScenesConfig(Section):
    """Synthetic videos (used where data.source is scenes)."""

    objects: tuple[str, ...] = ()
    """Object ids; empty stands for all of the catalogue."""
    videos_per_object: Positive = 5
    frames: Annotated[int, Field(ge=2, le=1000)] = 100
    """Frames a video."""
    fps: Annotated[float, Field(gt=0, le=240)] = 25.0
    width: Annotated[int, Field(ge=32, le=1280)] = 320
    height: Annotated[int, Field(ge=24, le=960)] = 240
    seed: Seed = 0


class FramesConfig(Section):
    """Which frames of a video the encoder sees, and how large."""

    salient_fraction: Fraction = 0.3
    """Share of frames kept, by summed absolute difference to the frame before (paper: 30 %)."""
    per_video: Annotated[int, Field(ge=1, le=64)] = 5
    """Frames drawn a video (paper: 5)."""
    size: Annotated[int, Field(ge=16, le=1024)] = 224
    """Side of the square that frames are stored at; must be the encoder's input size."""
    fit: Literal["crop", "squash"] = "crop"
    """`crop`: shorter side to `size`, then the centre (CLIP's own way). `squash`: the whole frame, aspect lost."""


class SplitConfig(Section):
    """Which objects are for training, validation and test."""

    name: Literal["paper", "release", "development", "kfold"] = "paper"
    seed: Seed = 0
    """Used by development and kfold."""
    test_objects: Positive = 7
    """Test objects of the development split."""
    folds: Annotated[int, Field(ge=3, le=50)] = 5
    fold: Annotated[int, Field(ge=0)] = 0
    missing: Literal["report", "error"] = "report"
    """What to do about validation or test objects without videos: go on and leave cells empty, or stop."""

    @model_validator(mode="after")
    def _fold_exists(self) -> Self:
        if self.fold >= self.folds:
            raise ValueError(f"split.fold is {self.fold}, allowed: 0 to {self.folds - 1}")
        return self


class QuestionCounts(Section):
    """Questions a task."""

    opd: Annotated[int, Field(ge=0)]
    pc: Annotated[int, Field(ge=0)]
    pss: Annotated[int, Field(ge=0)]
    pom: Annotated[int, Field(ge=0)]
    psr: Annotated[int, Field(ge=0)] = 0

    def by_task(self) -> dict[Task, int]:
        """The counts keyed by task."""
        return {task: getattr(self, task.lower()) for task in Task}


class QuestionsConfig(Section):
    """How many questions are built; fewer come where the objects allow no more without repeating."""

    seed: Seed = 0
    train: QuestionCounts
    evaluation: QuestionCounts

    @model_validator(mode="after")
    def _psr_is_not_trained(self) -> Self:
        if self.train.psr:
            raise ValueError("questions.train.psr must be 0: scenarios are for evaluation only")
        return self


class EncoderConfig(Section):
    """The CLIP encoder and its fine-tuning (paper: visual prompts, three heads, AdamW, cosine)."""

    weights: str
    """Folder in open_clip's format: open_clip_config.json and open_clip_model.safetensors."""
    prompts: Annotated[int, Field(ge=1, le=256)] = 8
    """Learnable prompts at each layer."""
    epochs: Positive = 30
    batch_size: Positive = 32
    learning_rate: Rate = 1e-3
    weight_decay: Annotated[float, Field(ge=0, lt=1)] = 0.0
    flip_probability: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Chance of each of the two flips in training."""
    standardize: bool = False
    """Shift and scale embeddings to mean 0 and deviation 1 over the training frames (the paper does not)."""
    embed_batch_size: Positive = 64
    """Frames at a time when embeddings are computed."""


class LanguageConfig(Section):
    """The language model and its generation."""

    weights: str
    """Folder in transformers' format with a Llama-like model (safetensors) and a fast tokenizer."""
    dtype: DtypeName = "float32"
    """Number format of the frozen weights; whatever is trained stays in float32."""
    system_prompt: str = ""
    """Put before each conversation (Vicuna has one; the stand-in was made without)."""
    max_new_tokens: Annotated[int, Field(ge=1, le=4096)] = 256
    generation_batch_size: Positive = 32


class TrainConfig(Section):
    """One stage of language training (AdamW, cosine)."""

    samples: Positive
    """Questions trained on (paper: 8k for alignment, 3k end to end)."""
    epochs: Positive = 1
    batch_size: Positive = 16
    """Questions an update, over all devices."""
    micro_batch_size: Positive = 16
    """Questions at a time on one device; the rest is accumulated."""
    projection_learning_rate: Rate = 2e-5
    warmup_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.0
    weight_decay: Annotated[float, Field(ge=0, lt=1)] = 0.0
    max_grad_norm: Annotated[float, Field(gt=0)] = 1.0

    @model_validator(mode="after")
    def _batches_divide(self) -> Self:
        if self.batch_size % self.micro_batch_size:
            raise ValueError(f"micro_batch_size {self.micro_batch_size} does not divide batch_size {self.batch_size}")
        return self


class LoraTrainConfig(TrainConfig):
    """End-to-end fine-tuning with low-rank adapters."""

    learning_rate: Rate = 2e-4
    rank: Annotated[int, Field(ge=1, le=1024)] = 128
    alpha: Annotated[float, Field(gt=0)] = 256
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.05
    target_modules: tuple[str, ...] = Field(default=("q_proj", "k_proj"), min_length=1)
    """Linear layers that get an adapter (the paper does not say; the published code: q_proj and k_proj)."""


class AblationConfig(Section):
    """Which variants of the system are trained and compared."""

    plan: PlanName = "paper"
    """`paper`: the four variants of the paper's tables. `factorial`: encoder x LoRA x OPD. `single`: no ablation."""
    seeds: tuple[Seed, ...] = Field(default=(0,), min_length=1)

    @model_validator(mode="after")
    def _seeds_differ(self) -> Self:
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"ablation.seeds {list(self.seeds)} repeats a seed")
        return self


class TrackingConfig(Section):
    """MLflow."""

    uri: str = ""
    """Tracking server; empty stands for the local database mlruns/mlflow.db."""
    experiment: str = "octopi"
    live: bool = True
    """Log trainings while they run (importing MLflow costs each of them seconds), or only when all is done."""
    timeout_seconds: Annotated[int, Field(ge=1, le=600)] = 10
    """After how long an unanswered call counts as a dead server."""


class RuntimeConfig(Section):
    """The machine."""

    device: DeviceName = "auto"
    launcher: str = "python"
    """What starts a training stage: `python`, or `accelerate launch` with its configuration for several GPUs."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """CPU threads of torch; 0 leaves it to torch. Sums depend on it in their last bits, so fix it to compare runs."""
    save_steps: Annotated[int, Field(ge=0)] = 0
    """Optimiser steps between checkpoints that a killed training resumes from; 0 writes none."""
    gradient_checkpointing: bool = False


class Settings(Section):
    """All that a person sets: params.yaml without what follows from it."""

    scale: Literal["smoke", "small", "paper-7b", "paper-13b"]
    seed: Seed = 0
    data: DataConfig
    scenes: ScenesConfig
    frames: FramesConfig
    split: SplitConfig
    questions: QuestionsConfig
    encoder: EncoderConfig
    language: LanguageConfig
    align: TrainConfig
    lora: LoraTrainConfig
    ablation: AblationConfig
    tracking: TrackingConfig
    runtime: RuntimeConfig

    @model_validator(mode="after")
    def _scenes_have_their_place(self) -> Self:
        if self.data.source == "scenes" and Path(self.data.dir) != SCENES_DIR:
            raise ValueError(f"data.dir must be {SCENES_DIR} where data.source is scenes (set data.source=videos?)")
        return self

    @property
    def report_name(self) -> str:
        """The folder in reports/ that this scale and source report into."""
        return f"{self.scale}-{self.data.source}"


class Params(Settings):
    """The whole of params.yaml."""

    plan: Plan
    """Resolved from data.source and ablation by `octopi scale`; DVC makes one stage of each entry."""

    @model_validator(mode="after")
    def _plan_is_resolved(self) -> Self:
        if self.plan != resolve_plan(self.data.source, self.ablation.plan, self.ablation.seeds):
            raise ValueError("plan does not follow from ablation; run `octopi scale` again instead of editing it")
        return self


SCENES_DIR = Path("data/scenes/videos")
"""Where the chain puts the videos that it makes itself."""


def resolve(values: Mapping[str, Any], origin: str) -> Params:
    """Validate composed settings and add the plan that follows from them; `origin` begins an error's line."""
    settings = _validate(Settings, values, origin)
    plan = resolve_plan(settings.data.source, settings.ablation.plan, settings.ablation.seeds)
    return Params(**{name: getattr(settings, name) for name in Settings.model_fields}, plan=plan)


def load_params(path: Path = PARAMS_FILE) -> Params:
    """Read and check params.yaml."""
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `octopi scale smoke` writes it") from None
    except yaml.YAMLError as error:
        raise UserError(
            f"{path}: not YAML ({' '.join(str(error).split())}); `octopi scale smoke` rewrites it"
        ) from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: empty; `octopi scale smoke` writes it")
    return _validate(Params, values, str(path))


def explain(error: ValidationError) -> str:
    """The first problem of a validation in one line: key, value, what is allowed."""
    detail = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in detail["loc"])
    if detail["type"] == "extra_forbidden":
        known = _known_keys(detail["loc"])
        close = difflib.get_close_matches(str(detail["loc"][-1]), known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        return f"{key} is not a parameter; {hint}allowed here: {', '.join(known)}"
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "missing":
        return f"{key} is missing; run `octopi scale` again to write a whole params.yaml"
    if detail["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} is {detail['input']!r}: {message}"


def _validate(model: type[S], values: Mapping[str, Any], origin: str) -> S:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UserError(f"{origin}: {explain(error)}") from None


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    model: type[BaseModel] = Params
    for part in location[:-1]:
        annotation = model.model_fields[str(part)].annotation
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [name for name in model.model_fields if name != "plan"]

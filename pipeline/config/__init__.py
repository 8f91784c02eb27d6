"""The schema of params.yaml: every key with its range and meaning.

`conf/` holds the scales and `octopi scale` composes one of them into params.yaml; `pipeline.config.params` reads it. A
function receives its own section, never the root.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, Strict, field_validator, model_validator

from pipeline.core.layout import PRETRAINED, SCENES_DIR
from pipeline.core.records import Encoder, Lora, Opd, TouchInput, Variant
from pipeline.core.runtime import DeviceName, DtypeName, Kernels, Quantization
from pipeline.running.errors import without_secrets

Whole = Annotated[int, Strict()]
"""Strict, since Python counts `true` as 1, and so `epochs: true` would train for one epoch."""
Number = Annotated[float, Strict()]
Fraction = Annotated[Number, Field(gt=0, le=1)]
Positive = Annotated[Whole, Field(ge=1)]
Rate = Annotated[Number, Field(gt=0, lt=10)]
GradNorm = Annotated[Number, Field(ge=0)]
Seed = Annotated[Whole, Field(ge=0, lt=2**31)]
QuestionCounts = dict[str, Annotated[Whole, Field(ge=0)]]
"""Questions of each task; `pipeline.tasks.questions.counts_by_task` knows which tasks there are."""

RecipeName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$")]
"""A name in `pipeline.encoder.recipes.RECIPES`; `octopi scale` checks that it is one."""
Backend = Literal["processes", "ray"]
TrainedEmbeddings = Literal["all", "new"]
ChatFormat = Literal["template", "published"]
Selection = Literal["salient", "release", "contact"]

LANGUAGE_DIR = "language"
"""Subfolder of a trained model's folder that holds connector and adapter."""


class Section(BaseModel):
    """A frozen part of the configuration; unknown keys are errors, and so are NaN and infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class DataConfig(Section):
    """Where the videos come from."""

    source: Literal["scenes", "videos"]
    """`scenes`: synthetic, made by the chain. `videos`: files in `dir`, named `<object>_<number>` or listed in its
    videos.csv."""
    dir: str = Field(min_length=1)
    """Folder of the videos; for scenes, where the chain puts them."""
    catalogue: str = "pipeline/physiclear"
    """Folder with objects.csv and properties.yaml (and, optionally, descriptions.csv and scenes.yaml)."""


class InventConfig(Section):
    """A catalogue of invented objects (used where data.catalogue is data/invented)."""

    objects: Annotated[Whole, Field(ge=27, le=100_000)] = 1500
    """All 27 combinations of three properties' classes come equally often."""
    seed: Seed = 0


class ScenesConfig(Section):
    """Synthetic videos (used where data.source is scenes)."""

    objects: tuple[str, ...] = ()
    """Object ids; empty stands for all of the catalogue."""
    videos_per_object: Positive = 5
    frames: Annotated[Whole, Field(ge=2, le=1000)] = 100
    """Frames a video."""
    fps: ClassVar[float] = 25.0
    """Frames a second."""
    tier: Literal["auto", "winkler", "layer", "half_space"] = "auto"
    """How a contact is computed: on springs, with the gel as an elastic layer or as a half-space; `auto` takes what is
    cheapest within `tolerance`."""
    cells: Annotated[Whole, Field(ge=32, le=1024)] = 256
    """`layer`, `half_space`: grid across the pressed patch."""
    tolerance: Annotated[Number, Field(gt=0, le=1)] = 0.25
    """`auto`: estimated relative error in the slopes of the gel's skin."""
    width: Annotated[Whole, Field(ge=32, le=1280, multiple_of=2)] = 320
    height: Annotated[Whole, Field(ge=24, le=960, multiple_of=2)] = 240
    """Even, as the videos' codec wants it."""
    seed: Seed = 0


class FramesConfig(Section):
    """Which frames of a video are kept for the encoder, and how large."""

    selection: Selection = "salient"
    """`salient`: the largest differences to the frame before (paper). `release`: the published code's rule. `contact`:
    the largest differences to the no-contact reference."""
    fraction: Fraction = 0.3
    """Share of a video's frames that is kept (paper: 30 %)."""
    per_video: Annotated[Whole, Field(ge=1, le=64)] = 5
    """Frames drawn of those that are kept (paper: 5)."""
    pixels: Annotated[Whole, Field(ge=16, le=1024)] = 224
    """Side of the square that frames are stored at; a CLIP's own or more, as larger frames are averaged. No key may be
    called `size` or `nfiles`: DVC's run cache leaves those out."""
    fit: Literal["crop", "squash"] = "crop"
    """`crop`: the centre, then to `pixels`. `squash`: the whole frame, aspect lost."""


class SplitConfig(Section):
    """Which objects are for training, validation and test."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")] = "paper"
    """`kfold`, or what stands behind `split_` in a column of the catalogue's objects.csv."""
    seed: Seed = 0
    """Used by kfold."""
    train_objects: Annotated[Whole, Field(ge=0)] = 0
    """`kfold`: train on this many of a fold's training objects, to see how many are enough; 0: all. A larger number
    includes all objects of a smaller one."""
    folds: Annotated[Whole, Field(ge=3, le=50)] = 5
    """`kfold`: number of folds. Seed s of `ablation.seeds` tests on fold s modulo `folds`."""

    @model_validator(mode="after")
    def _fewer_objects_of_folds(self) -> Self:
        if self.train_objects and self.name != "kfold":
            raise ValueError("split.train_objects leaves out objects of a fold; set split.name=kfold")
        return self

    def fold_of(self, seed: int) -> int | None:
        """The fold that a seed of `ablation.seeds` tests on; None where all seeds share one split."""
        return seed % self.folds if self.name == "kfold" else None

    def replicate_of(self, seed: int) -> int:
        """The replicate that a seed belongs to. Together, its seeds test each object once, so their answers are pooled
        like those of one seed."""
        return seed // self.folds if self.name == "kfold" else seed


class QuestionsConfig(Section):
    """How many questions are built; fewer come where the objects allow no more without repeating."""

    seed: Seed = 0
    train: QuestionCounts
    """By the task's name in lower case; a task without a number gets none. With kfold these are for each fold."""
    evaluation: QuestionCounts
    scenarios: Literal["published", "ours"] = "published"
    """Whose reading of the situations decides which objects are right in scenario questions (PSR): the published
    code's, or this project's, which has clearer contrasts. A catalogue's own scenarios are always asked."""
    wording: Literal["object", "class", "texts"] = "object"
    """Wording of free descriptions. `object`: each object has one phrase per class, as published. `class`: every object
    has its class's first phrase: with several, greedy decoding splits a class's probability among them. `texts`: what
    the catalogue's texts.csv says, one text drawn for each question; where it is silent, as `object`."""
    facts: bool = False
    """Begin matching questions with what the named objects are like, for a language model that has never heard of
    them: then no knowledge of the world is asked for. Tables say so."""
    names: Literal["catalogue", "number"] = "catalogue"
    """What objects are called. `number`: "object 7", as in the training of the shipped model, which copies no other."""
    restate: bool = False
    """Where everything is described (OPD `all`), answers to PC and PSS name the classes of the property asked for, and
    which object has more or less of it, before they conclude: for a model too small to find and compare at once."""
    two_turns: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    """Share of the training questions about several videos that become a dialogue in OPD mode `all`: the first turn
    describes all videos, as in scenarios (PSR), and each later one asks a question about them."""
    plainly: Annotated[Number, Field(ge=0, le=1)] = 0.0
    """Share of the other training comparisons that are asked as people do: "Which is softer?"."""


class EncoderConfig(Section):
    """The tactile encoder and its training on property labels."""

    recipe: RecipeName = "paper"
    """`paper`: CLIP with visual prompts, three heads. `release`: the same as the published code has it. `tuned`: a
    frame classifier is fitted to any backbones' features, then trained on with their last stage (CLIP: prompts)."""
    backbone: tuple[str, ...] = Field(default=("clip",), min_length=1)
    """Names in `pipeline.weights.backbones.BACKBONES`; of several, features stand side by side. `clip`: a ViT of
    open_clip's. `timm`: a network of timm's. `scenes`: the one that the chain pretrains (section `pretrain`)."""
    weights: str
    """Folder of `clip` in open_clip's format (open_clip_config.json and open_clip_model.safetensors), or of `timm` in
    timm's (config.json and model.safetensors). The chain makes what is named below data/weights/."""
    feature_stage: Annotated[Whole, Field(ge=0, le=200)] = 3
    """`timm`: which of the network's stages (a transformer: blocks) is read, from 0 on; what follows is not used."""
    embedding: Literal["projected", "class_token", "logits"] = "projected"
    """`paper`: what is read of CLIP, for the heads and the language model (ViT-L/14: 768 or 1024 values). `projected`:
    CLIP's own embedding. `class_token`: the normalised class token before CLIP's projection. `release` reads the
    class token in any case: normalised for the heads, and before that for the language model. `logits`: with any
    encoder, the property heads' logits of each frame; for training objects, from heads that did not see them."""
    prompts: Annotated[Whole, Field(ge=1, le=256)] = 8
    """Learnable prompts at each layer."""
    prompt_layers: Annotated[Whole, Field(ge=0)] = 0
    """Layers, from the first, that get prompts of their own; 0 is all (paper)."""
    epochs: Positive = 30
    batch_size: Positive = 32
    micro_batch_size: Annotated[Whole, Field(ge=0)] = 0
    """Videos per forward pass; gradients are accumulated up to `batch_size`. 0, or `batch_size` and more: all at once.
    `octopi scale` says what memory that takes."""
    autocast: Literal["none", "bfloat16"] = "none"
    """Mixed precision: the number format of torch's autocast in training. Trained weights stay in float32."""
    learning_rate: Rate = 1e-3
    weight_decay: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    max_grad_norm: GradNorm = 0.0
    """Clip gradients to this norm; 0 does not clip (the published code; the paper does not say)."""
    flip_probability: Annotated[Number, Field(ge=0, le=1)] = 0.5
    """Chance of each of the two flips in training."""
    reference: Literal["none", "subtract"] = "none"
    """`subtract`: show each frame's difference to the video's no-contact reference in place of the frame."""
    standardize: bool = False
    """Shift and scale embeddings to mean 0 and deviation 1 over the training frames (the paper names no such step)."""
    embed_batch_size: Positive = 64
    """Frames at a time when embeddings are computed."""
    pretrained: str = Field(default=str(PRETRAINED), exclude=True)
    """Not in params.yaml: the file of the backbone `scenes`. A packaged model has one of its own."""

    @model_validator(mode="after")
    def _settings_fit(self) -> Self:
        micro, named = self.micro_batch_size, ",".join(self.backbone)
        if 0 < micro < self.batch_size and self.batch_size % micro:
            raise ValueError(f"encoder.micro_batch_size {micro} does not divide batch_size {self.batch_size}")
        if self.embedding == "logits" and not self.standardize:
            raise ValueError("encoder.embedding: logits have any scale; set encoder.standardize=true")
        if len(set(self.backbone)) < len(self.backbone):
            raise ValueError(f"encoder.backbone=[{named}] names one twice")
        if self.recipe in ("paper", "release") and self.backbone != ("clip",):
            raise ValueError(
                f"encoder.recipe={self.recipe} is for CLIP alone, but encoder.backbone=[{named}]; set "
                "encoder.backbone=[clip] and encoder.weights, or encoder.recipe=tuned"
            )
        if "scenes" in self.backbone and self.reference != "subtract":
            raise ValueError("encoder.backbone: scenes was pretrained on differences: set encoder.reference=subtract")
        return self


class PretrainConfig(Section):
    """Pretraining of the backbone `scenes` on pictures of invented objects. It has no micro-batches, since batch
    normalisation needs the whole update."""

    objects: Annotated[Whole, Field(ge=8, le=1_000_000)] = 4000
    """Objects that are invented; each is drawn once."""
    steps: Positive = 900
    """Updates (AdamW, cosine)."""
    seed: Seed = 0
    presses: ClassVar[int] = 3
    """Pictures of each object, under different forces and lights."""
    batch_size: ClassVar[int] = 24
    """Objects an update."""
    learning_rate: ClassVar[float] = 2e-3
    weight_decay: ClassVar[float] = 0.01
    max_grad_norm: ClassVar[float] = 1.0


class LanguageConfig(Section):
    """The language model and its generation."""

    weights: str
    """Folder in transformers' format with a Llama-like model (safetensors) and a fast tokenizer. The chain makes what
    is named below data/weights/."""
    start: str = ""
    """Folder of a trained model, such as models/finetuned-with-all-0, whose connector and adapter to start from, and
    whose backbone `scenes` to take where `pretrain` has its defaults; empty: new ones. Encoder, language model and
    adapter must have its settings; it must not have met a test object. DVC tracks the model that is shipped, and of
    another folder only the name: `dvc repro --force align@...` trains on from what it holds by now."""
    dtype: DtypeName = "float32"
    """Number format of the frozen weights; whatever is trained stays in float32. `auto`: bfloat16 where the device
    computes it in hardware, else float32."""
    quantization: Quantization = "none"
    """`nf4`: hold the frozen linear layers in four bits (needs bitsandbytes and a CUDA device)."""
    system_prompt: str = ""
    """Put before each conversation (Vicuna has one)."""
    chat: ChatFormat = "template"
    """How conversations are written: by the tokenizer's own `template` (without one, Vicuna's), or as `published`,
    piece by piece."""
    bos: bool = True
    """Begin each conversation about touch with the begin token, where the tokenizer writes one (the published code
    takes it away). A chat template's own stays."""
    normalize_touch: bool = False
    """Scale each projected tactile embedding to the root mean square of the word embeddings. Otherwise alignment at a
    high learning rate makes them a hundred times as long, which drowns what attention adds, such as which video they
    show."""
    max_new_tokens: Annotated[Whole, Field(ge=1, le=4096)] = 256
    """Length of an answer, less where the language model has no more positions. Longer answers are cut and marked."""
    generation_batch_size: Positive = 32


class TrainConfig(Section):
    """One stage of language training (AdamW), whose updates are computed in parts."""

    batch_size: Positive = 16
    """Items an update, over all devices."""
    micro_batch_size: Positive = 16
    """Items per forward pass on a device; gradients accumulate. Changes time, memory and, by rounding, last digits."""
    max_grad_norm: GradNorm = 1.0
    """Clip gradients to this norm; 0 does not clip (the published code)."""
    samples: Positive
    """Questions trained on (paper: 8k for alignment, 3k end to end)."""
    epochs: Positive = 1
    weighting: Literal["question", "token"] = "question"
    """What has equal weight in the loss of an update: each `question`, by the mean over its answer's tokens (the
    published code, whose batches hold one question), or each `token`, so that long answers count more."""
    projection_learning_rate: Rate = 2e-5
    """Learning rate of the projection, and of word embeddings where they are trained."""
    projection_schedule: Literal["cosine", "constant"] = "cosine"
    """Schedule of the projection's learning rate (published code: `constant`); the other rates follow a cosine."""
    warmup_ratio: Annotated[Number, Field(ge=0, lt=1)] = 0.0
    weight_decay: Annotated[Number, Field(ge=0, lt=1)] = 0.0

    @model_validator(mode="after")
    def _batches_divide(self) -> Self:
        if self.batch_size % self.micro_batch_size:
            raise ValueError(f"micro_batch_size {self.micro_batch_size} does not divide batch_size {self.batch_size}")
        return self


class AlignConfig(TrainConfig):
    """Alignment of the projection."""

    train_embeddings: TrainedEmbeddings = "new"
    """Word embeddings that are trained, here and in the end-to-end training that follows: `all`, the whole layer
    (paper), or only those of the two `new` tokens. All take another 16 bytes a value, 2 GiB for Vicuna-7b."""
    begin_with_words: bool = False
    """First fit the projection to the word embeddings of each object's classes: for a small model, which would else
    need many more questions to tell one video's frames from the next one's."""


class LoraTrainConfig(TrainConfig):
    """End-to-end fine-tuning with low-rank adapters."""

    learning_rate: Rate = 2e-4
    """Learning rate of the adapters."""
    rank: Annotated[Whole, Field(ge=1, le=1024)] = 128
    alpha: Annotated[Number, Field(gt=0)] = 256.0
    dropout: Annotated[Number, Field(ge=0, lt=1)] = 0.05
    target_modules: Literal["all-linear"] | Annotated[tuple[str, ...], Field(min_length=1)] = ("q_proj", "k_proj")
    """Linear layers that get an adapter (the paper does not say; the published code: q_proj and k_proj); `all-linear`:
    all but the one that gives the logits."""


class AblationConfig(Section):
    """Which variants of the system are trained and compared: the product of the lists.

    The full system (fine-tuned encoder, with LoRA, all descriptions) is among them: every effect is a difference to it.
    """

    encoders: tuple[Encoder, ...] = (Encoder.FINETUNED, Encoder.BASE)
    """What the language model is given; the fine-tuned encoder is trained in any case, for the encoder's own table."""
    lora: tuple[Lora, ...] = (Lora.WITH, Lora.WITHOUT)
    """`without` answers with the alignment's checkpoint."""
    opd: tuple[Opd, ...] = (Opd.ALL, Opd.NONE)
    """How much an answer describes before it concludes: `all`, what is `needed` for the question, or `none`."""
    train: bool = True
    """False: no variant is trained, and the run only evaluates the models of `evaluate.models`."""
    seeds: tuple[Seed, ...] = Field(default=(0,), min_length=1)
    """With split.name=kfold seeds are folds: [0, 1, 2] of three folds tests each object once, [0, ..., 5] twice."""
    touch: tuple[Literal[TouchInput.REMOVED, TouchInput.SWAPPED, TouchInput.NOISE], ...] = ()
    """Input ablations: what the full system is also given in place of its videos, to test whether it uses touch."""

    @model_validator(mode="after")
    def _lists_make_sense(self) -> Self:
        full = {"encoders": Encoder.FINETUNED, "lora": Lora.WITH, "opd": Opd.ALL}
        for name in type(self).model_fields.keys() - {"train"}:
            values = [str(v) for v in getattr(self, name)]
            if len(set(values)) < len(values):
                raise ValueError(f"ablation.{name} [{', '.join(values)}] repeats a value")
            if name in full and full[name] not in values:
                raise ValueError(f"ablation.{name} [{', '.join(values)}] lacks the full system's value {full[name]}")
        return self

    def variants(self) -> list[Variant]:
        """All answering systems, in the lists' order; input ablations belong to the full system alone."""
        chosen = product(self.seeds, self.encoders, self.lora, self.opd) if self.train else ()
        return [Variant(encoder, lora, opd, seed) for seed, encoder, lora, opd in chosen]

    def touches(self, variant: Variant) -> tuple[TouchInput, ...]:
        """What a variant is asked with: the questions' videos, and the full system also with every input ablation."""
        return (TouchInput.REAL, *(self.touch if variant.full else ()))


class EvaluateConfig(Section):
    """Trained models that answer questions about the run's videos, with no training of this run."""

    models: tuple[str, ...] = ()
    """Folders of models/, or octopi-small, the one that is shipped. DVC tracks that one, and of others only the name:
    `dvc repro --force evaluate` asks a model that has changed."""
    objects: Literal["test", "all"] = "test"
    """Which objects they are asked about; a model that has met one of them is refused."""
    questions: Annotated[Whole, Field(ge=0)] = 0
    """How many, half of them descriptions; 0: as many as questions.evaluation says."""
    repeats: Positive = 1
    """Sets of questions about the same objects, to see how far accuracy moves from set to set."""
    rated: tuple[Annotated[Whole, Field(ge=0)], ...] = ()
    """Learning curve: each model also answers after `octopi adapt` by so many of the training objects, with ratings (0:
    by videos alone). For each seed, it answers the chain's own questions about test objects."""


class TrackingConfig(Section):
    """MLflow."""

    uri: str = ""
    """Tracking server; empty stands for the local database mlruns/mlflow.db. No password: MLflow reads those of a
    server from MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD."""
    experiment: str = "octopi"
    live: bool = True
    """Log trainings while they run (importing MLflow costs each of them seconds), or only when all is done."""
    timeout_seconds: Annotated[Whole, Field(ge=1, le=600)] = 10
    """After how long an unanswered call counts as a dead server."""

    @field_validator("uri")
    @classmethod
    def _holds_no_secret(cls, uri: str) -> str:
        if without_secrets(uri) != uri:
            raise ValueError(
                "holds a password or token, which Git would keep; leave it out and set MLFLOW_TRACKING_USERNAME and "
                "MLFLOW_TRACKING_PASSWORD, or MLFLOW_TRACKING_TOKEN (for a database what its driver reads: PGPASSWORD)"
            )
        return uri


class RuntimeConfig(Section):
    """The machine."""

    device: DeviceName = "auto"
    launcher: str = "python"
    """What align and lora start themselves with: `python`, or `accelerate launch` with a file of conf/accelerate."""
    parallel: Backend = "processes"
    """Where many files are worked on at once: `processes` of this machine, or `ray`, a cluster that `RAY_ADDRESS` names
    (without it: one of this machine's cores)."""
    threads: Annotated[Whole, Field(ge=0, le=1024)] = 0
    """CPU threads of torch; 0 leaves it to torch. Sums depend on it in their last bits, so fix it to compare runs."""
    save_steps: Annotated[Whole, Field(ge=0)] = 0
    """Optimiser steps between checkpoints that a killed training resumes from; 0 writes none."""
    gradient_checkpointing: bool = False


class Params(Section):
    """The whole of params.yaml."""

    scale: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$")]
    """Name of the file in conf/ that this comes from."""
    seed: Seed = 0
    kernels: Kernels = "machine"
    """`portable`: stages give the same bytes on every x86-64 processor with AVX2, and take longer. `machine`: they
    compute with what the processor has."""
    data: DataConfig
    invent: InventConfig = InventConfig()
    scenes: ScenesConfig
    frames: FramesConfig
    split: SplitConfig
    questions: QuestionsConfig
    encoder: EncoderConfig
    pretrain: PretrainConfig
    language: LanguageConfig
    align: AlignConfig
    lora: LoraTrainConfig
    ablation: AblationConfig
    evaluate: EvaluateConfig = EvaluateConfig()
    packaged: Literal["full", "all"] = "full"
    """Which variants get a folder in models/: the full system of each seed, or all. Each holds the whole encoder."""
    tracking: TrackingConfig
    runtime: RuntimeConfig

    @model_validator(mode="after")
    def _sections_fit(self) -> Self:
        if self.data.source == "scenes" and Path(self.data.dir) != SCENES_DIR:
            raise ValueError(f"data.dir must be {SCENES_DIR} where data.source is scenes (set data.source=videos?)")
        if self.kernels == "portable" and self.runtime.threads != 1:
            raise ValueError("kernels=portable: sums follow the number of threads; set runtime.threads=1")
        held: dict[int, set[int | None]] = {}
        for seed in self.ablation.seeds:
            held.setdefault(self.split.replicate_of(seed), set()).add(self.split.fold_of(seed))
        if len({frozenset(folds) for folds in held.values()}) > 1:
            raise ValueError(
                f"ablation.seeds {list(self.ablation.seeds)} test on some of the {self.split.folds} folds more often "
                "than on others; take as many seeds for each fold"
            )
        return self

    @property
    def report_name(self) -> str:
        """The folder in reports/ that this scale and source report into."""
        return f"{self.scale}-{self.data.source}"

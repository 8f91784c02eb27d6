"""Teaching: adapters on all linear layers learn plain items, then several properties, then all, and are merged in.

A phase begins when the one before it is passed, and widens one thing. All at once is not learnt in as long: choosing
between things comes first, then of which property, and both are learnt where the wording does not vary.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F
from torch.utils.data import Dataset, SequentialSampler
from transformers import PreTrainedModel, PreTrainedTokenizerBase, TrainerCallback
from transformers.modeling_outputs import CausalLMOutput

from pipeline.card import write_card
from pipeline.config import LanguageConfig, RuntimeConfig, TeachConfig
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.language.chat import IGNORE_INDEX, Encoded, encode_turns
from pipeline.language.teach import items
from pipeline.language.teach.items import Form, Item, draw
from pipeline.records import Measurement
from pipeline.runtime import derive_seed, name_dtype, resolve_dtype, seed_everything
from pipeline.training.trainer import (
    TrainableTrainer,
    Trained,
    TrainingMonitor,
    checkpoint_dir,
    train,
    training_arguments,
)

COURSE: dict[Form, dict[Form, float]] = {
    "plain": {"plain": 1},
    "several": {"several": 0.85, "plain": 0.15},
    "whole": {"whole": 0.35, "short": 0.15, "several": 0.5},
}
"""The phases, and the share of each form among a phase's items: what came before is reviewed. A phase is called by the
form of its exam."""
PHASES = tuple(COURSE)
LOWEST = 0.1
KEPT = ("config.json", "README.md")
"""Files of the base that the taught model writes anew, beside the weights."""


def encode_item(item: Item, tokenizer: PreTrainedTokenizerBase, system_prompt: str) -> Encoded:
    """Token ids of an item, with labels on what its answers conclude, end tokens included."""
    return encode_turns(item.turns, tokenizer, system_prompt=system_prompt, frames=0, descriptions=False)


def draw_of(phase: Form, rng: random.Random) -> Item:
    """An item of a phase."""
    form = rng.choices(list(COURSE[phase]), list(COURSE[phase].values()))[0]
    return draw(rng, form, further=True)


def replay(count: int, tokenizer: PreTrainedTokenizerBase, system_prompt: str, seed: int) -> list[Encoded]:
    """Items of the last phase, for a training that comes later and shall not undo this one."""
    rngs = (random.Random(derive_seed(seed, "replay", i)) for i in range(count))
    return [encode_item(draw_of(PHASES[-1], rng), tokenizer, system_prompt) for rng in rngs]


class Course(Dataset[Encoded]):
    """The teaching's items, an update's worth sorted by length, drawn from seed and index.

    Which phase an update belongs to follows from what was measured before it, so from the training's log, which a
    checkpoint holds. A phase begins one update late: the loader has fetched the next update's first items by then.
    """

    def __init__(self, config: TeachConfig, tokenizer: PreTrainedTokenizerBase, system_prompt: str, seed: int) -> None:
        self.config, self.tokenizer, self.system_prompt, self.seed = config, tokenizer, system_prompt, seed
        self.log: Callable[[], list[dict[str, float]]] = list
        """Asked for what the training has logged."""
        self._update = lru_cache(maxsize=2)(self._draw_update)

    def __len__(self) -> int:
        updates: int = sum(getattr(self.config.max_updates, phase) for phase in PHASES)
        return updates * self.config.batch_size

    def __getitem__(self, index: int) -> Encoded:
        update, place = divmod(index, self.config.batch_size)
        return self._update(update + 1, self.phase(update - 1))[place]

    def phase(self, step: int) -> Form:
        """What is learnt when so many updates are done."""
        return next((phase for phase in PHASES if step < self.ended(phase)), PHASES[-1])

    def ended(self, phase: Form) -> int:
        """The update after which a phase ended, or must end at the latest."""
        config, number = self.config, PHASES.index(phase)
        first = self.ended(PHASES[number - 1]) if number else 0
        enough = getattr(config.pass_marks, phase)
        steps = (int(e["step"]) for e in self.log() if e["step"] > first and e.get(f"eval_{phase}_items", 0) >= enough)
        return min(steps, default=first + getattr(config.max_updates, phase))

    def rate(self, step: int) -> float:
        """Share of the learning rate after so many updates: it rises, stays, and falls to a tenth in the last phase.

        What was learnt at a high rate settles while it falls (Hu et al. 2024, arXiv 2404.06395).
        """
        first = self.ended(PHASES[-2])
        fallen = (step - first) / float(getattr(self.config.max_updates, PHASES[-1]))
        rise = (step + 1) / max(1, self.config.warmup)
        return min(1.0, rise, 1 - (1 - LOWEST) * min(1.0, fallen))

    def exam(self, phase: Form) -> list[Encoded]:
        """Items that are never trained on, of one question; combinations of our properties are held out."""
        rngs = (random.Random(derive_seed(self.seed, "exam", phase, i)) for i in range(self.config.check_items))
        return [encode_item(draw(rng, phase, held=True), self.tokenizer, self.system_prompt) for rng in rngs]

    def _draw_update(self, update: int, phase: Form) -> list[Encoded]:
        rngs = (random.Random(derive_seed(self.seed, "teach", update, i)) for i in range(self.config.batch_size))
        drawn = [encode_item(draw_of(phase, rng), self.tokenizer, self.system_prompt) for rng in rngs]
        return sorted(drawn, key=lambda e: len(e.input_ids))


def collate(batch: Sequence[Encoded]) -> dict[str, torch.Tensor]:
    """Input ids and labels (batch x length), padded on the right with a token that no other one sees."""
    padding = {"input_ids": 0, "labels": IGNORE_INDEX}
    pad = torch.nn.utils.rnn.pad_sequence
    return {name: pad([torch.tensor(getattr(e, name)) for e in batch], True, value) for name, value in padding.items()}


class Pupil(nn.Module):
    """A language model that gives its loss on the answers' tokens; logits are computed for those alone."""

    _keys_to_ignore_on_save = None  # read by transformers' Trainer when it reloads a checkpoint
    accepts_loss_kwargs = True  # has Trainer count an update's tokens and give them to `forward`

    def __init__(self, llm: PreTrainedModel) -> None:
        super().__init__()
        self.llm = llm

    def predict(self, input_ids: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Logits (labelled tokens x vocabulary, at least float32) and the tokens that they ought to be."""
        targets = labels[:, 1:]
        learned = targets != IGNORE_INDEX
        columns = learned.any(0).nonzero().flatten()
        logits = self.llm(input_ids=input_ids, use_cache=False, logits_to_keep=columns).logits[learned[:, columns]]
        return logits.to(torch.promote_types(logits.dtype, torch.float32)), targets[learned]

    def forward(
        self, input_ids: torch.Tensor, labels: torch.Tensor, num_items_in_batch: torch.Tensor | int | None = None
    ) -> CausalLMOutput:
        """Cross-entropy over the labelled tokens, divided by their number in the whole update."""
        logits, targets = self.predict(input_ids, labels)
        loss = F.cross_entropy(logits, targets, reduction="sum")
        count = len(targets) if num_items_in_batch is None else num_items_in_batch
        return CausalLMOutput(loss=loss / torch.as_tensor(count, device=loss.device).clamp(min=1))

    @torch.inference_mode()
    def exact(self, exam: Sequence[Encoded], batch_size: int) -> float:
        """Share of items whose whole answer would be generated greedily: one pass, nothing is generated."""
        device, right = self.llm.get_input_embeddings().weight.device, 0
        ordered = sorted(exam, key=lambda e: len(e.input_ids))
        for start in range(0, len(ordered), batch_size):
            batch = {name: value.to(device) for name, value in collate(ordered[start : start + batch_size]).items()}
            logits, targets = self.predict(**batch)
            rows = (batch["labels"][:, 1:] != IGNORE_INDEX).nonzero()[:, 0]
            wrong = rows[logits.argmax(-1) != targets].unique()
            right += len(batch["labels"]) - len(wrong)
        return right / len(ordered)


class Teacher(TrainableTrainer):
    """Holds an exam where a Trainer evaluates, and stops when the last phase's is passed."""

    def __init__(self, course: Course, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, train_dataset=course, eval_dataset=course, **kwargs)
        self.course = course
        course.log = lambda: self.state.log_history

    def create_scheduler(
        self, num_training_steps: int, optimizer: torch.optim.Optimizer | None = None
    ) -> torch.optim.lr_scheduler.LRScheduler:
        """The course's own."""
        stepped = optimizer or self.optimizer
        assert stepped is not None
        self.lr_scheduler = torch.optim.lr_scheduler.LambdaLR(stepped, lambda step: self.course.rate(step))
        return self.lr_scheduler

    def evaluate(self, *_: Any, **__: Any) -> dict[str, float]:
        """The exam of the phase that the training is in."""
        step, pupil = self.state.global_step, self.accelerator.unwrap_model(self.model)
        # The exam at a phase's last update is that phase's.
        phase = self.course.phase(step - 1)
        pupil.eval()
        metrics = {f"eval_{phase}_items": pupil.exact(self.course.exam(phase), self.args.per_device_eval_batch_size)}
        self.log(metrics)
        print(f"teach: {phase} items right at update {step}: {metrics[f'eval_{phase}_items']:.2f}", flush=True)
        if phase == "whole" and step >= self.course.ended("whole"):
            self.control.should_training_stop = True
            # The Trainer looks at these once more where the epoch ends, and a finished training's checkpoint would be
            # trained on.
            self.control.should_evaluate = self.control.should_save = False
        return metrics


def teach(
    config: TeachConfig,
    language: LanguageConfig,
    runtime: RuntimeConfig,
    *,
    stage: str,
    seed: int,
    callbacks: Sequence[TrainerCallback] = (),
) -> tuple[PreTrainedModel, PreTrainedTokenizerBase, Trained]:
    """Teach the base model.

    Returns:
        The PEFT model around the base, the base's own tokenizer, and the curve.

    Raises:
        UserError: where the base cannot be loaded, or the training diverges.
    """
    from peft import LoraConfig, get_peft_model

    folder = Path(config.base)
    seed_everything(seed)
    dtype = name_dtype(language.dtype, runtime.device)
    base, tokenizer = load_llm(folder, resolve_dtype(dtype), key="teach.base"), load_tokenizer(folder, "teach.base")
    lora = LoraConfig(
        r=config.rank, lora_alpha=config.alpha, target_modules="all-linear", task_type="CAUSAL_LM", lora_dropout=0.0
    )
    course = Course(config, tokenizer, language.system_prompt, seed)
    arguments = training_arguments(
        checkpoint_dir(stage, config, language.system_prompt, dtype, seed, folder),
        runtime,
        seed,
        config,
        max_steps=len(course) // config.batch_size,
        learning_rate=config.learning_rate,
        logging_steps=config.check_every,
        eval_strategy="steps",
        eval_steps=config.check_every,
        # The adapters stay in float32 and are multiplied in the base's format, which took a fifth less time.
        bf16=dtype == "bfloat16",
    )
    trainer = Teacher(
        course,
        model=Pupil(get_peft_model(base, lora)),
        args=arguments,
        data_collator=collate,
        callbacks=[TrainingMonitor(), *callbacks],
        sampler=SequentialSampler(course),
    )
    trained = train(trainer)
    return trainer.accelerator.unwrap_model(trainer.model).llm.eval(), tokenizer, trained


def write_taught(
    folder: Path, llm: Any, config: TeachConfig, language: LanguageConfig, seed: int, history: Sequence[Measurement]
) -> PreTrainedModel:
    """Merge the adapters into the base and write a folder as transformers has them, with the base's tokenizer.

    Args:
        llm: The PEFT model; it is merged in place.
        history: Of the teaching.

    Returns:
        The merged model.
    """
    base = Path(config.base)
    folder.mkdir(parents=True, exist_ok=True)
    merged: PreTrainedModel = llm.merge_and_unload()
    merged.save_pretrained(str(folder))
    for file in sorted(base.iterdir()):
        if file.is_file() and file.name not in KEPT and not {".safetensors", ".bin", ".gguf"} & set(file.suffixes):
            shutil.copyfile(file, folder / file.name)
    write_card(
        folder,
        "A language model, taught to reason about described things",
        bases={"language model": base},
        data={
            "text": "made-up things whose qualities are told: comparing, choosing the extreme, matching, needs",
            "properties": ", ".join(items.words().properties),
            "left out": "the tasks' templates, the catalogue's objects, every third combination of "
            + ", ".join(items.OURS),
            "updates": max((m.step for m in history), default=0),
        },
        settings={**config.model_dump(), "number format": language.dtype, "seed": seed},
        limits=(
            "It was taught in text alone and has felt nothing.",
            "Results on PC, PSS, POM and PSR owe part of their reasoning to this teaching: name it beside them.",
            "What else the base could do may have suffered; that was not measured.",
        ),
    )
    return merged

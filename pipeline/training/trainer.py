"""What all trainings share: the Trainer, its arguments, checkpoints that survive a kill, and the recorded curve."""

from __future__ import annotations

import json
import logging
import os
import shutil
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from zipfile import BadZipFile, ZipFile

import torch
from accelerate.utils import save_fsdp_optimizer
from accelerate.utils.constants import OPTIMIZER_NAME
from pydantic import BaseModel
from safetensors import SafetensorError, safe_open
from torch.utils.data import Sampler
from transformers import PrinterCallback, Trainer, TrainerCallback, TrainerControl, TrainerState, TrainingArguments
from transformers.trainer import SCHEDULER_NAME, TRAINER_STATE_NAME, TRAINING_ARGS_NAME
from transformers.trainer_utils import get_last_checkpoint
from transformers.utils import SAFE_WEIGHTS_NAME

from pipeline.config import EncoderConfig, PretrainConfig, RuntimeConfig, TrainConfig
from pipeline.core.io import code_of, fingerprint
from pipeline.core.layout import CHECKPOINTS
from pipeline.core.records import Measurement
from pipeline.core.runtime import PORTABLE, limit_threads, resolve_device
from pipeline.running.errors import UserError
from pipeline.running.progress import LogLines
from pipeline.training.sampling import EpochDataset
from pipeline.training.trainable import load_trainable, whole_state

logger = logging.getLogger(__name__)


class TrainableTrainer(Trainer):
    """A Trainer whose checkpoints hold only what is trained, and whose parts may learn at rates of their own.

    The frozen base would otherwise be written again with each checkpoint (13 GB for Vicuna-7b).

    Args:
        rates: Learning rate of the parameters under each name.
        constant: Names in `rates` whose learning rate is constant.
        sampler: The order of the training set, where it is not simply random.
    """

    def __init__(
        self,
        *args: Any,
        callbacks: Sequence[TrainerCallback] = (),
        rates: Mapping[str, float] | None = None,
        constant: Collection[str] = (),
        sampler: Sampler[int] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, callbacks=[TrainingMonitor(), *callbacks], **kwargs)
        self.remove_callback(PrinterCallback)
        self._rates, self._constant, self._sampler = rates, constant, sampler
        self.optimizer: torch.optim.Optimizer | None

    def _get_train_sampler(self, train_dataset: Any = None) -> Sampler[int] | None:
        return self._sampler or cast("Sampler[int] | None", super()._get_train_sampler(train_dataset))

    def _get_num_items_in_batch(
        self, batch_samples: list[dict[str, torch.Tensor]], device: torch.device
    ) -> torch.Tensor | int | None:
        """What an update's loss is divided by: the sum of its weights over all devices; without any, its labels."""
        if not batch_samples or "weights" not in batch_samples[0]:
            return cast("torch.Tensor | int | None", super()._get_num_items_in_batch(batch_samples, device))
        total = torch.stack([batch["weights"].sum() for batch in batch_samples]).sum()
        return cast(torch.Tensor, self.accelerator.gather(total.to(device))).sum()

    def create_optimizer(self, model: torch.nn.Module | None = None) -> torch.optim.Optimizer:
        """AdamW with one parameter group for each prefix in `rates`; without `rates`, the Trainer's own optimizer."""
        if self._rates is None:
            return cast(torch.optim.Optimizer, super().create_optimizer(model))
        if self.optimizer is None:
            # By name, not by identity: distributed wrappers replace the parameters and prefix their names.
            trained = [(n, p) for n, p in (model or self.model).named_parameters() if p.requires_grad]
            groups: list[dict[str, Any]] = [
                # Dots on both sides, so that a prefix matches whole parts of a name only.
                {"params": [p for n, p in trained if f".{prefix}." in f".{n}."], "lr": rate}
                for prefix, rate in self._rates.items()
            ]
            # A parameter without a group would stay as it was drawn, and nothing would show.
            assert sum(len(group["params"]) for group in groups) == len(trained), f"rates for {list(self._rates)} alone"
            # Fused, as `training_arguments` has it.
            self.optimizer = torch.optim.AdamW(groups, weight_decay=self.args.weight_decay, fused=True)
        return self.optimizer

    def create_scheduler(
        self, num_training_steps: int, optimizer: torch.optim.Optimizer | None = None
    ) -> torch.optim.lr_scheduler.LRScheduler:
        """The Trainer's own schedule, except that rates in `constant` do not change."""
        scheduler = cast(torch.optim.lr_scheduler.LambdaLR, super().create_scheduler(num_training_steps, optimizer))
        for place, name in enumerate(self._rates or ()):
            if name in self._constant:
                scheduler.lr_lambdas[place] = lambda _: 1.0
                # Making the scheduler has already set the rate of the first step, which is 0 in a warm-up.
                scheduler.optimizer.param_groups[place]["lr"] = scheduler.base_lrs[place]
        return scheduler

    def save_model(self, output_dir: str | None = None, _internal_call: bool = False) -> None:
        """Write what is trained; all processes must call it, the first one writes."""
        trained = whole_state(self.accelerator.unwrap_model(self.model))
        check_finite(trained, self.state.global_step)
        if self.args.should_save:
            self._save(output_dir, {name: value.contiguous() for name, value in trained.items()})

    def _save_optimizer_and_scheduler(self, output_dir: str) -> None:
        if not self.is_fsdp_enabled:
            super()._save_optimizer_and_scheduler(output_dir)
            return
        # The Trainer would also have accelerate write the whole model here.
        plugin = self.accelerator.state.fsdp_plugin
        save_fsdp_optimizer(plugin, self.accelerator, self.optimizer, self.model, output_dir)
        if self.args.should_save:
            torch.save(self.lr_scheduler.state_dict(), Path(output_dir) / SCHEDULER_NAME)

    def _load_from_checkpoint(self, resume_from_checkpoint: str, model: torch.nn.Module | None = None) -> None:
        # The Trainer's own way warns of each frozen weight that a checkpoint lacks, and wants another format of FSDP's.
        load_trainable(model or self.model, Path(resume_from_checkpoint) / SAFE_WEIGHTS_NAME)


def check_finite(values: Mapping[str, torch.Tensor], step: int) -> None:
    """Raise UserError where a trained parameter, or what is logged of a training, is not finite."""
    if broken := next((name for name, value in values.items() if not value.isfinite().all()), None):
        raise UserError(
            f"{broken} is not finite at step {step}: the training diverged; lower the learning rate (earlier "
            "checkpoints are kept)"
        )


class TrainingMonitor(TrainerCallback):
    """Sets the data set's epoch, logs how far a training is, and stops it where loss or gradient is not finite."""

    _lines: LogLines | None = None

    def on_epoch_begin(
        self, args: TrainingArguments, state: TrainerState, control: TrainerControl, **handled: Any
    ) -> None:
        """Tell the training set its epoch: a data loader that resumes in mid-epoch would call that one the first."""
        if isinstance(data := handled["train_dataloader"].dataset, EpochDataset):
            # The state's epoch has a fraction for the steps within one.
            data.epoch = int(state.epoch or 0)

    def on_log(self, args: TrainingArguments, state: TrainerState, control: TrainerControl, **handled: Any) -> None:
        """Called by the Trainer after each logging step; UserError where loss or the gradient's norm is not finite."""
        values = logged_figures(handled["logs"])
        losses = {n: torch.tensor(v) for n, v in values.items() if n in ("loss", "grad_norm", "validation_loss")}
        check_finite(losses, state.global_step)
        # At a terminal the Trainer has a bar of its own.
        if state.is_world_process_zero and args.disable_tqdm and "loss" in values:
            self._lines = self._lines or LogLines("training", state.max_steps, "step", after=state.global_step)
            self._lines.reached(state.global_step, f"loss {values['loss']:.3f}")


def checkpoint_dir(stage: str, *parts: BaseModel | str | int | Path) -> Path:
    """Where a training keeps its checkpoints, outside DVC's reach (DVC deletes a killed stage's outputs).

    The key has the stage's code, `stage` being its name in dvc.yaml, the kernels, and `parts`, the settings and input
    files that the training depends on: one version never goes on with another's training.
    """
    portable = PORTABLE.items() <= os.environ.items()
    return CHECKPOINTS / stage / fingerprint(*parts, str(portable), *code_of(stage))


@dataclass(frozen=True)
class Trained:
    """What a training leaves: its curve, and the trained parameters by name, whole even where they were sharded."""

    history: list[Measurement]
    state: dict[str, torch.Tensor]


def check_accelerate() -> None:
    """Raise UserError where a launcher, or a shell, told accelerate to train otherwise than the parameters say."""
    switches = ("USE_DEEPSPEED", "USE_MEGATRON_LM", "USE_PARALLELISM_CONFIG")
    meant = {"ACCELERATE_MIXED_PRECISION": "no", "ACCELERATE_DYNAMO_BACKEND": "no", "FSDP_VERSION": "2"}
    meant |= {f"ACCELERATE_{switch}": "false" for switch in switches}
    # Without a version accelerate takes FSDP 1, which renames the trained parameters: no name in `rates` would match.
    unnamed = {"FSDP_VERSION": "1"} if "ACCELERATE_USE_FSDP" in os.environ else {}
    for name, value in meant.items():
        found = os.environ.get(name, unnamed.get(name, value))
        if found.lower() != value:
            raise UserError(
                f"runtime.launcher: {name} is {found}, which would change what is trained; launch with a file of "
                "conf/accelerate, and unset the variable in your shell"
            )


def training_arguments(
    folder: Path, runtime: RuntimeConfig, seed: int, config: TrainConfig | EncoderConfig | PretrainConfig, **own: Any
) -> TrainingArguments:
    """What all trainings share: AdamW, a cosine, checkpoints every `runtime.save_steps`; `own` adds and overrides.

    An update has `batch_size` items of `config` over all devices, in parts where it has a `micro_batch_size`.
    """
    limit_threads(runtime.threads)
    check_accelerate()
    batch, devices = config.batch_size, int(os.environ.get("WORLD_SIZE", "1"))
    micro = min(getattr(config, "micro_batch_size", 0) or batch, batch)
    if batch % (micro * devices):
        raise UserError(f"micro_batch_size {micro} on {devices} devices does not divide batch_size {batch}; lower it")
    shared: dict[str, Any] = {
        "output_dir": str(folder),
        "seed": seed,
        "per_device_train_batch_size": micro,
        "per_device_eval_batch_size": micro,
        "gradient_accumulation_steps": batch // (micro * devices),
        "max_grad_norm": config.max_grad_norm,
        # Fused: MKL's roots, which AdamW takes else, depend on the maker of the processor.
        "optim": "adamw_torch_fused",
        "lr_scheduler_type": "cosine",
        "save_strategy": "steps" if runtime.save_steps else "no",
        "save_steps": runtime.save_steps or 500,
        "save_total_limit": 1,
        "label_names": ["labels"],
        "logging_nan_inf_filter": False,
        "remove_unused_columns": False,
        "dataloader_pin_memory": False,
        "report_to": "none",
        # A bar is for a person at a terminal; a log file gets a line now and then.
        "disable_tqdm": not sys.stderr.isatty(),
        "use_cpu": resolve_device(runtime.device).type == "cpu",
    }
    arguments = TrainingArguments(**shared | own)
    if arguments.device.type == "cuda":
        # One process must not spread over several GPUs; that is accelerate's task, one process a GPU.
        arguments._n_gpu = 1
    return arguments


def train(trainer: Trainer) -> Trained:
    """Train to the end, from the last checkpoint where there is one; the stage removes them when all is written.

    Where the arguments name a `metric_for_best_model`, what the epoch with the best one reached is kept.
    """
    folder = Path(str(trainer.args.output_dir))
    if trainer.is_world_process_zero():
        _drop_damaged(folder)
    trainer.accelerator.wait_for_everyone()
    last = get_last_checkpoint(str(folder)) if folder.is_dir() else None
    if last and (Path(last) / f"{OPTIMIZER_NAME}.bin").is_file() != trainer.is_fsdp_enabled:
        raise UserError(
            f"{last}: was written {'unsharded' if trainer.is_fsdp_enabled else 'sharded'}; go on with the "
            "runtime.launcher that it was begun with, or delete the folder"
        )
    trainer.train(resume_from_checkpoint=last)
    model = trainer.accelerator.unwrap_model(trainer.model)
    if trainer.state.best_model_checkpoint:
        # Not by `load_best_model_at_end`, which would warn of each frozen weight that the checkpoint lacks.
        load_trainable(model, Path(trainer.state.best_model_checkpoint) / SAFE_WEIGHTS_NAME)
    state = whole_state(model)
    check_finite(state, trainer.state.global_step)
    history = [
        Measurement(step=entry["step"], name=name, value=value)
        for entry in trainer.state.log_history
        # Sorted: a resumed state has its names in alphabetical order, a fresh one in the order of logging.
        for name, value in sorted(logged_figures(entry).items())
    ]
    return Trained(history, state)


def _drop_damaged(folder: Path) -> None:
    """Remove checkpoints that were being written when their process died, and those that cannot be read whole."""
    for checkpoint in folder.glob("checkpoint-*"):
        if not (checkpoint / TRAINER_STATE_NAME).is_file():  # The Trainer writes it last.
            shutil.rmtree(checkpoint)
        elif (file := next((f for f in sorted(checkpoint.iterdir()) if not _is_whole(f)), None)) is not None:
            logger.warning("%s is damaged; training goes on from the checkpoint before it, or begins anew", file)
            shutil.rmtree(checkpoint)


def _is_whole(file: Path) -> bool:
    """Whether a file of a checkpoint can be read and, where its format has checksums, they are right."""
    try:
        if file.suffix == ".json":
            json.loads(file.read_text(encoding="utf-8"))
        elif file.suffix == ".safetensors":
            with safe_open(file, "pt"):
                pass
        elif file.suffix in (".pt", ".pth", ".bin") and file.name != TRAINING_ARGS_NAME:
            # torch's own format is a zip file, whose parts have checksums.
            with ZipFile(file) as parts:
                return parts.testzip() is None
    except (ValueError, BadZipFile, SafetensorError, EOFError, OSError):
        return False
    return True


def logged_figures(entry: Mapping[str, object]) -> dict[str, float]:
    """What of a log entry is a figure of the training: not its bookkeeping, nor wall-clock times."""
    bookkeeping = ("step", "epoch", "total_flos", "train_loss")
    return {
        "validation_loss" if name == "eval_loss" else name.removeprefix("eval_"): float(value)
        for name, value in entry.items()
        if isinstance(value, (int, float)) and name not in bookkeeping and not name.endswith(("_runtime", "_second"))
    }

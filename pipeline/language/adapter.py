"""LoRA adapters on disk, in PEFT's own format: plain `PeftModel.from_pretrained(base, folder)` loads them.

PEFT is imported where it is needed: a model without an adapter is ready seconds sooner.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from transformers import PreTrainedModel

from pipeline.errors import UserError
from pipeline.io import read_json, write_json

CONFIG_FILE = "adapter_config.json"
WEIGHTS_FILE = "adapter_model.safetensors"


def save_adapter(llm: PreTrainedModel, folder: Path, state: Mapping[str, torch.Tensor]) -> None:
    """Write the adapter of a PEFT model, the same bytes for the same values; of others nothing.

    Args:
        state: The language model's parameters by name, whole even where its own are sharded.
    """
    from peft import PeftModel

    if isinstance(llm, PeftModel):
        llm.save_pretrained(str(folder), state_dict=dict(state))
        # PEFT writes a set, whose order differs from process to process, and an empty model card.
        values = read_json(folder / CONFIG_FILE)
        write_json(folder / CONFIG_FILE, {**values, "target_modules": sorted(values["target_modules"])})
        (folder / "README.md").unlink(missing_ok=True)


def load_adapter(llm: PreTrainedModel, folder: Path) -> PreTrainedModel:
    """The language model with the adapter of a folder on it (float32, frozen).

    Raises:
        UserError: for a missing file, a pickle, or an adapter of another language model.
    """
    from peft import PeftModel

    for name in (CONFIG_FILE, WEIGHTS_FILE):
        if not (folder / name).is_file():
            raise UserError(f"{folder / name}: no such file (pickled adapters are refused); `dvc repro` makes it")
    try:
        return PeftModel.from_pretrained(llm, str(folder))
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{folder}: its adapter is broken or of another language model ({reason}); run `dvc repro`"
        ) from None

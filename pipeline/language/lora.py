"""Where LoRA is put on the language model."""

from __future__ import annotations

from torch import nn

from pipeline.config import LoraTrainConfig
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.running.errors import UserError


def add_lora(model: OctopiForCausalLM, config: LoraTrainConfig) -> None:
    """Add new LoRA adapters (float32) to the language model's linear layers, or train those that it has already.

    Layers that it lacks, or an adapter of another shape, are a UserError.
    """
    from peft import LoraConfig, PeftModel, get_peft_model
    from peft.tuners.tuners_utils import BaseTunerLayer

    if isinstance(model.llm, PeftModel):
        own = model.llm.peft_config["default"]
        for name, value in {"rank": own.r, "alpha": own.lora_alpha, "dropout": own.lora_dropout}.items():
            if value != getattr(config, name):
                raise UserError(f"lora.{name}: the adapter to train on has {value}; set lora.{name}={value}")
        # The layers that bear an adapter, and those of `all-linear`: all but the one that says words.
        base = model.llm.get_base_model()
        last, whole = base.get_output_embeddings(), [each for each in base.named_modules() if ".lora_" not in each[0]]
        layers = [(name.removesuffix(".base_layer").rsplit(".", 1)[-1], module) for name, module in whole]
        has = {name for name, layer in layers if isinstance(layer, BaseTunerLayer)}
        every = {name for name, layer in layers if isinstance(layer, nn.Linear) and layer is not last}
        if has != (every if config.target_modules == "all-linear" else set(config.target_modules)):
            own = "all-linear" if has == every else f"[{','.join(sorted(has))}]"
            raise UserError(f"lora.target_modules: the adapter to train on has {own}; set lora.target_modules={own}")
        for name, value in model.llm.named_parameters():
            value.requires_grad_("lora_" in name)
        return
    names = {name.rsplit(".", 1)[-1] for name, _ in model.llm.named_modules()}
    modules = config.target_modules if isinstance(config.target_modules, str) else list(config.target_modules)
    unknown = [] if isinstance(modules, str) else [module for module in modules if module not in names]
    if unknown:
        linear = ", ".join(sorted(n for n in names if n.endswith(("_proj", "lm_head"))))
        raise UserError(f"lora.target_modules: the language model has no layer {unknown[0]}; it has {linear}")
    shape = {"r": config.rank, "lora_alpha": config.alpha, "lora_dropout": config.dropout}
    model.llm = get_peft_model(model.llm, LoraConfig(**shape, target_modules=modules, task_type="CAUSAL_LM"))

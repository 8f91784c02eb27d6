"""Where LoRA is put on the language model."""

from __future__ import annotations

from pipeline.config import LoraTrainConfig
from pipeline.core.errors import UserError
from pipeline.language.octopi import OctopiForCausalLM


def add_lora(model: OctopiForCausalLM, config: LoraTrainConfig) -> None:
    """Add new LoRA adapters (float32) to the language model's linear layers, or train those that it has already.

    Layers that it lacks, or an adapter of another shape, are a UserError.
    """
    from peft import LoraConfig, PeftModel, get_peft_model

    if isinstance(model.llm, PeftModel):
        own = model.llm.peft_config["default"]
        for name, has in {"rank": own.r, "alpha": own.lora_alpha, "dropout": own.lora_dropout}.items():
            if has != getattr(config, name):
                raise UserError(f"lora.{name}: the adapter to train on has {has}; set lora.{name}={has}")
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

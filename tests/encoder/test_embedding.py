"""Which of CLIP's features heads and language model are given: its embedding, or the class token before projection."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pipeline.encoder.recipes import base_encoder
from tests.encoder.test_recipes import Tower
from tests.encoders import close, config, write_tower

WIDTH = {"projected": 16, "class_token": 32}
"""Of the tiny CLIP: its embedding's length and its transformer's width, as 768 and 1024 are ViT-L/14's."""


@pytest.mark.parametrize("name", list(WIDTH))
def test_the_base_encoder_reads_what_is_named(name: str, tmp_path: Path) -> None:
    weights = write_tower(tmp_path)
    frames = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    tower = Tower(weights)
    normalised = tower.norm(tower.token(frames), "ln_post")
    projection = load_file(weights / "open_clip_model.safetensors")["visual.proj"].double().numpy()
    encoder = base_encoder(config(weights, "paper", embedding=name))
    found = encoder(torch.from_numpy(frames), torch.arange(3))
    assert encoder.dim == found.shape[1] == WIDTH[name]
    close(found, normalised if name == "class_token" else normalised @ projection)


def test_release_reads_the_class_token_whatever_is_named(tmp_path: Path) -> None:
    weights, frames = write_tower(tmp_path), torch.zeros(2, 32, 32, 3, dtype=torch.uint8)
    one, other = (base_encoder(config(weights, "release", embedding=name)) for name in WIDTH)
    assert one.dim == other.dim == WIDTH["class_token"]
    assert torch.equal(one(frames, torch.arange(2)), other(frames, torch.arange(2)))

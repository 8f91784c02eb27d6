"""Sparsh: a tiny checkpoint with the published names and shapes, against a forward pass of its own in float64."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.encoder.timm_backbone import load_backbone
from pipeline.weights.published import adopt
from pipeline.weights.sparsh import write
from tests.conftest import refused

pytestmark = pytest.mark.usefixtures("elsewhere")

WIDTH, HEADS, REGISTERS, DEPTH, PATCH, SIDE = 128, 2, 2, 3, 16, 224
State = dict[str, torch.Tensor]


def checkpoint() -> State:
    """As facebook/sparsh-dino-base has it but for width and depth: no bias is 0 and no scale is 1."""
    draw = torch.Generator().manual_seed(0)

    def some(*shape: int) -> torch.Tensor:
        return 0.1 * torch.randn(shape, generator=draw)

    state = {
        "patch_embed.proj.weight": some(WIDTH, 6, PATCH, PATCH),
        "patch_embed.proj.bias": some(WIDTH),
        "register_tokens": some(1, REGISTERS, WIDTH),
        "pos_embed.frequency_bands": 10_000.0 ** -torch.arange(0, 1, 4 / WIDTH).expand(2, -1).clone(),
        "mask_token": some(1, WIDTH),
        "norm.weight": 1 + some(WIDTH),
        "norm.bias": some(WIDTH),
    }
    for block in range(DEPTH):
        b = f"blocks.{block}"
        for name, out, into in (("attn.qkv", 3, 1), ("attn.proj", 1, 1), ("mlp.fc1", 4, 1), ("mlp.fc2", 1, 4)):
            state[f"{b}.{name}.weight"] = some(out * WIDTH, into * WIDTH)
            state[f"{b}.{name}.bias"] = some(out * WIDTH)
        for part in ("1", "2"):
            state |= {f"{b}.norm{part}.weight": 1 + some(WIDTH), f"{b}.norm{part}.bias": some(WIDTH)}
            state[f"{b}.ls{part}.gamma"] = some(WIDTH)
    return state


def patches_of(state: State, pairs: torch.Tensor) -> torch.Tensor:
    """The last block's patches, in float64: batch x patches x width, of two pictures each: batch x 6 x side x side."""
    w = {name: value.double() for name, value in state.items()}
    grid = SIDE // PATCH
    x = F.conv2d(pairs, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"], stride=PATCH)
    tokens = x.flatten(2).transpose(1, 2).clone()
    for place in range(grid * grid):
        row, column = (n * w["pos_embed.frequency_bands"][axis] for axis, n in enumerate(divmod(place, grid)))
        tokens[:, place] += torch.cat([row.sin(), row.cos(), column.sin(), column.cos()])
    tokens = torch.cat([w["register_tokens"].expand(len(tokens), -1, -1), tokens], dim=1)
    for block in range(DEPTH):
        b = {name.removeprefix(f"blocks.{block}."): v for name, v in w.items() if name.startswith(f"blocks.{block}.")}
        y = F.layer_norm(tokens, (WIDTH,), b["norm1.weight"], b["norm1.bias"], eps=1e-6)
        heads = (y @ b["attn.qkv.weight"].T + b["attn.qkv.bias"]).unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = heads
        y = ((q @ k.transpose(2, 3) / (WIDTH // HEADS) ** 0.5).softmax(3) @ v).transpose(1, 2).flatten(2)
        tokens = tokens + b["ls1.gamma"] * (y @ b["attn.proj.weight"].T + b["attn.proj.bias"])
        y = F.layer_norm(tokens, (WIDTH,), b["norm2.weight"], b["norm2.bias"], eps=1e-6)
        y = F.gelu(y @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"]) @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"]
        tokens = tokens + b["ls2.gamma"] * y
    return tokens[:, REGISTERS:]


def adopted(*files: str) -> Path:
    """What is made of a download with the checkpoint in these files."""
    Path("download").mkdir()
    for name in files:
        save_file(checkpoint(), f"download/{name}.safetensors")
    Path("download/README.md").write_text("a card with its licence")
    return adopt("sparsh", Path("download"), Path("sparsh"))


def test_features_are_those_of_an_independent_forward_pass_of_the_same_picture_twice() -> None:
    folder = adopted("dino_vitbase")
    assert {f.name for f in folder.iterdir()} == {"config.json", "model.safetensors", "README.md", "SHA256SUMS"}
    settings = {"recipe": "tuned", "backbone": ("timm",), "reference": "subtract", "feature_stage": DEPTH - 1}
    backbone = load_backbone(EncoderConfig.model_validate(settings | {"weights": str(folder)}), tuned=False)
    # Differences of a picture to the untouched one, and what `encoder.reference=subtract` shows of them.
    differences = torch.randint(-60, 60, (2, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(1))
    features = backbone((128 + 2 * differences).to(torch.uint8), torch.zeros(2))
    picture = (differences / 255 + 0.5).permute(0, 3, 1, 2).double()
    patches = patches_of(checkpoint(), torch.cat([picture, picture], dim=1))
    expected = torch.cat([patches.mean(1), patches.std(1, correction=0)], dim=1)
    torch.testing.assert_close(features.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"norm.weight": None}, "norm.weight"),
        ({"blocks.0.attn.qkv.weight": torch.zeros(5, WIDTH)}, "attn.qkv.weight"),
        ({"patch_embed.proj.weight": torch.zeros(WIDTH, 3, PATCH, PATCH)}, "3 channels"),
    ],
)
def test_another_layout_is_named(tmp_path: Path, change: dict[str, torch.Tensor | None], why: str) -> None:
    stored = {name: value for name, value in (checkpoint() | change).items() if value is not None}
    with refused(f"sparsh: .*{why}"):
        write(tmp_path, stored, "sparsh")

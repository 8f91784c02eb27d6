"""What the recipes compute, against towers and heads that are written anew here, in float64."""

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from scipy.special import log_softmax
from scipy.stats import kstest, norm, uniform

from pipeline.core.runtime import seed_everything
from pipeline.encoder.clip import TactileEncoder, VisualPrompts
from pipeline.encoder.model import Heads
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.release import PublishedHeads
from tests.checkpoints import CLIP_CONFIG
from tests.encoders import FRAME_INDICES, Floats, close, config, float64, write_tower

pytestmark = pytest.mark.usefixtures("elsewhere")


class Tower:
    """CLIP's visual transformer in NumPy and float64, from the checkpoint's bare tensors."""

    def __init__(self, folder: Path) -> None:
        tensors = load_file(folder / "open_clip_model.safetensors")
        self.state = {k[7:]: v.double().numpy() for k, v in tensors.items() if k.startswith("visual.")}
        self.mean, self.std = (np.array(CLIP_CONFIG["preprocess_cfg"][name]) for name in ("mean", "std"))

    def tokens(self, pictures: Floats, prompts: Sequence[Floats] = (), *, normed: bool = False) -> Floats:
        """Class token and patches after the last block, of pictures (0 to 255), batch x side x side x RGB.

        Args:
            prompts: Count x width a layer, which take the place of those of the layer before; layers behind get none.
            normed: Whether the first layer's prompts go through ln_pre.
        """
        kernel = self.state["conv1.weight"]
        width, _, patch, _ = kernel.shape
        side = pictures.shape[1] // patch
        pixels = (pictures.astype(np.float64) / 255 - self.mean) / self.std
        blocks = pixels.reshape(-1, side, patch, side, patch, 3)
        patches = np.einsum("bipjqc,wcpq->bijw", blocks, kernel).reshape(len(pictures), -1, width)
        first = np.broadcast_to(self.state["class_embedding"], (len(pictures), 1, width))
        tokens = np.concatenate([first, patches], axis=1) + self.state["positional_embedding"]
        tokens, own = self.norm(tokens, "ln_pre"), tokens.shape[1]
        for layer in range(2):
            if layer < len(prompts):
                added = self.norm(prompts[layer], "ln_pre") if normed and layer == 0 else prompts[layer]
                tokens = np.concatenate([tokens[:, :own], np.repeat(added[None], len(tokens), axis=0)], axis=1)
            tokens = self.block(tokens, f"transformer.resblocks.{layer}")
        return tokens[:, :own]

    def block(self, x: Floats, name: str) -> Floats:
        width = x.shape[-1]
        mixed = self.linear(self.norm(x, f"{name}.ln_1"), f"{name}.attn.in_proj_weight", f"{name}.attn.in_proj_bias")
        query, key, value = (
            part.reshape(*x.shape[:2], width // 16, 16).swapaxes(1, 2) for part in np.split(mixed, 3, axis=-1)
        )
        scores = np.exp(query @ key.swapaxes(-1, -2) / 4)
        seen = (scores / scores.sum(axis=-1, keepdims=True) @ value).swapaxes(1, 2).reshape(x.shape)
        x = x + self.linear(seen, f"{name}.attn.out_proj.weight", f"{name}.attn.out_proj.bias")
        hidden = self.linear(self.norm(x, f"{name}.ln_2"), f"{name}.mlp.c_fc.weight", f"{name}.mlp.c_fc.bias")
        hidden = hidden / (1 + np.exp(-1.702 * hidden))
        return x + self.linear(hidden, f"{name}.mlp.c_proj.weight", f"{name}.mlp.c_proj.bias")

    def norm(self, x: Floats, name: str) -> Floats:
        centred = x - x.mean(axis=-1, keepdims=True)
        scaled = centred / np.sqrt((centred**2).mean(axis=-1, keepdims=True) + 1e-5)
        return scaled * self.state[f"{name}.weight"] + self.state[f"{name}.bias"]

    def linear(self, x: Floats, weight: str, bias: str) -> Floats:
        return x @ self.state[weight].T + self.state[bias]

    def embedding(self, token: Floats) -> Floats:
        return self.norm(token, "ln_post") @ self.state["proj"]


def waves(frame_indices: Floats, dim: int) -> Floats:
    """Vaswani et al. 2017, section 3.5, one number at a time."""

    def wave(frame_index: float, k: int) -> float:
        angle = frame_index / 10_000 ** (2 * (k // 2) / dim)
        return math.cos(angle) if k % 2 else math.sin(angle)

    return np.array([[wave(frame_index, k) for k in range(dim)] for frame_index in frame_indices.tolist()])


def tuned_encoder(weights: Path, recipe: str, **changes: object) -> TactileEncoder:
    encoder = property_classifier(config(weights, recipe, **changes), [3, 2]).eval().encoder
    assert isinstance(encoder, TactileEncoder)
    return encoder


def own_prompts(encoder: TactileEncoder) -> list[Floats]:
    """What enters the tower at each layer."""
    prompts = encoder.prompts
    assert prompts is not None
    mapped = float64(prompts.prompts)
    if prompts.shared is not None:
        mapped = mapped @ float64(prompts.shared.weight).T + float64(prompts.shared.bias)
    return list(mapped)


@pytest.mark.parametrize(("layers", "prompted"), [(None, 0), (0, 2), (1, 1), (9, 2)])
@pytest.mark.parametrize("recipe", ["paper", "release"])
@pytest.mark.parametrize("averages", [False, True])
def test_encoders_are_the_tower_with_prompts(
    layers: int | None, prompted: int, recipe: str, averages: bool, frames: torch.Tensor, tmp_path: Path
) -> None:
    """As a forward pass without hooks; None is the base. A tower that averages is read by its patches.

    The published prompts enter before the first normalisation and pass no shared map.
    """
    weights, release = write_tower(tmp_path, averages=averages), recipe == "release"
    if layers is None:
        encoder, prompts = base_encoder(config(weights, recipe)), []
    else:
        encoder = tuned_encoder(weights, recipe, prompt_layers=layers)
        with torch.no_grad():
            if release:
                encoder.prompts.prompts.mul_(50)  # As drawn they are so small that a wrong place would hardly show.
            else:
                encoder.prompts.shared.bias.normal_(generator=torch.Generator().manual_seed(2))
        prompts = own_prompts(encoder)
    assert len(prompts) == prompted
    tower, indices = Tower(weights), FRAME_INDICES[:, 1]
    tokens = tower.tokens(frames[:, 1].numpy(), prompts, normed=release)
    token = tokens[:, 1:].mean(axis=1) if averages else tokens[:, 0]
    if release:
        close(encoder(frames[:, 1], indices), token + waves(indices.numpy(), 32))
        close(encoder.describe(frames[:, 1], indices), tower.norm(token, "ln_post") + waves(indices.numpy(), 32))
        assert encoder.dim == 32
    else:
        expected = tower.embedding(tokens)[:, 1:].mean(axis=1) if averages else tower.embedding(token)
        close(encoder(frames[:, 1], indices), expected)
        assert torch.equal(encoder(frames[:, 1], indices), encoder.describe(frames[:, 1], FRAME_INDICES[:, 2]))


def test_the_class_token_is_read_where_it_is_named(frames: torch.Tensor, tmp_path: Path) -> None:
    weights, pictures, indices = write_tower(tmp_path), frames[:, 0], FRAME_INDICES[:, 0]
    tower, encoder = Tower(weights), base_encoder(config(weights, "paper", embedding="class_token"))
    assert encoder.dim == 32
    close(encoder(pictures, indices), tower.norm(tower.tokens(pictures.numpy())[:, 0], "ln_post"))
    names = ("projected", "class_token")
    one, other = (base_encoder(config(weights, "release", embedding=name))(pictures, indices) for name in names)
    assert torch.equal(one, other)


@pytest.mark.parametrize("side", [32, 64, 33, 60])
@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_larger_frames_are_means_over_areas(side: int, recipe: str, weights: Path) -> None:
    """Each pixel of the tower's is the mean of all that its share of the frame touches; of whole multiples, a block."""
    encoder = tuned_encoder(weights, recipe)
    frames = np.random.default_rng(side).integers(0, 256, (2, side, side, 3), dtype=np.uint8)
    borders = [(i * side // 32, -(-(i + 1) * side // 32)) for i in range(32)]
    means = np.array([[frames[:, a:b, c:d].astype(float).mean((1, 2)) for c, d in borders] for a, b in borders])
    tower, indices = Tower(weights), torch.tensor([3, 8])
    token = tower.tokens(means.transpose(2, 0, 1, 3), own_prompts(encoder), normed=recipe == "release")[:, 0]
    expected = token + waves(indices.numpy(), 32) if recipe == "release" else tower.embedding(token)
    close(encoder(torch.from_numpy(frames), indices), expected)


@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_classifiers_stand_on_the_mean_frame(recipe: str, weights: Path, frames: torch.Tensor) -> None:
    """Those of `release` stand on the mean's direction, behind a hidden layer."""
    model = property_classifier(config(weights, recipe), [3, 3, 2]).eval()
    described = model.encoder.describe(frames.flatten(0, 1), FRAME_INDICES.flatten())
    features, heads = float64(described).reshape(4, 3, -1).mean(axis=1), model.heads
    if isinstance(heads, PublishedHeads):
        unit = features / np.sqrt((features**2).sum(axis=1, keepdims=True))
        features = np.maximum(unit @ float64(heads.shared.weight).T + float64(heads.shared.bias), 0)
        heads = heads.properties
    assert isinstance(heads, Heads)
    expected = [features @ float64(h.weight).T + float64(h.bias) for h in heads]
    labels = torch.tensor([[0, 2, 1], [2, 0, 0], [1, 1, 1], [0, 0, 0]])
    found = model(frames, FRAME_INDICES, labels)
    close(found["logits"], np.concatenate(expected, axis=1))
    loss = sum(-log_softmax(z, axis=1)[range(4), y].mean() for z, y in zip(expected, labels.T.numpy(), strict=True))
    assert found["loss"].item() == pytest.approx(loss, rel=1e-5)
    assert (model.decide(found["logits"]).numpy() == np.stack([z.argmax(1) for z in expected], axis=1)).all()


@pytest.mark.parametrize("shared", [False, True])
def test_prompts_are_drawn_as_said(shared: bool) -> None:
    seed_everything(0)
    tower = SimpleNamespace(transformer=SimpleNamespace(width=96, resblocks=range(4)), patch_size=(16, 16))
    values = float64(VisualPrompts(tower, 64, shared=shared).prompts).ravel()
    bound = math.sqrt(6 / (768 + 96))
    assert kstest(values, (uniform(-bound, 2 * bound) if shared else norm(0, 0.02)).cdf).pvalue > 0.01


def test_heads_of_release_ignore_length_and_drop_half_of_the_units() -> None:
    seed_everything(0)
    heads, features = PublishedHeads(8, [2]).eval(), torch.randn(1, 8)
    for scale in (1e-3, 1e15):
        torch.testing.assert_close(heads(features)[0], heads(features * scale)[0], atol=1e-5, rtol=0)
    assert not torch.allclose(heads(features)[0], heads(-features)[0])
    hidden = heads.shared(features / features.norm()).relu().expand(500, -1)
    seen: list[torch.Tensor] = []
    heads.properties[0].register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    heads.train()(features.expand(500, -1))
    kept = seen[0] != 0
    torch.testing.assert_close(seen[0], 2 * hidden * kept)
    assert kept[hidden > 0].float().mean().item() == pytest.approx(0.5, abs=0.05)

"""The recipes of encoders against towers, heads, rates and votes that are written anew here, mostly in float64."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from scipy.special import log_softmax
from scipy.stats import kstest, norm, uniform
from torch.optim.optimizer import register_optimizer_step_pre_hook
from transformers import EvalPrediction, TrainingArguments

from pipeline.config import Recipe
from pipeline.encoder import finetune as training
from pipeline.encoder.clips import ClipDataset, LabelledVideo
from pipeline.encoder.finetune import accuracies, train_classifier
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import Heads, PropertyClassifier, TactileEncoder
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.release import DROPOUT, PublishedEncoder, PublishedHeads, sinusoid
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.vpt import VisualPrompts
from pipeline.errors import UserError
from pipeline.records import Part
from pipeline.runtime import seed_everything
from pipeline.trainable import load_trainable, save_trainable, trainable_state
from pipeline.training import TrainableTrainer
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.weights import check_encoder
from tests.checkpoints import CLIP_CONFIG
from tests.encoders import (
    CPU,
    FRAME_INDICES,
    PARTS,
    Floats,
    close,
    config,
    encoder_data,
    float64,
    random_heads,
    write_frames,
    write_tower,
)

pytestmark = pytest.mark.usefixtures("elsewhere")


class Tower:
    """CLIP's visual transformer in NumPy and float64, from the checkpoint's bare tensors."""

    def __init__(self, folder: Path) -> None:
        tensors = load_file(folder / "open_clip_model.safetensors")
        self.state = {k[7:]: v.double().numpy() for k, v in tensors.items() if k.startswith("visual.")}
        preprocess = CLIP_CONFIG["preprocess_cfg"]
        self.mean, self.std = np.array(preprocess["mean"]), np.array(preprocess["std"])

    def token(self, pictures: Floats, prompts: Sequence[Floats] = (), *, normed: bool = False) -> Floats:
        """The class token after the last block."""
        return self.tokens(pictures, prompts, normed=normed)[:, 0]

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
    table = np.empty((len(frame_indices), dim))
    for row, frame_index in enumerate(frame_indices.tolist()):
        for k in range(dim):
            angle = frame_index / 10_000 ** (2 * (k // 2) / dim)
            table[row, k] = math.cos(angle) if k % 2 else math.sin(angle)
    return table


# The published code's recipe


def test_base_of_release_is_the_class_token_before_the_last_normalisation(weights: Path, frames: torch.Tensor) -> None:
    tower, encoder = Tower(weights), base_encoder(config(weights, "release"))
    token, frame_indices = tower.token(frames[:, 0].numpy()), FRAME_INDICES[:, 2]
    close(encoder(frames[:, 0], frame_indices), token + waves(frame_indices.numpy(), 32))
    close(encoder.describe(frames[:, 0], frame_indices), tower.norm(token, "ln_post") + waves(frame_indices.numpy(), 32))
    assert encoder.dim == 32


@pytest.mark.parametrize(("layers", "prompted"), [(0, 2), (1, 1), (2, 2), (9, 2)])
def test_prompts_of_release_enter_as_published(layers: int, prompted: int, weights: Path, frames: torch.Tensor) -> None:
    """Without a shared map, the first layer's before the first normalisation; told by a forward pass without hooks."""
    model = property_classifier(config(weights, "release", prompt_layers=layers), [3, 2]).eval()
    encoder = model.encoder
    assert isinstance(encoder, PublishedEncoder)
    assert encoder.prompts is not None
    with torch.no_grad():
        encoder.prompts.prompts.mul_(50)  # As drawn they are so small that a wrong place would hardly show.
    tower, frame_indices = Tower(weights), FRAME_INDICES[:, 1]
    prompts = list(float64(encoder.prompts.prompts))
    assert len(prompts) == prompted
    token = tower.token(frames[:, 1].numpy(), prompts, normed=True)
    close(encoder(frames[:, 1], frame_indices), token + waves(frame_indices.numpy(), 32))
    close(encoder.describe(frames[:, 1], frame_indices), tower.norm(token, "ln_post") + waves(frame_indices.numpy(), 32))
    wrong = tower.token(frames[:, 1].numpy(), prompts, normed=False)
    assert np.abs(wrong - token).max() > 1e-2, "the place of the first prompts matters here"


@pytest.mark.parametrize("layers", [0, 1])
def test_prompts_of_the_paper_pass_the_shared_map(layers: int, weights: Path, frames: torch.Tensor) -> None:
    """At every layer; or at the first alone, to go on from there."""
    encoder = property_classifier(config(weights, "paper", prompt_layers=layers), [3, 2]).encoder
    assert isinstance(encoder, TactileEncoder)
    assert encoder.prompts is not None
    assert encoder.prompts.shared is not None
    with torch.no_grad():
        encoder.prompts.shared.bias.normal_(generator=torch.Generator().manual_seed(2))
    mapped = float64(encoder.prompts.prompts) @ float64(encoder.prompts.shared.weight).T
    tower = Tower(weights)
    token = tower.token(frames[:, 0].numpy(), list(mapped + float64(encoder.prompts.shared.bias)))
    close(encoder(frames[:, 0], FRAME_INDICES[:, 0]), tower.embedding(token))
    assert torch.equal(encoder(frames[:, 0], FRAME_INDICES[:, 0]), encoder.describe(frames[:, 0], FRAME_INDICES[:, 2]))


def test_a_tower_that_averages_is_read_by_its_patches(frames: torch.Tensor, tmp_path: Path) -> None:
    """It has no trained class token; prompts are no patches."""
    folder = write_tower(tmp_path / "averaging", averages=True)
    tower, frame_indices = Tower(folder), FRAME_INDICES[:, 0]
    plain = tower.tokens(frames[:, 0].numpy())
    close(base_encoder(config(folder, "paper"))(frames[:, 0], frame_indices), tower.embedding(plain)[:, 1:].mean(axis=1))
    close(
        base_encoder(config(folder, "release"))(frames[:, 0], frame_indices),
        plain[:, 1:].mean(axis=1) + waves(frame_indices.numpy(), 32),
    )
    tuned = property_classifier(config(folder, "release"), [2]).encoder
    assert isinstance(tuned, PublishedEncoder)
    assert tuned.prompts is not None
    patches = tower.tokens(frames[:, 0].numpy(), list(float64(tuned.prompts.prompts)), normed=True)[:, 1:]
    close(tuned(frames[:, 0], frame_indices), patches.mean(axis=1) + waves(frame_indices.numpy(), 32))
    described = tower.norm(patches.mean(axis=1), "ln_post") + waves(frame_indices.numpy(), 32)
    close(tuned.describe(frames[:, 0], frame_indices), described)


@pytest.mark.parametrize("shared", [False, True])
def test_prompts_are_drawn_as_said(shared: bool) -> None:
    seed_everything(0)
    prompts = VisualPrompts(4, 64, 96, 768, shared=shared)
    values = float64(prompts.prompts).ravel()
    bound = math.sqrt(6 / (768 + 96))
    expected = uniform(-bound, 2 * bound) if shared else norm(0, 0.02)
    assert kstest(values, expected.cdf).pvalue > 0.01
    assert sorted(n for n, _ in prompts.named_parameters()) == (
        ["prompts", "shared.bias", "shared.weight"] if shared else ["prompts"]
    )


def test_heads_of_release_stand_on_the_direction_of_the_mean(weights: Path, frames: torch.Tensor) -> None:
    model = property_classifier(config(weights, "release"), [3, 3, 2]).eval()
    encoder, heads = model.encoder, model.heads
    assert isinstance(encoder, PublishedEncoder)
    assert isinstance(heads, PublishedHeads)
    assert encoder.prompts is not None
    tower = Tower(weights)
    flat = frames.flatten(0, 1).numpy()
    token = tower.token(flat, list(float64(encoder.prompts.prompts)), normed=True)
    mean = (tower.norm(token, "ln_post") + waves(FRAME_INDICES.flatten().numpy(), 32)).reshape(4, 3, 32).mean(axis=1)
    shared = heads.shared
    hidden = mean / np.sqrt((mean**2).sum(axis=1, keepdims=True)) @ float64(shared.weight).T + float64(shared.bias)
    expected = [np.maximum(hidden, 0) @ float64(h.weight).T + float64(h.bias) for h in heads.properties]
    labels = torch.tensor([[0, 2, 1], [2, 0, 0], [1, 1, 1], [0, 0, 0]])
    found = model(frames, FRAME_INDICES, labels)
    close(found["logits"], np.concatenate(expected, axis=1))
    loss = sum(-log_softmax(z, axis=1)[range(4), y].mean() for z, y in zip(expected, labels.T.numpy(), strict=True))
    assert found["loss"].item() == pytest.approx(loss, rel=1e-5)


def test_length_of_features_means_nothing_to_the_heads_of_release() -> None:
    seed_everything(0)
    heads, features = PublishedHeads(16, [3, 2]).eval(), torch.randn(5, 16)
    for scale in (1e-3, 1e3, 1e15):
        for a, b in zip(heads(features), heads(features * scale), strict=True):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    assert not torch.allclose(heads(features)[0], heads(-features)[0])


def test_dropout_of_release_keeps_the_mean_and_half_of_the_units() -> None:
    """Of n hidden units h a head makes w . h; with each dropped by half that has mean w . h, variance sum (w h)^2."""
    seed_everything(0)
    heads = PublishedHeads(8, [2])
    (head,) = heads.properties
    feature = torch.randn(1, 8)
    hidden = heads.shared(feature / feature.norm()).relu()
    count = 20_000
    with torch.no_grad():
        drawn = float64(heads.train()(feature.expand(count, -1))[0])
        mean = float64(head(hidden))[0]
        variance = float64((head.weight * hidden).square().sum(1)) * DROPOUT / (1 - DROPOUT)
    assert DROPOUT == 0.5
    assert np.abs(drawn.mean(axis=0) - mean).max() < 5 * np.sqrt(variance.max() / count)
    np.testing.assert_allclose(drawn.var(axis=0), variance, rtol=0.06)


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=5), st.sampled_from([1, 2, 7, 32, 33, 1024]))
def test_sinusoid_against_its_formula(frame_indices: list[int], dim: int) -> None:
    found = sinusoid(torch.tensor(frame_indices), dim)
    assert found.dtype == torch.float32
    np.testing.assert_allclose(float64(found), waves(np.array(frame_indices), dim), rtol=0, atol=1e-7)


def test_sinusoid_tells_late_neighbours_apart() -> None:
    """In float32 frames 10^6 and 10^6 + 1 would be a rounding error apart in the slow waves."""
    table = float64(sinusoid(torch.tensor([10**6, 10**6 + 1]), 64))
    np.testing.assert_allclose(
        table[1] - table[0], np.diff(waves(np.array([10**6, 10**6 + 1]), 64), axis=0)[0], atol=2e-7
    )


# The wave of learning rates


@pytest.mark.parametrize("wave", [1, 2, 3, 7])
def test_the_wave_is_torchs_cosine_annealing_over_and_over(wave: int, tmp_path: Path) -> None:
    def optimiser() -> torch.optim.Optimizer:
        return torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=3e-3)

    arguments = TrainingArguments(output_dir=str(tmp_path), use_cpu=True, report_to="none")
    trainer = TrainableTrainer(model=torch.nn.Linear(1, 1), args=arguments, wave=wave)
    mine, theirs = optimiser(), optimiser()
    schedule = trainer.create_scheduler(1000, mine)
    reference = torch.optim.lr_scheduler.CosineAnnealingLR(theirs, T_max=wave, eta_min=3e-5)
    for step in range(6 * wave + 1):
        (rate,) = schedule.get_last_lr()
        assert rate == pytest.approx(3e-3 * (0.01 + 0.99 * (1 + math.cos(math.pi * step / wave)) / 2), rel=1e-12)
        assert rate == pytest.approx(reference.get_last_lr()[0], rel=1e-9)
        for stepped in (mine, theirs, schedule, reference):
            stepped.step()


@pytest.fixture
def rates() -> Iterator[list[float]]:
    """The rate of each update of any optimiser."""
    used: list[float] = []
    handle = register_optimizer_step_pre_hook(lambda optimiser, *_: used.append(optimiser.param_groups[0]["lr"]))
    yield used
    handle.remove()


@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_training_follows_its_recipes_rates_and_leaves_the_backbone(
    recipe: Recipe, weights: Path, catalogue: Catalogue, tmp_path: Path, rates: list[float]
) -> None:
    """Batches of 2 of 5 videos make three updates an epoch."""
    data, setting = encoder_data(tmp_path, catalogue, PARTS), config(weights, recipe, epochs=4, batch_size=2)
    seed_everything(0)
    model = property_classifier(setting, data.classes)
    assert isinstance(model.encoder, TactileEncoder)
    assert model.encoder.prompts is not None
    backbone = {n: v.clone() for n, v in model.encoder.visual.state_dict().items()}
    before = {n: v.clone() for n, v in trainable_state(model).items()}
    train_classifier(model, data, setting, CPU, seed=1, inputs=[])
    if recipe == "release":
        expected = [1e-3 * (0.01 + 0.99 * (1 + math.cos(math.pi * s / 3)) / 2) for s in range(12)]
    else:
        expected = [1e-3 * (1 + math.cos(math.pi * s / 12)) / 2 for s in range(12)]
    assert rates == pytest.approx(expected, rel=1e-9)
    after = trainable_state(model)
    moved = (after["encoder.prompts.prompts"] - before["encoder.prompts.prompts"]).flatten(1).abs().amax(dim=1)
    assert (moved > 0).all(), "the prompts of every layer learn"
    assert all(not torch.equal(before[n], after[n]) for n in before)
    assert all(torch.equal(backbone[n], v) for n, v in model.encoder.visual.state_dict().items())


@pytest.mark.parametrize(
    ("reached", "kept"),
    [((0.1, 0.5, 0.5, 0.2), 1), ((0.0, 0.0, 0.0, 0.0), 0), ((0.1, 0.2, 0.3, 0.4), 3), ((), 3)],
)
def test_the_first_of_the_best_epochs_is_kept(
    reached: tuple[float, ...],
    kept: int,
    weights: Path,
    catalogue: Catalogue,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without validation videos it is the last."""
    parts = PARTS if reached else dict.fromkeys(PARTS, Part.TRAIN)
    data, setting = encoder_data(tmp_path, catalogue, parts), config(weights, "paper", epochs=4)
    seed_everything(0)
    model = property_classifier(setting, data.classes)
    seen: list[dict[str, torch.Tensor]] = []

    def log(_: int, values: dict[str, float]) -> None:
        if "loss" in values:
            seen.append({n: v.clone() for n, v in trainable_state(model).items()})

    script = iter(reached)
    monkeypatch.setattr(training, "accuracies", lambda *_: {"validation_combined": next(script)})
    history = train_classifier(model, data, setting, CPU, seed=1, inputs=[], log=log)
    found = trainable_state(model)
    assert [all(torch.equal(v, found[n]) for n, v in epoch.items()) for epoch in seen] == [i == kept for i in range(4)]
    assert [m.value for m in history if m.name == "validation_combined"] == list(reached)
    assert not any(tmp_path.glob("checkpoints/*/*")), "a finished training leaves no checkpoint"


def test_a_clip_depends_on_seed_epoch_and_video_alone(tmp_path: Path) -> None:
    store = FrameStore(write_frames(tmp_path, {"a_0": 9, "b_0": 9}))
    videos = [LabelledVideo("a_0", (0,)), LabelledVideo("b_0", (1,))]

    def clip(seed: int, epoch: int, order: int = 1) -> tuple[list[int], bytes]:
        data = ClipDataset(store, videos[::order], per_video=3, seed=seed, flip_probability=0.5)
        data.follow(lambda: epoch)
        item = data[0 if order > 0 else 1]
        return item["frame_indices"].tolist(), item["frames"].numpy().tobytes()

    assert clip(1, 4) == clip(1, 4) == clip(1, 4, -1)
    assert len({clip(1, epoch)[1] for epoch in range(20)}) > 15
    assert len({clip(seed, 0)[1] for seed in range(20)}) > 15


def test_each_epoch_draws_its_own_clips(
    weights: Path, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, setting = encoder_data(tmp_path, catalogue, PARTS), config(weights, "paper", epochs=3, batch_size=2)
    drawn: list[tuple[int, str]] = []
    draw = ClipDataset.__getitem__

    def spy(self: ClipDataset, index: int) -> dict[str, torch.Tensor]:
        if self.seed is not None:
            drawn.append((self.epoch, self.videos[index].video_id))
        return draw(self, index)

    monkeypatch.setattr(ClipDataset, "__getitem__", spy)
    seed_everything(0)
    train_classifier(property_classifier(setting, data.classes), data, setting, CPU, seed=1, inputs=[])
    training = [f"{o}_0" for o, part in PARTS.items() if part == Part.TRAIN]
    assert sorted(drawn) == sorted((epoch, video) for epoch in range(3) for video in training)
    assert [epoch for epoch, _ in drawn] == sorted(epoch for epoch, _ in drawn)


def test_validation_counts_videos_that_are_right_in_everything(catalogue: Catalogue) -> None:
    logits = np.array([[3, 1, 0, 0, 2, 1, 0, 0, 5], [0, 1, 0, 4, 0, 0, -1, -3, -2], [0, 0, 1, 0, 0, 1, 0, 1, 0]])
    labels = np.array([[0, 1, 2], [1, 0, 1], [1, 2, 1]])
    found = accuracies(EvalPrediction(logits, labels), catalogue)
    assert found == pytest.approx(
        {
            "validation_hardness": 2 / 3,
            "validation_roughness": 1,
            "validation_bumpiness": 2 / 3,
            "validation_combined": 1 / 3,
        }
    )


# Pictures larger than the tower's side


@pytest.mark.parametrize("factor", [1, 2, 3])
@pytest.mark.parametrize("kind", ["base", "paper", "release"])
def test_frames_of_a_whole_multiple_are_block_means(factor: int, kind: str, weights: Path) -> None:
    recipe: Recipe = "release" if kind == "release" else "paper"
    encoder = base_encoder(config(weights, recipe))
    prompts: list[Floats] = []
    if kind == "paper":
        tuned = property_classifier(config(weights, "paper"), [3]).encoder
        assert isinstance(tuned, TactileEncoder)
        assert tuned.prompts is not None
        assert tuned.prompts.shared is not None
        encoder = tuned
        prompts = list(float64(tuned.prompts.shared(tuned.prompts.prompts)))
    side = 32 * factor
    frames = np.random.default_rng(factor).integers(0, 256, (2, side, side, 3), dtype=np.uint8)
    means = frames.astype(np.float64).reshape(2, 32, factor, 32, factor, 3).mean(axis=(2, 4))
    tower, frame_indices = Tower(weights), torch.tensor([3, 8])
    token = tower.token(means, prompts)
    expected = token + waves(frame_indices.numpy(), 32) if kind == "release" else tower.embedding(token)
    close(encoder(torch.from_numpy(frames), frame_indices), expected)
    fine = np.repeat(np.repeat(frames[:, :32, :32], factor, axis=1), factor, axis=2)
    torch.testing.assert_close(
        encoder(torch.from_numpy(fine), frame_indices),
        encoder(torch.from_numpy(frames[:, :32, :32]), frame_indices),
        atol=1e-5,
        rtol=0,
    )


@pytest.mark.parametrize("side", [33, 45, 60])
def test_other_larger_frames_are_means_over_areas(side: int, weights: Path) -> None:
    """Each pixel of the tower's is the mean of all that its share of the frame touches."""
    encoder = base_encoder(config(weights, "paper"))
    frames = np.random.default_rng(side).integers(0, 256, (2, side, side, 3), dtype=np.uint8)
    borders = [(i * side // 32, -(-(i + 1) * side // 32)) for i in range(32)]
    means = np.array(
        [[frames[:, a:b, c:d].astype(float).mean(axis=(1, 2)) for c, d in borders] for a, b in borders]
    ).transpose(2, 0, 1, 3)
    tower = Tower(weights)
    close(encoder(torch.from_numpy(frames), torch.zeros(2)), tower.embedding(tower.token(means, [])))


@given(st.integers(16, 1024))
@settings(max_examples=200)
def test_no_smaller_frames_are_taken(weights: Path, size: int) -> None:
    if size >= 32:
        check_encoder(weights, size)
    else:
        with pytest.raises(UserError, match=rf"frames\.size is {size} .* frames\.size=32$"):
            check_encoder(weights, size)


# What is saved


def test_running_statistics_are_saved_with_the_network_and_reload_exactly(tmp_path: Path) -> None:
    seed_everything(0)
    model = PropertyClassifier(SceneEncoder(), Heads(256, [3, 2]), [3, 2]).train()
    frames = torch.randint(0, 256, (4, 2, 32, 32, 3), dtype=torch.uint8)
    labels, frame_indices = torch.tensor([[0, 1], [2, 0], [1, 1], [0, 0]]), torch.zeros(4, 2, dtype=torch.int64)
    optimiser = torch.optim.AdamW(model.parameters(), lr=1e-2)
    for _ in range(3):
        optimiser.zero_grad()
        model(frames, frame_indices, labels)["loss"].backward()
        optimiser.step()
    state = trainable_state(model)
    assert state.keys() == model.state_dict().keys(), "nothing is frozen, so everything is there"
    assert sum("running_" in name for name in state) == 2 * 7
    assert all(int(v) == 3 for n, v in state.items() if n.endswith("num_batches_tracked"))
    save_trainable(model, tmp_path / "model.safetensors")
    other = PropertyClassifier(SceneEncoder(), Heads(256, [3, 2]), [3, 2])
    load_trainable(other, tmp_path / "model.safetensors")
    assert all(torch.equal(v, other.state_dict()[n]) for n, v in model.state_dict().items())
    with torch.no_grad():
        assert torch.equal(model.eval()(frames, frame_indices)["logits"], other.eval()(frames, frame_indices)["logits"])
        untrained = PropertyClassifier(SceneEncoder(), other.heads, [3, 2]).eval()
        assert not torch.allclose(untrained(frames, frame_indices)["logits"], other(frames, frame_indices)["logits"])


def test_statistics_of_frozen_layers_are_not_called_trained() -> None:
    encoder = SceneEncoder()
    encoder.requires_grad_(False)
    assert trainable_state(encoder) == {}
    first = next(layer for layer in encoder.layers if isinstance(layer, torch.nn.BatchNorm2d))
    first.requires_grad_(True)
    assert sorted(n.split(".")[-1] for n in trainable_state(encoder)) == [
        "bias",
        "num_batches_tracked",
        "running_mean",
        "running_var",
        "weight",
    ]


def test_a_strong_classifier_reloads_exactly(weights: Path, tmp_path: Path) -> None:
    seed_everything(1)
    model = property_classifier(config(weights, "pretrained"), [3, 3, 2])
    assert isinstance(model, JointFrameClassifier)
    random_heads(2, 256, [3, 3, 2], 0.1).copy_into(model)
    save_trainable(model, tmp_path / "model.safetensors")
    other = property_classifier(config(weights, "pretrained"), [3, 3, 2])
    load_trainable(other, tmp_path / "model.safetensors")
    frames = torch.randint(0, 256, (3, 2, 48, 48, 3), dtype=torch.uint8)
    frame_indices = torch.zeros(3, 2, dtype=torch.int64)
    with torch.no_grad():
        first, second = (m.eval()(frames, frame_indices)["logits"] for m in (model, other))
    assert torch.equal(first, second)
    assert torch.equal(model.decide(first), other.decide(second))
    assert isinstance(other, JointFrameClassifier)
    assert torch.equal(model.dependence, other.dependence)
    with pytest.raises(UserError, match="does not fit the model"):
        load_trainable(property_classifier(config(weights, "pretrained"), [3, 3, 3]), tmp_path / "model.safetensors")
    with pytest.raises(UserError, match="does not fit the model"):
        load_trainable(property_classifier(config(weights, "paper"), [3, 3, 2]), tmp_path / "model.safetensors")


def test_what_is_trained_of_each_recipe(weights: Path) -> None:
    heads = [f"{n}.{kind}" for n in ("0", "1") for kind in ("bias", "weight")]
    trained = {
        r: sorted(trainable_state(property_classifier(config(weights, r), [3, 2]))) for r in ("paper", "release")
    }
    assert trained["paper"] == sorted(
        ["encoder.prompts.prompts", "encoder.prompts.shared.bias", "encoder.prompts.shared.weight"]
        + [f"heads.{name}" for name in heads]
    )
    assert trained["release"] == sorted(
        ["encoder.prompts.prompts", "heads.shared.bias", "heads.shared.weight"]
        + [f"heads.properties.{name}" for name in heads]
    )

"""Encoders at the edge: no signal, too much of it, too high rates, fewer bits, lacking classes, NaN, and kills."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from pipeline.encoder.frame_heads import STRENGTHS, fit_votes
from pipeline.stability.encoder import hard_frames, seasoned
from pipeline.stability.heads import HEAVIER, SIZES, cancelling, huge_classifier, huge_features, published_heads
from torch.nn import functional as F
from torch.optim.optimizer import register_optimizer_step_pre_hook

from pipeline.config import EncoderConfig, FramesConfig, PretrainConfig, RuntimeConfig
from pipeline.encoder import pretrain as pretraining
from pipeline.encoder.clips import ClipDataset, LabelledVideo
from pipeline.encoder.embed import embed_videos
from pipeline.encoder.finetune import EncoderData, classify, fit_heads, train_classifier
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.encoder.pretrain import pretrain
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import CHANNELS, WEIGHTS, SceneEncoder
from pipeline.encoder.synthetic import Lessons
from pipeline.errors import UserError
from pipeline.records import Measurement, Part
from pipeline.runtime import seed_everything
from pipeline.trainable import trainable_state
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from tests.encoders import CPU, MOMENTS, OBJECTS, PARTS, config, encoder_data, write_frames

CLASSES = [3, 3, 3]
DEVICE = torch.device("cpu")
KINDS = ("paper", "release", "pretrained", "scratch")


pytestmark = pytest.mark.usefixtures("elsewhere")


def classifier(kind: str, weights: Path, seed: int = 0) -> PropertyClassifier:
    """`scratch` is the strong recipe's network with the paper's heads, trained from end to end."""
    seed_everything(seed)
    if kind == "scratch":
        return PropertyClassifier(seasoned(SceneEncoder()), Heads(256, CLASSES), CLASSES)
    model = property_classifier(settings_of(kind, weights), CLASSES)
    if isinstance(model.encoder, SceneEncoder):
        seasoned(model.encoder)
    return model


def settings_of(kind: str, weights: Path, **changes: object) -> EncoderConfig:
    return config(
        weights, "release" if kind == "release" else "pretrained" if kind == "pretrained" else "paper", **changes
    )


# No signal, and too much


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_features_of_length_0_have_finite_gradients(dtype: torch.dtype) -> None:
    """A mean of exactly 0: what the heads of release say of it is among the hard cases."""
    heads = published_heads(dtype)
    features = cancelling(dtype).requires_grad_()
    logits = torch.cat(PropertyClassifier(FrameEncoder(16), heads, [3, 2]).classify(features), dim=1)
    F.cross_entropy(logits.float(), torch.tensor([2])).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in heads.parameters())
    # Of the features it is up to 1 / SHORTEST_FEATURE times as large, which float16 does not hold.
    assert features.grad is not None
    assert dtype == torch.float16 or features.grad.isfinite().all()


@pytest.mark.parametrize("name", hard_frames())
@pytest.mark.parametrize("kind", KINDS)
def test_hard_frames_train_and_are_decided_on(kind: str, name: str, weights: Path) -> None:
    shown = hard_frames()[name]
    frames, moments = torch.stack([shown[:3], shown[1:]]), torch.tensor([[0, 1, 2], [10**6, 10**6, 10**6]])
    model = classifier(kind, weights).train()
    loss = model(frames, moments, torch.tensor([[0, 1, 2], [2, 1, 0]]))["loss"]
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    with torch.no_grad():
        logits = model.eval()(frames, moments)["logits"]
        assert logits.isfinite().all()
        assert set(model.decide(logits).flatten().tolist()) <= {0, 1, 2}


def test_an_untouched_picture_is_0_to_the_network() -> None:
    """128 is no difference: without biases all that is left are those of the normalisations."""
    encoder = SceneEncoder()
    shown: list[torch.Tensor] = []
    encoder.layers.register_forward_pre_hook(lambda _, given: shown.append(given[0]))
    encoder.eval()(torch.full((1, 32, 32, 3), 128, dtype=torch.uint8), torch.zeros(1))
    encoder(torch.full((1, 32, 32, 3), 128 + 24, dtype=torch.uint8), torch.zeros(1))
    assert (shown[0] == 0).all()
    assert (shown[1] == 1).all(), "twelve steps of difference, which pictures show doubled"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("weight", HEAVIER)
@pytest.mark.parametrize("kind", [PropertyClassifier, FrameVotes])
def test_huge_logits_have_finite_losses_and_gradients(
    kind: type[PropertyClassifier], weight: float, size: float
) -> None:
    """Features and weights as large as that; votes clip features, so that there it is the weights that count."""
    model, features = huge_classifier(kind, weight), huge_features(size).requires_grad_()
    logits = model.classify(features)
    exact = copy.deepcopy(model).double().classify(features.detach().double())
    assert all(z.log_softmax(1).isfinite().all() for z in logits)
    loss = torch.stack([F.cross_entropy(z, torch.tensor([0, 1, 2, 0])) for z in logits]).sum()
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
    assert features.grad is not None
    assert features.grad.isfinite().all()
    with torch.no_grad():
        decided = model.decide(torch.cat(logits, dim=1))
        assert torch.equal(decided, torch.stack([z.argmax(1) for z in exact], dim=1))


def test_the_network_is_seven_convolutions_with_the_normalisation_folded_in(frames: torch.Tensor) -> None:
    """In float64, by BN(w * x) = (g w / s) * x + b - g m / s."""
    seed_everything(0)
    encoder = seasoned(SceneEncoder())
    state = {n: v.double() for n, v in encoder.state_dict().items()}
    maps = (frames.flatten(0, 1).double().permute(0, 3, 1, 2) - 128) / 24
    for number, (channels, stride) in enumerate(CHANNELS):
        convolution, norm = f"layers.{3 * number}", f"layers.{3 * number + 1}"
        scale = state[f"{norm}.weight"] / (state[f"{norm}.running_var"] + 1e-5).sqrt()
        kernel = state[f"{convolution}.weight"] * scale[:, None, None, None]
        assert kernel.shape[0] == channels
        shift = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale
        maps = F.conv2d(maps, kernel, shift, stride=stride, padding=kernel.shape[-1] // 2).clamp(min=0)
    assert maps.shape[1:] == (128, 2, 2)
    expected = torch.cat([maps.flatten(2).mean(2), maps.flatten(2).max(2).values], dim=1)
    with torch.no_grad():
        found = encoder(frames.flatten(0, 1), MOMENTS.flatten())
    torch.testing.assert_close(found.double(), expected, atol=2e-6 * expected.max().item(), rtol=0)


# Batches and clips


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_of_one_equals_a_batch_of_many(kind: str, weights: Path, frames: torch.Tensor) -> None:
    model = classifier(kind, weights).eval()
    with torch.no_grad():
        whole = model(frames, MOMENTS)["logits"]
        single = torch.cat([model(f[None], m[None])["logits"] for f, m in zip(frames, MOMENTS, strict=True)])
    torch.testing.assert_close(whole, single, atol=2e-6, rtol=2e-6)
    assert not torch.allclose(whole[0], whole[1]), "the videos differ"


@pytest.mark.parametrize("kind", KINDS)
def test_classifications_do_not_depend_on_the_batch(
    kind: str, weights: Path, catalogue: Catalogue, tmp_path: Path
) -> None:
    data, model = encoder_data(tmp_path, catalogue, PARTS), classifier(kind, weights)
    alone, together = (classify(model, data, [Part.TRAIN, Part.VALIDATION], b, DEVICE) for b in (1, 64))
    assert [(r.video_id, r.property, r.predicted) for r in alone] == [
        (r.video_id, r.property, r.predicted) for r in together
    ]
    for one, other in zip(alone, together, strict=True):
        assert one.probabilities == pytest.approx(other.probabilities, abs=1e-6)
        assert sum(one.probabilities) == pytest.approx(1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_video_of_one_frame_is_that_frame_repeated(
    kind: str, weights: Path, catalogue: Catalogue, tmp_path: Path
) -> None:
    store = FrameStore(write_frames(tmp_path, {"long_0": 4, "short_0": 1}))
    video = LabelledVideo("short_0", (0, 1, 2))
    item = ClipDataset(store, [video], per_video=5)[0]
    drawn = ClipDataset(store, [video], per_video=5, seed=3, flip_probability=0.5)[0]
    assert item["frames"].shape == drawn["frames"].shape == (5, 32, 32, 3)
    assert (item["frames"] == torch.from_numpy(store.pictures("short_0"))[0]).all()
    assert (drawn["frames"] == drawn["frames"][:1]).all()
    model = classifier(kind, weights).eval()
    with torch.no_grad():
        repeated = model(item["frames"][None], item["moments"][None])["logits"]
        once = model(item["frames"][None, :1], item["moments"][None, :1])["logits"]
    torch.testing.assert_close(repeated, once, atol=2e-6, rtol=2e-6)


# Lacking classes

HARD = {"baseball": Part.TRAIN, "controller_base": Part.TRAIN, "potato": Part.TRAIN, "ice_block": Part.TRAIN}
"""All of the highest hardness; none of the highest bumpiness."""


@pytest.mark.parametrize("kind", ["paper", "release", "scratch"])
def test_a_class_that_training_lacks_does_not_stop_it(
    kind: str, weights: Path, catalogue: Catalogue, tmp_path: Path
) -> None:
    data = encoder_data(tmp_path, catalogue, {**HARD, "pillow": Part.VALIDATION, "rug": Part.TEST})
    assert {catalogue.labels(o)[0] for o in HARD} == {2}
    model = classifier(kind, weights)
    history = train_classifier(model, data, settings_of(kind, weights, epochs=2), CPU, seed=0, inputs=[])
    assert all(np.isfinite(m.value) for m in history)
    judged = classify(model, data, [Part.TEST], 4, DEVICE)
    assert [r.expected for r in judged] == list(catalogue.labels("rug"))
    assert all(np.isfinite(r.probabilities).all() and min(r.probabilities) > 0 for r in judged)


def test_heads_of_the_strong_recipe_are_fitted_without_a_class(
    weights: Path, catalogue: Catalogue, tmp_path: Path
) -> None:
    data = encoder_data(tmp_path, catalogue, {**HARD, "pillow": Part.TEST})
    model = classifier("pretrained", weights)
    assert isinstance(model, FrameVotes)
    curve = fit_heads(model, data, settings_of("pretrained", weights), CPU, 0)
    assert [m.name for m in curve] == ["inner_combined"] * len(STRENGTHS)
    judged = classify(model, data, [Part.TEST], 4, DEVICE)
    assert judged[0].predicted == 2
    assert judged[0].probabilities[:2] == pytest.approx((0, 0), abs=1e-3)


def test_a_single_video_fits() -> None:
    clips = np.random.default_rng(0).normal(size=(1, 3, 4)).astype(np.float32)
    votes = fit_votes(clips, np.array([[2, 0]]), ["a"], [3, 2], STRENGTHS[0])
    assert votes.predict(clips).tolist() == [[2, 0]]
    assert votes.predict(-1e6 * clips).tolist() == [[2, 0]]


# NaN


class Sick(FrameEncoder):
    """Says nothing finite of what is bright all over."""

    def __init__(self, value: float) -> None:
        super().__init__(256)
        self.value = value

    def forward(self, frames: torch.Tensor, moments: torch.Tensor) -> torch.Tensor:
        embedded = frames.double().flatten(1)[:, :256].float()
        bright = frames.flatten(1).amin(1) == 255
        embedded[bright, 3] = self.value
        return embedded


def with_a_bright_video(folder: Path, catalogue: Catalogue, parts: dict[str, Part], bright: str) -> EncoderData:
    data = encoder_data(folder, catalogue, parts)
    pixels = np.array(data.store.pixels)
    pixels[data.store.rows(bright)[-1]] = 255
    np.save(folder / "frames.npy", pixels)
    return EncoderData(FrameStore(folder), catalogue, data.assignments, data.per_video)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_an_embedding_that_is_not_finite_is_named(value: float, catalogue: Catalogue, tmp_path: Path) -> None:
    data = with_a_bright_video(tmp_path, catalogue, PARTS, "pillow_0")
    with pytest.raises(UserError, match=r"^pillow_0: .*not finite"):
        embed_videos(Sick(value), data.store, data.assignments, batch_size=3, device=DEVICE)
    unused = [a.model_copy(update={"part": Part.UNUSED}) if a.object_id == "pillow" else a for a in data.assignments]
    tensor, index = embed_videos(Sick(value), data.store, unused, batch_size=3, device=DEVICE)
    assert tensor.isfinite().all()
    assert len(tensor) == len(index)


@pytest.mark.parametrize(("kind", "value"), [("heads", float("nan")), ("heads", float("inf")), ("votes", float("nan"))])
@pytest.mark.parametrize("batch", [2, 64])
def test_logits_that_are_not_finite_are_named(
    kind: str, value: float, batch: int, catalogue: Catalogue, tmp_path: Path
) -> None:
    """Votes clip what is infinite, as every wild feature."""
    data = with_a_bright_video(tmp_path, catalogue, dict.fromkeys(OBJECTS, Part.TEST), "rug_0")
    data = EncoderData(data.store, catalogue, data.assignments, 4)
    encoder, heads = Sick(value), Heads(256, CLASSES)
    model = FrameVotes(encoder, CLASSES) if kind == "votes" else PropertyClassifier(encoder, heads, CLASSES)
    with pytest.raises(UserError, match=r"^rug_0: .*not finite"):
        classify(model, data, [Part.TEST], batch, DEVICE)


# Rates that are too high


@pytest.mark.parametrize("factor", [100, 1e6, 1e20])
@pytest.mark.parametrize("kind", ["paper", "release", "scratch"])
def test_a_rate_too_high_ends_finite_or_in_one_line(
    kind: str, factor: float, weights: Path, catalogue: Catalogue, tmp_path: Path
) -> None:
    """Params allow no rate from 10 on; a model may be as badly scaled all the same."""
    data, model = encoder_data(tmp_path, catalogue, PARTS), classifier(kind, weights)
    setting = settings_of(kind, weights, epochs=1, batch_size=1)
    wild = setting.model_copy(update={"learning_rate": factor * setting.learning_rate})
    if factor == 1e20:
        with pytest.raises(UserError, match=r"^loss is .* at step 5: .*lower the learning rate.*$"):
            train_classifier(model, data, wild, CPU, seed=0, inputs=[])
    else:
        history = train_classifier(model, data, wild, CPU, seed=0, inputs=[])
        assert all(np.isfinite(m.value) for m in history)
        assert all(v.isfinite().all() for v in trainable_state(model).values())


Hook = Callable[[Callable[[int], None]], None]


@pytest.fixture
def before_updates() -> Iterator[Hook]:
    """Has something called before each update of any optimiser, with the number of updates made."""
    handles = []

    def register(call: Callable[[int], None]) -> None:
        made = iter(range(10**6))
        handles.append(register_optimizer_step_pre_hook(lambda *_: call(next(made))))

    yield register
    for handle in handles:
        handle.remove()


def test_a_loss_that_is_no_number_stops_the_training_and_leaves_the_last_checkpoint(
    weights: Path, catalogue: Catalogue, tmp_path: Path, before_updates: Hook
) -> None:
    data, setting = encoder_data(tmp_path, catalogue, PARTS), settings_of("paper", weights, epochs=4, batch_size=2)
    smooth = classifier("paper", weights)
    train_classifier(smooth, data, setting, CPU, seed=0, inputs=[])
    model = classifier("paper", weights)
    heads = model.heads

    def poison(update: int) -> None:
        if update == 7:  # The second of the third epoch's three.
            with torch.no_grad():
                next(iter(heads.parameters())).fill_(float("inf"))

    before_updates(poison)
    with pytest.raises(UserError, match="loss is nan at step 9: .*lower the learning rate") as caught:
        train_classifier(model, data, setting, CPU, seed=0, inputs=[])
    assert "\n" not in str(caught.value)
    assert "checkpoint-6" in {f.name for f in tmp_path.glob("checkpoints/*/*/*")}
    again = classifier("paper", weights)
    train_classifier(again, data, setting, CPU, seed=0, inputs=[])
    same(trainable_state(smooth), trainable_state(again))


# Kills


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    assert [n for n in one if not torch.equal(one[n], other[n])] == []


def in_order(history: list[Measurement]) -> list[tuple[int, str, float]]:
    return sorted((m.step, m.name, m.value) for m in history)


@pytest.mark.parametrize(("kind", "validated"), [("paper", True), ("release", True), ("scratch", False)])
def test_a_killed_training_ends_as_if_it_had_not_been(
    kind: str, validated: bool, weights: Path, catalogue: Catalogue, tmp_path: Path, before_updates: Hook
) -> None:
    """Killed in the second epoch, and again in the third; release drops units at random."""
    parts = PARTS if validated else dict.fromkeys(PARTS, Part.TRAIN)
    data, setting = encoder_data(tmp_path, catalogue, parts), settings_of(kind, weights, epochs=3, batch_size=2)
    epoch = 3 if validated else 4

    def run() -> tuple[list[Measurement], dict[str, torch.Tensor]]:
        model = classifier(kind, weights)
        history = train_classifier(model, data, setting, CPU, seed=0, inputs=[])
        return history, trainable_state(model)

    history, state = run()
    begun: list[int] = []

    def kill(_: int) -> None:
        begun.append(1)
        if len(begun) in (epoch + 2, 2 * epoch + 3):
            raise KeyboardInterrupt

    before_updates(kill)
    for number in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            run()
        assert (tmp_path / f"checkpoint-{number * epoch}").name in {f.name for f in tmp_path.glob("checkpoints/*/*/*")}
    resumed, end = run()
    assert len(begun) == (epoch + 2) + (epoch + 1) + epoch, "only what the last checkpoint lacked was done again"
    assert in_order(resumed) == in_order(history)
    same(state, end)
    assert not any(tmp_path.glob("checkpoints/*/*"))


@pytest.fixture(scope="module")
def lessons() -> Lessons:
    """Noise, with something to tell of it."""
    rng = np.random.default_rng(0)
    return Lessons(
        pictures=rng.integers(0, 256, (16, 2, 16, 16, 3), dtype=np.uint8),
        quantities=rng.normal(size=(16, 2, 5)).astype(np.float32),
        kinds=rng.integers(0, 2, (16, 4)).astype(np.uint8),
    )


@pytest.mark.parametrize("killed", [3, 7])
def test_a_killed_pretraining_ends_as_if_it_had_not_been(
    killed: int, lessons: Lessons, tmp_path: Path, before_updates: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    """15 lessons make four updates an epoch: the checkpoint after 2 is within the first, after 6 within the second."""
    setting = PretrainConfig(objects=16, presses=2, steps=8, batch_size=4)
    frames, runtime = FramesConfig(size=16), RuntimeConfig(device="cpu", save_steps=2)
    drawn: list[int] = []

    def draw(*_: object) -> Lessons:
        drawn.append(1)
        return lessons

    monkeypatch.setattr(pretraining, "draw_lessons", draw)
    encoder, history = pretrain(setting, frames, runtime)
    begun: list[int] = []

    def kill(update: int) -> None:
        begun.append(update)
        if update == killed:
            raise KeyboardInterrupt

    before_updates(kill)
    with pytest.raises(KeyboardInterrupt):
        pretrain(setting, frames, runtime)
    assert [f.name for f in tmp_path.glob("checkpoints/pretrain/*/*")] == [f"checkpoint-{killed - 1}"]
    again, resumed = pretrain(setting, frames, runtime)
    assert len(begun) == (killed + 1) + 8 - (killed - 1)
    same(trainable_state(encoder), trainable_state(again))
    assert in_order(resumed) == in_order(history)
    assert not any(tmp_path.glob("checkpoints/*/*"))


def test_a_tiny_pretraining_draws_trains_and_tells_what_it_left_aside(tmp_path: Path) -> None:
    setting = PretrainConfig(objects=8, presses=2, steps=4, batch_size=4)
    encoder, history = pretrain(setting, FramesConfig(size=32), RuntimeConfig(device="cpu", save_steps=2))
    assert all(np.isfinite(m.value) for m in history)
    last = {m.name: m.value for m in history if m.step == 4}
    parts = {name: last[f"held_out_{name}"] for name in WEIGHTS}
    assert last["held_out_loss"] == pytest.approx(sum(WEIGHTS[name] * value for name, value in parts.items()), rel=1e-5)
    assert [m.step for m in history if m.name == "loss"] == [1, 2, 3, 4]
    assert all(v.isfinite().all() for v in trainable_state(encoder).values())
    counts = [int(b) for n, b in encoder.named_buffers() if n.endswith("num_batches_tracked")]
    assert counts == [4] * len(CHANNELS), "the lesson left aside has touched no statistics"
    assert not any(tmp_path.glob("checkpoints/*/*"))

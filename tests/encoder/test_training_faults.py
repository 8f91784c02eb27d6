"""Trainings of encoders that go wrong: classes that lack, NaN, rates that are too high, kills, too few objects."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pipeline.config import FramesConfig, PretrainConfig, RecipeName, RuntimeConfig
from pipeline.core.records import Measurement, Part
from pipeline.encoder import pretrain as pretraining
from pipeline.encoder.data import EncoderData, classify
from pipeline.encoder.embed import Loaded, embed_videos
from pipeline.encoder.finetune import finetune
from pipeline.encoder.frame_classifier import JointFrameClassifier
from pipeline.encoder.model import FrameEncoder, Heads, PropertyClassifier
from pipeline.encoder.pretrain import WEIGHTS, pretrain
from pipeline.encoder.scene_encoder import CHANNELS, SceneEncoder
from pipeline.encoder.synthetic import SyntheticPictures
from pipeline.training.trainable import trainable_state
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from tests.checkpoints import cut
from tests.conftest import Begun, refused
from tests.encoder.conftest import Hook, gradient, killed_at, relabelled, setting_of
from tests.encoders import PARTS, encoder_data, training

State = dict[str, torch.Tensor]
CLASSES = [3, 3, 3]
DEVICE = torch.device("cpu")
pytestmark = pytest.mark.usefixtures("elsewhere")


def trained(
    kind: RecipeName, weights: Path, data: EncoderData, *, factor: float = 1.0, keep: bool = False, **changes: object
) -> tuple[list[Measurement], State]:
    """History and end state of a training with the learning rate times `factor`; its checkpoints go, unless `keep`."""
    setting = setting_of(kind, weights, **changes)
    setting = setting.model_copy(update={"learning_rate": factor * setting.learning_rate})
    model, history = finetune(training(data, setting))
    if not keep:
        shutil.rmtree("checkpoints")  # As the stage does, when all is written.
    return history, trainable_state(model)


def same(one: State, other: State) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=0)


class Sick(FrameEncoder):
    """Says nothing finite of what is bright all over."""

    def __init__(self, value: float) -> None:
        super().__init__(256)
        self.value = value

    def forward(self, frames: torch.Tensor, frame_indices: torch.Tensor) -> torch.Tensor:
        embedded = frames.flatten(1)[:, :256].float()
        embedded[frames.flatten(1).amin(1) == 255, 3] = self.value
        return embedded


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_named(value: float, weights: Path, catalogue: Catalogue, tmp_path: Path) -> None:
    data = encoder_data(tmp_path, catalogue, PARTS, per_video=4)
    pixels = np.load(tmp_path / "frames.npy")
    pixels[data.store.rows("pillow_0")[-1]] = 255
    np.save(tmp_path / "frames.npy", pixels)
    data = replace(data, store=FrameStore(tmp_path))
    with refused("^pillow_0: .*not finite"):
        embed_videos(Loaded(Sick(value), data.store, DEVICE, 3), data.assignments)
    unused = [a.model_copy(update={"part": Part.UNUSED}) if a.object_id == "pillow" else a for a in data.assignments]
    assert embed_videos(Loaded(Sick(value), data.store, DEVICE, 3), unused)[0].isfinite().all()
    for batch in (2, 64):
        plain = PropertyClassifier(Sick(value), Heads(256, CLASSES), CLASSES)
        for model in (plain, JointFrameClassifier(Sick(value), CLASSES)):
            with refused("^pillow_0: .*not finite"):
                classify(model, data, list(Part), batch, DEVICE)


@pytest.mark.slow
def test_a_rate_too_high_ends_finite_or_in_one_line(weights: Path, data: EncoderData) -> None:
    """Params allow no rate from 10 on; a model may be as badly scaled all the same.

    A batch of eight makes the first update the last: what diverges in it is told too.
    """
    history, state = trained("paper", weights, data, factor=1e6, epochs=1, batch_size=1)
    assert all(np.isfinite(m.value) for m in history)
    assert all(v.isfinite().all() for v in state.values())
    with refused("^loss is .* at step 5: .*lower the learning rate"):
        trained("paper", weights, data, factor=1e20, epochs=1, batch_size=1)
    with refused("lower the learning rate"):
        trained("paper", weights, data, factor=1e23, epochs=1, batch_size=8)


@pytest.mark.slow
def test_gradients_are_shortened(weights: Path, data: EncoderData, before_updates: Hook) -> None:
    norms: list[float] = []
    before_updates(lambda _, optimizer: norms.append(float(gradient(optimizer).norm())))
    for limit in (0.0, 1e-3):
        trained("paper", weights, data, epochs=1, batch_size=8, max_grad_norm=limit)
    assert norms[0] > 0.1
    assert norms[1] == pytest.approx(1e-3, rel=1e-2)


def in_order(history: list[Measurement]) -> list[tuple[int, str, float]]:
    return sorted((m.step, m.name, m.value) for m in history)


@pytest.mark.slow
@pytest.mark.usefixtures("few_fits")
@pytest.mark.parametrize(("kind", "validated"), [("paper", False), ("release", True), ("tuned", True)])
def test_a_killed_training_ends_as_if_it_had_not_been(
    kind: RecipeName, validated: bool, weights: Path, catalogue: Catalogue, tmp_path: Path, before_updates: Hook
) -> None:
    """Killed in the second epoch, again in the third, and once more behind the last, before anything is written.

    `release` drops units at random, `tuned` trains above what its trunk makes of mirrored frames.
    """
    data = encoder_data(tmp_path, catalogue, PARTS if validated else dict.fromkeys(PARTS, Part.TRAIN))
    run = partial(trained, kind, weights, data, epochs=3, batch_size=2)
    epoch = 3 if validated else 4
    history, state = run()
    begun: list[int] = []
    before_updates(killed_at([epoch + 1, 2 * epoch + 2], begun))
    for left in (epoch, 2 * epoch):
        with pytest.raises(KeyboardInterrupt):
            run()
        assert f"checkpoint-{left}" in {f.name for f in Path("checkpoints").glob("*/*/*")}
    for keep in (True, False):  # First as where what it gave could not be written.
        resumed, end = run(keep=keep)
        assert in_order(resumed) == in_order(history)
        same(state, end)
        assert len(begun) == (epoch + 2) + (epoch + 1) + epoch, "only what the last checkpoint lacked was done again"


def unwritten(file: Path) -> None:
    """Leave the checkpoint as while this file is written; the Trainer writes its state last."""
    file.with_name("trainer_state.json").unlink()
    file.write_bytes(b"")


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)


@pytest.mark.slow
def test_a_damaged_checkpoint_is_passed_over(
    weights: Path, data: EncoderData, tmp_path: Path, before_updates: Hook, caplog: pytest.LogCaptureFixture
) -> None:
    """One that was being written, however far it had come; or cut short, or with a byte changed: a checksum tells."""
    run = partial(trained, "release", weights, data, epochs=3, batch_size=2)
    history, whole = run()
    before_updates(killed_at([7], []))
    with pytest.raises(KeyboardInterrupt):
        run()
    shutil.copytree(tmp_path / "checkpoints", tmp_path / "kept")
    damages = {"model.safetensors": unwritten, "optimizer.pt": cut, "rng_state.pth": flip}
    damages["trainer_state.json"] = partial(cut, by=9)
    for name, damage in damages.items():
        shutil.copytree(tmp_path / "kept", tmp_path / "checkpoints", dirs_exist_ok=True)
        (last,) = tmp_path.glob("checkpoints/*/*/checkpoint-6")
        damage(last / name)
        caplog.clear()
        resumed, again = run()
        told = [f"{name} is damaged" in r.getMessage() for r in caplog.records].count(True)
        assert told == (damage is not unwritten)
        assert resumed == history
        same(whole, again)


def pretrained(steps: int, saved: int, objects: int = 16, side: int = 16) -> tuple[list[Measurement], SceneEncoder]:
    setting = PretrainConfig(objects=objects, steps=steps)
    encoder, history = pretrain(setting, FramesConfig(pixels=side), RuntimeConfig(device="cpu", save_steps=saved))
    return history, encoder


@pytest.mark.slow
def test_what_diverges_between_two_reports_replaces_no_good_checkpoint(
    tmp_path: Path, before_updates: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reports come every second update, checkpoints after each; with noise in place of scenes."""
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (16, 2, 16, 16, 3), dtype=np.uint8)
    made = SyntheticPictures(pictures, rng.normal(size=(16, 2, 5)).astype(np.float32), np.eye(16, 4, dtype=np.uint8))
    monkeypatch.setattr(pretraining, "draw_pictures", lambda *_: made)

    def poison(update: int, optimizer: torch.optim.Optimizer) -> None:
        if update == 4:
            optimizer.param_groups[0]["params"][-1].data.fill_(float("inf"))

    before_updates(poison)
    with refused("earlier checkpoints are kept"):
        pretrained(48, 1)
    (kept,) = tmp_path.glob("checkpoints/pretrain/*/*/model.safetensors")
    assert kept.parent.name == "checkpoint-4"
    assert all(value.isfinite().all() for value in load_file(kept).values())


@pytest.mark.slow
def test_a_tiny_pretraining_draws_trains_and_tells_what_it_left_aside() -> None:
    history, encoder = pretrained(4, 2, objects=8, side=32)
    assert all(np.isfinite(m.value) for m in history)
    last = {m.name: m.value for m in history if m.step == 4}
    parts = {name: last[f"held_out_{name}"] for name in WEIGHTS}
    assert last["held_out_loss"] == pytest.approx(sum(WEIGHTS[name] * value for name, value in parts.items()), rel=1e-5)
    assert [m.step for m in history if m.name == "loss"] == [1, 2, 3, 4]
    assert all(v.isfinite().all() for v in trainable_state(encoder).values())
    counts = [int(b) for n, b in encoder.named_buffers() if n.endswith("num_batches_tracked")]
    assert counts == [4] * len(CHANNELS), "the object left aside has touched no statistics"


def test_a_training_goes_on_only_with_its_own_settings_labels_and_objects(
    weights: Path, data: EncoderData, versions: Callable[[str], None], begun_in: Begun
) -> None:
    rated = data.assignments[0].object_id
    exchanged = [a.model_copy(update={"part": Part.TEST}) if a.object_id == rated else a for a in data.assignments]

    def begun(held: EncoderData = data, **changes: object) -> str:
        return begun_in(lambda: trained("paper", weights, held, **changes))

    places = [begun(epochs=7), begun(relabelled(data, rated)), begun(replace(data, assignments=exchanged))]
    usual, again = begun(), begun()
    versions("pipeline/encoder/model.py")
    assert usual == again
    assert len({usual, *places, begun()}) == 5

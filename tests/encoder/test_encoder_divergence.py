"""Trainings of encoders that go wrong late: half-written checkpoints, divergence between reports, too few objects."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from pipeline.config import CrossValidationConfig, EncoderConfig, FramesConfig, PretrainConfig, RuntimeConfig
from pipeline.encoder import pretrain as pretraining
from pipeline.encoder.candidates import CANDIDATES
from pipeline.encoder.cross_validation import Arena, judge
from pipeline.encoder.finetune import EncoderData, fit_heads, train_classifier
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.pretrain import pretrain
from pipeline.encoder.scene_encoder import LessonModel, SceneEncoder
from pipeline.encoder.synthetic import Lessons
from pipeline.errors import UserError
from pipeline.trainable import trainable_state
from pipeline.videos.catalogue import Catalogue, load_catalogue
from tests.closure import ROOT
from tests.conftest import fake_videos
from tests.encoder.test_encoder_stability import (
    CLASSES,
    Hook,
    Sick,
    before_updates,
    classifier,
    same,
    settings_of,
    with_a_bright_video,
)
from tests.encoders import CPU, PARTS, encoder_data, write_frames, write_tower

__all__ = ["before_updates"]
"""A fixture."""
pytestmark = pytest.mark.usefixtures("elsewhere")
WRITTEN = (
    "model.safetensors",
    "training_args.bin",
    "optimizer.pt",
    "scheduler.pt",
    "rng_state.pth",
    "trainer_state.json",
)
"""Files of a checkpoint in the order that the Trainer writes them."""


def killed_at(update: int, before: Hook) -> None:
    def kill(number: int) -> None:
        if number == update:
            raise KeyboardInterrupt

    before(kill)


@pytest.mark.parametrize("first_lacking", ["trainer_state.json", "optimizer.pt", "model.safetensors"])
def test_a_checkpoint_that_was_being_written_is_passed_over(
    first_lacking: str, weights: Path, catalogue: Catalogue, tmp_path: Path, before_updates: Hook
) -> None:
    data, setting = encoder_data(tmp_path, catalogue, PARTS), settings_of("release", weights, epochs=3, batch_size=2)
    whole = classifier("release", weights)
    history = train_classifier(whole, data, setting, CPU, seed=0, inputs=[])
    killed_at(7, before_updates)
    with pytest.raises(KeyboardInterrupt):
        train_classifier(classifier("release", weights), data, setting, CPU, seed=0, inputs=[])
    (last,) = tmp_path.glob("checkpoints/*/*/checkpoint-6")
    for name in WRITTEN[WRITTEN.index(first_lacking) :]:
        (last / name).unlink(missing_ok=True)
    again = classifier("release", weights)
    assert train_classifier(again, data, setting, CPU, seed=0, inputs=[]) == history, "in the same order, too"
    same(trainable_state(whole), trainable_state(again))


def test_features_that_are_not_finite_are_named_when_heads_are_fitted(
    catalogue: Catalogue, tmp_path: Path, weights: Path
) -> None:
    data = with_a_bright_video(tmp_path, catalogue, PARTS, "pillow_0")
    data = EncoderData(data.store, catalogue, data.assignments, 4)
    with pytest.raises(UserError, match="pillow_0"):
        fit_heads(FrameVotes(Sick(float("nan")), CLASSES), data, settings_of("pretrained", weights), CPU, 0)


def test_a_last_step_that_diverges_is_told(weights: Path, catalogue: Catalogue, tmp_path: Path) -> None:
    data, model = encoder_data(tmp_path, catalogue, PARTS), classifier("paper", weights)
    setting = settings_of("paper", weights, epochs=1, batch_size=8).model_copy(update={"learning_rate": 1e20})
    with pytest.raises(UserError, match="lower the learning rate"):
        train_classifier(model, data, setting, CPU, seed=0, inputs=[])


def test_what_diverges_between_two_reports_replaces_no_good_checkpoint(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, before_updates: Hook
) -> None:
    rng = np.random.default_rng(0)
    lessons = Lessons(
        pictures=rng.integers(0, 256, (16, 2, 16, 16, 3), dtype=np.uint8),
        quantities=rng.normal(size=(16, 2, 5)).astype(np.float32),
        kinds=rng.integers(0, 2, (16, 4)).astype(np.uint8),
    )
    made: list[LessonModel] = []
    original: Callable[[SceneEncoder, Lessons], LessonModel] = pretraining.lesson_model

    def keep(encoder: SceneEncoder, taught: Lessons) -> LessonModel:
        made.append(original(encoder, taught))
        return made[-1]

    def poison(update: int) -> None:
        if update == 41:
            with torch.no_grad():
                made[-1].head[1].weight.fill_(float("inf"))

    monkeypatch.setattr(pretraining, "draw_lessons", lambda *_: lessons)
    monkeypatch.setattr(pretraining, "lesson_model", keep)
    before_updates(poison)
    setting, runtime = (
        PretrainConfig(objects=16, presses=2, steps=240, batch_size=4),
        RuntimeConfig(device="cpu", save_steps=4),
    )
    with pytest.raises(UserError, match="earlier checkpoints are kept"):
        pretrain(setting, FramesConfig(size=16), runtime)
    kept = list(tmp_path.glob("checkpoints/pretrain/*/*/model.safetensors"))
    assert kept
    assert all(value.isfinite().all() for file in kept for value in load_file(file).values())


def two_objects(tmp_path: Path) -> Arena:
    videos = fake_videos(["rug", "pillow"], 2)
    frames = write_frames(tmp_path / "frames", {v.video_id: 1 for v in videos})
    return Arena(
        videos=videos,
        catalogue=load_catalogue(ROOT / "pipeline" / "physiclear"),
        frames=frames,
        recordings=frames,
        per_video=1,
        encoder=EncoderConfig(weights=str(write_tower(tmp_path / "tower")), epochs=1),
        runtime=CPU,
        pretrained=tmp_path / "none",
    )


def test_more_folds_than_objects_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cross_validation.folds is 5 but only 2 objects"):
        judge(CANDIDATES["constant"], two_objects(tmp_path), CrossValidationConfig(folds=5))


def test_one_training_object_leaves_none_to_validate_by(tmp_path: Path) -> None:
    judged = judge(CANDIDATES["paper"], two_objects(tmp_path), CrossValidationConfig(folds=2, repeats=1))
    assert len(judged) == 4

"""Training of encoders, the clips that they are shown, what is saved of them, and the registry of recipes."""

import itertools
import random
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import StandardScaler
from torch.utils._python_dispatch import TorchDispatchMode
from transformers import TrainerCallback

from pipeline.core.layout import PRETRAINED
from pipeline.core.records import Embedding, Flip, Part
from pipeline.core.runtime import derive_seed, seed_everything
from pipeline.encoder import finetune as module
from pipeline.encoder.data import ClipDataset, EncoderData, LabelledVideo
from pipeline.encoder.embed import logits_of, standardize, statistics, union
from pipeline.encoder.finetune import accuracies, finetune, train_classifier
from pipeline.encoder.frame_classifier import STRENGTHS, deal
from pipeline.encoder.model import Heads, PropertyClassifier, mean_and_deviation
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.scales import compose
from pipeline.training.embeddings import Statistics
from pipeline.training.sampling import sample_evaluation, sample_training
from pipeline.training.trainable import load_trainable, trainable_state
from pipeline.training.trainer import TrainableTrainer, training_arguments
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.videos.records import Assignment
from tests.conftest import ROOT
from tests.encoder.conftest import Hook, gradient, setting_of
from tests.encoders import PARTS, config, float64, training, write_frames, write_pretrained

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["paper", "release"])
def test_training_follows_its_recipe_and_leaves_the_backbone(
    recipe: str, weights: Path, data: EncoderData, before_updates: Hook, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rates are torch's cosine annealing, which in `release` goes on and on: down in an epoch, up in the next.

    Batches of 2 of 5 videos make three updates an epoch; each epoch draws its own clips.
    """
    theirs = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=1e-3)
    half = {"T_max": 3, "eta_min": 1e-5} if recipe == "release" else {"T_max": 4 * 3, "eta_min": 0}
    annealing = torch.optim.lr_scheduler.CosineAnnealingLR(theirs, **half)
    expected: list[float] = []
    for _ in range(4 * 3):
        expected += annealing.get_last_lr()
        theirs.step()
        annealing.step()
    rates: list[float] = []
    before_updates(lambda _, optimizer: rates.append(optimizer.param_groups[0]["lr"]))
    drawn: list[tuple[int, str]] = []
    draw = ClipDataset.__getitem__

    def spy(self: ClipDataset, index: int) -> dict[str, torch.Tensor]:
        if self.seed is not None:
            drawn.append((self.epoch, self.videos[index].video_id))
        return draw(self, index)

    monkeypatch.setattr(ClipDataset, "__getitem__", spy)
    setting = config(weights, recipe, epochs=4, batch_size=2)
    seed_everything(0)
    model = property_classifier(setting, data.classes)
    backbone = {n: v.clone() for n, v in model.encoder.visual.state_dict().items()}
    before = {n: v.clone() for n, v in trainable_state(model).items()}
    assert not model.train().encoder.visual.training
    train_classifier(model, training(data, setting))
    assert rates == pytest.approx(expected, rel=1e-9)
    after = trainable_state(model)
    moved = (after["encoder.prompts.prompts"] - before["encoder.prompts.prompts"]).flatten(1).abs().amax(dim=1)
    assert (moved > 0).all(), "the prompts of every layer learn"
    assert all(not torch.equal(before[n], after[n]) for n in before)
    assert all(torch.equal(backbone[n], v) for n, v in model.encoder.visual.state_dict().items())
    trained = [f"{o}_0" for o, part in PARTS.items() if part == Part.TRAIN]
    assert sorted(drawn) == sorted((epoch, video) for epoch in range(4) for video in trained)
    assert drawn == sorted(drawn, key=lambda each: each[0])


@pytest.mark.slow
def test_accumulated_videos_weigh_alike(weights: Path, data: EncoderData, before_updates: Hook) -> None:
    """The gradient of five videos in an update is that of all at once, however they are divided; some parts are odd."""
    data = replace(data, assignments=[a for a in data.assignments if a.part == Part.TRAIN])
    gradients: list[torch.Tensor] = []
    before_updates(lambda _, optimizer: gradients.append(gradient(optimizer)))
    for micro in (0, 3, 2):
        setting = config(weights, "paper", epochs=1, batch_size=6, micro_batch_size=micro)
        seed_everything(0)
        train_classifier(property_classifier(setting, data.classes).double(), training(data, setting))
    assert len(gradients) == 3
    for other in gradients[1:]:
        # The number of labels that the Trainer gives is float32's.
        torch.testing.assert_close(other, gradients[0], atol=1e-6 * float(gradients[0].abs().max()), rtol=0)


@pytest.mark.slow
def test_autocast_computes_in_bfloat16_and_learns_in_float32(weights: Path, data: EncoderData) -> None:
    for autocast, expected in (("none", torch.float32), ("bfloat16", torch.bfloat16)):
        setting = config(weights, "paper", epochs=1, batch_size=8, autocast=autocast)
        model, seen = property_classifier(setting, data.classes), set[torch.dtype]()
        attended = model.encoder.visual.get_submodule("transformer.resblocks.0.mlp.c_fc")
        attended.register_forward_hook(lambda _, __, output, seen=seen: seen.add(output.dtype))
        train_classifier(model, training(data, setting))
        assert seen == {expected}
        assert {value.dtype for value in trainable_state(model).values()} == {torch.float32}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "scores", "kept"),
    [
        ("paper", (0.1, 0.5, 0.5), 1),
        ("paper", (0.0, 0.0, 0.0), 0),
        ("paper", (), 2),  # Without validation videos it is the last.
        ("tuned", (0.5, 0.5, 0.5), 0),  # Of `tuned` the first is the probe, which has had no epoch.
        ("tuned", (0.2, 0.4, 0.3), 1),
    ],
)
def test_the_first_of_the_best_epochs_is_kept(
    kind: str, scores: Sequence[float], kept: int, weights: Path, data: EncoderData, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not scores:
        data = replace(data, assignments=[a.model_copy(update={"part": Part.TRAIN}) for a in data.assignments])
    seen: list[dict[str, torch.Tensor]] = []
    script = iter(scores)

    def see(model: torch.nn.Module) -> None:
        seen.append({n: v.clone() for n, v in trainable_state(model).items()})

    class Remember(TrainerCallback):
        def on_log(self, *_: object, logs: dict[str, float], model: torch.nn.Module, **__: object) -> None:
            if "loss" in logs:
                see(model)

    def scripted(_: object, __: object, decide: Any, ___: object) -> dict[str, float]:
        if not seen:
            see(decide.__self__)
        return {"validation_combined": next(script)}

    monkeypatch.setattr(module, "accuracies", scripted)
    setting = setting_of(kind, weights, epochs=2 if kind == "tuned" else 3, batch_size=8)
    model, history = finetune(training(data, setting, callbacks=[Remember()]))
    found = trainable_state(model)
    assert [all(torch.equal(v, found[n]) for n, v in epoch.items()) for epoch in seen] == [i == kept for i in range(3)]
    assert [m.value for m in history if m.name == "validation_combined"] == list(scores)


@given(st.integers(1, 400), st.integers(1, 64), st.integers(0, 2**32))
def test_training_samples(count: int, k: int, seed: int) -> None:
    drawn = sample_training(count, k, random.Random(seed))
    assert len(drawn) == k
    assert list(drawn) == sorted(drawn)
    assert set(drawn) <= set(range(count))
    assert len(set(drawn)) == k or count < k
    assert drawn == sample_training(count, k, random.Random(seed))


@given(st.integers(1, 400), st.integers(1, 64))
def test_evaluation_samples_are_uniform_from_the_first(count: int, k: int) -> None:
    drawn = sample_evaluation(count, k)
    assert len(drawn) == k
    assert drawn[0] == 0
    assert drawn[-1] < count
    gaps = [b - a for a, b in itertools.pairwise(drawn)]
    assert all(between in (count // k, -(-count // k)) for between in gaps)


def test_a_clip_depends_on_seed_epoch_and_video_alone(tmp_path: Path) -> None:
    store = FrameStore(write_frames(tmp_path, {"a_0": 9, "b_0": 9}))
    videos = [LabelledVideo("a_0", (0,)), LabelledVideo("b_0", (1,))]

    def clip(seed: int, epoch: int, order: int = 1) -> tuple[list[int], bytes]:
        data = ClipDataset(store, videos[::order], per_video=3, seed=seed, flip_probability=0.5)
        data.epoch = epoch
        item = data[0 if order > 0 else 1]
        return item["frame_indices"].tolist(), item["frames"].numpy().tobytes()

    assert clip(1, 4) == clip(1, 4) == clip(1, 4, -1)
    assert len({clip(1, epoch)[1] for epoch in range(20)}) > 15
    assert len({clip(seed, 0)[1] for seed in range(20)}) > 15


def test_validation_counts_videos_that_are_right_in_everything(catalogue: Catalogue) -> None:
    logits = np.array([[3, 1, 0, 0, 2, 1, 0, 0, 5], [0, 1, 0, 4, 0, 0, -1, -3, -2], [0, 0, 1, 0, 0, 1, 0, 1, 0]])
    decide = PropertyClassifier(SceneEncoder(), Heads(256, [3, 3, 3]), [3, 3, 3]).decide
    found = accuracies(logits, np.array([[0, 1, 2], [1, 0, 1], [1, 2, 1]]), decide, catalogue)
    expected = {"hardness": 2 / 3, "roughness": 1, "bumpiness": 2 / 3, "combined": 1 / 3}
    assert found == pytest.approx({f"validation_{name}": value for name, value in expected.items()})


def test_running_statistics_are_saved_with_what_is_trained_alone(tmp_path: Path) -> None:
    """As stage `pretrain` saves the whole network, and `tuned` its last layers."""
    made = write_pretrained(1)
    state = trainable_state(made)
    assert state.keys() == made.state_dict().keys(), "nothing is frozen, so everything is there"
    other = SceneEncoder().eval()
    load_trainable(other, PRETRAINED)
    frames = torch.randint(0, 256, (4, 32, 32, 3), dtype=torch.uint8)
    assert torch.equal(made(frames, torch.zeros(4)), other(frames, torch.zeros(4)))
    other.requires_grad_(False)
    assert trainable_state(other) == {}, "statistics of frozen layers are not trained"
    next(layer for layer in other.layers if isinstance(layer, torch.nn.BatchNorm2d)).requires_grad_(True)
    names = {"bias", "num_batches_tracked", "running_mean", "running_var", "weight"}
    assert {n.split(".")[-1] for n in trainable_state(other)} == names


def indexed(keys: Iterable[tuple[str, Flip, int]]) -> list[Embedding]:
    return [Embedding(video_id=v, frame_index=f, flip=flip, row=row) for row, (v, flip, f) in enumerate(keys)]


def test_standardized_by_training_frames_alone() -> None:
    videos = ("train_0", "train_1", "test_0")
    index = indexed((video, flip, f) for video in videos for flip in ("none", "both") for f in range(4))
    raw = torch.randn(len(index), 3, generator=torch.manual_seed(0)) * torch.tensor([1e-3, 1.0, 0.0]) + 1e3
    rows = [e.row for e in index if e.video_id.startswith("train") and e.flip == "none"]
    done = standardize(raw, statistics(raw, index, {"train_0", "train_1"}))
    exact = float64(raw)
    deviation = np.array([*exact[rows].std(0)[:2], 1.0])  # A constant dimension is only shifted.
    np.testing.assert_allclose(done.numpy(), (exact - exact[rows].mean(0)) / deviation, rtol=1e-6)
    raw[[e.row for e in index if e.video_id == "test_0"]] += 5
    assert torch.equal(standardize(raw, statistics(raw, index, {"train_0", "train_1"}))[rows], done[rows])


class Operators(TorchDispatchMode):
    """The names of torch's operators while it is entered."""

    def __init__(self) -> None:
        super().__init__()
        self.seen = set[str]()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.seen.add(str(function.overloadpacket))
        return function(*args, **(kwargs or {}))


def test_no_root_is_mkls(tmp_path: Path) -> None:
    """Which depends on the maker of the processor, also with `kernels: portable`."""
    line, params = torch.nn.Linear(2, 1), compose("smoke", conf=ROOT / "conf")
    arguments = training_arguments(tmp_path, params.runtime, 0, params.pretrain, max_steps=1)
    trainer = TrainableTrainer(model=line, args=arguments, train_dataset=[])
    line(torch.ones(1, 2)).sum().backward()
    with Operators() as operators:
        trainer.create_optimizer().step()
        statistics(torch.randn(4, 3), indexed(("a", "none", f) for f in range(4)), {"a"})
        mean_and_deviation(torch.rand(2, 3, 4))
    assert "aten.rsqrt" in operators.seen
    assert not {name for name in operators.seen if re.search(r"\bsqrt", name)}


def test_a_training_object_gets_logits_of_heads_that_did_not_see_it(catalogue: Catalogue, tmp_path: Path) -> None:
    """Its own label changes nothing of them; a test video's follow from all training objects, as when it is asked."""
    objects = list(catalogue.objects)[:24]
    parts = [Part.TEST if i % 4 == 3 else Part.TRAIN for i in range(24)]
    split = [Assignment(video_id=f"{o}_0", object_id=o, part=part) for o, part in zip(objects, parts, strict=True)]
    flips: dict[Part, tuple[Flip, ...]] = {Part.TRAIN: ("none", "both"), Part.TEST: ("none",)}
    index = indexed((a.video_id, flip, f) for a in split for flip in flips[a.part] for f in range(3))
    raw = torch.randn(len(index), 5, generator=torch.manual_seed(0)) * 3 + 1
    found, heads = logits_of(raw, index, split, catalogue, 0)
    assert found.shape == (len(index), 9)

    # By scikit-learn alone, of hardness: all training frames, or those of the other parts.
    def reference(learnt: list[Embedding], strength: float) -> np.ndarray:
        frames = raw[[e.row for e in learnt]].numpy()
        scaler = StandardScaler().fit(frames)
        labels = [catalogue.labels(e.video_id[:-2])[0] for e in learnt]
        model = LogisticRegression(C=strength, max_iter=2000).fit(scaler.transform(frames).clip(-5, 5), labels)
        return model.decision_function(scaler.transform(raw.numpy()))

    trained = {a.object_id for a in split if a.part == Part.TRAIN}
    learnt = [e for e in index if e.flip == "none" and e.video_id[:-2] in trained]
    tested = [e.row for e in index if e.video_id[:-2] not in trained]
    wholes = [reference(learnt, strength) for strength in STRENGTHS]
    own = found[tested, :3].numpy()
    errors = [np.abs(own - whole[tested]).max() for whole in wholes]
    assert min(errors) < 1e-3, "one of the strengths that are tried"
    strength = STRENGTHS[int(np.argmin(errors))]

    first, *_ = deal(sorted(trained), 5, derive_seed(0, "logits"))
    held = [e.row for e in index if e.video_id[:-2] in first]
    others = reference([e for e in learnt if e.video_id[:-2] not in first], strength)
    np.testing.assert_allclose(found[held, :3].numpy(), others[held], atol=1e-3)
    assert np.abs(found[held, :3].numpy() - wholes[STRENGTHS.index(strength)][held]).max() > 0.01

    known = statistics(found, index, {f"{o}_0" for o in trained})._replace(heads=heads)
    known.save(tmp_path / "statistics.safetensors")
    asked = standardize(raw[tested], Statistics.load(tmp_path / "statistics.safetensors"))
    torch.testing.assert_close(asked, standardize(found, known._replace(heads=None))[tested], rtol=1e-5, atol=1e-5)


def test_a_video_that_any_split_trains_on_is_embedded_for_training() -> None:
    train, test, unused = Part.TRAIN, Part.TEST, Part.UNUSED
    parts = {"a": (train, test), "b": (test, train), "c": (test, test), "d": (unused, test), "e": (unused, unused)}
    splits = [[Assignment(video_id=v, object_id=v, part=both[i]) for v, both in parts.items()] for i in (0, 1)]
    found = {a.video_id: a.part for a in union(splits)}
    assert found == {"a": train, "b": train, "c": test, "d": test, "e": unused}

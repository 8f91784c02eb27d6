"""The per-frame classifier: fitted heads against scikit-learn, decisions against all combinations."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import log_softmax, logsumexp
from sklearn.linear_model import LogisticRegression

from pipeline.core.records import Part
from pipeline.encoder import frame_classifier
from pipeline.encoder.data import EncoderData
from pipeline.encoder.finetune import finetune
from pipeline.encoder.frame_classifier import STRENGTHS, JointFrameClassifier, choose_strength, deal, fit_frame_heads
from pipeline.encoder.model import FrameEncoder
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FrameStore
from tests.encoders import OBJECTS, Floats, config, encoder_data, float64, random_heads, training, write_pretrained

pytestmark = pytest.mark.usefixtures("elsewhere")


@settings(max_examples=30)
@given(
    st.integers(0, 10**6),
    st.lists(st.integers(1, 4), min_size=1, max_size=3),
    st.integers(1, 6),
    st.sampled_from([0.0, 0.3, 3.0, 100.0]),
    st.sampled_from([1.0, 1e6, 1e30]),
)
def test_evidence_of_frames(seed: int, classes: list[int], frames: int, strength: float, scale: float) -> None:
    """Strong weights make the frames so sure that the other classes' probabilities are 0 in float32."""
    heads = random_heads(seed, 5, classes, strength)
    model = JointFrameClassifier(FrameEncoder(5), classes)
    heads.copy_into(model)
    clips = (scale * np.random.default_rng(seed).normal(size=(3, frames, 5))).astype(np.float32)
    with torch.no_grad():
        found = model.classify(torch.from_numpy(clips))
    scaled = (clips.astype(np.float64) - heads.centre) / heads.spread.astype(np.float64)
    for z, weight, bias, evidence in zip(found, heads.weights, heads.biases, heads.evidence(clips), strict=True):
        logs = log_softmax(np.clip(scaled, -5, 5) @ weight.T + bias, axis=-1)
        expected = logsumexp(logs, axis=1, b=1 / frames)
        np.testing.assert_allclose(z.numpy(), expected, rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose(evidence, expected, rtol=2e-5, atol=2e-5)


def planted(seed: int, objects: int = 12, videos: int = 2) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Clips of three frames whose first columns tell the labels through noise; the last is constant."""
    rng = np.random.default_rng(seed)
    truth = np.stack([np.arange(objects) % 3, np.arange(objects) // 3 % 2], axis=1)
    labels = np.repeat(truth, videos, axis=0)
    clips = rng.normal(size=(len(labels), 3, 6)).astype(np.float32)
    clips[..., :2] += 2 * labels[:, None]
    clips[..., -1] = 0.1
    return clips, labels, [f"o{i}" for i in range(objects) for _ in range(videos)]


def reference(clips: np.ndarray, wanted: np.ndarray, strength: float) -> tuple[Callable[[np.ndarray], Floats], Floats]:
    """Another solver to convergence: probabilities of a frame, and the classes that they are of."""
    frames = clips.reshape(-1, clips.shape[-1]).astype(np.float64)
    mean, deviation = frames.mean(axis=0), frames.std(axis=0)
    deviation[deviation < 1e-6] = 1

    def scale(some: np.ndarray) -> Floats:
        return np.clip((some.reshape(-1, some.shape[-1]) - mean) / deviation, -5, 5)

    model = LogisticRegression(C=strength, solver="newton-cholesky", tol=1e-10)
    model.fit(scale(clips), np.repeat(wanted, clips.shape[1]))
    return lambda some: model.predict_proba(scale(some)).reshape(*some.shape[:2], -1), model.classes_


@pytest.mark.parametrize("strength", [STRENGTHS[0], STRENGTHS[-1]])
def test_heads_are_scikit_learns_logistic_regression(strength: float) -> None:
    """Of three and of two classes; the latter it fits with one row of weights, which the penalty treats otherwise."""
    clips, labels, objects = planted(0)
    unseen = planted(1)[0]
    heads = fit_frame_heads(clips, labels, objects, [3, 2], strength)
    for position, logs in enumerate(heads.evidence(unseen)):
        probabilities, _ = reference(clips, labels[:, position], strength)
        np.testing.assert_allclose(np.exp(logs), probabilities(unseen).mean(axis=1), atol=2e-4)


@pytest.mark.parametrize("kept", [(0, 2), (1, 2), (0,), (2,)])
def test_a_class_that_training_lacks_is_all_but_impossible(kept: tuple[int, ...]) -> None:
    clips, labels, objects = planted(0, objects=18)
    some = np.isin(labels[:, 0], kept)
    clips, labels, objects = clips[some], labels[some], [o for o, s in zip(objects, some, strict=True) if s]
    heads = fit_frame_heads(clips, labels, objects, [4, 2], STRENGTHS[-1])
    unseen = np.concatenate([planted(1)[0], 1e6 * planted(2)[0], -1e6 * planted(3)[0], np.zeros((1, 3, 6), np.float32)])
    found = np.exp(heads.evidence(unseen)[0])
    lacking = [c for c in range(4) if c not in kept]
    assert np.isfinite(found).all()
    assert 0 < found[:, lacking].min() <= found[:, lacking].max() < 1e-3
    assert found.sum(axis=1) == pytest.approx(1)
    assert set(heads.predict(unseen)[:, 0].tolist()) <= set(kept)
    heads.copy_into(model := JointFrameClassifier(FrameEncoder(6), [4, 2]))
    logits = torch.cat(model.classify(torch.from_numpy(unseen)), dim=1)
    assert (model.decide(logits).numpy() == heads.predict(unseen)).all(), "the model decides alike"
    if len(kept) == 2:
        probabilities, present = reference(clips, labels[:, 0], STRENGTHS[-1])
        assert tuple(present) == kept
        np.testing.assert_allclose(found[:, list(kept)], probabilities(unseen).mean(axis=1), atol=3e-4)


@pytest.mark.parametrize(("right", "chosen"), [((3, 5, 5, 2), 1), ((4, 4, 4, 4), 0), ((0, 0, 0, 1), 3)])
def test_the_strength_is_chosen_inside(right: tuple[int, ...], chosen: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of seven objects, whose number is the first feature and whose labels are all 1, heads get as many right.

    They are asked about each object once, on folds that all strengths share, and never about one that they learnt from.
    """
    owners = np.repeat(np.arange(7), 2)
    clips = np.zeros((14, 3, 2), np.float32)
    clips[..., 0] = owners[:, None]
    asked: dict[float, list[set[int]]] = {}

    def fit(clips: np.ndarray, labels: np.ndarray, names: list[str], _: object, strength: float) -> SimpleNamespace:
        assert [f"o{i:.0f}" for i in clips[:, 0, 0]] == names
        assert len(labels) == len(names)

        def predict(clips: np.ndarray) -> np.ndarray:
            tested = clips[:, 0, 0].astype(int)
            assert not {f"o{i}" for i in tested} & set(names), "tested on an object that it learnt from"
            asked.setdefault(strength, []).append(set(tested.tolist()))
            return np.where(tested < right[STRENGTHS.index(strength)], 1, 0)[:, None]

        return SimpleNamespace(predict=predict)

    monkeypatch.setattr(frame_classifier, "fit_frame_heads", fit)
    strength, curve = choose_strength(clips, np.ones((14, 1), np.int64), [f"o{i}" for i in owners], [2], seed=4)
    assert strength == STRENGTHS[chosen]
    assert [m.value for m in curve] == pytest.approx([r / 7 for r in right])
    assert [m.step for m in curve] == [0, 1, 2, 3]
    assert list(asked) == list(STRENGTHS), "all in their order"
    assert all(folds == asked[strength] for folds in asked.values())
    assert sorted(itertools.chain(*asked[strength])) == list(range(7))


def test_one_object_leaves_nothing_to_choose_by(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_classifier, "fit_frame_heads", None)
    clips, labels, _ = planted(0, objects=1)
    assert choose_strength(clips, labels, ["o0"] * 2, [3, 2], seed=0) == (STRENGTHS[1], [])


def test_tuning_begins_with_heads_fitted_to_evaluation_clips(
    weights: Path, catalogue: Catalogue, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By hand: the pretrained network on frames i n // k of each video's difference; unvalidated, that is all."""
    monkeypatch.setattr(frame_classifier, "STRENGTHS", STRENGTHS[:2])
    pretrained = write_pretrained(3)
    parts = {o: Part.TEST if i > 4 else Part.TRAIN for i, o in enumerate(OBJECTS)}
    plain = encoder_data(tmp_path, catalogue, parts)
    data = EncoderData(FrameStore(tmp_path, "subtract"), catalogue, plain.assignments, 2)
    model, curve = finetune(training(data, config(weights, "tuned"), seed=5))
    assert isinstance(model, JointFrameClassifier)
    shown = [data.store.pictures(f"{o}_0", [0, n // 2]) for o, n in zip(OBJECTS, (4, 1, 3, 4, 1), strict=False)]
    with torch.no_grad():
        clips = np.stack([pretrained(torch.from_numpy(pictures), torch.zeros(2)).numpy() for pictures in shown])
    known = (clips, np.array([catalogue.labels(o) for o in OBJECTS[:5]]), OBJECTS[:5], [3, 3, 3])
    strength, expected = choose_strength(*known, 5)
    heads = fit_frame_heads(*known, strength)
    assert curve == expected
    for head, weight in zip(model.heads.children(), heads.weights, strict=True):
        np.testing.assert_allclose(float64(head.get_parameter("weight")), weight, atol=1e-5)
    np.testing.assert_allclose(float64(model.centre), heads.centre, atol=1e-6)
    np.testing.assert_array_equal(float64(model.dependence), heads.dependence)
    own = model.encoder.get_submodule("backbones.0").state_dict()
    assert all(torch.equal(v, own[n]) for n, v in pretrained.state_dict().items()), "the network itself stays"


def test_the_prior_counts_each_object_once() -> None:
    labels = np.array([[0, 0], [0, 0], [0, 0], [1, 2], [1, 0]])
    dependence = frame_classifier.log_dependence(labels, ["a", "a", "a", "b", "c"], (2, 3))
    joint = np.array([[1, 0, 0], [1, 0, 1]]) + frame_classifier.SMOOTHING
    joint /= joint.sum()
    np.testing.assert_allclose(dependence, np.log(joint / joint.sum(1, keepdims=True) / joint.sum(0)), rtol=1e-6)
    assert frame_classifier.log_dependence(np.zeros((1, 1), np.int64), ["a"], (4,)) == pytest.approx(np.zeros(4))


@given(st.integers(0, 10**6), st.lists(st.integers(1, 4), min_size=1, max_size=4))
def test_joint_decoding_against_brute_force(seed: int, classes: list[int]) -> None:
    rng = np.random.default_rng(seed)
    tables = [rng.dirichlet(np.ones(count), size=5) for count in classes]
    dependence = rng.normal(size=tuple(classes))
    decoded = frame_classifier.decode_jointly([np.log(table) for table in tables], dependence)
    for video in range(5):

        def score(combination: tuple[int, ...], video: int = video) -> float:
            chances = [table[video, c] for table, c in zip(tables, combination, strict=True)]
            return float(dependence[combination]) + sum(map(math.log, chances))

        assert tuple(decoded[video]) == max(itertools.product(*map(range, classes)), key=score)


@given(st.lists(st.integers(0, 30), min_size=2, max_size=80), st.integers(2, 7), st.integers(0, 99))
def test_folds_hold_whole_objects_and_are_even(numbers: list[int], folds: int, seed: int) -> None:
    objects = [f"o{n}" for n in numbers]
    folds = min(folds, len(set(objects)))
    dealt = deal(objects, folds, seed)
    assert sorted(itertools.chain.from_iterable(dealt)) == sorted(set(objects))
    assert max(map(len, dealt)) - min(map(len, dealt)) <= 1
    assert dealt == deal(objects[::-1], folds, seed)

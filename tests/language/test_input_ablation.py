"""Input ablations: no touch, another object's, noise; the same for every variant and batch."""

from pathlib import Path

import pytest
import torch

from pipeline.core.records import Dialogue, Gold, Opd, Part, Question, TouchInput, Turn
from pipeline.language.conversations import evaluation_features
from pipeline.language.input_ablation import ablate_input
from pipeline.training.embeddings import EmbeddingStore
from tests.conftest import refused
from tests.language.conftest import DIM, stored


def question(objects: str, video: int = 0) -> Question:
    said = Turn(user="{tactile}" * len(objects), assistant="x")
    gold = Gold(choice="yes", labels=((0,),) * len(objects), properties=("hardness",))
    told = {"question_id": objects, "task": "PC", "part": Part.TEST, "objects": tuple(objects), "gold": gold}
    dialogues = (Dialogue(opd=Opd.ALL, turns=(said,)),)
    return Question(**told, videos=tuple(f"{o}_{video}" for o in objects), dialogues=dialogues)


def store_of(folder: Path, videos: dict[str, int]) -> EmbeddingStore:
    """An embedding of video v's frame f begins with v's number and f."""
    frames = [(video, frame, "none") for video, count in videos.items() for frame in range(count)]
    tensor = torch.randn(len(frames), DIM, generator=torch.Generator().manual_seed(0))
    tensor[:, :2] = torch.tensor([(list(videos).index(video), frame) for video, frame, _ in frames])
    return stored(folder, frames, tensor)


@pytest.fixture
def store(tmp_path: Path) -> EmbeddingStore:
    return store_of(tmp_path, {f"{o}_{v}": 2 + 3 * v for o in "abcd" for v in range(2)})


QUESTIONS = [question("ab"), question("cd"), question("ad", video=1)]


def test_swapped_is_always_another_object_and_none_is_given_twice(store: EmbeddingStore) -> None:
    names = sorted({v for v, _ in store._rows})
    for seed in range(20):
        ablated, given = ablate_input(store, TouchInput.SWAPPED, QUESTIONS, seed)[0], {}
        for asked in QUESTIONS:
            for video, own in zip(asked.videos, asked.objects, strict=True):
                first = ablated.features(video, range(ablated.count(video)))
                other = names[int(first[0, 0])]
                assert torch.equal(first, store.features(other, range(store.count(other))))
                given[own] = other.split("_")[0]
        assert all(own != other for own, other in given.items())
        assert sorted(given) == sorted(given.values()) == list("abcd")
        assert ablated.dim == DIM
    with refused("ablation.touch: swapped needs questions about two objects"):
        ablate_input(store, TouchInput.SWAPPED, [question("a")], 0)
    for touch in (TouchInput.SWAPPED, TouchInput.NOISE):
        assert ablate_input(store, touch, [], 0)[0].dim == store.dim, "no test object has videos: nothing is asked"


def test_noise_has_the_embeddings_moments_and_is_no_ones_touch(tmp_path: Path) -> None:
    store = store_of(tmp_path, {"a_0": 4000, "b_0": 4000})
    ablated = ablate_input(store, TouchInput.NOISE, [question("ab")], 3)[0]
    drawn = torch.cat([ablated.features(v, range(4000)) for v in ("a_0", "b_0")])
    mean, deviation = store.tensor.mean(0), store.tensor.std(0)
    # Five standard errors of a mean and of a deviation over 8000 draws.
    assert ((drawn.mean(0) - mean).abs() < 5 * deviation / 8000**0.5).all()
    assert ((drawn.std(0) / deviation - 1).abs() < 5 / (2 * 8000) ** 0.5).all()
    assert abs(torch.corrcoef(torch.stack([drawn[:, 0], store.tensor[:, 0]]))[0, 1]) < 5 / 8000**0.5


def test_noise_is_the_same_at_each_call_and_differs_between_frames_videos_and_seeds(store: EmbeddingStore) -> None:
    ablated, again, other = (ablate_input(store, TouchInput.NOISE, QUESTIONS, seed)[0] for seed in (3, 3, 4))
    first = ablated.features("a_1", [0, 1, 4])
    assert torch.equal(first[[2, 0]], again.features("a_1", [4, 0]))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[0], ablated.features("d_1", [0])[0])
    assert not torch.equal(first[0], other.features("a_1", [0])[0])
    assert ablated.features("a_1", []).shape == (0, DIM)


def test_real_touch_is_the_videos_own_and_removed_leaves_the_delimiters_alone(store: EmbeddingStore) -> None:
    given, asked = ablate_input(store, TouchInput.REAL, QUESTIONS, 0)
    assert (given, asked) == (store, QUESTIONS)
    real = evaluation_features(QUESTIONS[0], store, 3)
    for touch in (TouchInput.SWAPPED, TouchInput.NOISE):
        given, asked = ablate_input(store, touch, QUESTIONS, 0)
        assert asked == QUESTIONS
        other = evaluation_features(QUESTIONS[0], given, 3)
        assert other.shape == real.shape
        assert not torch.equal(other, real)
    given, asked = ablate_input(store, TouchInput.REMOVED, QUESTIONS, 0)
    assert evaluation_features(asked[0], given, 3).shape == (0, DIM)
    assert [q.dialogues[0].turns[0].user for q in asked] == ["<tact_start><tact_end>" * 2] * 3
    assert [q.question_id for q in asked] == [q.question_id for q in QUESTIONS]

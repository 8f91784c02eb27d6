"""Classes read from logits, held against the rules as reports grade them."""

import numpy as np
import pytest
import torch
from scipy.special import softmax

from pipeline.core.records import Question
from pipeline.evaluation.grading import conclude
from pipeline.language.classes import uncontradicted
from pipeline.tasks.questions import build_questions
from pipeline.training.embeddings import STATISTICS_FILE, EmbeddingStore, Statistics
from tests.conftest import classified
from tests.language.conftest import stored
from tests.tasks.shared import CATALOGUE, POOL

ASKED = {"OPD": 20, "PC": 60, "PSS": 60, "POM": 90}


@pytest.fixture(scope="module")
def questions() -> list[Question]:
    return build_questions(POOL, {**ASKED, "PSR": 4}, seed=3, distinct=True, facts=True, restate=True, plainly=0.5)


@pytest.fixture(scope="module")
def logits(questions: list[Question]) -> dict[str, torch.Tensor]:
    """By video, of three frames that differ widely: classes do not follow from a mean over logits."""
    drawn = torch.manual_seed(0)
    videos = sorted({video for q in questions for video in q.videos})
    own = [torch.tensor(CATALOGUE.labels(video.rpartition("_")[0])) for video in videos]
    noise = [3.0 * torch.randn(3, 9, generator=drawn, dtype=torch.float64) for _ in videos]
    likely = [2.0 * torch.nn.functional.one_hot(labels, 3).flatten().double() for labels in own]
    return {video: one + other for video, one, other in zip(videos, likely, noise, strict=True)}


@pytest.fixture(scope="module")
def store(logits: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> EmbeddingStore:
    """Of standardised logits, whose scales differ widely too."""
    folder = tmp_path_factory.mktemp("logits")
    frames = [(video, frame, "none") for video in logits for frame in range(3)]
    mean, scale = torch.linspace(-4, 4, 9).double(), torch.linspace(0.2, 5, 9).double()
    store = stored(folder, frames, ((torch.cat([*logits.values()]) - mean) / scale).float())
    Statistics(mean, scale).save(folder / STATISTICS_FILE)
    return store


def shares(frames: torch.Tensor, place: int) -> tuple[float, ...]:
    return tuple(softmax(frames[:, 3 * place : 3 * place + 3].numpy(), axis=1).mean(0).tolist())


def test_comparisons_stay_that_follow_from_the_logits_by_rule(
    questions: list[Question], logits: dict[str, torch.Tensor], store: EmbeddingStore
) -> None:
    said = [
        classified(video, prop.name, 0, int(np.argmax(own := shares(frames, place))), own)
        for video, frames in logits.items()
        for place, prop in enumerate(CATALOGUE.properties)
    ]
    questions = [q for q in questions if q.task != "PSR"]
    right = {s.question_id for s in conclude(questions, said, CATALOGUE) if s.measure == "choice" and s.correct}
    kept = uncontradicted(questions, store, CATALOGUE)
    assert {q.question_id for q in kept if q.task != "OPD"} == right
    assert [q for q in questions if q in kept] == kept
    counts = {task: sum(q.task == task for q in kept) for task in ASKED}
    assert counts["OPD"] == 20
    assert all(10 < counts[task] < ASKED[task] - 10 for task in ("PC", "PSS", "POM")), counts

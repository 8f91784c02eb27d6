"""Classes read from logits, held against the rules as reports grade them."""

from pathlib import Path

import numpy as np
import torch
from scipy.special import softmax
from torch.nn.functional import one_hot

from pipeline.evaluation.grading import conclude
from pipeline.language.classes import uncontradicted
from pipeline.tasks.questions import build_questions
from pipeline.training.embeddings import STATISTICS_FILE, Statistics
from tests.conftest import classified
from tests.language.conftest import stored
from tests.tasks.shared import CATALOGUE, POOL

ASKED = {"OPD": 20, "PC": 60, "PSS": 60, "POM": 90}


def test_comparisons_stay_that_follow_from_the_logits_by_rule(tmp_path: Path) -> None:
    """From three standardised frames a video, which differ widely: a mean over logits would tell other classes."""
    questions = build_questions(POOL, ASKED, seed=3, distinct=True, facts=True, restate=True, plainly=0.5)
    drawn, logits = torch.manual_seed(0), dict[str, torch.Tensor]()
    for video in sorted({video for q in questions for video in q.videos}):
        likely = 2.0 * one_hot(torch.tensor(CATALOGUE.labels(video.rpartition("_")[0])), 3).flatten()
        logits[video] = likely + 3.0 * torch.randn(3, 9, generator=drawn, dtype=torch.float64)
    mean, scale = torch.linspace(-4, 4, 9).double(), torch.linspace(0.2, 5, 9).double()
    frames = [(video, frame, "none") for video in logits for frame in range(3)]
    store = stored(tmp_path, frames, ((torch.cat([*logits.values()]) - mean) / scale).float())
    Statistics(mean, scale).save(tmp_path / STATISTICS_FILE)

    def shares(frames: torch.Tensor, place: int) -> tuple[float, ...]:
        return tuple(softmax(frames[:, 3 * place : 3 * place + 3].numpy(), axis=1).mean(0).tolist())

    said = [
        classified(video, prop.name, 0, int(np.argmax(own := shares(frames, place))), own)
        for video, frames in logits.items()
        for place, prop in enumerate(CATALOGUE.properties)
    ]
    right = {s.question_id for s in conclude(questions, said, CATALOGUE) if s.measure == "choice" and s.correct}
    kept = uncontradicted(questions, store, CATALOGUE)
    assert {q.question_id for q in kept if q.task != "OPD"} == right
    assert [q for q in questions if q in kept] == kept
    counts = {task: sum(q.task == task for q in kept) for task in ASKED}
    assert counts["OPD"] == 20
    assert all(10 < counts[task] < ASKED[task] - 10 for task in ("PC", "PSS", "POM")), counts

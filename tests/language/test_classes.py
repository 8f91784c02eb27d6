"""Training questions that the heads contradict, held against the rules as reports grade them."""

from __future__ import annotations

from pathlib import Path

import torch
from scipy.special import softmax

from pipeline.core.embeddings import STATISTICS_FILE, Statistics
from pipeline.core.records import Classification, Part
from pipeline.evaluation.grading import conclude
from pipeline.language.training import uncontradicted
from pipeline.tasks.questions import build_questions
from tests.language.shared import write_store
from tests.tasks.shared import CATALOGUE, POOL


def test_comparisons_stay_that_follow_from_the_logits_by_rule(tmp_path: Path) -> None:
    asked = {"OPD": 20, "PC": 60, "PSS": 60, "POM": 60}
    questions = build_questions(POOL, asked, seed=3, distinct=True, facts=True, restate=True, plainly=0.5)
    videos = sorted({video for q in questions for video in q.videos})
    frames = [(video, frame, "none") for video in videos for frame in range(3)]
    # Classes follow from neither the standardised numbers nor a mean over logits: scales and frames differ widely.
    own = torch.tensor([[*CATALOGUE.labels(video.rpartition("_")[0])] for video, _, _ in frames])
    logits = 2.0 * torch.nn.functional.one_hot(own, 3).flatten(1).double()
    logits += 3.0 * torch.randn(logits.shape, generator=torch.manual_seed(0), dtype=torch.float64)
    mean, scale = torch.linspace(-4, 4, 9).double(), torch.linspace(0.2, 5, 9).double()
    store = write_store(tmp_path, frames, ((logits - mean) / scale).float())
    Statistics(mean, scale).save(tmp_path / STATISTICS_FILE)
    said = []
    for place, prop in enumerate(CATALOGUE.properties):
        for index, video in enumerate(videos):
            rows = logits[3 * index : 3 * index + 3, 3 * place : 3 * place + 3].numpy()
            shares = softmax(rows, axis=1).mean(0)
            said.append(
                Classification(
                    video_id=video,
                    object_id=video.rpartition("_")[0],
                    part=Part.TRAIN,
                    property=prop.name,
                    expected=0,
                    predicted=int(shares.argmax()),
                    probabilities=tuple(shares),
                )
            )
    right = {s.question_id for s in conclude(questions, said, CATALOGUE) if s.measure == "choice" and s.correct}
    kept = uncontradicted(questions, store, CATALOGUE)
    assert {q.question_id for q in kept if q.task != "OPD"} == right
    assert [q for q in questions if q in kept] == kept
    counts = {task: sum(q.task == task for q in kept) for task in asked}
    assert counts["OPD"] == 20
    assert all(10 < counts[task] < 50 for task in ("PC", "PSS", "POM")), counts

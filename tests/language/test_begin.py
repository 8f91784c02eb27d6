"""The projection's start: frames of each class read like its words, also those of videos that it was not fitted to."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from pipeline.config import LanguageConfig
from pipeline.core.records import Question
from pipeline.language.training import Material, assemble
from pipeline.language.words import begin_with_words
from pipeline.videos.catalogue import load_catalogue
from tests.closure import ROOT
from tests.language.shared import DIM, material, taking, write_store

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")


def felt(labels: tuple[int, ...], drawn: torch.Generator) -> torch.Tensor:
    """An embedding that tells all classes, and noise."""
    values = torch.tensor(labels, dtype=torch.float32) - 1
    clean = torch.cat([1.2 * values, 2 * (values.square() - 2 / 3)])
    return clean + 0.05 * torch.randn(DIM, generator=drawn)


@pytest.mark.parametrize("normalize", [False, True])
def test_frames_read_like_the_words_of_their_classes(
    normalize: bool,
    language: LanguageConfig,
    questions: list[Question],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    labels = {v: label for q in questions for v, label in zip(q.videos, q.gold.labels, strict=True)}
    drawn = torch.Generator().manual_seed(0)
    frames = [(v, f, "none") for v in sorted(labels) for f in range(3)]
    store = write_store(tmp_path, frames, torch.stack([felt(labels[v], drawn) for v, _, _ in frames]))
    held = material(language.model_copy(update={"normalize_touch": normalize}), questions, store)
    monkeypatch.setattr("pipeline.language.words.STEPS", 150)
    model, data = assemble(held, taking(14), "test")
    begin_with_words(model, data, CATALOGUE, seed=1)
    assert all(p.grad is None for p in model.parameters())

    words = model.llm.get_input_embeddings().weight
    seen = sorted({label for q in data.questions for label in q.gold.labels})
    assert len(seen) > 4
    means = []
    for label in seen:
        ids = [
            model.tokenizer.encode(f" {p.levels[i]}", add_special_tokens=False)
            for p, i in zip(CATALOGUE.properties, label, strict=True)
        ]
        means.append(torch.stack([words[i].mean(0) for i in ids]).mean(0))
    targets = F.normalize(torch.stack(means) - torch.stack(means).mean(0), dim=1)
    chosen = [felt(random.Random(i).choice(seen), drawn) for i in range(100)]
    expected = [seen.index(random.Random(i).choice(seen)) for i in range(100)]
    with torch.no_grad():
        projected = model.connector.projection(torch.stack(chosen))
    scale = torch.stack(means).square().mean(1).sqrt().mean() if normalize else 1.0
    read = F.normalize(projected * scale - torch.stack(means).mean(0), dim=1) @ targets.T
    right = sum(place == want for place, want in zip(read.argmax(1).tolist(), expected, strict=True))
    assert right >= 90


def test_the_start_follows_from_the_seed(held: Material, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.language.words.STEPS", 5)
    (one, data), (same, _), (other, _) = (assemble(held, taking(14), "test") for _ in range(3))
    for model, seed in ((one, 1), (same, 1), (other, 2)):
        begin_with_words(model, data, CATALOGUE, seed)
    first, twin, another = (model.connector.projection[0].weight for model in (one, same, other))
    assert torch.equal(first, twin)
    assert not torch.equal(first, another)

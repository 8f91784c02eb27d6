"""Fixtures of the language side: a tiny Llama, questions in real wording, embeddings of noise."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from pipeline.config import LanguageConfig
from pipeline.core.embeddings import FLIPS, EmbeddingStore
from pipeline.core.records import Assignment, Part, Question
from pipeline.core.runtime import seed_everything
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Material
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import load_catalogue
from tests.checkpoints import write_llama
from tests.closure import ROOT
from tests.language.shared import DIM, material, write_store


@pytest.fixture(scope="session")
def language(tmp_path_factory: pytest.TempPathFactory) -> LanguageConfig:
    folder = write_llama(tmp_path_factory.mktemp("llama"))
    return LanguageConfig(weights=str(folder), max_new_tokens=12, generation_batch_size=4)


@pytest.fixture(scope="session")
def questions() -> list[Question]:
    catalogue = load_catalogue(ROOT / "pipeline" / "physiclear")
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TRAIN) for o in list(catalogue.objects)[::4]]
    counts = {"OPD": 4, "PC": 4, "PSS": 3, "PSR": 3}
    return build_questions(pool_of(Part.TRAIN, videos, catalogue), counts, seed=0, distinct=False)


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory, questions: list[Question]) -> EmbeddingStore:
    folder = tmp_path_factory.mktemp("embeddings")
    videos = sorted({v for q in questions for v in q.videos})
    frames = [(v, f, flip) for v in videos for flip in FLIPS for f in range(3)]
    return write_store(folder, frames, torch.randn(len(frames), DIM, generator=torch.manual_seed(0)))


@pytest.fixture(scope="session")
def held(language: LanguageConfig, questions: list[Question], store: EmbeddingStore) -> Material:
    """All of it, to train with."""
    return material(language, questions, store)


@pytest.fixture
def model(language: LanguageConfig) -> OctopiForCausalLM:
    seed_everything(1)
    return OctopiForCausalLM.from_base(language.weights, DIM).eval()


@pytest.fixture
def checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where trainings keep theirs."""
    monkeypatch.setattr("pipeline.training.trainer.CHECKPOINTS", tmp_path)
    return tmp_path

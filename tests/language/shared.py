"""What the tests of the language side share: a tiny Llama, questions in real wording, embeddings of noise."""

from __future__ import annotations

import pytest
import torch

from pipeline.config import LanguageConfig, TrainConfig
from pipeline.embeddings import FLIPS, INDEX_FILE, TENSOR, TENSOR_FILE, EmbeddingStore
from pipeline.io import save_tensors, write_table
from pipeline.language.generate import GenerationSettings
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Material
from pipeline.records import Assignment, Embedding, Opd, Part, Question
from pipeline.runtime import seed_everything
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import load_catalogue
from tests.checkpoints import write_llama
from tests.closure import ROOT

__all__ = ["language", "model", "questions", "store"]
"""Fixtures."""
FRAMES, DIM = 2, 6


@pytest.fixture(scope="module")
def language(tmp_path_factory: pytest.TempPathFactory) -> LanguageConfig:
    folder = write_llama(tmp_path_factory.mktemp("llama"))
    return LanguageConfig(weights=str(folder), max_new_tokens=12, generation_batch_size=4)


@pytest.fixture(scope="module")
def questions() -> list[Question]:
    catalogue = load_catalogue(ROOT / "pipeline" / "physiclear")
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TRAIN) for o in list(catalogue.objects)[::4]]
    counts = {"OPD": 4, "PC": 4, "PSS": 3, "PSR": 3}
    return build_questions(pool_of(Part.TRAIN, videos, catalogue), counts, seed=0, distinct=False)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, questions: list[Question]) -> EmbeddingStore:
    folder = tmp_path_factory.mktemp("embeddings")
    videos = sorted({v for q in questions for v in q.videos})
    index = [Embedding(video_id=v, frame_index=f, flip=flip, row=0) for v in videos for flip in FLIPS for f in range(3)]
    index = [entry.model_copy(update={"row": row}) for row, entry in enumerate(index)]
    write_table(folder / INDEX_FILE, Embedding, index)
    save_tensors(folder / TENSOR_FILE, {TENSOR: torch.randn(len(index), DIM, generator=torch.manual_seed(0))})
    return EmbeddingStore(folder)


def material(language: LanguageConfig, questions: list[Question], store: EmbeddingStore) -> Material:
    trained = [q for q in questions if q.task != "PSR"]
    return Material(trained, store, Opd.ALL, language, per_video=FRAMES, flip_probability=0.5, seed=3)


@pytest.fixture
def model(language: LanguageConfig) -> OctopiForCausalLM:
    seed_everything(1)
    return OctopiForCausalLM.from_base(language.weights, DIM).eval()


def generation(batch_size: int, tokens: int = 12) -> GenerationSettings:
    return GenerationSettings(system_prompt="", per_video=FRAMES, max_new_tokens=tokens, batch_size=batch_size)


SMALL = TrainConfig(samples=8, epochs=2, batch_size=4, micro_batch_size=2, projection_learning_rate=1e-3)

"""What tests of the language side share: a tiny Llama, questions in real wording, embeddings of noise, references."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F

from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig, TrainConfig
from pipeline.core.io import save_tensors, write_table
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding, Opd, Part, Question
from pipeline.core.runtime import seed_everything
from pipeline.language.lora import add_lora
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Job, Material, assemble, fit
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.training import trainer
from pipeline.training.embeddings import FLIPS, EmbeddingStore
from pipeline.training.trainer import Trained
from pipeline.videos.records import Assignment
from tests.checkpoints import write_llama
from tests.conftest import CATALOGUE

FRAMES, DIM = 2, 6


def stored(folder: Path, frames: Sequence[tuple[str, int, str]], tensor: torch.Tensor) -> EmbeddingStore:
    """Embeddings of these frames: their videos, their places and how they are flipped."""
    index = [Embedding(video_id=v, frame_index=f, flip=flip, row=row) for row, (v, f, flip) in enumerate(frames)]
    write_table(folder / INDEX_FILE, Embedding, index)
    save_tensors(folder / TENSOR_FILE, {TENSOR: tensor})
    return EmbeddingStore(folder)


def material(language: LanguageConfig, questions: list[Question], store: EmbeddingStore) -> Material:
    trained = [q for q in questions if q.task != "PSR"]
    return Material(trained, store, CATALOGUE, Opd.ALL, language, per_video=FRAMES, flip_probability=0.5, seed=3)


def generation(batch_size: int, tokens: int = 12) -> LanguageConfig:
    return LanguageConfig(weights="", max_new_tokens=tokens, generation_batch_size=batch_size)


def taking(samples: int, **own: float | str) -> LoraTrainConfig:
    return LoraTrainConfig(samples=samples, **own)


SMALL = TrainConfig(samples=8, epochs=2, batch_size=4, micro_batch_size=2, projection_learning_rate=1e-3)
LORA = LoraTrainConfig(samples=1, rank=4, alpha=8, dropout=0.0)


def train(job: Job, held: Material, config: LoraTrainConfig, folder: Path) -> Trained:
    """Alignment, or LoRA with trained word embeddings; checkpoints below the folder, after each second update."""
    trainer.CHECKPOINTS = folder
    model, data = assemble(held, config, "test")
    if job.stage == "lora":
        model.train_words()
        add_lora(model, config)
    return fit(model, data, config, RuntimeConfig(device="cpu", save_steps=2), job)


def adapted(model: OctopiForCausalLM, config: LoraTrainConfig = LORA) -> OctopiForCausalLM:
    """With an adapter that changes something."""
    if not hasattr(model.llm, "peft_config"):
        add_lora(model, config)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def call(model: OctopiForCausalLM) -> dict[str, torch.Tensor]:
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.frame_id, model.end_id, 7, 9]])
    return {"input_ids": ids, "features": torch.randn(1, 2, DIM, generator=torch.manual_seed(3))}


def assert_comes_back(model: OctopiForCausalLM, folder: Path, **how: str) -> OctopiForCausalLM:
    """The model that was saved in the folder, which says the same to the bit.

    An adapter is written in the base's number format, so that of the model in memory is rounded to it, too.
    """
    again = OctopiForCausalLM.from_pretrained(folder, **how)
    assert not again.training
    with torch.no_grad():
        for name, value in model.named_parameters():
            value.copy_(value.to(model.llm.dtype) if "lora_" in name else value)
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert torch.equal(again(**call(again)).logits, model.eval()(**call(model)).logits)
    return again


def embedded(model: OctopiForCausalLM, ids: list[int], features: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
    """`embed` of one row by the letter: token for token, with a counter of frames, and the embeddings of `words`."""
    own = dict(model.connector.named_parameters())
    frames, rows = iter(features), []
    for token in ids:
        if token == model.frame_id:
            hidden = F.gelu(own["projection.0.weight"] @ next(frames) + own["projection.0.bias"])
            rows.append(own["projection.2.weight"] @ hidden + own["projection.2.bias"])
        elif token in (model.start_id, model.end_id):
            rows.append(own["delimiters"][int(token == model.end_id)])
        else:
            rows.append(words[token])
    return torch.stack(rows)


@pytest.fixture(scope="session")
def language(tmp_path_factory: pytest.TempPathFactory) -> LanguageConfig:
    folder = write_llama(tmp_path_factory.mktemp("llama"))
    return LanguageConfig(weights=str(folder), max_new_tokens=12, generation_batch_size=4)


@pytest.fixture(scope="session")
def questions() -> list[Question]:
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TRAIN) for o in list(CATALOGUE.objects)[::4]]
    counts = {"OPD": 4, "PC": 4, "PSS": 3, "PSR": 3}
    return build_questions(pool_of(Part.TRAIN, videos, CATALOGUE), counts, seed=0, distinct=False)


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory, questions: list[Question]) -> EmbeddingStore:
    folder = tmp_path_factory.mktemp("embeddings")
    videos = sorted({v for q in questions for v in q.videos})
    frames = [(v, f, flip) for v in videos for flip in FLIPS for f in range(3)]
    return stored(folder, frames, torch.randn(len(frames), DIM, generator=torch.manual_seed(0)))


@pytest.fixture(scope="session")
def held(language: LanguageConfig, questions: list[Question], store: EmbeddingStore) -> Material:
    return material(language, questions, store)


@pytest.fixture
def model(language: LanguageConfig) -> OctopiForCausalLM:
    seed_everything(1)
    return OctopiForCausalLM.from_base(language.weights, DIM).eval()


@pytest.fixture
def checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("pipeline.training.trainer.CHECKPOINTS", tmp_path)
    return tmp_path

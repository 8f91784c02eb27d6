"""The language model: how many questions at a time, and which number format.

The model of params.yaml is aligned briefly, so that answers have realistic lengths. It is asked the pipeline's own
questions about noise pictures, as no cost depends on what they show.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from benchmarks.table import Row, interleaved, machine, make_rows, share_of
from pipeline.config import EncoderConfig, LanguageConfig
from pipeline.config.params import load_params
from pipeline.core.embeddings import EmbeddingStore
from pipeline.core.records import Opd, Part, Question
from pipeline.core.runtime import DtypeName, seed_everything
from pipeline.encoder.clip import base_encoder
from pipeline.language.conversations import ConversationDataset, UpdateSampler, collate
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import load_catalogue

FRAMES, UPDATE = 5, 16
"""A video's frames, and conversations an update."""
ASKED = ("OPD", "PC", "PSS", "POM")
Way = Callable[[None], list[str]]
"""Answers to all questions."""


def measure(
    root: Path,
    repeats: int = 5,
    questions: int = 64,
    aligned: int = 192,
    limit: int = 160,
    sizes: Sequence[int] = (1, 8, 32),
) -> list[Row]:
    """Both questions.

    Args:
        questions: How many are answered in each repeat.
        aligned: Number of conversations that the model is trained on first.
        limit: Maximum number of new tokens of an answer.
        sizes: Batch sizes to compare.
    """
    torch.set_num_threads(1)
    model, store, asked = prepare(root, aligned, questions)
    ask = partial(_texts, store, asked, limit)
    batches: dict[str, Way] = {f"{batch} at a time": partial(ask, model, batch) for batch in sizes}
    formats: dict[str, Way] = {}
    names: tuple[DtypeName, ...] = ("float32", "bfloat16")
    for name in names:
        # The frozen weights in fewer bits; the connector stays in float32.
        base = model.octopi_config
        other = OctopiForCausalLM.from_base(base.base_model, base.tactile_dim, dtype=name)
        other.connector.load_state_dict(model.connector.state_dict())
        formats[name] = partial(ask, other, sizes[-1])
    return [
        row
        for question, ways in (("answering", batches), ("number format, language model", formats))
        for row in _question(question, ways, asked, model, repeats)
    ]


def prepare(root: Path, aligned: int, asked: int) -> tuple[OctopiForCausalLM, EmbeddingStore, list[Question]]:
    """The model of params.yaml, its connector trained on some conversations; embeddings of noise; questions.

    Questions are about every third object of the catalogue.
    """
    params = load_params(root / "params.yaml")
    seed_everything(0)
    encoder = base_encoder(EncoderConfig(weights=str(root / params.encoder.weights))).eval()
    model = OctopiForCausalLM.from_base(root / params.language.weights, encoder.dim)
    catalogue = load_catalogue(root / params.data.catalogue)
    videos = {o: [f"{o}_0"] for o in list(catalogue.objects)[::3]}
    pool = Pool(Part.TRAIN, catalogue, videos)
    learnt, questions = (
        build_questions(pool, {t: -(-n // len(ASKED)) for t in ASKED}, seed=seed, distinct=False)[:n]
        for seed, n in enumerate((aligned, asked))
    )
    rng, shape = np.random.default_rng(0), (FRAMES, *encoder.visual.image_size, 3)
    pictures = [torch.from_numpy(rng.integers(0, 256, shape, dtype=np.uint8)) for _ in videos]
    with torch.no_grad():
        embeddings = torch.cat([encoder(each, torch.zeros(FRAMES)) for each in pictures])
    rows = {name: range(i * FRAMES, (i + 1) * FRAMES) for i, (name,) in enumerate(videos.values())}
    store = EmbeddingStore().with_rows(rows, embeddings)
    data = ConversationDataset(
        learnt,
        Opd.ALL,
        store,
        model.tokenizer,
        system_prompt="",
        per_video=FRAMES,
        flip_probability=0.0,
        seed=0,
        positions=model.positions,
        by_question=False,
    )
    # In random order: questions are built task by task.
    order = list(UpdateSampler(data, UPDATE, seed=0))
    optimiser = torch.optim.AdamW(model.connector.parameters(), lr=3e-3)
    for start in range(0, len(order), UPDATE):
        model(**collate([data[i] for i in order[start : start + UPDATE]])).loss.backward()
        optimiser.step()
        optimiser.zero_grad()
    return model, store, questions


def _question(
    question: str, ways: Mapping[str, Way], asked: Sequence[Question], model: OctopiForCausalLM, repeats: int
) -> list[Row]:
    """One row for each way: milliseconds per answer, and how often its answers differ from those of the first."""
    said = {name: way(None) for name, way in ways.items()}
    baseline, objects, count = next(iter(ways)), [q.objects for q in asked], len(asked)
    errors, counts = {}, {}
    for name, texts in said.items():
        errors[name] = share_of([float(a != b) for a, b in zip(texts, said[baseline], strict=True)], objects)
        counts[name] = {"tokens": fmean(len(model.tokenizer(text).input_ids) for text in texts)}
    costs = interleaved(ways, [None], repeats, warm=False)
    return make_rows(
        question,
        {name: [ms / count for ms in own] for name, own in costs.items()},
        unit="ms an answer",
        baseline=baseline,
        errors=errors,
        error_of=f"share of answers that differ from {baseline}'s",
        counts=counts,
        machine=machine("1 thread"),
    )


def _texts(
    store: EmbeddingStore, asked: Sequence[Question], limit: int, model: OctopiForCausalLM, batch: int, _: None
) -> list[str]:
    language = LanguageConfig(weights="", max_new_tokens=limit, generation_batch_size=batch)
    return [prediction.outputs[0] for prediction in answer(model, store, asked, Opd.ALL, language, FRAMES)]

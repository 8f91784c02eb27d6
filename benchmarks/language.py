"""The language model: how many questions at a time, which number format, and how much to describe.

Beside them stands the published loop (github.com/clear-nus/octopi, train_llm.py and utils/model.py). It takes one
question at a time and encodes its videos anew. It first reads the reference answer, padded to 512 tokens, with logits
for all of them, and then calls `generate` with the question alone. That it opens a JPEG for each frame is left out, in
its favour. All ways use the same model (from params.yaml, aligned briefly so that answers have realistic lengths), the
pipeline's own questions, and noise pictures, as no cost depends on content.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch.nn import functional as F

from benchmarks.describing import describing
from benchmarks.errors import share_of
from benchmarks.table import Row, make_rows
from benchmarks.timing import counted, interleaved, machine
from pipeline.config import EncoderConfig, LanguageConfig
from pipeline.config.params import load_params
from pipeline.core.embeddings import FLIPS, EmbeddingStore
from pipeline.core.io import save_tensors, write_table
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Assignment, Embedding, Opd, Part, Question
from pipeline.core.runtime import DtypeName, seed_everything
from pipeline.encoder.model import FrameEncoder, base_encoder
from pipeline.language.chat import IGNORE_INDEX
from pipeline.language.conversations import ConversationDataset, UpdateSampler, collate
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import load_catalogue

FRAMES, UPDATE, CUTOFF = 5, 16, 512
"""A video's frames, conversations an update, and the tokens that the published code pads to."""
ASKED = ("OPD", "PC", "PSS", "POM")
PUBLISHED = "published way"


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    repeats: int = 5
    asked: int = 64
    """Questions answered in a repeat."""
    aligned: int = 192
    """Conversations that are trained on before."""
    limit: int = 160
    """New tokens of an answer."""
    batches: tuple[int, ...] = (1, 8, 32)


@dataclass(frozen=True)
class Setup:
    """Model, encoder and questions of a run."""

    model: OctopiForCausalLM
    encoder: FrameEncoder
    store: EmbeddingStore
    pictures: Mapping[str, torch.Tensor]
    """uint8, frames x side x side x RGB."""
    aligned: Sequence[Question]
    asked: Sequence[Question]

    def conversations(self, questions: Sequence[Question]) -> ConversationDataset:
        """As the training stages make them, each token weighing alike."""
        return ConversationDataset(
            questions,
            Opd.ALL,
            self.store,
            self.model.tokenizer,
            system_prompt="",
            per_video=FRAMES,
            flip_probability=0.5,
            seed=0,
            positions=self.model.positions,
            by_question=False,
        )

    @torch.no_grad()
    def encode(self, question: Question) -> torch.Tensor:
        """Embeddings of a question's videos, one video after the other: frames x dim."""
        return torch.cat([self.encoder(self.pictures[v], torch.zeros(FRAMES)) for v in question.videos])


def measure(root: Path, size: Size | None = None) -> list[Row]:
    """All questions; how much to describe only where answers were graded and their report written."""
    described = describing(root)  # First, as it may be refused.
    torch.set_num_threads(1)
    with TemporaryDirectory() as folder:
        setup = make_setup(root, size := size or Size(), Path(folder))
        align(setup)
        return [*answering(setup, size), *formats(setup, size), *described]


def make_setup(root: Path, size: Size, folder: Path) -> Setup:
    """The models of params.yaml, and questions about every third object of the catalogue.

    Args:
        folder: Where the embeddings are kept.
    """
    params = load_params(root / "params.yaml")
    seed_everything(0)
    encoder = base_encoder(EncoderConfig(weights=str(root / params.encoder.weights))).eval()
    model = OctopiForCausalLM.from_base(root / params.language.weights, encoder.dim)
    catalogue = load_catalogue(root / params.data.catalogue)
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TRAIN) for o in list(catalogue.objects)[::3]]
    pool = pool_of(Part.TRAIN, videos, catalogue)
    aligned, asked = (
        build_questions(pool, {t: -(-n // len(ASKED)) for t in ASKED}, seed=seed, distinct=False)[:n]
        for seed, n in enumerate((size.aligned, size.asked))
    )
    rng, shape = np.random.default_rng(0), (FRAMES, *encoder.visual.image_size, 3)
    names = [video.video_id for video in videos]
    pictures = {name: torch.from_numpy(rng.integers(0, 256, shape, dtype=np.uint8)) for name in names}
    rows = [(v, x, f) for v in names for x in FLIPS for f in range(FRAMES)]
    index = [Embedding(video_id=v, frame_index=f, flip=x, row=row) for row, (v, x, f) in enumerate(rows)]
    with torch.inference_mode():
        # Mirrored noise is noise: one embedding serves all four.
        blocks = [encoder(pictures[v], torch.zeros(FRAMES)).repeat(len(FLIPS), 1) for v in names]
    save_tensors(folder / TENSOR_FILE, {TENSOR: torch.cat(blocks)})
    write_table(folder / INDEX_FILE, Embedding, index)
    return Setup(model, encoder, EmbeddingStore(folder), pictures, aligned, asked)


def align(setup: Setup) -> None:
    """Train the connector on each of its conversations once."""
    data = setup.conversations(setup.aligned)
    # In random order: questions are built task by task.
    order = list(UpdateSampler(data.lengths, UPDATE, seed=0, epoch=lambda: 0))
    optimiser = torch.optim.AdamW(setup.model.connector.parameters(), lr=3e-3)
    for start in range(0, len(order), UPDATE):
        setup.model(**collate([data[i] for i in order[start : start + UPDATE]])).loss.backward()
        optimiser.step()
        optimiser.zero_grad()


def answering(setup: Setup, size: Size) -> list[Row]:
    """Milliseconds an answer by the published loop and at several questions at a time, and whether all answer alike."""
    ways: dict[str, Callable[[None], list[str]]] = {
        PUBLISHED: lambda _: [published_answer(setup, size.limit, question) for question in setup.asked],
        **{
            f"the pipeline's way, {batch} at a time": partial(_texts, setup, setup.model, size.limit, batch)
            for batch in size.batches
        },
    }
    return _asked("answering", ways, setup, size.repeats)


def formats(setup: Setup, size: Size) -> list[Row]:
    """The frozen weights in fewer bits; the connector stays in float32."""
    ways: dict[str, Callable[[None], list[str]]] = {}
    names: tuple[DtypeName, ...] = ("float32", "bfloat16")
    for name in names:
        base = setup.model.octopi_config
        model = OctopiForCausalLM.from_base(base.base_model, base.tactile_dim, dtype=name)
        model.connector.load_state_dict(setup.model.connector.state_dict())
        ways[name] = partial(_texts, setup, model, size.limit, size.batches[-1])
    return _asked("number format, language model", ways, setup, size.repeats)


def _asked(question: str, ways: Mapping[str, Callable[[None], list[str]]], setup: Setup, repeats: int) -> list[Row]:
    said = {name: counted(partial(way, None)) for name, way in ways.items()}
    baseline, objects, count = next(iter(ways)), [q.objects for q in setup.asked], len(setup.asked)
    errors, counts = {}, {}
    for name, (texts, flops) in said.items():
        differ = [float(one != other) for one, other in zip(texts, said[baseline][0], strict=True)]
        errors[name] = share_of(differ, objects)
        tokens = fmean(len(setup.model.tokenizer(text).input_ids) for text in texts)
        counts[name] = {"flops": flops / count, "tokens": tokens}
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


def _texts(setup: Setup, model: OctopiForCausalLM, limit: int, batch: int, _: None) -> list[str]:
    """The pipeline's own way."""
    language = LanguageConfig(weights="", max_new_tokens=limit, generation_batch_size=batch)
    return [prediction.outputs[0] for prediction in answer(model, setup.store, setup.asked, Opd.ALL, language, FRAMES)]


@torch.no_grad()
def published_answer(setup: Setup, limit: int, question: Question) -> str:
    """One question as the published loop answers it."""
    model, tokenizer, sample = setup.model.eval(), setup.model.tokenizer, setup.conversations([question])[0]
    whole = model.embed(sample["input_ids"][None], setup.encode(question)[None])
    rest = max(0, CUTOFF - whole.shape[1])
    mask = F.pad(torch.ones(whole.shape[:2], dtype=torch.int64), (0, rest))
    model.llm(inputs_embeds=F.pad(whole, (0, 0, 0, rest)), attention_mask=mask)
    asked = sample["input_ids"][: int((sample["labels"] != IGNORE_INDEX).nonzero()[0])][None]
    new = model.llm.generate(
        inputs_embeds=model.embed(asked, setup.encode(question)[None]),
        attention_mask=torch.ones_like(asked),
        max_new_tokens=limit,
        do_sample=False,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    return str(tokenizer.decode(new[0], skip_special_tokens=True)).strip()

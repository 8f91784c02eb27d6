"""The language model: what each part of the pipeline's way brings against the published loop, and how much to describe.

The published code (github.com/clear-nus/octopi, train_llm.py and utils/model.py) takes one conversation at a time,
encodes its videos anew, pads the embeddings to 512 tokens, computes logits for all of them, and steps after 16. To
answer it first reads the reference answer likewise, and then calls `generate` with the question alone. That it opens a
JPEG for each frame is left out, in its favour. All ways use the same model (from params.yaml, aligned briefly so that
answers have realistic lengths), the pipeline's own questions, and noise pictures, as no cost depends on content.
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
from benchmarks.timing import flops_of, interleaved, machine, one_thread
from pipeline.config import EncoderConfig, LanguageConfig
from pipeline.config.params import load_params
from pipeline.core.embeddings import FLIPS, INDEX_FILE, TENSOR, TENSOR_FILE, EmbeddingStore
from pipeline.core.io import save_tensors, write_table
from pipeline.core.records import Assignment, Embedding, Opd, Part, Question
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
DIFFERS = "share of answers that differ from {}'s"


@dataclass(frozen=True)
class Size:
    """How much is measured: conversations that are trained on and answered in a repeat, and aligned on before."""

    repeats: int = 5
    trained: int = 64
    asked: int = 64
    aligned: int = 192
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
    training: Sequence[Question]
    asked: Sequence[Question]

    def conversations(self, questions: Sequence[Question]) -> ConversationDataset:
        """As the training stages make them, each token weighing alike: what all ways compute with least ado."""
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
    with one_thread(), TemporaryDirectory() as folder:
        setup = make_setup(root, size := size or Size(), Path(folder))
        optimiser = torch.optim.AdamW(setup.model.connector.parameters(), lr=3e-3)
        train(setup, WAYS["4 at a time, of like length"], setup.training, optimiser)
        return [*training(setup, size), *answering(setup, size), *formats(setup, size), *described]


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
    training, asked = (
        build_questions(pool, {t: -(-n // len(ASKED)) for t in ASKED}, seed=seed, distinct=False)[:n]
        for seed, n in enumerate((max(size.aligned, size.trained), size.asked))
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
    return Setup(model, encoder, EmbeddingStore(folder), pictures, training, asked)


# --- Training


@dataclass(frozen=True)
class Way:
    """How conversations are trained on."""

    batch: int = 1
    padded: bool = False
    """To `CUTOFF`, with an attention mask."""
    encodes: bool = False
    all_logits: bool = False
    buckets: bool = False


WAYS = {
    PUBLISHED: Way(padded=True, encodes=True, all_logits=True),
    "embeddings cached": Way(padded=True, all_logits=True),
    "and not padded": Way(all_logits=True),
    "and logits of answers only": Way(),
    "and 16 at a time, in any order": Way(batch=16),
    "4 at a time, of like length": Way(batch=4, buckets=True),
}
"""From the published way on, one thing more each; the last is beside them."""


def training(setup: Setup, size: Size) -> list[Row]:
    """Milliseconds a useful token; all ways compute the same loss, so there is no error to trade."""
    questions = setup.training[: size.trained]
    optimiser = torch.optim.AdamW(setup.model.connector.parameters(), lr=1e-6)
    ways: dict[str, Callable[[object], object]] = {
        name: lambda _, way=way: train(setup, way, questions, optimiser)  # type: ignore[misc]
        for name, way in WAYS.items()
    }
    flops = {name: flops_of(lambda run=run: run(None)) for name, run in ways.items()}  # type: ignore[misc]
    tokens = sum(setup.conversations(questions).lengths)
    costs = interleaved(ways, [None], size.repeats, warm=False)
    return make_rows(
        "training",
        {name: [ms / tokens for ms in own] for name, own in costs.items()},
        unit="ms a useful token",
        baseline=PUBLISHED,
        counts={n: {"flops": f / len(questions), "tokens": tokens / len(questions)} for n, f in flops.items()},
        machine=machine("1 thread"),
    )


def train(setup: Setup, way: Way, questions: Sequence[Question], optimiser: torch.optim.Optimizer) -> None:
    """Train on all of the questions once, a step after every `UPDATE`."""
    data = setup.conversations(questions)
    order = list(UpdateSampler(data.lengths, UPDATE, 0, lambda: 0)) if way.buckets else list(range(len(data)))
    for start in range(0, len(data), UPDATE):
        chosen = order[start : start + UPDATE]
        labelled = sum(sum(label != IGNORE_INDEX for label in data.encoded[i].labels) for i in chosen)
        for first in range(0, len(chosen), way.batch):
            part = chosen[first : first + way.batch]
            loss(setup, way, [data.questions[i] for i in part], [data[i] for i in part], labelled).backward()
        optimiser.step()
        optimiser.zero_grad()


def loss(
    setup: Setup, way: Way, questions: Sequence[Question], samples: Sequence[dict[str, torch.Tensor]], labelled: int
) -> torch.Tensor:
    """A batch's share of the loss of an update with so many labelled tokens."""
    batch = collate(samples)
    if way.encodes:
        batch["features"] = torch.stack([setup.encode(q) for q in questions])
    if not way.all_logits:
        found: torch.Tensor = setup.model(**batch, num_items_in_batch=labelled).loss
        return found
    embeddings, labels = setup.model.embed(batch["input_ids"], batch["features"]), batch["labels"]
    mask = torch.ones_like(labels)
    if way.padded:
        rest = max(0, CUTOFF - embeddings.shape[1])
        embeddings = F.pad(embeddings, (0, 0, 0, rest))
        labels, mask = F.pad(labels, (0, rest), value=IGNORE_INDEX), F.pad(mask, (0, rest))
    logits = setup.model.llm(inputs_embeds=embeddings, attention_mask=mask).logits.float()
    summed: torch.Tensor = F.cross_entropy(logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten(), reduction="sum")
    return summed / labelled


# --- Answering


def answering(setup: Setup, size: Size) -> list[Row]:
    """Milliseconds an answer, and whether all ways answer alike."""

    def one_by_one(**options: bool) -> Callable[[object], list[str]]:
        return lambda _: [_answer(setup, size.limit, place, **options) for place in range(len(setup.asked))]

    ways: dict[str, Callable[[object], list[str]]] = {
        PUBLISHED: one_by_one(reads=True),
        "without the published loop's forward pass": one_by_one(),
        "and without a cache of keys and values": one_by_one(cache=False),
        **{
            f"the pipeline's way, {batch} at a time": partial(_texts, setup, setup.model, size.limit, batch)
            for batch in size.batches
        },
    }
    return _asked("answering", ways, setup, size.repeats)


def formats(setup: Setup, size: Size) -> list[Row]:
    """The frozen weights in fewer bits; the connector stays in float32."""
    ways: dict[str, Callable[[object], list[str]]] = {}
    names: tuple[DtypeName, ...] = ("float32", "bfloat16")
    for name in names:
        base = setup.model.octopi_config
        model = OctopiForCausalLM.from_base(base.base_model, base.tactile_dim, dtype=name)
        model.connector.load_state_dict(setup.model.connector.state_dict())
        ways[name] = partial(_texts, setup, model, size.limit, size.batches[-1])
    return _asked("number format, language model", ways, setup, size.repeats)


def _asked(question: str, ways: Mapping[str, Callable[[object], list[str]]], setup: Setup, repeats: int) -> list[Row]:
    said: dict[str, list[str]] = {}
    flops = {name: flops_of(lambda n=name, w=way: said.update({n: w(None)})) for name, way in ways.items()}  # type: ignore[misc]
    first, objects, count = next(iter(ways)), [q.objects for q in setup.asked], len(setup.asked)
    costs, tokenizer = interleaved(ways, [None], repeats, warm=False), setup.model.tokenizer
    return make_rows(
        question,
        {name: [ms / count for ms in own] for name, own in costs.items()},
        unit="ms an answer",
        baseline=first,
        errors={
            name: share_of([float(a != b) for a, b in zip(texts, said[first], strict=True)], objects)
            for name, texts in said.items()
        },
        error_of=DIFFERS.format(first),
        counts={
            name: {"flops": flops[name] / count, "tokens": fmean(len(tokenizer(t).input_ids) for t in texts)}
            for name, texts in said.items()
        },
        machine=machine("1 thread"),
    )


def _texts(setup: Setup, model: OctopiForCausalLM, limit: int, batch: int, _: object) -> list[str]:
    """The pipeline's own way."""
    language = LanguageConfig(weights="", max_new_tokens=limit, generation_batch_size=batch)
    return [prediction.outputs[0] for prediction in answer(model, setup.store, setup.asked, Opd.ALL, language, FRAMES)]


@torch.no_grad()
def _answer(setup: Setup, limit: int, place: int, reads: bool = False, cache: bool = True) -> str:
    """One question, its frames encoded; `reads`: after the reference answer, padded, as the published loop has it."""
    data, model, tokenizer = (
        setup.conversations(setup.asked[place : place + 1]),
        setup.model.eval(),
        setup.model.tokenizer,
    )
    question, sample = data.questions[0], data[0]
    if reads:
        loss(setup, WAYS[PUBLISHED], [question], [sample], 1)
    ids = sample["input_ids"][: int((sample["labels"] != IGNORE_INDEX).nonzero()[0])][None]
    embeddings = model.embed(ids, setup.encode(question)[None])
    if cache:
        ends = {"eos_token_id": tokenizer.eos_token_id, "pad_token_id": tokenizer.pad_token_id}
        call = {"attention_mask": torch.ones_like(ids), "max_new_tokens": limit, "do_sample": False, **ends}
        new = model.llm.generate(inputs_embeds=embeddings, **call)
    else:
        new = _without_cache(model, embeddings, limit)
    return str(tokenizer.decode(new[0], skip_special_tokens=True)).strip()


def _without_cache(model: OctopiForCausalLM, embeddings: torch.Tensor, limit: int) -> torch.Tensor:
    """Greedy, all that was said read anew for each token: 1 x tokens. transformers' `generate` always keeps a cache."""
    said: list[torch.Tensor] = []
    while len(said) < limit and not (said and said[-1].item() == model.tokenizer.eos_token_id):
        logits = model.llm(inputs_embeds=embeddings, use_cache=False, logits_to_keep=1).logits
        said.append(logits[:, -1].argmax(-1, keepdim=True))
        embeddings = torch.cat([embeddings, model.embed_words(said[-1])], dim=1)
    return torch.cat(said, dim=1)

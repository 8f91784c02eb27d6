"""Train the tiny Llama from scratch on generated text, by a curriculum whose steps are gated.

Run from the repository's root: `python -m standins.make_llama`. Writes `standins/llama/` (transformers' format) and
`standins/llama_curve.csv`.
"""

from __future__ import annotations

import argparse
import copy
import csv
import random
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from transformers import GenerationConfig, LlamaConfig, LlamaForCausalLM

from pipeline.runtime import derive_seed, seed_everything
from standins.curriculum import FORMATS, Format, phrases, vocabulary
from standins.documents import Tokens, tokenise
from standins.outputs import replacing, write_rows
from standins.settings import FOLDER, LlamaSettings, load_settings
from standins.vocabulary import build_tokenizer
from standins.world import combinations, make_world, questions

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

DOCUMENTS_A_WORLD = 160
EMBEDDING_STD = 0.1
"""With transformers' usual .02 even copying is not learnt."""

HEADER = ("step", "tokens", "format", "kind", "accuracy", "loss")
CURVE = FOLDER / "llama_curve.csv"
CurveRow = tuple[int, int, str, str, float, float]


def make_model(settings: LlamaSettings, tokenizer: PreTrainedTokenizerFast) -> LlamaForCausalLM:
    """An untrained Llama: matrices of variance 1 / fan-in, those that write into the residual stream half of that."""
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=settings.hidden_size,
        intermediate_size=settings.intermediate_size,
        num_hidden_layers=settings.layers,
        num_attention_heads=settings.heads,
        max_position_embeddings=settings.max_positions,
        tie_word_embeddings=True,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )
    model = LlamaForCausalLM(config)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "embed" in name:
                weight.normal_(0, EMBEDDING_STD)
            elif weight.ndim == 2:
                writes = "o_proj" in name or "down_proj" in name
                weight.normal_(0, weight.shape[1] ** -0.5 * (0.5 if writes else 1.0))
    return model


@dataclass
class Trainer:
    """The training's state, moved on step by step."""

    model: LlamaForCausalLM
    tokenizer: PreTrainedTokenizerFast
    settings: LlamaSettings

    def __post_init__(self) -> None:
        matrices = [p for n, p in self.model.named_parameters() if p.ndim == 2 and "embed" not in n]
        others = [p for n, p in self.model.named_parameters() if p.ndim != 2 or "embed" in n]
        groups = [
            {"params": matrices, "weight_decay": self.settings.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(groups, lr=self.settings.learning_rate, betas=self.settings.betas)
        self.rng = random.Random(derive_seed("llama text", self.settings.seed))
        self.steps = self.tokens = self.first = 0
        self.losses: list[float] = []
        self.curve: list[CurveRow] = []

    def learn(self, formats: Sequence[Format], start: int) -> None:
        """Learn each format from `start` on until its gate is passed or its steps are spent, then decay on the last."""
        for number, current in list(enumerate(formats))[start:]:
            if not self._learn_one(current, formats[:number]):
                print(f"{current.name}: gate not passed", flush=True)
            save(self.model, self.tokenizer)
        batches = self._batches(formats[-1], formats[:-1])
        for left in range(self.settings.decay_steps, 0, -1):
            self._step(next(batches), left / self.settings.decay_steps)
        self._check(formats[-1], "decayed")

    def go_on(self, curve: Sequence[CurveRow]) -> None:
        """Count on from the last row of an earlier run's curve; the optimiser starts, and warms up, anew."""
        self.curve = list(curve)
        if self.curve:
            self.steps, self.tokens, *_ = self.curve[-1]
            self.first = self.steps

    def _learn_one(self, current: Format, earlier: Sequence[Format]) -> bool:
        batches = self._batches(current, earlier)
        for step in range(1, self.settings.format_steps + 1):
            if self.steps >= self.settings.max_steps:
                return False
            stalled = step > self.settings.stall_steps
            self._step(next(batches), self.settings.stalled_rate if stalled else 1.0)
            if step % self.settings.check_every == 0 and self._check(current, current.name):
                return True
        return False

    def _batches(self, current: Format, earlier: Sequence[Format]) -> Iterator[list[Tokens]]:
        """Endless batches of about `batch_tokens` tokens, documents of like length together."""
        combos = combinations(self.settings.held_out, held=False)
        while True:
            world = make_world(combos, questions("training"), self.rng)
            documents = []
            for _ in range(DOCUMENTS_A_WORLD):
                old = bool(earlier) and self.rng.random() < self.settings.earlier_share
                documents.append((self.rng.choice(earlier) if old else current).write(world, self.rng))
            batches = bucket(tokenise(documents, self.tokenizer), self.settings.batch_tokens)
            self.rng.shuffle(batches)
            yield from batches

    def _step(self, batch: Sequence[Tokens], rate: float) -> None:
        self.model.train()
        warm = min(1.0, (self.steps - self.first + 1) / self.settings.warmup_steps)
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * rate * warm
        ids, weights = pad(batch)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            hidden = self.model.model(input_ids=ids).last_hidden_state[:, :-1]
            counted = weights[:, 1:] > 0
            logits = self.model.lm_head(hidden[counted])
        # The weighted mean over the tokens that count; the others need no logits at all.
        weight = weights[:, 1:][counted]
        loss = (F.cross_entropy(logits.float(), ids[:, 1:][counted], reduction="none") * weight).sum() / weight.sum()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.gradient_clip)
        self.optimiser.step()
        self.steps += 1
        self.tokens += sum(len(t.ids) for t in batch)
        self.losses.append(loss.item())

    def _check(self, current: Format, name: str) -> bool:
        """Whether all kinds of decision pass, on property combinations that training never shows."""
        rng = random.Random(derive_seed("llama check", self.settings.seed, self.steps))
        world = make_world(combinations(self.settings.held_out, held=True), questions("training"), rng)
        documents = [current.write(world, rng) for _ in range(len(current.kinds) * self.settings.check_questions)]
        reached = accuracies(self.model, tokenise(documents, self.tokenizer), self.settings.batch_tokens * 4)
        loss = statistics.fmean(self.losses)
        self.curve += [(self.steps, self.tokens, name, kind, reached[kind], loss) for kind in current.kinds]
        print(self.steps, self.tokens, name, {k: round(v, 3) for k, v in reached.items()}, round(loss, 4), flush=True)
        self.losses = []
        return all(reached[kind] >= self.settings.pass_accuracy for kind in current.kinds)


def bucket(documents: Sequence[Tokens], limit: int) -> list[list[Tokens]]:
    """Batches of documents of like length, each of at most `limit` tokens with padding."""
    batches: list[list[Tokens]] = [[]]
    for document in sorted(documents, key=lambda d: len(d.ids)):
        if batches[-1] and (len(batches[-1]) + 1) * len(document.ids) > limit:
            batches.append([])
        batches[-1].append(document)
    return batches


def pad(batch: Sequence[Tokens]) -> tuple[torch.Tensor, torch.Tensor]:
    """Ids and loss weights, documents x longest. Padding stands on the right, where causal attention ignores it."""
    ids = [torch.tensor(t.ids) for t in batch]
    weights = [torch.tensor(t.weights) for t in batch]
    padded = torch.nn.utils.rnn.pad_sequence(ids, batch_first=True, padding_value=0)
    return padded, torch.nn.utils.rnn.pad_sequence(weights, batch_first=True)


@torch.no_grad()
def accuracies(model: LlamaForCausalLM, documents: Sequence[Tokens], limit: int) -> dict[str, float]:
    """Share of decisions whose tokens are all the most likely ones given the text before them, by kind."""
    model.eval()
    hits: defaultdict[str, list[bool]] = defaultdict(list)
    for batch in bucket(documents, limit):
        ids, _ = pad(batch)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            right = model(input_ids=ids).logits[:, :-1].argmax(-1) == ids[:, 1:]
        for row, tokens in zip(right.tolist(), batch, strict=True):
            made: dict[int, bool] = {}
            for hit, decision in zip(row, tokens.decisions[1:], strict=False):
                if decision >= 0:
                    made[decision] = made.get(decision, True) and hit
            hits[tokens.kind] += made.values()
    return {kind: statistics.fmean(values) for kind, values in hits.items() if values}


def save(model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast) -> None:
    """Put the model, rounded to bfloat16, and its tokenizer in place."""
    ends = {"bos_token_id": tokenizer.bos_token_id, "eos_token_id": tokenizer.eos_token_id}
    stored = copy.deepcopy(model).to(torch.bfloat16)
    stored.generation_config = GenerationConfig(**ends, pad_token_id=tokenizer.pad_token_id)
    with replacing(FOLDER / "llama") as folder:
        tokenizer.save_pretrained(folder)
        stored.save_pretrained(folder)


def read_curve(formats: Sequence[str]) -> list[CurveRow]:
    """The rows of an earlier run about these formats."""
    with CURVE.open(encoding="utf-8", newline="") as stream:
        rows = [tuple(row[name] for name in HEADER) for row in csv.DictReader(stream)]
    return [(int(s), int(t), f, k, float(a), float(x)) for s, t, f, k, a, x in rows if f in formats]


def main() -> None:
    """Make the stand-in, or go on with it."""
    names = [current.name for current in FORMATS]
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--resume-at", choices=names, help="go on from the weights in the folder with this format")
    resume_at = parser.parse_args().resume_at
    torch.set_num_threads(1)
    settings = load_settings().llama
    seed_everything(settings.seed)
    tokenizer = build_tokenizer(vocabulary(), phrases())
    model = make_model(settings, tokenizer)
    if resume_at:
        model = LlamaForCausalLM.from_pretrained(FOLDER / "llama", dtype=torch.float32)
    print(f"{len(tokenizer)} tokens, {model.num_parameters() / 1e6:.2f}M parameters", flush=True)
    trainer = Trainer(model, tokenizer, settings)
    if resume_at:
        trainer.go_on(read_curve(names[: names.index(resume_at)]))
    trainer.learn(FORMATS, names.index(resume_at) if resume_at else 0)
    save(model, tokenizer)
    write_rows(CURVE, HEADER, trainer.curve)


if __name__ == "__main__":
    main()

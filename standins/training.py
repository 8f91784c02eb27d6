"""The training of the tiny Llama: rounds of generated text, gates, checkpoints."""

from __future__ import annotations

import random
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F

from pipeline.runtime import derive_seed
from standins.curriculum import Format
from standins.documents import Tokens, tokenise
from standins.probes import Probes
from standins.settings import LlamaSettings
from standins.world import combinations, make_world, questions, real_catalogue

if TYPE_CHECKING:
    from transformers import LlamaForCausalLM, PreTrainedTokenizerFast

BLEND_SCALE = (0.6, 1.2)
BLUR = 0.03
"""Deviation of the noise on a sum of words, beside .1 of a word at the start."""
CurveRow = tuple[int, int, str, str, float, float]


class Trainer:
    """The training's state, moved on round by round; a round is a world and `round_documents` texts about it.

    Args:
        checkpoint: Where the state is kept between checks, so that a killed training goes on; None keeps none.
        mark: What the training depends on. A checkpoint of another mark is passed over.
    """

    def __init__(
        self,
        model: LlamaForCausalLM,
        tokenizer: PreTrainedTokenizerFast,
        settings: LlamaSettings,
        formats: Sequence[Format],
        checkpoint: Path | None = None,
        mark: str = "",
    ) -> None:
        self.model, self.tokenizer, self.settings, self.formats = model, tokenizer, settings, tuple(formats)
        self.checkpoint, self.mark = checkpoint, mark
        levels = [len(p.levels) for p in real_catalogue().properties]
        self.probes = Probes(settings.hidden_size, levels, settings.probe_layer)
        named = [*model.named_parameters(), *self.probes.named_parameters()]
        matrices = [p for n, p in named if p.ndim == 2 and n.startswith("model.layers")]
        others = [p for n, p in named if not (p.ndim == 2 and n.startswith("model.layers"))]
        groups = [
            {"params": matrices, "weight_decay": settings.weight_decay},
            {"params": others, "weight_decay": 0.0},
        ]
        self.optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=settings.betas, fused=True)
        self.format = self.rounds = self.steps = self.tokens = 0
        self.entered = 0
        """The round at which the current format began."""
        self.losses: list[float] = []
        self.curve: list[CurveRow] = []

    def learn(self) -> None:
        """Learn each format until its gate is passed or its rounds are spent; at the end the rate sinks to zero."""
        while self.format < len(self.formats):
            current = self.formats[self.format]
            spent = self.rounds - self.entered
            self._round(current, self.formats[: self.format], self._rate(spent))
            spent += 1
            passed = spent % self.settings.check_rounds == 0 and self._check(current, current.name)
            if (passed and spent >= current.least) or spent >= min(current.most, self.settings.format_rounds):
                print(f"{current.name}: gate {'passed' if passed else 'not passed'}", flush=True)
                self.format, self.entered = self.format + 1, self.rounds
                if self.format < len(self.formats):
                    enlarge(self.model, self.optimiser, self.formats[self.format].enlarge)
                self.save(f"after {current.name}")
            if spent % self.settings.check_rounds == 0:
                self.save()
        last = self.formats[-1]
        while (done := self.rounds - self.entered) < self.settings.decay_rounds:
            self._round(last, self.formats[:-1], self._rate(0) * (1 - done / self.settings.decay_rounds))
            if (done + 1) % self.settings.check_rounds == 0 or done + 1 == self.settings.decay_rounds:
                self._check(last, "decay")
                self.save()

    def save(self, name: str = "last") -> None:
        """Keep everything that the next round depends on."""
        if self.checkpoint is None:
            return
        self.checkpoint.mkdir(parents=True, exist_ok=True)
        state = {
            "mark": self.mark,
            "model": self.model.state_dict(),
            "probes": self.probes.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "counters": (self.format, self.rounds, self.steps, self.tokens, self.entered),
            "losses": self.losses,
            "curve": self.curve,
        }
        part = self.checkpoint / f".{name}.part"
        torch.save(state, part)
        part.replace(self.checkpoint / f"{name}.pt")

    def resume(self, file: Path | None = None) -> bool:
        """Go on from the last checkpoint of the same mark, or from `file` whatever its mark; False where none is."""
        wanted = file or (self.checkpoint / "last.pt" if self.checkpoint else None)
        if wanted is None or not wanted.is_file():
            return False
        state = torch.load(wanted, weights_only=True)
        if file is None and state["mark"] != self.mark:
            return False
        self.model.load_state_dict(state["model"])
        self.probes.load_state_dict(state["probes"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.format, self.rounds, self.steps, self.tokens, self.entered = state["counters"]
        self.losses, self.curve = list(state["losses"]), [tuple(row) for row in state["curve"]]
        return True

    def _rate(self, spent: int) -> float:
        return self.settings.stalled_rate if spent >= self.settings.stall_rounds else 1.0

    def _round(self, current: Format, earlier: Sequence[Format], rate: float) -> None:
        for batch in self._batches(current, earlier):
            self._step(batch, rate)
        self.rounds += 1

    def _batches(self, current: Format, earlier: Sequence[Format]) -> Iterator[list[Tokens]]:
        """A round's batches of about `batch_tokens` tokens, documents of like length together."""
        rng = random.Random(derive_seed("llama text", self.settings.seed, self.rounds))
        combos = combinations(self.settings.held_out, held=False)
        world = make_world(combos, questions("training"), rng, held=False)
        share = current.earlier if earlier else 0.0
        replay = [f.replay for f in earlier]
        drawn = [
            rng.choices(earlier, replay)[0] if rng.random() < share else current
            for _ in range(self.settings.round_documents)
        ]
        batches = bucket(tokenise([f.write(world, rng) for f in drawn], self.tokenizer), self.settings.batch_tokens)
        rng.shuffle(batches)
        yield from batches

    def _step(self, batch: Sequence[Tokens], rate: float) -> None:
        self.model.train()
        warm = min(1.0, (self.steps + 1) / self.settings.warmup_steps)
        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * rate * warm
        ids, weights = pad(batch)
        noise = torch.Generator().manual_seed(derive_seed("llama noise", self.settings.seed, self.steps) % 2**32)
        output = self.model.model(inputs_embeds=embed(self.model, ids, batch, noise), output_hidden_states=True)
        counted = weights[:, 1:] > 0
        logits = self.model.lm_head(output.last_hidden_state[:, :-1][counted])
        # The weighted mean over the tokens that count; the others need no logits at all.
        weight = weights[:, 1:][counted]
        loss = (F.cross_entropy(logits, ids[:, 1:][counted], reduction="none") * weight).sum() / weight.sum()
        self.losses.append(loss.item())
        read = self.probes(output.hidden_states, batch, self.model.get_input_embeddings().weight)
        loss = loss + self.settings.probe_weight * read
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), self.settings.gradient_clip)
        self.optimiser.step()
        self.steps += 1
        self.tokens += sum(len(t.ids) for t in batch)

    def _check(self, current: Format, name: str) -> bool:
        """Whether all kinds of decision pass, on property combinations and names that training never shows."""
        rng = random.Random(derive_seed("llama check", self.settings.seed, self.rounds))
        combos = combinations(self.settings.held_out, held=True)
        world = make_world(combos, questions("training"), rng, held=True)
        documents = [current.write(world, rng) for _ in range(self.settings.check_questions)]
        reached = accuracies(self.model, tokenise(documents, self.tokenizer), self.settings.batch_tokens * 4)
        loss = statistics.fmean(self.losses)
        self.curve += [
            (self.steps, self.tokens, name, str(kind), reached.get(kind, 0.0), loss) for kind in current.kinds
        ]
        print(self.steps, self.tokens, name, {k: round(v, 3) for k, v in reached.items()}, round(loss, 4), flush=True)
        self.losses = []
        return all(reached.get(kind, 0.0) >= self.settings.pass_accuracy for kind in current.kinds)


@torch.no_grad()
def enlarge(model: LlamaForCausalLM, optimiser: torch.optim.Optimizer, factor: float) -> None:
    """Enlarge the words' vectors, and make the last norm smaller by as much, so that the logits stay about the same.

    After the first formats the layers write a hundred times as much into the residual stream as a word's own vector
    holds. For those formats this is no matter; to copy a word, the upper layers must read which it is.
    """
    for weight, by in ((model.get_input_embeddings().weight, factor), (model.model.norm.weight, 1 / factor)):
        weight.mul_(by)
        state = optimiser.state[weight]
        if state:
            state["exp_avg"].div_(by)
            state["exp_avg_sq"].div_(by**2)


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


def embed(
    model: LlamaForCausalLM, ids: torch.Tensor, batch: Sequence[Tokens], noise: torch.Generator | None = None
) -> torch.Tensor:
    """Word embeddings, with the sums of `Tokens.blends` in their places; with `noise`, scaled at random and blurred."""
    matrix = model.get_input_embeddings().weight
    embeddings = F.embedding(ids, matrix)
    places = [(row, place, words) for row, t in enumerate(batch) for place, words in t.blends]
    if not places:
        return embeddings
    sums = torch.stack([matrix[list(words)].sum(0) for *_, words in places])
    if noise is not None:
        scale = torch.empty(len(places), 1).uniform_(*BLEND_SCALE, generator=noise)
        sums = scale * sums + BLUR * torch.empty_like(sums).normal_(generator=noise)
    rows, columns = (torch.tensor([place[i] for place in places]) for i in (0, 1))
    return embeddings.index_put((rows, columns), sums)


@torch.no_grad()
def accuracies(model: LlamaForCausalLM, documents: Sequence[Tokens], limit: int) -> dict[str, float]:
    """Share of decisions whose tokens are all the most likely ones given the text before them, by kind."""
    model.eval()
    hits: defaultdict[str, list[bool]] = defaultdict(list)
    for batch in bucket(documents, limit):
        ids, _ = pad(batch)
        length = ids.shape[1]
        decisions = torch.tensor([[*t.decisions, *[-1] * (length - len(t.decisions))] for t in batch])
        counted = decisions[:, 1:] >= 0
        hidden = model.model(inputs_embeds=embed(model, ids, batch)).last_hidden_state[:, :-1][counted]
        right = (model.lm_head(hidden).argmax(-1) == ids[:, 1:][counted]).tolist()
        made: dict[tuple[int, int], bool] = {}
        rows = counted.nonzero()[:, 0].tolist()
        for row, decision, hit in zip(rows, decisions[:, 1:][counted].tolist(), right, strict=True):
            made[row, decision] = made.get((row, decision), True) and hit
        for (row, decision), hit in made.items():
            hits[batch[row].kinds[decision]].append(hit)
    return {kind: statistics.fmean(values) for kind, values in hits.items()}

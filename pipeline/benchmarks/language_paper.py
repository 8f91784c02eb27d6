"""Rows of paper-7b at its true shapes, counted: what an update and an answer cost either way on a card, and hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.benchmarks.language_bed import FRAMES, LanguageRow
from pipeline.benchmarks.language_counts import H100, Batch, Card, Cost, Llama, Tower, answering, encoding, step, total
from pipeline.benchmarks.language_memory import answering_bytes, training_bytes
from pipeline.benchmarks.language_ways import CUTOFF

RANK = 128
"""Of the paper's adapters."""
Length = tuple[int, int, int]
"""Of a conversation its tokens, those of the answer, and its videos."""


def counted_rows(lengths: Sequence[Length], card: Card = H100) -> list[LanguageRow]:
    """Alignment, LoRA and answering: the published way, and the pipeline's.

    Args:
        lengths: Of the conversations; none is longer than the published code takes.
    """
    llama, tower = Llama(), Tower()
    rows: list[LanguageRow] = []
    tokens = sum(length for length, _, _ in lengths)
    one = Batch(1, CUTOFF, CUTOFF, 0)
    for name, rank in (("alignment", 0), ("LoRA", RANK)):
        costs = {"published way": published_training(lengths, llama, tower, card, rank)}
        peaks = {"published way": training_bytes(llama, one, rank, tower=tower.weights)}
        for size, again in ((4, True), (4, False), (16, False)):
            case = f"{size} at a time{', gradient checkpointing' if again else ''}"
            costs[case] = pipeline_training(lengths, size, llama, card, rank, again)
            peaks[case] = max(training_bytes(llama, batch, rank, again) for batch in largest(lengths, size))
        rows += _rows(f"paper-7b on {card.name}, {name}", costs, peaks, card, tokens, len(lengths), tokens)
    new, longest = sum(answer for _, answer, _ in lengths), max(length for length, _, _ in lengths)
    costs = {
        "published way": published_answers(lengths, llama, tower, card, forward=True),
        "without the published loop's forward pass": published_answers(lengths, llama, tower, card, forward=False),
        "16 at a time": pipeline_answers(lengths, 16, llama, card),
    }
    peaks = dict.fromkeys(costs, answering_bytes(llama, 1, longest, tower.weights))
    peaks["16 at a time"] = answering_bytes(llama, 16, longest)
    return rows + _rows(f"paper-7b on {card.name}, answering", costs, peaks, card, None, len(lengths), new)


def _rows(
    what: str,
    costs: Mapping[str, Cost],
    peaks: Mapping[str, int],
    card: Card,
    useful: int | None,
    samples: int,
    tokens: int,
) -> list[LanguageRow]:
    """Args:
    useful: Tokens trained on, of which the row gives the rate; without, it gives the rate of samples.
    """
    baseline, amount = next(iter(costs)), useful or samples
    return [
        LanguageRow(
            case=f"{what}, {case}",
            cost=round(amount / cost.seconds, 4),
            low=round(amount / cost.seconds, 4),
            high=round(amount / cost.seconds, 4),
            unit="useful tokens a second" if useful else "samples a second",
            baseline=f"{what}, {baseline}",
            ratio=round(costs[baseline].seconds / cost.seconds, 3),
            samples=samples,
            tokens=tokens,
            flops=cost.flops,
            gigabytes=round(cost.bytes / 1e9, 1),
            megabytes=round(peaks[case] / 1e6, 1),
            share=round(cost.flops / cost.seconds / card.rate, 4),
            source="counted",
        )
        for case, cost in costs.items()
    ]


def published_training(lengths: Sequence[Length], llama: Llama, tower: Tower, card: Card, rank: int) -> Cost:
    """One conversation at a time, encoded, padded, with all logits."""
    return total(
        encoding(tower, FRAMES, card) * videos + step(llama, Batch(1, CUTOFF, CUTOFF, FRAMES * videos), card, rank)
        for _, _, videos in lengths
    )


def pipeline_training(lengths: Sequence[Length], size: int, llama: Llama, card: Card, rank: int, again: bool) -> Cost:
    """Batches of like length from cached embeddings, logits where a row has an answer."""
    return total(step(llama, batch, card, rank, again) for batch in batches(lengths, size))


def batches(lengths: Sequence[Length], size: int) -> list[Batch]:
    """Neighbours in length; logits are computed from the first answer's beginning to the longest one's end."""
    order = sorted(lengths)
    groups = [order[i : i + size] for i in range(0, len(order), size)]
    return [
        Batch(
            rows=len(group),
            length=max(length for length, _, _ in group),
            logits=len(group) * (max(le for le, _, _ in group) - min(le - answer for le, answer, _ in group)),
            frames=FRAMES * sum(videos for _, _, videos in group),
        )
        for group in groups
    ]


def largest(lengths: Sequence[Length], size: int) -> set[Batch]:
    """The batches of most tokens and of most logits: one of them holds most."""
    cut = batches(lengths, size)
    return {max(cut, key=lambda b: b.rows * b.length), max(cut, key=lambda b: b.logits)}


def published_answers(lengths: Sequence[Length], llama: Llama, tower: Tower, card: Card, forward: bool) -> Cost:
    """One question at a time; `forward`: after a pass over question and reference answer, padded."""
    found = Cost()
    for length, answer, videos in lengths:
        encoded = encoding(tower, FRAMES, card) * videos
        prompt = Batch(1, length - answer, 1, FRAMES * videos)
        found += encoded + answering(llama, prompt, answer, card)
        if forward:
            padded = Batch(1, CUTOFF, CUTOFF, FRAMES * videos)
            found += answering(llama, padded, 1, card)
    return found


def pipeline_answers(lengths: Sequence[Length], size: int, llama: Llama, card: Card) -> Cost:
    """Neighbours in the length of their prompts together, until the longest answer ends."""
    order = sorted((length - answer, answer, videos) for length, answer, videos in lengths)
    groups = [order[i : i + size] for i in range(0, len(order), size)]
    return total(
        answering(
            llama,
            Batch(len(group), max(p for p, _, _ in group), len(group), FRAMES * sum(v for _, _, v in group)),
            max(answer for _, answer, _ in group),
            card,
        )
        for group in groups
    )

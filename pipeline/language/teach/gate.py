"""The gate: the tasks' questions in plain words about objects whose properties are told, for any language model.

Nothing is felt here. What a model cannot conclude from perfect descriptions it cannot conclude from touch either, and a
table of the tasks then says nothing about touch.
"""

from __future__ import annotations

import itertools
import random
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from pipeline.language.chat import encode, end_ids, render
from pipeline.language.teach.items import held_out
from pipeline.records import Described, Turn
from pipeline.runtime import derive_seed, track
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.catalogue.wording import unmarked

LETTERS = "abc"
TOKENS, MATCHING = 16, 40
"""Of the longest answer, and of one that matches three names."""
RESTATING = 64
"""Of the longest answer of a model that learnt to restate before it concludes."""
VERDICTS = {"yes": "yes", "no": "no", "same": "same", "both": "same", "neither": "same", "alike": "same"}


@dataclass(frozen=True)
class GateQuestion:
    """One question of the gate."""

    task: str
    text: str
    right: str
    names: tuple[str, ...] = ()
    """POM: the objects' names without their article, in the order that the question lists them."""

    def read(self, answer: str) -> str | None:
        """What an answer chooses; None where it names no choice, or several."""
        text = unmarked(answer).lower().rpartition("conclusion:")[2]
        if self.task == "POM":
            longest = sorted(self.names, key=len, reverse=True)
            found = list(dict.fromkeys(re.findall("|".join(rf"\b{re.escape(n)}\b" for n in longest), text)))
            return "".join(str(self.names.index(n)) for n in found) if len(found) == len(self.names) else None
        if self.task == "PC":
            said = {VERDICTS[word] for word in re.findall(rf"\b({'|'.join(VERDICTS)})\b", text)}
        else:
            said = set(re.findall(r"\b([abc])(?=[).:,]|\s*$)", text))
        return said.pop() if len(said) == 1 else None


Maker = Callable[[Catalogue, random.Random, int], GateQuestion | None]


def gate_questions(catalogue: Catalogue, count: int, seed: int) -> list[GateQuestion]:
    """`count` questions of each task, fewer where the catalogue has no scenarios.

    Objects are combinations of classes that teaching leaves out (`held_out`), described as the catalogue describes. In
    matching (POM) they are the catalogue's own objects, and which name goes with which description is the language
    model's own knowledge.
    """
    makers: dict[str, Maker] = {"PC": _pc, "PSS": _pss, "POM": _pom}
    if catalogue.language.scenarios:
        makers["PSR"] = _psr
    questions = []
    for task, make in makers.items():
        rng = random.Random(derive_seed(seed, "gate", task))
        made: list[GateQuestion] = []
        for _ in range(1000 * count):
            # By what was made and not by what was tried, so that every right answer comes as often.
            question = make(catalogue, rng, len(made) % 6) if len(made) < count else None
            made += [question] if question is not None else []
        questions += made
    return questions


def examine(
    llm: PreTrainedModel,
    tokenizer: PreTrainedTokenizerBase,
    questions: Sequence[GateQuestion],
    *,
    model: str,
    system_prompt: str,
    batch_size: int,
    tokens: int = TOKENS,
) -> list[Described]:
    """Ask a loaded language model everything, greedily; one score a task. The table calls it `model`."""
    said: dict[GateQuestion, str] = {}
    by_length = sorted(questions, key=lambda q: (q.task == "POM", len(q.text)))
    for start in track(range(0, len(by_length), batch_size), f"gate of the {model} model", "batch"):
        batch = by_length[start : start + batch_size]
        said |= zip(batch, _answers(llm, tokenizer, batch, system_prompt, tokens), strict=True)
    scores = []
    for task in dict.fromkeys(q.task for q in questions):
        read = [(q.right, q.read(said[q])) for q in questions if q.task == task]
        scores.append(
            Described(
                model=model,
                task=task,
                n=len(read),
                right=sum(right == choice for right, choice in read),
                unread=sum(choice is None for _, choice in read),
            )
        )
    return scores


@torch.inference_mode()
def _answers(
    llm: PreTrainedModel,
    tokenizer: PreTrainedTokenizerBase,
    batch: Sequence[GateQuestion],
    system_prompt: str,
    tokens: int,
) -> list[str]:
    turns = [[Turn(user=q.text, assistant="")] for q in batch]
    texts = [render(t, tokenizer, system_prompt=system_prompt, frames=0, complete=False) for t in turns]
    prompts = [list(encode(text, tokenizer).input_ids) for text in texts]
    ends, device = list(end_ids(tokenizer)), llm.get_input_embeddings().weight.device
    # What is padding is known by the mask, so any token will do.
    pad, longest = ends[0], max(map(len, prompts))
    ids = torch.tensor([[pad] * (longest - len(p)) + p for p in prompts], device=device)
    mask = torch.tensor([[0] * (longest - len(p)) + [1] * len(p) for p in prompts], device=device)
    limits = [max(tokens, MATCHING) if q.task == "POM" else tokens for q in batch]
    new = llm.generate(
        input_ids=ids,
        attention_mask=mask,
        max_new_tokens=max(limits),
        do_sample=False,
        eos_token_id=ends,
        pad_token_id=pad,
    )[:, longest:]
    said = [row[:limit] for row, limit in zip(new, limits, strict=True)]
    return [str(text).strip() for text in tokenizer.batch_decode(said, skip_special_tokens=True)]


def _objects(catalogue: Catalogue) -> list[tuple[int, ...]]:
    every = itertools.product(*(range(len(p.levels)) for p in catalogue.properties))
    return [labels for labels in every if held_out(labels)]


def _described(catalogue: Catalogue, labels: tuple[int, ...], rng: random.Random) -> str:
    """An object as the catalogue describes one with these classes."""
    phrases = {p.name: rng.choice(p.phrases[level]) for p, level in zip(catalogue.properties, labels, strict=True)}
    return f"{catalogue.language.unstructured.format(**phrases)} {catalogue.structured(labels)}"


def _pc(catalogue: Catalogue, rng: random.Random, number: int) -> GateQuestion | None:
    index, rising = rng.randrange(len(catalogue.properties)), rng.random() < 0.5
    one, other = rng.choices(_objects(catalogue), k=2)
    actual = "same" if one[index] == other[index] else "yes" if (one[index] > other[index]) == rising else "no"
    if actual != ("yes", "no", "same")[number % 3]:
        return None
    prop = catalogue.properties[index]
    told = f"First object: {_described(catalogue, one, rng)} Second object: {_described(catalogue, other, rng)}"
    ask = f"Is the first object {prop.more if rising else prop.less} than the second? Answer yes, no or same."
    return GateQuestion("PC", f"{told} {ask}", actual)


def _pss(catalogue: Catalogue, rng: random.Random, number: int) -> GateQuestion | None:
    index, rising = rng.randrange(len(catalogue.properties)), rng.random() < 0.5
    objects = rng.choices(_objects(catalogue), k=3)
    levels = [labels[index] for labels in objects]
    extreme = max(levels) if rising else min(levels)
    if levels.count(extreme) != 1 or levels[number % 3] != extreme:
        return None
    prop = catalogue.properties[index]
    ask = f"Which one is the {prop.most if rising else prop.least}? Answer with its letter."
    return GateQuestion("PSS", f"{_lettered(catalogue, objects, rng)} {ask}", LETTERS[number % 3])


def _psr(catalogue: Catalogue, rng: random.Random, number: int) -> GateQuestion | None:
    scenario = rng.choice(catalogue.language.scenarios)
    suited = [o for o in _objects(catalogue) if _fits(o, scenario.target, catalogue)]
    others = [o for o in _objects(catalogue) if _fits(o, scenario.other, catalogue) and o not in suited]
    if not suited or not others:
        return None
    objects = [rng.choice(suited), rng.choice(others)]
    if number % 2:
        objects.reverse()
    text = f"{_lettered(catalogue, objects, rng)} {scenario.question} Answer with its letter."
    return GateQuestion("PSR", text, LETTERS[number % 2])


def _pom(catalogue: Catalogue, rng: random.Random, number: int) -> GateQuestion | None:
    if len(catalogue.objects) < 3:
        return None
    objects = rng.sample(sorted(catalogue.objects), 3)
    if len({catalogue.labels(o) for o in objects}) < 3:
        return None
    full = sorted((catalogue.objects[o].name for o in objects), key=str.lower)
    order = list(itertools.permutations(range(3)))[number]
    by_name = {catalogue.objects[o].name: o for o in objects}
    told = " ".join(f"{LETTERS[place]}) {catalogue.describe(by_name[full[i]])}" for place, i in enumerate(order))
    ask = f"These are, in some other order, {full[0]}, {full[1]} and {full[2]}. Which is which? Name a), b) and c)."
    names = tuple(re.sub(r"^(an?|the) ", "", name).lower() for name in full)
    return GateQuestion("POM", f"{told} {ask}", "".join(map(str, order)), names)


def _lettered(catalogue: Catalogue, objects: Sequence[tuple[int, ...]], rng: random.Random) -> str:
    return " ".join(f"{x}) {_described(catalogue, o, rng)}" for x, o in zip(LETTERS, objects, strict=False))


def _fits(labels: tuple[int, ...], wanted: Mapping[str, tuple[int, ...]], catalogue: Catalogue) -> bool:
    return all(labels[catalogue.property_index(name)] in classes for name, classes in wanted.items())

"""Can the tiny Llama conclude from perfect descriptions in words? In the pipeline's full format, by its own graders.

Run from the repository's root: `python -m standins.gate`. Writes `standins/gate.csv`. In the first rows the
descriptions are given as the assistant's own words (OPD mode `all`) and the model says the conclusion; in the rows
"from slots" the classes stand in words where the videos would be and the model says everything; "from blends" puts one
vector there, the sum of those words' embeddings, as a projection of touch might. Made-up objects have property
combinations and names that no training text shows; the "test objects" are the catalogue's, and so are their scenarios,
of which no training text speaks at all; the "whole catalogue" has every name that an evaluation may ask for. For POM
the facts about the named objects stand in the question.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch

from pipeline.language.chat import TACTILE, vicuna
from pipeline.records import Opd, Part, Prediction, Question, Turn
from pipeline.runtime import derive_seed
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.tasks.pom import facts
from pipeline.videos.catalogue import Catalogue
from standins.conversing import draw_draft
from standins.describing import short
from standins.documents import BLEND, blend_ids
from standins.outputs import wilson, write_rows
from standins.settings import FOLDER, LlamaSettings, load_settings
from standins.vocabulary import EOS
from standins.world import World, combinations, make_world, questions, real_catalogue

if TYPE_CHECKING:
    from transformers import LlamaForCausalLM, PreTrainedTokenizerFast

MARKER = " Conclusion:"
HEADER = ("task", "accuracy", "low", "high", "n", "goal", "passed")
QUESTIONS_A_WORLD = 20
NEW_TOKENS = 200
BATCH = 50
COMPARING = ("PC", "PSS")
SLOTS: tuple[Literal["words", "blends"], ...] = ("words", "blends")
GOALS = {"OPD": 0.95, "PC": 0.95, "PSS": 0.97, "POM": 0.7, "PSR": 0.85}
Row = tuple[str, float, float, float, int, float, str]


@dataclass(frozen=True)
class Exam:
    """One row of the gate."""

    name: str
    task: str
    goal: float
    mode: Opd = Opd.ALL
    slots: Literal["none", "words", "blends"] = "none"
    objects: Literal["made up", "test", "test, own sentence alone", "all"] = "made up"
    scenarios: Literal["training", "seen", "unseen"] = "training"
    measure: str = "choice"


@dataclass(frozen=True)
class Item:
    """A question, its turns as asked, and what of its last answer is given already."""

    question: Question
    catalogue: Catalogue
    turns: tuple[Turn, ...]
    given: str
    blends: tuple[tuple[str, ...], ...] = ()
    """The words summed in each blended slot, in reading order."""


def exams() -> tuple[Exam, ...]:
    """All rows, in the table's order."""
    made = [Exam(str(t), t, GOALS[t]) for t in COMPARING]
    test = [Exam(f"{t} test objects", t, 0.9, objects="test") for t in COMPARING]
    alone = [Exam(f"{t} test objects free sentences", t, 0.9, objects="test, own sentence alone") for t in COMPARING]
    matching = [
        Exam("POM", "POM", GOALS["POM"]),
        Exam("POM test objects", "POM", GOALS["POM"], objects="test"),
        Exam("POM whole catalogue", "POM", GOALS["POM"], objects="all"),
    ]
    suited = [
        Exam("PSR seen kinds", "PSR", GOALS["PSR"], scenarios="seen"),
        Exam("PSR unseen kinds", "PSR", 0.65, scenarios="unseen"),
        Exam("PSR test objects", "PSR", 0.65, objects="test"),
    ]
    modes = {"OPD": (Opd.ALL,), "POM": (Opd.ALL, Opd.NONE)}
    return (
        *(*made, *test, *alone, *matching, *suited),
        *(
            Exam(
                f"{task} from {'slots' if slots == 'words' else slots}{'' if mode == Opd.ALL else f' {mode}'}",
                task,
                GOALS[task],
                mode,
                slots,
                scenarios="seen",
                measure="combined" if task == "OPD" else "choice",
            )
            for slots in SLOTS
            for task in (TASKS if slots == "words" else ("OPD", *COMPARING))
            for mode in modes.get(task, (Opd.ALL, Opd.NEEDED, Opd.NONE))
        ),
    )


def make_items(exam: Exam, settings: LlamaSettings) -> list[Item]:
    """The questions of one row, drawn by the gate's seed."""
    rng = random.Random(derive_seed("gate", settings.gate_seed, exam.name))
    combos = combinations(settings.held_out, held=True)
    items: list[Item] = []
    while len(items) < settings.gate_questions:
        if exam.objects == "made up":
            world = make_world(combos, questions(exam.scenarios), rng, held=True)
        else:
            world = World(_real_pool(Part) if exam.objects == "all" else _real_pool((Part.TEST,)))
        items += [_item(exam, world, len(items) + i, rng) for i in range(QUESTIONS_A_WORLD)]
    return items[: settings.gate_questions]


def _real_pool(parts: Iterable[Part]) -> Pool:
    real, wanted = real_catalogue(), set(parts)
    chosen = {name: [name] for name, o in real.objects.items() if o.splits["paper"] in wanted}
    return Pool(part=Part.TEST, catalogue=real, videos=chosen)


def _item(exam: Exam, world: World, number: int, rng: random.Random) -> Item:
    draft = draw_draft(world, exam.task, rng)
    catalogue = world.catalogue
    question = Question(
        question_id=f"{exam.name}-{number}",
        task=exam.task,
        part=Part.TEST,
        videos=draft.videos,
        objects=draft.objects,
        dialogues=draft.dialogues,
        gold=draft.gold,
    )
    turns = list(next(d.turns for d in draft.dialogues if d.opd == exam.mode))
    first, said = turns[0].user, [t.assistant for t in turns]
    blends: list[tuple[str, ...]] = []
    for object_id in draft.objects:
        labels = catalogue.labels(object_id)
        shown = {"none": "", "words": short(catalogue, labels), "blends": BLEND}[exam.slots]
        first = first.replace(TACTILE, shown, 1)
        if exam.slots == "blends":
            blends.append(tuple(p.levels[level] for p, level in zip(catalogue.properties, labels, strict=True)))
        if exam.objects == "test, own sentence alone":
            said = [text.replace(f" {catalogue.structured(labels)}", "") for text in said]
    if exam.task == "POM":
        first = f"{facts(catalogue, draft.objects, rng)} {first}"
    asked = [first, *(t.user for t in turns[1:])]
    given = "" if exam.slots != "none" or exam.task == "PSR" else f" {said[-1].rpartition(MARKER)[0]}{MARKER}"
    filled = tuple(Turn(user=user, assistant=text) for user, text in zip(asked, said, strict=True))
    return Item(question, catalogue, filled, given, tuple(blends))


def prompts(items: Sequence[Item], said: Sequence[Sequence[str]]) -> list[str]:
    """What the model goes on from, `said` being its own earlier answers to each item."""
    texts = []
    for item, own in zip(items, said, strict=True):
        turns = [Turn(user=t.user, assistant=a) for t, a in zip(item.turns, [*own, ""], strict=False)]
        prompt = vicuna(turns, "", EOS, complete=False).text
        texts.append(prompt + (item.given if len(turns) == len(item.turns) else ""))
    return texts


@torch.no_grad()
def answer(
    model: LlamaForCausalLM,
    tokenizer: PreTrainedTokenizerFast,
    texts: Sequence[str],
    blends: Sequence[Sequence[Sequence[str]]],
) -> list[str]:
    """What the model goes on with, greedily, up to its end token; `blends` are each text's blended slots."""
    tokenizer.padding_side = "left"
    matrix = model.get_input_embeddings().weight
    order = sorted(range(len(texts)), key=lambda i: len(texts[i]))
    said = [""] * len(texts)
    for start in range(0, len(order), BATCH):
        chosen = order[start : start + BATCH]
        batch = tokenizer([texts[i] for i in chosen], padding=True, return_tensors="pt")
        ids, mask = batch["input_ids"], batch["attention_mask"]
        embeddings = model.get_input_embeddings()(ids)
        for row, i in enumerate(chosen):
            places = ((ids[row] == tokenizer.pad_token_id) & (mask[row] > 0)).nonzero()[:, 0]
            summed = [words for slot in blends[i] for words in blend_ids(slot, tokenizer)]
            for place, words in zip(places.tolist(), summed, strict=True):
                embeddings[row, place] = matrix[list(words)].sum(0)
        new = model.generate(inputs_embeds=embeddings, attention_mask=mask, max_new_tokens=NEW_TOKENS, do_sample=False)
        for i, text in zip(chosen, tokenizer.batch_decode(new, skip_special_tokens=True), strict=True):
            said[i] = text.strip()
    return said


def outputs(
    model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast, items: Sequence[Item], *, alone: bool
) -> list[list[str]]:
    """The answers to all turns of each item: `alone` the model's own, otherwise the earlier ones as they should be."""
    said: list[list[str]] = [[] for _ in items]
    turns = len(items[0].turns)
    for number in range(turns):
        if alone or number == turns - 1:
            texts = answer(model, tokenizer, prompts(items, said), [item.blends for item in items])
        else:
            texts = [item.turns[number].assistant for item in items]
        for own, text in zip(said, texts, strict=True):
            own.append(text)
    return said


def examine(
    model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast, exam: Exam, settings: LlamaSettings
) -> tuple[Row, list[tuple[Item, list[str], bool]]]:
    """One row (task, accuracy, the ends of its 95 % interval, n, goal, whether it is reached) and the answers to it."""
    items = make_items(exam, settings)
    graded = []
    for item, texts in zip(items, outputs(model, tokenizer, items, alone=exam.slots != "none"), strict=True):
        name = item.question.question_id
        said = Prediction(question_id=name, task=exam.task, outputs=tuple(texts), truncated=False, tokens=0)
        scores = TASKS[exam.task].grade(item.question, said, item.catalogue)
        graded.append((item, texts, next(s.correct for s in scores if s.measure == exam.measure)))
    share, low, high = wilson(sum(right for *_, right in graded), len(graded))
    return (exam.name, share, low, high, len(graded), exam.goal, "yes" if share >= exam.goal else "no"), graded


def main() -> None:
    """Examine the stand-in as committed."""
    from transformers import AutoModelForCausalLM, AutoTokenizer

    torch.set_num_threads(1)
    settings = load_settings().llama
    model = AutoModelForCausalLM.from_pretrained(FOLDER / "llama", dtype=torch.float32).eval()
    tokenizer = AutoTokenizer.from_pretrained(FOLDER / "llama")
    rows = []
    for exam in exams():
        row, _ = examine(model, tokenizer, exam, settings)
        print("{:32s} {:.3f} [{:.3f}, {:.3f}] n = {} goal {} {}".format(*row), flush=True)
        rows.append(row)
    write_rows(FOLDER / "gate.csv", HEADER, rows)


if __name__ == "__main__":
    main()

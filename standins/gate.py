"""Can the tiny Llama conclude from perfect descriptions in words? In the pipeline's full format, by its own graders.

Run from the repository's root: `python -m standins.gate`. Writes `standins/gate.csv`. All objects have property
combinations that no training text shows. Questions stand under OPD mode `all`. In the first rows the descriptions
are given as the assistant's own words and the model says the conclusion; in the rows "from slots" the classes stand
where the videos would be and the model says everything. For POM the facts about the names stand in the question.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from pipeline.physiclear.catalogue import Catalogue, Scenario
from pipeline.prompts import TACTILE, render
from pipeline.records import Opd, Part, Prediction, Question, Task, Turn
from pipeline.runtime import derive_seed
from pipeline.tasks import TASKS
from standins.describing import short, told_facts
from standins.outputs import wilson, write_rows
from standins.settings import FOLDER, LlamaSettings, load_settings
from standins.text import draw_draft
from standins.vocabulary import EOS
from standins.world import World, combinations, make_world, questions

if TYPE_CHECKING:
    from transformers import LlamaForCausalLM, PreTrainedTokenizerFast

MARKER = " Conclusion:"
QUESTIONS_A_WORLD = 20
NEW_TOKENS = 160
BATCH = 50


@dataclass(frozen=True)
class Exam:
    """One row of the gate."""

    name: str
    task: Task
    scenarios: tuple[Scenario, ...]
    slots: bool = False


@dataclass(frozen=True)
class Item:
    """A question with the text that the model goes on from and what of its answer is given already."""

    question: Question
    catalogue: Catalogue
    prompt: str


def exams() -> tuple[Exam, ...]:
    """All rows, in the table's order."""
    training = questions("training")
    return (
        Exam("PC", Task.PC, training),
        Exam("PSS", Task.PSS, training),
        Exam("POM", Task.POM, training),
        Exam("PSR seen kinds", Task.PSR, questions("seen")),
        Exam("PSR unseen kinds", Task.PSR, questions("unseen")),
        Exam("PC from slots", Task.PC, training, slots=True),
        Exam("PSS from slots", Task.PSS, training, slots=True),
        Exam("POM from slots", Task.POM, training, slots=True),
    )


def make_items(exam: Exam, settings: LlamaSettings) -> list[Item]:
    """The questions of one row, drawn by the gate's seed."""
    rng = random.Random(derive_seed("gate", settings.gate_seed, exam.name))
    combos = combinations(settings.held_out, held=True)
    items: list[Item] = []
    while len(items) < settings.gate_questions:
        world = make_world(combos, exam.scenarios, rng)
        items += [_item(exam, world, len(items) + i, rng) for i in range(QUESTIONS_A_WORLD)]
    return items[: settings.gate_questions]


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
    turns = list(next(d.turns for d in draft.dialogues if d.opd == Opd.ALL))
    words = [short(catalogue, catalogue.labels(o)) for o in draft.objects]
    first = turns[0].user
    for word in words:
        first = first.replace(TACTILE, word if exam.slots else "", 1)
    if exam.task == Task.POM:
        first = f"{told_facts(world, draft.objects, rng)} {first}"
    turns[0] = Turn(user=first, assistant=turns[0].assistant)
    prompt = render(turns, system_prompt="", frames=0, eos=EOS, complete=False).text
    if exam.task != Task.PSR and not exam.slots:
        prompt += " " + turns[-1].assistant.rpartition(MARKER)[0] + MARKER
    return Item(question, catalogue, prompt)


@torch.no_grad()
def answer(model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast, prompts: Sequence[str]) -> list[str]:
    """What the model goes on with, greedily, up to its end token."""
    tokenizer.padding_side = "left"
    texts = []
    for start in range(0, len(prompts), BATCH):
        batch = tokenizer(list(prompts[start : start + BATCH]), padding=True, return_tensors="pt")
        ids = model.generate(
            input_ids=batch["input_ids"],
            attention_mask=batch["attention_mask"],
            max_new_tokens=NEW_TOKENS,
            do_sample=False,
        )
        texts += tokenizer.batch_decode(ids[:, batch["input_ids"].shape[1] :], skip_special_tokens=True)
    return [text.strip() for text in texts]


def examine(
    model: LlamaForCausalLM, tokenizer: PreTrainedTokenizerFast, exam: Exam, settings: LlamaSettings
) -> tuple[str, float, float, float, int]:
    """One row: task, accuracy, the ends of its 95 % interval, n."""
    items = make_items(exam, settings)
    right = 0
    for item, text in zip(items, answer(model, tokenizer, [i.prompt for i in items]), strict=True):
        prediction = Prediction(
            question_id=item.question.question_id, task=exam.task, outputs=(text,), truncated=False, tokens=0
        )
        right += TASKS[exam.task].grade(item.question, prediction, item.catalogue)[0].correct
    return (exam.name, *wilson(right, len(items)), len(items))


def main() -> None:
    """Examine the stand-in as committed."""
    from transformers import AutoModelForCausalLM, AutoTokenizer

    torch.set_num_threads(1)
    settings = load_settings().llama
    model = AutoModelForCausalLM.from_pretrained(FOLDER / "llama", dtype=torch.float32).eval()
    tokenizer = AutoTokenizer.from_pretrained(FOLDER / "llama")
    rows = [examine(model, tokenizer, exam, settings) for exam in exams()]
    write_rows(FOLDER / "gate.csv", ("task", "accuracy", "low", "high", "n"), rows)
    for row in rows:
        print("{:20s} {:.3f} [{:.3f}, {:.3f}] n = {}".format(*row))


if __name__ == "__main__":
    main()

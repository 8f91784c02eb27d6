"""What a task is: it builds its questions and grades its answers, side by side in one module."""

from __future__ import annotations

import random
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.core.records import Dialogue, Gold, Opd, Part, Prediction, Question, Turn
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue, Property
from pipeline.videos.catalogue.wording import mentioned, plain, unmarked

LETTERS = "abc"
LISTED = ("a)", "b)", "c)")
"""Labels of the videos, in the question's list and in descriptions."""
Classes = Sequence[Sequence[tuple[int, float]]]
"""The property heads' predictions, by video and property: the class, and the expected class under the probabilities.
Such pairs can be compared: of two videos of one class, the one with the higher expected class is larger.
"""
ORDINALS = ("First", "Second")
MARKER = r"[^\S\n]*(?:[:,]|-\s|is\b|\n|$)"
LETTER = (
    r"(?<![\w'])(?:(?:option|object|video) \(?([a-z])\b\)?|"
    r"\(?([a-z])(?:\)|(?=\s*(?:[.,:;!]|is\b|because\b))|(?<=[b-z])(?=\s*$)))"
)
CHOICE = rf"{LETTER}(?:,?\s*(?:or|nor|and|/)\s*{LETTER})?"
"""How answers name what they choose: "b)", "(b)", "option B", or "b" where nothing follows that "a" could belong to."""
BEGUN = r"(?:^|[.,;:]\s+|\b(?:so|thus)\s+)"
"""The beginning of a clause, so that no words before the match can negate it or put it in doubt."""


@dataclass(frozen=True)
class Pool:
    """The videos that questions of one part of the split may draw from."""

    part: Part
    catalogue: Catalogue
    videos: Mapping[str, Sequence[str]]
    """Object id to its video ids; objects without videos are absent."""

    @property
    def objects(self) -> list[str]:
        """Object ids in a fixed order."""
        return sorted(self.videos)


@dataclass(frozen=True)
class Draft:
    """A question before it has its number."""

    videos: tuple[str, ...]
    objects: tuple[str, ...]
    dialogues: tuple[Dialogue, ...]
    gold: Gold
    finding: str = ""
    """The result of comparing the classes, in short form, before it is worded as an answer: "Harder: second
    object."."""

    def numbered(self, question_id: str, task: str, part: Part) -> Question:
        """The question as it is written to disk."""
        asked = {name: value for name, value in vars(self).items() if name != "finding"}
        return Question(question_id=question_id, task=task, part=part, **asked)

    def with_dialogues(self, dialogues: Iterable[Dialogue]) -> Draft:
        """The same question, asked or answered in other words."""
        return replace(self, dialogues=tuple(dialogues))


class TaskDefinition(ABC):
    """One task: how it asks, what a right answer is, what a guess would score and what tables call it."""

    name: str
    """Short, unique; stands in question ids, files and tables. Its lower case is the key of its question counts."""
    title: str
    """Written out, as tables head it."""
    trained = True
    """Whether its questions may be used for training (PSR's may not)."""
    listed: tuple[str, ...] = ()
    """Names of the objects in an answer that restates their classes; empty for a task about several properties."""
    adjectives: tuple[str, ...] = ()
    """Fields of a property with the two adjectives that a question may ask by, the one for high classes first."""
    choices = 2
    """How many answers there are to choose from."""
    measure = "choice"
    """The measure that says that a whole answer is right; `chance` lists all measures."""
    told = ""
    """What `conclude` is given besides the videos' classes, in the words of the tables."""

    @abstractmethod
    def strata(self, catalogue: Catalogue) -> int:
        """How many kinds of question there are; a set takes them by turns, so that they are balanced."""

    @abstractmethod
    def draft(self, pool: Pool, stratum: int, rng: random.Random) -> Draft | None:
        """Draw a question of a stratum; None where this draw found none (the caller tries again)."""

    @abstractmethod
    def grade(self, question: Question, prediction: Prediction, catalogue: Catalogue) -> list[Score]:
        """One score for each measure; an answer that cannot be read is wrong and not `parsed`."""

    def conclude(self, question: Question, classes: Classes, catalogue: Catalogue) -> str | None:
        """The answer that follows from the classes of the videos by rule, without a language model.

        It is worded as a right answer is, so that `grade` reads it. None where no rule leads to an answer.

        Args:
            question: It is read for what is asked; its right answer is not looked at.
            classes: One entry a video of the question.
            catalogue: With the scenarios that were asked, and no others (`Catalogue.asking`).
        """
        return None

    def adjective(self, question: Question | Draft, catalogue: Catalogue) -> tuple[str, str]:
        """The adjective that the question asks by, such as "softer", and its opposite."""
        prop = catalogue.properties[catalogue.property_index(question.gold.properties[0])]
        high, low = (getattr(prop, field) for field in self.adjectives)
        rising = mentioned(question.dialogues[0].turns[-1].user, (high, low)) == [plain(high)]
        return (high, low) if rising else (low, high)

    def chance(self, catalogue: Catalogue) -> dict[str, float]:
        """Accuracy of a uniform guess, 0 to 1, by measure."""
        return {"choice": 1 / self.choices}

    def with_facts(self, draft: Draft, catalogue: Catalogue, rng: random.Random) -> Draft:
        """The question with a fact about each object that it names; unchanged if it names none."""
        return draft

    def plainly(self, draft: Draft, catalogue: Catalogue, rng: random.Random) -> Draft:
        """The question in everyday wording; unchanged where the task has none."""
        return draft

    def as_choice(self, draft: Draft, catalogue: Catalogue) -> Draft | None:
        """The question as a choice between objects, in the form of scenario questions but without a scenario; None if
        impossible."""
        return None

    def restated(self, draft: Draft, catalogue: Catalogue) -> Draft:
        """The question whose answer, in OPD mode `all`, repeats the classes asked for between descriptions and
        conclusion.

        A small model cannot find that property among all, recall the question and conclude within one token. Written
        out, these are separate steps.
        """
        if not self.listed:
            return draft
        place = catalogue.property_index(draft.gold.properties[0])
        levels = [labels[place] for labels in draft.gold.labels]
        prop = catalogue.properties[place]
        each = ", ".join(f"{name} {prop.levels[level]}" for name, level in zip(self.listed, levels, strict=True))
        # "Hardness: a) soft, b) hard."
        return before_concluding(draft, f"{prop.spoken.capitalize()}: {each}. {draft.finding}".strip())


def before_concluding(draft: Draft, told: str) -> Draft:
    """Insert a text between the descriptions and the conclusion of the answer in OPD mode `all`."""
    dialogues = []
    for dialogue in draft.dialogues:
        *before, last = dialogue.turns
        if dialogue.opd is Opd.ALL:
            said = last.assistant.replace("Conclusion: ", f"{told} Conclusion: ", 1)
            last = last.model_copy(update={"assistant": said})
        dialogues.append(Dialogue(opd=dialogue.opd, turns=(*before, last)))
    return draft.with_dialogues(dialogues)


def draft_about(
    pool: Pool,
    objects: Sequence[str],
    rng: random.Random,
    *,
    turns: Mapping[Opd, Sequence[Turn]],
    choice: str,
    properties: Sequence[str],
    finding: str = "",
) -> Draft:
    """A question about one random video of each of these objects, one dialogue for each OPD mode that has turns."""
    return Draft(
        videos=tuple(rng.choice(list(pool.videos[o])) for o in objects),
        objects=tuple(objects),
        dialogues=tuple(Dialogue(opd=m, turns=tuple(turns[m])) for m in Opd if m in turns),
        gold=Gold(choice=choice, labels=tuple(map(pool.catalogue.labels, objects)), properties=tuple(properties)),
        finding=finding,
    )


def single_turn(user: Mapping[Opd, str], answer: Mapping[Opd, str]) -> dict[Opd, list[Turn]]:
    """One turn for each OPD mode; all of an answer before its conclusion counts as description."""
    before = {mode: len(text.rpartition(" Conclusion: ")[0]) for mode, text in answer.items()}
    return {mode: [Turn(user=user[mode], assistant=answer[mode], described=before[mode])] for mode in user}


def in_turns(draft: Draft, more: Sequence[Draft], catalogue: Catalogue) -> Draft:
    """Split a question into turns: the first asks for descriptions of all videos, the others for conclusions.

    A question about one video is left as it is, and so is one that has no description, several turns already, or not
    both of the modes `all` and `none`.

    Args:
        more: Further questions about the same videos, a turn each: descriptions are long, so several conclusions
            follow the same ones.
    """
    asked = {d.opd: d.turns for d in draft.dialogues}
    single = set(map(len, asked.values())) == {1} and asked.keys() >= {Opd.ALL, Opd.NONE}
    if not single or not asked[Opd.ALL][0].described or not 1 < len(draft.videos) <= len(LETTERS):
        return draft
    first = descriptions(catalogue, draft.objects)
    turns = [Turn(user=described_first(len(draft.videos)), assistant=first, described=len(first))]
    for one in (draft, *more):
        (bare,), (told,) = (d.turns for mode in (Opd.NONE, Opd.ALL) for d in one.dialogues if d.opd is mode)
        # Later turns name the videos of the first turn by letter. A listed question has the letter already, so it is
        # removed before it is added.
        *texts, end = bare.user.split("{tactile}")
        named = [text.removesuffix(f"{x}) ") + f"{x})" for text, x in zip(texts, LETTERS, strict=False)]
        question = "".join([*named, end])
        turns.append(Turn(user=question, assistant=told.assistant[told.described :].strip()))
    asked[Opd.ALL] = tuple(turns)
    return draft.with_dialogues(Dialogue(opd=mode, turns=own) for mode, own in asked.items())


def described_first(count: int, aspects: str = "") -> str:
    """The request of a first turn: to describe `aspects` of two or three videos, or all their properties."""
    asked = f"the {aspects} of these" if aspects else "these"
    return f"Describe {asked} {('two', 'three')[count - 2]} tactile videos: {lettered(count)}."


def descriptions(
    catalogue: Catalogue, objects: Sequence[str], only: Sequence[str] = (), prefixes: Sequence[str] = LISTED
) -> str:
    """The description of each object behind its prefix; only the properties named, or everything."""
    texts = []
    for prefix, object_id in zip(prefixes, objects, strict=False):
        told = [catalogue.describe_one(object_id, name) for name in only] or [catalogue.describe(object_id)]
        texts.append(" ".join([prefix, *told]))
    return " ".join(texts)


def concluded(
    catalogue: Catalogue,
    objects: Sequence[str],
    conclusion: str,
    only: Sequence[str] = (),
    prefixes: Sequence[str] = LISTED,
) -> dict[Opd, str]:
    """The answer in every OPD mode: descriptions of all objects (in mode `needed` of the properties `only`), then the
    conclusion."""
    needed, whole = (descriptions(catalogue, objects, some, prefixes) for some in (only, ()))
    return {
        Opd.NONE: conclusion,
        Opd.NEEDED: f"{needed} Conclusion: {conclusion}",
        Opd.ALL: f"{whole} Conclusion: {conclusion}",
    }


def lettered(count: int) -> str:
    """`a) {tactile}, b) {tactile}, ...` as the paper writes a list of videos."""
    return ", ".join(f"{LETTERS[i]}) {{tactile}}" for i in range(count))


def conclusion(text: str) -> list[str]:
    """The text after an answer's last "Conclusion:", or the whole answer without one; markup is removed.

    It is split at each "Answer:". Graders read every part, so that an answer whose parts choose differently has no
    choice.
    """
    said = re.split(rf"\bconclusion{MARKER}", unmarked(text), flags=re.IGNORECASE)[-1]
    return [" ".join(part.split()) for part in re.split(rf"\banswer{MARKER}", said, flags=re.IGNORECASE)]


def find_level(text: str, prop: Property) -> int | None:
    """The one class of `prop` that `text` names as a whole phrase; None where it names none or several."""
    named = mentioned(text, prop.levels)
    return list(map(plain, prop.levels)).index(named[0]) if len(named) == 1 else None


def chosen_letter(answer: str, letters: str, *sayings: str, concluded: bool = False) -> str | None:
    """The single letter that an answer chooses; None if it names two, "a) or b)", or one outside `letters`.

    Args:
        sayings: Patterns in which CHOICE stands for the letter; the first that matches decides. If none does, the
            letter counts that is the whole answer or begins its conclusion, before any reason.
        concluded: Look for sayings in the conclusion alone.
    """
    whole, parts = " ".join(unmarked(answer).split()), conclusion(answer)
    found: list[tuple[str, ...]] = []
    for saying in sayings:
        found = found or re.findall(saying.replace("CHOICE", CHOICE), " ".join(parts) if concluded else whole, re.I)
    follows = r"\W*$" if parts == [whole] else r"\W*$|[,.;!]|\s*-"
    for part in () if found else parts:
        claim = re.split(r"\b(?:because|since)\b", part, flags=re.I)[0]
        if begun := re.match(rf"\W*(?:{LETTER}(?={follows})|([a-z])\s*$)", claim, re.I):
            found += [begun.groups(""), *re.findall(r"\b([a-z])[).]", claim, re.I)]
    named = {letter.lower() for group in found for letter in group if letter}
    return named.pop() if len(named) == 1 and named <= {*letters} else None


def scored(
    question: Question,
    prediction: Prediction,
    measure: str,
    expected: str,
    predicted: str | None,
    strict: bool | None = None,
) -> Score:
    """The score of one measure; `predicted` is None where nothing could be read."""
    return Score(
        question_id=question.question_id,
        task=question.task,
        measure=measure,
        correct=predicted == expected,
        parsed=predicted is not None,
        truncated=prediction.truncated,
        expected=expected,
        predicted=predicted or "",
        objects=question.objects,
        tokens=prediction.tokens,
        strict=strict,
    )


def choice_score(
    question: Question, prediction: Prediction, predicted: str | None, *, published: bool = False
) -> list[Score]:
    """The score of a question with one right choice, as `scored` has it.

    `published` compares also as the published code does: letter by letter from the last "Conclusion: " on, or the whole
    answer where there is none.
    """
    strict = None
    if published:
        # The conclusion is the same in all OPD modes, so any dialogue serves.
        right = question.dialogues[0].turns[-1].assistant.split("Conclusion: ")[-1]
        strict = prediction.outputs[-1].split("Conclusion: ")[-1].startswith(right)
    return [scored(question, prediction, "choice", question.gold.choice, predicted, strict)]

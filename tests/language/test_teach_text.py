"""The teaching text: it says nothing of the tasks' wordings or objects, and its answers are right."""

from __future__ import annotations

import random
import re
from collections.abc import Iterable

import pytest

from pipeline.language.teach.gate import GateQuestion, gate_questions
from pipeline.language.teach.items import OURS, Form, Item, draw, held_out, words
from pipeline.records import Assignment, Opd, Part
from pipeline.tasks import TASKS
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue

GRAM = 6


def grams(text: str) -> set[tuple[str, ...]]:
    """Runs of six words, in small letters and without punctuation."""
    said = re.findall(r"[a-z0-9']+", text.lower())
    return {tuple(said[i : i + GRAM]) for i in range(len(said) - GRAM + 1)}


def text(item: Item) -> str:
    return " ".join(f"{turn.user} {turn.assistant}" for turn in item.turns)


@pytest.fixture(scope="module")
def items() -> list[Item]:
    forms: tuple[Form, ...] = ("whole", "whole", "whole", "short", "short", "short", "plain", "several")
    return [draw(random.Random(i), forms[i % 8], held=i % 16 == 1, further=i % 3 > 0) for i in range(12000)]


def asked(catalogue: Catalogue, facts: bool) -> Iterable[str]:
    """Every question and answer of a large set over the whole catalogue, in every mode of OPD."""
    videos = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TEST) for o in catalogue.objects]
    counts = dict.fromkeys(TASKS, 400)
    for question in build_questions(pool_of(Part.TEST, videos, catalogue), counts, seed=1, distinct=False, facts=facts):
        for mode in Opd:
            dialogue = question.dialogue(mode)
            for turn in dialogue.turns if dialogue else ():
                # Videos stand where embeddings will be, so that the words around one do not touch.
                yield from (*turn.user.split("{tactile}"), turn.user.replace("{tactile}", ""), turn.assistant)


@pytest.mark.parametrize("facts", [False, True])
def test_no_six_words_of_a_task(items: list[Item], catalogue: Catalogue, facts: bool) -> None:
    """Descriptions are held to it too, though the templates alone would do."""
    tasks: set[tuple[str, ...]] = set().union(*map(grams, asked(catalogue, facts)))
    assert len(tasks) > 5000
    taught: set[tuple[str, ...]] = set().union(*map(grams, map(text, items)))
    assert len(taught) > 50_000
    assert not [" ".join(gram) for gram in tasks & taught]


def test_no_object_of_the_catalogue(items: list[Item], catalogue: Catalogue) -> None:
    names = [re.sub(r"^(an?|the) ", "", o.name.lower()) for o in catalogue.objects.values()]
    pattern = re.compile(
        "|".join(rf"\b{re.escape(name)}\b" for name in [*names, *(o.replace("_", " ") for o in catalogue.objects)])
    )
    assert not {found[0] for item in items if (found := pattern.search(text(item).lower()))}


SHORT_KINDS = ("compare", "which", "extreme", "same", "pair", "odd", "need")


def told(item: Item) -> dict[str, dict[str, int]]:
    """The levels of each thing by its name and topic, read from the words alone."""
    meaning = {
        phrase: (topic, level)
        for topic, own in words().properties.items()
        for level, phrases in enumerate(own.levels)
        for phrase in phrases
    }
    said = " ".join(f"{t.user} {t.assistant}" for t in item.turns)
    found: dict[str, dict[str, int]] = {}
    mark = r"(?:\b(First|Second|Third|[A-Z][a-z]{4,6})(?: one| thing)?:"
    mark += r"|\b(The (?:first|second|third))(?: one| thing)? (?=is|has)"
    mark += r"|\b([abc]\)) |\b([A-Z][a-z]{4,6}) (?=is|has))"
    marks = list(re.finditer(mark, said))
    for here, following in zip(marks, [*marks[1:], None], strict=True):
        part = said[here.end() : following.start() if following else None].split(".")[0]
        phrases = re.split(r", | and ", part.strip())
        levels = [meaning[p] for p in (re.sub(r"^(is|has|with) ", "", p) for p in phrases) if p in meaning]
        name = re.sub(r"^the ", "", next(filter(None, here.groups())).lower())
        if levels:
            found.setdefault(name, dict(levels))
    return found


def fields(item: Item) -> dict[str, str] | None:
    """What fills the template of an item's question."""
    user = item.turns[-1].user
    for template in words().questions[item.kind]:
        pattern = re.escape(template).replace(r"\{", "{").replace(r"\}", "}")
        for name in ("x", "y", "more", "most", "noun", "need"):
            kind = r"the \w+(?: one| thing)?|[abc]\)|[A-Z]\w+" if name in "xy" else r"[\w ]+?"
            first, *rest = pattern.split(f"{{{name}}}")
            pattern = first + "".join(
                f"{f'(?P={name})' if i else f'(?P<{name}>{kind})'}{r}" for i, r in enumerate(rest)
            )
        match = re.search(rf"(?:^|[.):] ){pattern}(?= |$)", user, flags=re.IGNORECASE)
        if match:
            return match.groupdict()
    return None


def plain(name: str) -> str:
    return re.sub(r"^the | one$| thing$", "", name.lower().removesuffix("."))


def expected(item: Item) -> str | None:
    """The answer that follows from the words, worked out anew; None where the words cannot be read."""
    things, filled = told(item), fields(item)
    if filled is None or len(things) < 2 or len({frozenset(thing) for thing in things.values()}) != 1:
        return None
    topics = set(next(iter(things.values())))
    if len(topics) > 1:
        asked = (filled.get("more") or filled.get("most") or "").lower()
        every = words().properties
        topics = {t for t in topics if asked in (*every[t].more, *every[t].less, *every[t].most, *every[t].least)}
    if len(topics) != 1:
        return None
    (topic,) = topics
    own, levels = words().properties[topic], {name: thing[topic] for name, thing in things.items()}
    sign = 1
    word = (filled.get("more") or filled.get("most") or "").lower()
    if word and word not in (*own.more, *own.most):
        assert word in (*own.less, *own.least)
        sign = -1
    if "need" in filled:
        sign = 1 if filled["need"] in own.needs["high"] else -1
    scores = {name: sign * level for name, level in levels.items()}
    if item.kind in ("compare", "same"):
        x, y = (scores[plain(filled[name])] for name in "xy")
        if item.kind == "same":
            return "yes" if x == y else "no"
        return "both alike" if x == y else "yes" if x > y else "no"
    if item.kind in ("which", "extreme", "need"):
        best = [name for name, score in scores.items() if score == max(scores.values())]
        return best[0] if len(best) == 1 else "neither"
    values = list(scores.values())
    alone = [name for name, score in scores.items() if values.count(score) == 1]
    assert len(alone) == 1
    return alone[0] if item.kind == "odd" else " and ".join(name for name in scores if name != alone[0])


def concluded(item: Item) -> str:
    """What the last answer says behind its description."""
    last = item.turns[-1]
    return last.assistant[last.described :].strip()


def unformed(item: Item) -> str:
    """What an answer names, whatever form the question wants it in."""
    wanted = re.search(r"'(.+)'", item.turns[-1].user)
    if not wanted:
        return concluded(item)
    x, y = (f"(?P<{name}>.+)" for name in "xy")
    said = re.fullmatch(re.sub(r"\by\b", y, re.sub(r"\bx\b", x, wanted[1]), count=1), concluded(item), re.IGNORECASE)
    assert said, item
    assert "y" not in said.groupdict() or said["y"] in words().properties
    return said["x"]


def test_answers_follow_from_the_words() -> None:
    read: dict[Form, int] = {"plain": 0, "several": 0, "short": 0}
    for i in range(3000):
        form = tuple(read)[i % 3]
        item = draw(random.Random(f"answers {i}"), form)
        if item.kind in SHORT_KINDS and (answer := expected(item)) is not None:
            read[form] += 1
            given = " and ".join(plain(part) for part in unformed(item).split(" and "))
            assert given == answer, item
    assert min(read.values()) > 600, "the reader must understand most items, or the test says little"


def test_plain_items_vary_in_what_they_are_about_alone() -> None:
    items = [draw(random.Random(i), "plain") for i in range(1000)]
    assert {item.kind for item in items} == {"compare", "extreme", "which"}
    said = " ".join(map(text, items)).lower()
    for name in OURS:
        for first, *others in words().properties[name].levels:
            assert f" {first}." in said
            assert not [other for other in others if re.search(rf"\b{other}\b", said)]


@pytest.mark.parametrize("form", ["plain", "several", "short", "whole"])
def test_answers_are_balanced(form: Form) -> None:
    """A guess that ignores the things must not do well."""
    items = [draw(random.Random(f"balance {i}"), form) for i in range(4000)]
    compared = [concluded(item) for item in items if item.kind == "compare"]
    for answer in ("Yes.", "No.", "Both alike."):
        assert 0.28 < compared.count(answer) / len(compared) < 0.39
    extremes = [plain(concluded(item)) for item in items if item.kind == "extreme"]
    lettered = [answer for answer in extremes if answer in ("a)", "b)", "c)")]
    assert all(0.25 < lettered.count(x) / len(lettered) < 0.42 for x in ("a)", "b)", "c)"))


def test_held_out_combinations_are_never_taught() -> None:
    seen: dict[bool, set[tuple[int, ...]]] = {True: set(), False: set()}
    for i in range(4000):
        item = draw(random.Random(f"held {i}"), "several" if i % 8 > 3 else "whole", held=i % 4 == 0, further=True)
        for thing in told(item).values():
            if set(OURS) <= thing.keys():
                combination = tuple(thing[name] for name in OURS)
                seen[i % 4 == 0].add(combination)
                assert held_out(combination) == (i % 4 == 0)
    assert (len(seen[True]), len(seen[False])) == (9, 18), "all 27 combinations come, on one side each"
    for index in range(3):
        assert {c[index] for c in seen[True]} == {c[index] for c in seen[False]} == {0, 1, 2}


@pytest.mark.parametrize(
    ("task", "answer", "choice"),
    [
        ("PC", "Yes, the first object is harder.", "yes"),
        ("PC", "Both objects have the same hardness.", "same"),
        ("PC", "Both alike.", "same"),
        ("PC", "_Yes_, it is.", "yes"),
        ("PC", "Yes and no.", None),
        ("PC", "Yesterday nobody knew.", None),
        ("PC", "", None),
        ("PC", "Hardness: a) soft, b) hard. Harder: second object. Conclusion: No, the second object is harder.", "no"),
        ("PSS", "Hardness: a) soft, b) hard, c) hard. Softest: a). Conclusion: a) is the softest.", "a"),
        ("PSS", "b)", "b"),
        ("PSS", "**B**", "b"),
        ("PSS", "c) is the hardest.", "c"),
        ("PSS", "a hard object", None),
        ("PSS", "a) is hard, but b) is harder", None),
        ("PSR", "The most suitable object is a), because", "a"),
        ("POM", "a) a pen's grip, b) a pen, c) the ruler", "102"),
        ("POM", "a) a ruler and b) a pen", None),
    ],
)
def test_answers_are_read(task: str, answer: str, choice: str | None) -> None:
    assert GateQuestion(task, "", "", ("pen", "pen's grip", "ruler")).read(answer) == choice


def test_gate_asks_what_was_never_taught(catalogue: Catalogue) -> None:
    questions = gate_questions(catalogue, 60, seed=0)
    assert questions == gate_questions(catalogue, 60, seed=0) != gate_questions(catalogue, 60, seed=1)
    for task, choices in {"PC": 3, "PSS": 3, "PSR": 2, "POM": 6}.items():
        right = [q.right for q in questions if q.task == task]
        assert len(right) == 60
        assert sorted(map(right.count, set(right))) == [60 / choices] * choices
    for question in questions:
        sentences = re.findall(r"Overall, it presents an? (.+?) and (.+?) surface with (.+?)\.", question.text)
        labels = [tuple(p.levels.index(w) for p, w in zip(catalogue.properties, s, strict=True)) for s in sentences]
        assert len(labels) == {"PC": 2, "PSS": 3, "PSR": 2, "POM": 3}[question.task]
        assert question.task == "POM" or all(map(held_out, labels))

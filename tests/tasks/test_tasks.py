"""Every task grades its own answers as right and everything else as wrong or unread."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from itertools import islice

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.records import Opd, Part, Question, Score
from pipeline.language.chat import TACTILE
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool, conclusion, find_level
from pipeline.tasks.questions import build_questions
from pipeline.videos.catalogue import Catalogue
from tests.tasks.shared import CATALOGUE, grade

POOL = Pool(Part.TRAIN, CATALOGUE, {o: [f"{o}_{i}" for i in range(3)] for o in CATALOGUE.objects})
HARDNESS = CATALOGUE.properties[0]
EACH = 2
every_task = pytest.mark.parametrize("task", list(TASKS))


def drafted(task: str) -> list[Question]:
    """Some questions of every stratum."""
    definition, rng, questions = TASKS[task], random.Random(0), []
    for stratum in range(definition.strata(CATALOGUE)):
        drafts = (definition.draft(POOL, stratum, rng) for _ in range(2000))
        for draft in islice(filter(None, drafts), EACH):
            fields = {name: getattr(draft, name) for name in ("videos", "objects", "dialogues", "gold")}
            questions.append(Question(question_id=f"{task}-{len(questions)}", task=task, part=POOL.part, **fields))
    return questions


QUESTIONS = {task: drafted(task) for task in TASKS}


def answers(question: Question) -> Iterator[tuple[Opd, tuple[str, ...]]]:
    for dialogue in question.dialogues:
        yield dialogue.opd, tuple(turn.assistant for turn in dialogue.turns)


def choice(question: Question, *outputs: str) -> Score:
    (score,) = grade(question, *outputs)
    return score


@every_task
def test_gold_answers_are_right_in_every_mode(task: str) -> None:
    assert len(QUESTIONS[task]) == EACH * TASKS[task].strata(CATALOGUE), "every stratum can be drawn"
    for question in QUESTIONS[task]:
        for _, outputs in answers(question):
            for decorated in (outputs, tuple(f"  {o}\n" for o in outputs), tuple(o.upper() for o in outputs)):
                scores = grade(question, *decorated)
                assert {s.measure for s in scores} == TASKS[task].chance(CATALOGUE).keys()
                assert all(s.correct and s.parsed and s.predicted == s.expected for s in scores), (decorated, scores)
                assert all(s.question_id == question.question_id and s.objects == question.objects for s in scores)


@every_task
def test_prompts_show_each_video_once_in_every_mode(task: str) -> None:
    for question in QUESTIONS[task]:
        assert question.gold.labels == tuple(map(CATALOGUE.labels, question.objects))
        assert len(question.videos) == len(set(question.objects)) == len(question.objects)
        assert {d.opd for d in question.dialogues} == ({Opd.NEEDED, Opd.ALL} if task == "OPD" else set(Opd))
        assert (question.dialogue(Opd.NONE) is None) == (task == "OPD")
        for dialogue in question.dialogues:
            text = "".join(turn.user for turn in dialogue.turns)
            assert text.count(TACTILE) == len(question.videos)
            assert "{" not in text.replace(TACTILE, "")
            assert not any(TACTILE in turn.assistant for turn in dialogue.turns)


@pytest.mark.parametrize("task", ["PC", "PSS"])
def test_comparisons_and_superlatives_are_true_and_the_extreme_is_unique(task: str) -> None:
    for question in QUESTIONS[task]:
        (name,) = question.gold.properties
        prop = CATALOGUE.properties[CATALOGUE.property_index(name)]
        levels = [labels[CATALOGUE.property_index(name)] for labels in question.gold.labels]
        asked = question.dialogues[0].turns[0].user
        if task == "PC":
            rising = f" {prop.more} than" in asked
            truth = "same" if levels[0] == levels[1] else "yes" if (levels[0] > levels[1]) == rising else "no"
        else:
            extreme = max(levels) if f"the {prop.most}" in asked else min(levels)
            assert levels.count(extreme) == 1
            truth = "abc"[levels.index(extreme)]
        assert question.gold.choice == truth


LABELS = st.lists(st.tuples(*(st.integers(0, len(p.levels) - 1) for p in CATALOGUE.properties)), max_size=9)


@settings(max_examples=40)
@given(LABELS, st.integers(0, 3))
def test_a_superlative_is_the_extreme_of_all_that_the_part_has(labels: list[tuple[int, ...]], seed: int) -> None:
    """Whatever classes there are; a middle one is asked for where nothing beyond it is there."""
    objects = {
        name: CATALOGUE.objects[name].model_copy(update={"ratings": tuple((label,) for label in own)})
        for name, own in zip(CATALOGUE.objects, labels, strict=False)
    }
    pool = Pool(Part.TEST, Catalogue(language=CATALOGUE.language, objects=objects), {o: [f"{o}_0"] for o in objects})
    questions = build_questions(pool, {"PSS": 18}, seed=seed, distinct=True)
    asked = set()
    for question in questions:
        place = CATALOGUE.property_index(question.gold.properties[0])
        most = f"the {CATALOGUE.properties[place].most}" in question.dialogues[0].turns[0].user
        levels = [own[place] for own in question.gold.labels]
        right = (max if most else min)(own[place] for own in labels)
        assert [level == right for level in levels] == [letter == question.gold.choice for letter in "abc"]
        asked.add((place, most))
    for place in range(len(CATALOGUE.properties)):
        classes = [own[place] for own in labels]
        for most, extreme in ((True, max(classes, default=0)), (False, min(classes, default=0))):
            assert ((place, most) in asked) == (len(classes) - classes.count(extreme) > 1)


def test_options_are_alphabetical_and_told_apart() -> None:
    for question in QUESTIONS["POM"]:
        options = sorted((CATALOGUE.objects[o].name for o in question.objects), key=str.lower)
        listed = ", ".join(f"{i}) {name}" for i, name in enumerate(options, 1))
        assert all(d.turns[0].user.endswith(f"in alphabetical order: {listed}.") for d in question.dialogues)
        names = [options[int(number) - 1] for number in question.gold.choice]
        assert names == [CATALOGUE.objects[o].name for o in question.objects]
        assert len(set(question.gold.labels)) == 3


def test_scenarios_prefer_what_their_classes_say() -> None:
    for question in QUESTIONS["PSR"]:
        asked = question.dialogues[0].turns[0].user
        scenario = next(s for s in CATALOGUE.language.scenarios if s.question in asked)
        right = "ab".index(question.gold.choice)
        for position, classes in ((right, scenario.target), (1 - right, scenario.other)):
            for name, allowed in classes.items():
                assert question.gold.labels[position][CATALOGUE.property_index(name)] in allowed
    assert {q.gold.choice for q in QUESTIONS["PSR"]} == {"a", "b"}


def test_a_description_is_graded_property_by_property() -> None:
    question = next(q for q in QUESTIONS["OPD"] if q.gold.labels == ((2, 0, 0),))
    found = grade(question, "Overall, it presents a hard and slightly rough surface with no bumps.")
    assert [(s.measure, s.correct) for s in found] == [
        *(("hardness", True), ("roughness", False), ("bumpiness", True), ("combined", False)),
    ]
    assert (found[1].predicted, found[3].expected) == ("slightly rough", "hard, smooth, no bumps")


@pytest.mark.parametrize(
    ("level", "texts"),
    [
        (2, ["a hard surface", "hard, very hard"]),
        (1, ["a moderately hard surface", "a Moderately  Hard one", "moderately\nhard", "a moderately-hard surface"]),
        (0, ["SOFT"]),
        (None, ["hard and soft", "hard or moderately hard", "hardly softened", "a moderately", ""]),
    ],
)
def test_levels_are_read_whole(level: int | None, texts: list[str]) -> None:
    assert {find_level(text, HARDNESS) for text in texts} == {level}


@every_task
def test_an_answer_cut_off_before_its_end_is_never_right(task: str) -> None:
    """Cut before the sentence that holds the answer: wrong in every mode, whatever the descriptions said."""
    markers = {"OPD": "Overall", "PSR": "The most suitable", "RIPE": "The riper"}
    for question in QUESTIONS[task][:: 1 + len(QUESTIONS[task]) // 40]:
        for opd, outputs in answers(question):
            marker = markers.get(task, "Conclusion:" if opd != Opd.NONE else "")
            end = outputs[-1].index(marker) if marker else 0
            for stop in {*range(0, end, 23), end}:
                scores = grade(question, *outputs[:-1], outputs[-1][:stop])
                assert not any(s.correct or s.parsed for s in scores), outputs[-1][:stop]


@pytest.mark.parametrize("task", ["PC", "PSS", "POM", "PSR", "RIPE"])
def test_the_answer_to_another_question_is_wrong(task: str) -> None:
    by_choice = {question.gold.choice: question for question in QUESTIONS[task]}
    for question in QUESTIONS[task]:
        others = (other for other in by_choice.values() if other.gold.choice != question.gold.choice)
        assert not any(choice(question, *outputs).correct for other in others for _, outputs in answers(other))


UNREADABLE = {
    "OPD": ["", " ", "yes", "Overall", "a)", "Conclusion:", "\x00", "🙂" * 50, "a" * 10_000],
    "PC": [
        *("", "Maybe.", "Not sure.", "None", "Nobody knows", "The first object is harder.", "Yesterday", "Bothersome"),
        *("Conclusion:", "Conclusion: maybe", "Yes. Conclusion: I cannot say.", "First object: Overall, yes."),
        *("Yes and no.", "yes or no", "Yes/No", "Conclusion: No / yes", "Both or no", "**Yes** / **No**"),
        *("No idea.", "**No** answer can be given.", "Conclusion: Yes. Answer: No.", "Conclusion: ~~Yes~~"),
        *("<think>Conclusion: Yes.</think> I cannot tell.", "<think>Conclusion: Yes."),
    ],
    "PSS": [
        *(
            "",
            "a hard one",
            "The hardest.",
            "a), b) or c)",
            "d) is the hardest.",
            "a) is the hardest. b) is the hardest.",
        ),
        *("ba) is the", "a) is the same as b).", "The hardest is **a)** or **b)**.", "Answer: A human cannot tell."),
        *(f"Conclusion: {x}" for x in ("a), b) or c)", "a) is soft, b) is hard, c) is hard.", "d)", "unclear", "a b)")),
        *("a) The surface feels hard", "a. The surface feels hard.", "Conclusion: **a)**. Answer: **b)**."),
        *("Answer: b) Conclusion: I cannot tell.", "Option A or option B", "None of **b)**"),
    ],
    "RIPE": [
        "",
        "a) It is soft",
        "The riper avocado is a) or b).",
        "The riper avocado is c).",
        "The riper kiwi is a).",
    ],
    "PSR": [
        *(
            f"The most suitable object is {x}"
            for x in ("a) or b).", "a) and b).", "c).", "x), because xxx", "a hammer")
        ),
        *("The most suitable object is a). The most suitable object is b).", "a) and b)", "", "The object is a)."),
        *(
            "Neither a) nor b) is the most suitable.",
            "I do not think that b) is the most suitable.",
            "Answer: c",
            "The most suitable object is a",
        ),
        *("The most suitable object for this is a) or b).", "The most suitable object for a pan. What is b)?"),
    ],
}


@pytest.mark.parametrize("task", UNREADABLE)
def test_nothing_is_read_from(task: str) -> None:
    for output in UNREADABLE[task]:
        scores = grade(QUESTIONS[task][0], *(["descriptions"] if task in ("PSR", "RIPE") else []), output)
        assert not any(s.parsed or s.correct or s.predicted for s in scores), output


@pytest.mark.parametrize(
    ("output", "predicted"),
    [
        ("The most suitable object is a), because of its hardness.", "a"),
        ("The most suitable object is (b), because a) is soft.", "b"),
        ("the most suitable object is B)", "b"),
        ("The most suitable object for cleaning a pan without scratching it is a).", "a"),
    ],
)
def test_what_is_read_of_a_scenario(output: str, predicted: str) -> None:
    assert choice(QUESTIONS["PSR"][0], "descriptions", output).predicted == predicted


MARKS = (
    "**{}**",
    "*{}*",
    "_{}_",
    "__{}__",
    "***{}***",
    "`{}`",
    "<b>{}</b>",
    "\\textbf{{{}}}",
    "“{}”",
    "'{}'",
    "${}$",
    "({})",
)
OPENINGS = ("", "### ", "- ", "* ", "> ", "2. ", "**Answer:** ", "<think>\nConclusion: no. a) is the</think>\n\n")


@every_task
@settings(max_examples=40)
@given(st.data())
def test_markdown_and_the_like_leave_what_is_read(task: str, data: st.DataObject) -> None:
    """Marks around any words of a right answer, breaks between its sentences, a heading, thoughts before it."""
    question = data.draw(st.sampled_from(QUESTIONS[task]))
    *before, last = data.draw(st.sampled_from([outputs for _, outputs in answers(question)]))
    words, separator = last.split(" "), data.draw(st.sampled_from([" ", "\N{NO-BREAK SPACE}", "  "]))
    for mark in data.draw(st.lists(st.sampled_from(MARKS[:-1]), max_size=3)):
        start = data.draw(st.integers(0, len(words) - 1))
        stop = data.draw(st.integers(start + 1, min(len(words), start + 4)))
        words[start:stop] = mark.format(" ".join(words[start:stop])).split(" ")
    text = separator.join(words)
    if data.draw(st.booleans()):
        text = text.replace("Conclusion:", data.draw(st.sampled_from(["\n\n### Conclusion\n", "\n**Conclusion:**"])))
    text = data.draw(st.sampled_from(OPENINGS)) + text
    plain, decorated = grade(question, *before, last), grade(question, *before, text)
    assert [(s.predicted, s.parsed, s.correct) for s in decorated] == [
        (s.predicted, s.parsed, s.correct) for s in plain
    ]


@pytest.mark.parametrize(
    ("task", "read", "outputs"),
    [
        (
            "PC",
            "yes",
            [
                *("**Conclusion:** Yes, the first.", "**Conclusion**: yes", "### Conclusion\n\nYes.", "\\boxed{Yes}"),
                *("Answer: Yes", "The answer is **yes**.", "In conclusion, yes.", "_Yes_ — the first", "“Yes”, it is."),
                *(
                    "1. Yes.",
                    "$\\boxed{\\text{Yes, the first}}$",
                    "# Answer\nYES",
                    "It is hard.\n\n**Final Answer:** yes",
                ),
            ],
        ),
        ("PC", "same", ["Conclusion: **Both** objects are similar.", "Answer: both are."]),
        (
            "PSS",
            "b",
            [
                *(
                    "Conclusion: **b)** is the hardest.",
                    "**b)** is the hardest. So B) is the hardest.",
                    "**Conclusion: b)**",
                ),
                *(
                    "Option B is the hardest.",
                    "Answer: b",
                    "Answer: Option B.",
                    "The hardest object is b).",
                    "(b)",
                    "B.",
                ),
                *(
                    "\\boxed{b}",
                    "**Conclusion:** b), because a) is soft",
                    "b is clearly the hardest",
                    "Final answer - B",
                ),
                *(
                    "The most bumpy one is **b**.",
                    "`b)` is the hardest",
                    "Conclusion: \\(b\\)",
                    "\N{FULLWIDTH LATIN SMALL LETTER B}) is the hardest",
                ),
            ],
        ),
        (
            "PSR",
            "b",
            [
                *(
                    "Conclusion: **b)**",
                    "The most suitable object is **b**, because it is soft.",
                    "b) is the best choice.",
                ),
                *(
                    "The **most suitable object** is *b)*, since a) is hard.",
                    "Answer: B",
                    "\\boxed{\\text{b)}}",
                    "Option B",
                ),
                *(
                    "The most suitable object is: b)",
                    "So, b) is the most suitable object.",
                    "the most suitable object is Object b",
                ),
            ],
        ),
        ("RIPE", "b", ["The riper avocado is **b)**.", "**Answer:** b", "Thus b) is riper.", "\\boxed{B}"]),
    ],
)
def test_what_a_person_reads_is_read(task: str, read: str, outputs: list[str]) -> None:
    for output in outputs:
        found = grade(QUESTIONS[task][0], *(["descriptions"] if task in ("PSR", "RIPE") else []), output)
        assert [s.predicted for s in found] == [read], output


def test_the_last_conclusion_counts() -> None:
    question = next(q for q in QUESTIONS["PC"] if q.gold.choice == "yes")
    assert choice(question, "Conclusion: No. Conclusion: Yes, the first object is harder.").correct
    assert not choice(question, "Conclusion: Yes. CONCLUSION : No, the second.").correct
    assert conclusion("no marker") == ["no marker"]


def matching(*names: str) -> Question:
    """A matching question whose options bear these names, the videos in that order."""
    by_name = {o.name: o.object_id for o in CATALOGUE.objects.values()}
    question = QUESTIONS["POM"][0]
    order = "".join(str(sorted(names, key=str.lower).index(n) + 1) for n in names)
    gold = question.gold.model_copy(update={"choice": order})
    return question.model_copy(update={"objects": tuple(by_name[n] for n in names), "gold": gold})


def test_a_matching_must_be_whole() -> None:
    a, b, c = names = ("a tomato", "a baseball", "a lemon")
    question = matching(*names)
    assert choice(question, f"a) is {a}, b) is {b} and c) is {c}.").correct
    assert choice(question, f"c) is {c}; b) is {b}; a) is {a.upper()}").correct
    swapped = choice(question, f"a) is {b}, b) is {a} and c) is {c}.")
    assert (swapped.parsed, swapped.correct) == (True, False)
    for output in (
        f"a) is {a}, b) is {b}.",
        f"a) is {a}, b) is {b} and c) is {b}.",
        f"a) is {a}, a) is {a}, b) is {b} and c) is {c}.",
        f"a) is {a}, b) is {b} and c) is {c}s.",
        f"a) is {a}, b) is {b} and c) is a spaceship.",
        f"{a}, {b}, {c}",
        f"1) is {a}, 2) is {b} and 3) is {c}.",
    ):
        assert not choice(question, output).parsed, output


def test_a_matching_is_read_however_it_is_set() -> None:
    names = a, b, c = ("a lanyard's card holder", "a baseball", "a lemon")
    question = matching(*names)
    for output in (
        f"**Conclusion:** **a)** is **{a}**, **b)** is *{b}* and c) is `{c}`.",
        f"- a) {a}\n- b) {b}\n- c) {c}",
        f"A: {a}; B: {b}; C: {c}",
        f"(a) is “{a}”, (b) is '{b}', (c) is \"{c}\".",
        f"Option A is {a.replace(chr(39), chr(8217))}, option B is {b} and option C is {c}",
        f"\\boxed{{a) = {a}, b) = {b}, c) = {c}}}",
        f"1. a) → {a}\n2. b) → {b}\n3. c) → {c}",
    ):
        assert choice(question, output).correct, output
    for output in (
        f"a) is not {a}, b) is {b} and c) is {c}.",
        f"a) {a} or {b}, b) {b}, c) {c}",
        f"a) is {a}, b) or c) is {c}",
    ):
        assert not choice(question, output).parsed, output


def test_a_longer_name_is_not_the_shorter_one() -> None:
    question = matching("a lanyard", "a tomato", "a potato")
    assert choice(question, "a) is a lanyard, b) is a tomato and c) is a potato.").correct
    assert not choice(question, "a) is a lanyard's card holder, b) is a tomato and c) is a potato.").parsed
    both = matching("a lanyard's card holder", "a lanyard", "a potato")
    assert choice(both, "a) is a lanyard's card holder, b) is a lanyard and c) is a potato.").correct


WORDS = ["Overall", "hard", "a)", "b)", " is ", "is the", "Conclusion:", "yes", "no", "(", "[", "\\", "*", "\n"]


@every_task
@settings(max_examples=20)
@given(st.integers(0, 10**6), st.text(max_size=100) | st.lists(st.sampled_from(WORDS), max_size=20).map(" ".join))
def test_no_text_crashes_a_grader(task: str, number: int, text: str) -> None:
    for score in grade(QUESTIONS[task][number % len(QUESTIONS[task])], text, truncated=True):
        assert score.parsed or (not score.correct and score.predicted == "")
        assert score.correct == (score.predicted == score.expected)
        assert score.truncated


def test_chance_is_that_of_a_uniform_guess() -> None:
    expected = {"PC": 1 / 3, "PSS": 1 / 3, "POM": 1 / 6, "PSR": 1 / 2, "RIPE": 1 / 2}
    assert {task: TASKS[task].chance(CATALOGUE) for task in expected} == {t: {"choice": v} for t, v in expected.items()}
    described = TASKS["OPD"].chance(CATALOGUE)
    assert described["combined"] == pytest.approx(1 / 27)
    assert math.prod(described[p] for p in CATALOGUE.property_names) == pytest.approx(described["combined"])


@every_task
@pytest.mark.parametrize("objects", [("rug",), ("rug", "potato")])
def test_too_few_objects_are_no_crash(task: str, objects: tuple[str, ...]) -> None:
    pool = Pool(Part.TEST, CATALOGUE, {o: [f"{o}_0"] for o in objects})
    for stratum in range(TASKS[task].strata(CATALOGUE)):
        for _ in range(3):
            draft = TASKS[task].draft(pool, stratum, random.Random(0))
            assert draft is None or set(draft.objects) <= set(objects)

"""Every task grades its own answers as right and everything else as wrong or unread."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.core.records import Opd, Part, Question
from pipeline.language.chat import TACTILE
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool, find_level
from pipeline.tasks.questions import build_questions
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from tests.tasks.shared import CATALOGUE, drafted, grade

POOL = Pool(Part.TRAIN, CATALOGUE, {o: [f"{o}_{i}" for i in range(3)] for o in CATALOGUE.objects})
EACH = 2
every_task = pytest.mark.parametrize("task", list(TASKS))


QUESTIONS = {task: drafted(task, POOL, EACH) for task in TASKS}


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


LABELS = st.lists(st.tuples(*(st.integers(0, len(p.levels) - 1) for p in CATALOGUE.properties)), max_size=9)


@settings(max_examples=40)
@given(LABELS, st.integers(0, 3))
def test_a_superlative_is_the_extreme_of_all_that_the_part_has(labels: list[tuple[int, ...]], seed: int) -> None:
    """Whatever classes there are; a middle one is asked for where nothing beyond it is there."""
    ratings = {name: tuple((label,) for label in own) for name, own in zip(CATALOGUE.objects, labels, strict=False)}
    objects = {name: CATALOGUE.objects[name].model_copy(update={"ratings": own}) for name, own in ratings.items()}
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


def test_a_description_is_graded_property_by_property() -> None:
    question = next(q for q in QUESTIONS["OPD"] if q.gold.labels == ((2, 0, 0),))
    found = grade(question, "Overall, it presents a hard and slightly rough surface with no bumps.")
    assert [(s.measure, s.correct) for s in found] == [
        *(("hardness", True), ("roughness", False), ("bumpiness", True), ("combined", False))
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
    assert {find_level(text, CATALOGUE.properties[0]) for text in texts} == {level}


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


MARKS = ["**{}**", "*{}*", "_{}_", "__{}__", "***{}***", "`{}`", "<b>{}</b>", "“{}”", "'{}'", "${}$"]
OPENINGS = ("", "### ", "- ", "* ", "> ", "2. ", "**Answer:** ", "<think>\nConclusion: no. a) is the</think>\n\n")


@every_task
@settings(max_examples=40)
@given(st.data())
def test_markdown_and_the_like_leave_what_is_read(task: str, data: st.DataObject) -> None:
    """Marks around any words of a right answer, breaks between its sentences, a heading, thoughts before it."""
    question = data.draw(st.sampled_from(QUESTIONS[task]))
    *before, last = data.draw(st.sampled_from([outputs for _, outputs in answers(question)]))
    words, separator = last.split(" "), data.draw(st.sampled_from([" ", "\N{NO-BREAK SPACE}", "  "]))
    for mark in data.draw(st.lists(st.sampled_from(MARKS), max_size=3)):
        start = data.draw(st.integers(0, len(words) - 1))
        stop = data.draw(st.integers(start + 1, min(len(words), start + 4)))
        words[start:stop] = mark.format(" ".join(words[start:stop])).split(" ")
    text = separator.join(words)
    if data.draw(st.booleans()):
        text = text.replace("Conclusion:", data.draw(st.sampled_from(["\n\n### Conclusion\n", "\n**Conclusion:**"])))
    text = data.draw(st.sampled_from(OPENINGS)) + text
    plain, decorated = (
        [(s.predicted, s.parsed, s.correct) for s in grade(question, *before, said)] for said in (last, text)
    )
    assert decorated == plain


UNREAD = {
    "OPD": "yes\nOverall\na)\nConclusion:\n\x00\n" + "🙂" * 50 + "\n" + "a" * 10_000,
    "PC": """
        The first object is harder.
        Yesterday
        Conclusion: No / yes
        **No** answer can be given.
        Conclusion: Yes. Answer: No.
        Conclusion: ~~Yes~~
        <think>Conclusion: Yes.</think> I cannot tell.
        <think>Conclusion: Yes.
        Yes, the first object is **harder**.
        Conclusion: No, the first object is softer.
        Both objects are similar: the first object is softer.
        """,
    "PSS": """
        d) is the softest.
        a) is the same as b).
        The softest is **a)** or **b)**.
        Conclusion: b) is the **hardest**.
        Option B is clearly the hardest
        The hardest object is (b).
        Answer: A human cannot tell.
        Conclusion: a) is soft, b) is hard, c) is hard.
        Conclusion: a b)
        a. The surface feels hard.
        Answer: b) Conclusion: I cannot tell.
        None of **b)**
        """,
    "RIPE": """
        The riper avocado is a). No: the riper avocado is b).
        The less ripe avocado is a).
        The riper kiwi is a).
        """,
    "PSR": """
        The object is a).
        Neither a) nor b) is the most suitable.
        I do not think that b) is the most suitable.
        The most suitable object is a
        The most suitable object for a pan. What is b)?
        """,
}
READ = {
    ("PC", "yes"): """
        **Conclusion:** Yes, the first.
        \\boxed{Yes}
        In conclusion, yes.
        $\\boxed{\\text{Yes, the first}}$
        Conclusion: No. Conclusion: Yes, the first object is softer.
        Yes, the second object is harder.
        The first object is harder. Conclusion: Yes, the first object is softer.
        """,
    ("PC", "no"): """
        No, the second object is softer.
        No, the first object is harder than the second object.
        No, I cannot say that the first object is softer.
        """,
    ("PC", "same"): "Conclusion: **Both** objects are similar.\nAnswer: both are.",
    ("PSS", "b"): """
        Conclusion: **b)** is the softest.
        Option B is the softest.
        Answer: b
        B.
        \\boxed{b}
        **Conclusion:** b), because a) is soft
        b is clearly the softest
        b) is the softest. The hardest is c).
        Hardness: b) is the hardest. Conclusion: b) is the softest.
        Final answer - B
        The most bumpy one is **b**.
        Conclusion: \\(b\\)
        \N{FULLWIDTH LATIN SMALL LETTER B}) is the softest
        """,
    ("PSR", "b"): """
        The most suitable object is (b), because a) is soft.
        The most suitable object for cleaning a pan without scratching it is b).
        b) is the best choice.
        Option B
        the most suitable object is Object b
        """,
    ("RIPE", "b"): """
        The riper avocado is **b)**.
        Thus b) is riper.
        The Riper Avocado is (B).
        a) is hard, so the riper one is b).
        """,
}
"""What nobody reads an answer from, and what a person reads as which, a line each."""


@pytest.mark.parametrize(
    ("task", "read", "outputs"),
    [
        *((task, "", ["", *outputs.split("\n")]) for task, outputs in UNREAD.items()),
        *((*key, outputs.strip().split("\n")) for key, outputs in READ.items()),
        ("PC", "yes", ["### Conclusion\n\nYes.", "# Answer\nYES", "It is hard.\n\n**Final Answer:** yes"]),
    ],
)
def test_what_a_person_reads_is_read_and_nothing_else(task: str, read: str, outputs: list[str]) -> None:
    for output in outputs:
        found = grade(QUESTIONS[task][0], *(["descriptions"] if task in ("PSR", "RIPE") else []), output.strip(" "))
        assert {(s.predicted, s.parsed) for s in found} == {(read, bool(read))}, output


PLAIN = ("a lanyard's card holder", "a baseball", "a lemon")


@pytest.mark.parametrize(
    ("names", "output", "verdict"),
    [
        (PLAIN, "a) is {a}, b) is {b} and c) is {c}.", True),
        (PLAIN, "- a) {a}\n- b) {b}\n- c) {c}", True),
        (PLAIN, "(a) is “{a}”, (b) is '{b}', (c) is \"{c}\".", True),
        (PLAIN, "Option A is a lanyard\N{RIGHT SINGLE QUOTATION MARK}s card holder, B is {b} and C is {c}", True),
        (PLAIN, "\\boxed{{a) = {a}, b) = {b}, c) = {c}}}", True),
        (PLAIN, "a) is {b}, b) is {a} and c) is {c}.", False),
        (PLAIN, "a) is {a}, b) is {b}.", None),
        (PLAIN, "a) is {a}, b) is {b} and c) is {b}.", None),
        (PLAIN, "a) is {a}, a) is {a}, b) is {b} and c) is {c}.", None),
        (PLAIN, "{a}, {b}, {c}", None),
        (PLAIN, "a) is not {a}, b) is {b} and c) is {c}.", None),
        (PLAIN, "a) is {a}, b) or c) is {c}", None),
        (("a lanyard", "a tomato", "a potato"), "a) is {a}, b) is {b} and c) is {c}.", True),
        (("a lanyard", "a tomato", "a potato"), "a) is a lanyard's card holder, b) is {b} and c) is {c}.", None),
        (("a lanyard's card holder", "a lanyard", "a potato"), "a) is {a}, b) is {b} and c) is {c}.", True),
    ],
)
def test_a_matching_must_be_whole_however_it_is_set(names: tuple[str, ...], output: str, verdict: bool | None) -> None:
    """None: it cannot be read. A longer name is not the shorter one."""
    by_name = {o.name: o.object_id for o in CATALOGUE.objects.values()}
    order = "".join(str(sorted(names, key=str.lower).index(n) + 1) for n in names)
    question = QUESTIONS["POM"][0]
    gold = question.gold.model_copy(update={"choice": order})
    question = question.model_copy(update={"objects": tuple(by_name[n] for n in names), "gold": gold})
    score = choice(question, output.format(**dict(zip("abc", names, strict=True))))
    assert (score.parsed, score.correct) == (verdict is not None, bool(verdict))


WORDS = ["Overall", "hard", "a)", "b)", " is ", "is the", "Conclusion:", "yes", "no", "(", "[", "\\", "*", "\n"]


@every_task
@settings(max_examples=20)
@given(st.integers(0, 10**6), st.text(max_size=100) | st.lists(st.sampled_from(WORDS), max_size=20).map(" ".join))
def test_no_text_crashes_a_grader(task: str, number: int, text: str) -> None:
    for score in grade(QUESTIONS[task][number % len(QUESTIONS[task])], text, truncated=True):
        assert score.parsed or (not score.correct and score.predicted == "")
        assert score.correct == (score.predicted == score.expected)
        assert score.truncated

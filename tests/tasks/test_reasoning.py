"""Descriptions read out of answers, and the table that parts wrong descriptions from wrong conclusions."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pipeline.reporting import write_report
from pipeline.reporting.answered import FAILED

from pipeline.evaluation.grading import grade
from pipeline.io import read_jsonl, write_jsonl, write_table, write_text
from pipeline.params import Params
from pipeline.records import Assignment, Opd, Part, Prediction, Question, Score
from pipeline.statistics import Outcome, clustered
from pipeline.tasks.described import described_right, read_descriptions
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue, load_catalogue
from tests.closure import ROOT
from tests.fake_chain import fake_params, write_chain

CATALOGUE = load_catalogue(ROOT / "pipeline" / "physiclear")
CONCLUDING = ("PC", "PSS", "POM", "PSR")
DESCRIBING = (Opd.NEEDED, Opd.ALL)


def _questions(catalogue: Catalogue, each: int = 40) -> list[Question]:
    assignments = [Assignment(video_id=f"{o}_0", object_id=o, part=Part.TEST) for o in catalogue.objects]
    pool = pool_of(Part.TEST, assignments, catalogue)
    return build_questions(pool, dict.fromkeys(CONCLUDING, each), seed=3, distinct=True)


QUESTIONS = _questions(CATALOGUE)


def _said(question: Question, *outputs: str) -> Prediction:
    return Prediction(question_id=question.question_id, task=question.task, outputs=outputs, truncated=False, tokens=1)


def _reference(question: Question, opd: Opd) -> list[str]:
    dialogue = question.dialogue(opd)
    assert dialogue is not None
    return [turn.assistant for turn in dialogue.turns]


def _right(question: Question, *outputs: str) -> bool | None:
    return described_right(question, _said(question, *outputs), CATALOGUE)


@pytest.mark.parametrize("opd", DESCRIBING)
@pytest.mark.parametrize("task", CONCLUDING)
def test_every_reference_answer_describes_right(task: str, opd: Opd) -> None:
    asked = [q for q in QUESTIONS if q.task == task]
    assert len(asked) == 40
    for question in asked:
        assert _right(question, *_reference(question, opd)) is True
        places = [i for i, name in enumerate(CATALOGUE.property_names) if name in question.gold.properties]
        expected = tuple(tuple(labels[i] for i in places) for labels in question.gold.labels)
        assert read_descriptions(question, _said(question, *_reference(question, opd)), CATALOGUE) == expected


@given(data=st.data())
def test_one_class_changed_is_wrong_exactly_where_it_is_asked_about(data: st.DataObject) -> None:
    question = data.draw(st.sampled_from(QUESTIONS))
    classes = [list(labels) for labels in question.gold.labels]
    place = data.draw(st.integers(0, len(classes) - 1))
    number = data.draw(st.integers(0, len(CATALOGUE.properties) - 1))
    prop = CATALOGUE.properties[number]
    classes[place][number] = data.draw(st.sampled_from([i for i in range(3) if i != classes[place][number]]))
    marks = ("First object:", "Second object:") if question.task == "PC" else ("a)", "b)", "c)")
    text = " ".join(f"{mark} {_sentence(levels)}" for mark, levels in zip(marks, classes, strict=False))
    asked = prop.name in question.gold.properties
    assert _right(question, f"{text} Conclusion: whatever.") is not asked


def _sentence(levels: list[int]) -> str:
    """Written out here anew, without the catalogue's templates."""
    hardness, roughness, bumpiness = (p.levels[i] for p, i in zip(CATALOGUE.properties, levels, strict=True))
    return f"Overall, it presents a {hardness} and {roughness} surface with {bumpiness}."


COMPARED = next(q for q in QUESTIONS if q.task == "PC" and q.gold.properties == ("hardness",))
CHOSEN = next(q for q in QUESTIONS if q.task == "PSS" and q.gold.properties == ("bumpiness",))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Conclusion: Yes, the first object is harder.",
        "I cannot tell.",
        "First object: Overall, it presents a hard surface.",
        "Second object: Overall, it presents a hard surface. First object: Overall, it presents a soft surface.",
        "First object: Overall, a hard surface. First object: Overall, a hard surface. Second object: Overall, a soft "
        "surface.",
        "a) Overall, it presents a hard surface. b) Overall, it presents a soft surface.Second object:",
        "First object: Overall, it presents a hard or soft surface. Second object: Overall, it is soft.",
        "First object: Overall, it presents a hard surface. Second object: Overall, it presents a",
        "First object: Overall, it presents a surface. Second object: Overall, it presents a hard surface.",
    ],
)
def test_what_cannot_be_read_is_neither_right_nor_wrong(text: str) -> None:
    assert _right(COMPARED, text) is None


def test_what_stands_before_overall_or_after_the_conclusion_is_not_read() -> None:
    levels = [CATALOGUE.properties[2].levels[labels[2]] for labels in CHOSEN.gold.labels]
    closing = [f"Overall, it presents a surface with {level}." for level in levels]
    a, b, c = closing
    text = (
        f"a) It may have big bumps. {a} b) No bumps? {b} c) Small bumps? {c} Conclusion: a) is the least bumpy, b) not."
    )
    assert _right(CHOSEN, text) is True
    # What was described in full stays described where the answer was cut before it concluded.
    assert _right(CHOSEN, f"a) {a} b) {b} c) {c}") is True
    # An answer without that sentence is read as it stands.
    assert _right(CHOSEN, f"a) {levels[0]} b) {levels[1]} c) {levels[2]}") is True


@given(data=st.data())
def test_free_words_are_read_by_what_they_stand_for(data: st.DataObject) -> None:
    question = data.draw(st.sampled_from(QUESTIONS))
    marks = ("First object:", "Second object:") if question.task == "PC" else ("a)", "b)", "c)")
    texts = []
    for mark, labels in zip(marks, question.gold.labels, strict=False):
        words = [data.draw(st.sampled_from(p.phrases[i])) for p, i in zip(CATALOGUE.properties, labels, strict=True)]
        texts.append(f"{mark} {', '.join(words)}.")
    assert _right(question, " ".join(texts)) is True
    assert _right(question, " ".join(texts[:-1])) is None


def test_of_two_turns_the_first_describes() -> None:
    question = next(q for q in QUESTIONS if q.task == "PSR")
    first, second = _reference(question, Opd.ALL)
    assert _right(question, first, "The most suitable object is b).") is True
    assert _right(question, second, first) is None


@given(
    st.text(max_size=40),
    st.lists(st.sampled_from(["a)", "b)", "c)", "First object:", "Overall", "hard", "no bumps", "Conclusion:"])),
    st.sampled_from(QUESTIONS),
)
def test_any_text_is_read_or_refused(noise: str, words: list[str], question: Question) -> None:
    read = read_descriptions(question, _said(question, f"{noise} {' '.join(words)}"), CATALOGUE)
    if read is not None:
        assert len(read) == len(question.objects)
        assert {len(levels) for levels in read} == {len(question.gold.properties)}


# The table: answers of four kinds (described right or wrong, concluded right or wrong) and unreadable ones.

KINDS = ((True, True), (False, True), (True, False), (False, False), (None, False), (True, True), (False, False))
Kind = tuple[bool | None, bool]
GATE = """task,accuracy,low,high,n,goal,passed
PC,0.99,0.97,1.0,500,0.95,yes
PSR,0.3,0.25,0.35,500,0.65,no
"""


def _answer(question: Question, opd: Opd, kind: Kind) -> tuple[str, ...]:
    """An answer whose descriptions and whose conclusion are as `kind` says; described in full whatever the mode."""
    described, concluded = kind
    if question.task == "OPD":
        return tuple(_reference(question, opd))
    classes = [list(labels) for labels in question.gold.labels]
    if described is False:
        place = CATALOGUE.property_index(question.gold.properties[-1])
        classes[-1][place] = (classes[-1][place] + 1) % 3
    marks = ("First object:", "Second object:") if question.task == "PC" else ("a)", "b)", "c)")
    text = " ".join(f"{mark} {_sentence(levels)}" for mark, levels in zip(marks, classes, strict=False))
    text = "Two surfaces." if described is None else text
    *_, last = _reference(question, opd)
    verdict = last.split("Conclusion: ")[-1] if concluded else "That is hard to say."
    return (text, verdict) if question.task == "PSR" else (f"{text} Conclusion: {verdict}",)


@pytest.fixture(scope="module")
def params() -> Params:
    return fake_params(
        "ablation.plan=factorial",
        "ablation.seeds=[0,3]",
        "ablation.counterfactuals=[removed]",
        "language.weights=base/llama",
    )


@pytest.fixture(scope="module")
def kinds() -> dict[tuple[str, str], Kind]:
    """By variant and question."""
    return {}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, params: Params, kinds: dict[tuple[str, str], Kind]) -> Path:
    folder = tmp_path_factory.mktemp("reasoning")
    write_chain(folder, params)
    questions = read_jsonl(folder / "data" / "questions" / "evaluation.jsonl", Question)
    for place, (key, variant) in enumerate(params.plan.variants.items()):
        said = []
        for number, question in enumerate(questions):
            if variant.opd is Opd.NONE or question.dialogue(variant.opd) is None:
                continue
            kinds[key, question.question_id] = kind = KINDS[(number * number + place) % len(KINDS)]
            outputs = _answer(question, variant.opd, kind)
            said.append(_said(question, *outputs))
        if said:
            write_jsonl(folder / "data" / "answers" / key / "predictions.jsonl", said)
            write_table(folder / "data" / "scores" / key / "scores.parquet", Score, grade(questions, said, CATALOGUE))
    write_text(folder / "base" / "gate.csv", GATE)
    write_report(params, folder)
    return folder


def _rows(root: Path, params: Params) -> list[dict[str, str]]:
    file = root / "reports" / params.report_name / "language" / "reasoning.csv"
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_every_variant_that_describes_has_a_row_a_task(root: Path, params: Params) -> None:
    table = _rows(root, params)
    keys = [(r["encoder"], r["lora"], r["opd"], r["task"]) for r in table]
    assert len(set(keys)) == len(keys) == 2 * 2 * 2 * 4
    assert {k[2] for k in keys} == {"needed", "all"}
    assert {k[3] for k in keys} == set(CONCLUDING)
    page = (root / "reports" / params.report_name / "README.md").read_text()
    section = page.split("## Touch or reasoning: where answers go wrong\n")[1].split("\n## ")[0]
    assert section.count("\n| finetuned | ") == section.count("\n| base | ") == 2 * 2 * 4


def test_shares_are_those_of_the_answers_that_were_made_up(
    root: Path, params: Params, kinds: dict[tuple[str, str], Kind]
) -> None:
    questions = {q.question_id: q for q in read_jsonl(root / "data" / "questions" / "evaluation.jsonl", Question)}
    for row in _rows(root, params):
        keys = ["-".join((row["encoder"], row["lora"], row["opd"], seed)) for seed in ("0", "3")]
        every = [(q, kinds[k, q]) for k, q in kinds if k in keys and questions[q].task == row["task"]]
        assert int(row["n"]) == len({q for q, _ in every}) == len(every) / 2
        assert float(row["accuracy"]) == pytest.approx(fmean(right for _, (_, right) in every), abs=1e-4)
        assert float(row["described"]) == pytest.approx(fmean(said is True for _, (said, _) in every), abs=1e-4)
        assert float(row["missing"]) == pytest.approx(fmean(said is None for _, (said, _) in every), abs=1e-4)
        for name, wanted in (("concluded", True), ("otherwise", False)):
            by_question: dict[str, list[bool]] = defaultdict(list)
            for question, (said, right) in every:
                if (said is True) is wanted:
                    by_question[question].append(right)
            shares = [Outcome(fmean(v), questions[q].objects) for q, v in by_question.items()]
            assert int(row[f"{name}_n"]) == len(shares)
            if not shares:
                assert row[name] == row[f"{name}_low"] == ""
                continue
            assert float(row[name]) == pytest.approx(fmean(s.correct for s in shares), abs=1e-4)
            interval = clustered(shares)
            found = row[f"{name}_low"], row[f"{name}_high"]
            if interval is None:
                assert found == ("", "")
            else:
                assert [float(end) for end in found] == pytest.approx([interval.low, interval.high], abs=1e-4)


def test_the_base_models_gate_stands_beside_every_row(root: Path, params: Params) -> None:
    marks = {(row["task"], row["gate"]) for row in _rows(root, params)}
    assert marks == {("PC", "passed"), ("PSS", ""), ("POM", "facts told"), ("PSR", FAILED)}


def test_without_answers_or_descriptions_there_is_no_table(tmp_path: Path) -> None:
    params = fake_params("ablation.plan=factorial", "ablation.counterfactuals=[]")
    write_chain(tmp_path, params)
    for key, variant in params.plan.variants.items():
        if variant.opd is not Opd.NONE:
            (tmp_path / "data" / "answers" / key / "predictions.jsonl").unlink()
    write_report(params, tmp_path)
    assert not (tmp_path / "reports" / params.report_name / "language" / "reasoning.csv").exists()

"""Questions that others answer: what is exported, what is taken back, and what it says in a report."""

import json
import runpy
from pathlib import Path

import pytest

from pipeline.core.io import read_jsonl
from pipeline.core.layout import questions_file
from pipeline.core.records import Opd, Question
from pipeline.report.load import load_report
from pipeline.tasks import TASKS
from tests.conftest import ROOT, octopi, refused
from tests.fake_run import fake_params, write_run

FEW = ("ablation.encoders=[finetuned]", "ablation.touch=[]", "questions.evaluation={opd:4,pc:4,pss:4,pom:4,psr:4}")


@pytest.mark.slow
def test_right_answers_are_right_and_no_answer_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    params = write_run(tmp_path, fake_params(*FEW))
    assert "questions" in octopi("questions", "export", "asked.jsonl")
    asked = [json.loads(line) for line in Path("asked.jsonl").read_text().splitlines()]
    built = {q.question_id: q for q in read_jsonl(questions_file(0), Question)}
    assert [row["id"] for row in asked] == [*built]
    told = []
    for row in asked:
        dialogue = built[row["id"]].dialogue(Opd.ALL)
        assert dialogue
        assert row.keys() == {"id", "task", "turns", "videos"}
        assert row["turns"] == [turn.user for turn in dialogue.turns]
        assert sum(turn.count("{tactile}") for turn in row["turns"]) == len(row["videos"])
        assert not any(turn.assistant in json.dumps(row) for turn in dialogue.turns)
        told.append({"id": row["id"], "text": dialogue.turns[-1].assistant})
    # As other writers have it: a separator of Unicode stands for itself, and ends no line.
    told[0]["text"] = "Well.\u2028" + told[0]["text"]
    rows = [json.dumps(row, ensure_ascii=False) for row in told]
    Path("told.jsonl").write_text("\n".join(rows), encoding="utf-8")
    assert f"{len(built)} answers" in octopi("questions", "grade", "told.jsonl", "--name", "their-model")
    for stage in ("grade", "report"):
        runpy.run_path(str(ROOT / "stages" / f"{stage}.py"), run_name="__main__")
    report = load_report(Path("reports") / params.report_name)
    rows = report.scores.query("encoder == 'their-model' and seed == 'all'")
    whole = rows[[m == TASKS[t].measure for t, m in zip(rows["task"], rows["measure"], strict=True)]]
    assert set(whole["task"]) == {q.task for q in built.values()}
    assert (rows["accuracy"] == 1).all()
    assert "| their-model, answered outside this project |" in (report.folder / "README.md").read_text()

    first, *others, last = told
    for words, lines in (
        (rf"{last['id']} has no answer \(1 question in all", told[:-1]),
        (f"line 2: {first['id']} is answered twice", [first, first]),
        ("PC-none is none of this run's questions", [*told, {"id": "PC-none", "text": ""}]),
        ("line 1: .*write id and text", ["yes"]),
        ("3 texts for", [{**first, "text": ["a", "b", "c"]}, *others, last]),
    ):
        Path("wrong.jsonl").write_text("\n".join(map(json.dumps, lines)))
        with refused(words):
            octopi("questions", "grade", "wrong.jsonl", "--name", "other")
    with refused("--name a/b"):
        octopi("questions", "grade", "told.jsonl", "--name", "a/b")
    with refused("nowhere.jsonl: cannot be read"):
        octopi("questions", "grade", "nowhere.jsonl", "--name", "other")
    assert [folder.name for folder in Path("external", params.report_name).iterdir()] == ["their-model"]

"""`octopi answer-with` through OpenAI's client, in front of an endpoint that answers well, badly, or not at all."""

import functools
import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx2
import numpy as np
import openai
import pytest
from PIL import Image
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.io import read_jsonl, read_table, write_jsonl
from pipeline.core.records import Dialogue, Opd, Part, Prediction, Question, Turn
from pipeline.evaluation.answer_with import instruction
from pipeline.evaluation.pictures import frames
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.report.load import load_report
from pipeline.running.errors import UserError
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment
from tests.closure import ROOT, closure
from tests.encoders import write_frames
from tests.fake_run import fake_params, write_run

pytestmark = pytest.mark.slow
URL, KEY = "http://127.0.0.1:1/v1", "sk-a-key-that-nobody-may-see"
PLACE = Path("external/smoke-scenes/some-maker-sees-1-frames")
FRAMES, QUESTIONS = Path("data/frames"), Path("data/questions/0")


def reply(content: Any, ended: Any = "stop", refusal: Any = None, **more: Any) -> httpx2.Response:
    message = {"role": "assistant", "content": content, "refusal": refusal}
    choices = [{"index": 0, "message": message, "finish_reason": ended}]
    usage = {"prompt_tokens": 9, "completion_tokens": 5, "total_tokens": 14}
    whole = {"id": "1", "object": "chat.completion", "created": 1, "model": "sees-1-of-may", "usage": usage}
    return httpx2.Response(200, json={**whole, "choices": choices, **more})


def turns() -> list[tuple[Question, int, Turn]]:
    """What has to be asked, in order."""
    asked = read_jsonl(QUESTIONS / "evaluation.jsonl", Question)
    return [(q, n, t) for q in asked for d in q.dialogues if d.opd is Opd.ALL for n, t in enumerate(d.turns)]


def right(n: int) -> httpx2.Response:
    return reply(turns()[n][2].assistant)


@pytest.fixture
def endpoint(tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Keeps what it is sent, in `bodies`, and answers the n-th request (from 0) as the test's `step` says.

    The working directory has a run down to its answers, with frames of noise of the test videos.
    """
    monkeypatch.chdir(tmp_path)
    full = ("ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[all]", "ablation.touch=[]")
    write_run(tmp_path, fake_params(*full, "questions.evaluation={opd:2,pc:2,pss:2,pom:2,psr:2}"))
    split = read_table(Path("data/splits/0.parquet"), Assignment)
    pool, counts = pool_of(Part.TRAIN, split, catalogue), {"PC": 9, "PSS": 1, "POM": 12}
    write_jsonl(QUESTIONS / "train.jsonl", build_questions(pool, counts, seed=0, distinct=True))
    videos = sorted(a.video_id for a in split if a.part is Part.TEST)
    write_frames(FRAMES, {video: (7, 3, 1)[n % 3] for n, video in enumerate(videos)}, side=16)
    endpoint = SimpleNamespace(step=right, bodies=[])

    def answer(request: httpx2.Request) -> httpx2.Response:
        assert (request.url.path, request.headers["Authorization"]) == ("/v1/chat/completions", f"Bearer {KEY}")
        endpoint.bodies.append(json.loads(request.content))
        found = endpoint.step(len(endpoint.bodies) - 1)
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    client = httpx2.Client(transport=httpx2.MockTransport(answer))
    monkeypatch.setattr(openai, "OpenAI", functools.partial(openai.OpenAI, http_client=client, max_retries=0))
    return endpoint


def run(*more: str, refused: bool = False) -> str:
    """Run the command; what it said, in one line."""
    usual = ["answer-with", "--endpoint", URL, "--model", "some-maker/sees-1", "--input", "frames"]
    done = CliRunner().invoke(app, [*usual, *more])
    assert isinstance(done.exception, UserError) if refused else done.exit_code == 0, (done.output, done.exception)
    said = str(done.exception) if refused else done.output.strip()
    assert "\n" not in said
    assert KEY not in said
    return said


def graded() -> list[GradedVision]:
    runpy.run_path(str(ROOT / "stages" / "grade.py"), run_name="__main__")
    return read_table(Path("data/graded_vision.parquet"), GradedVision)


def test_frames_and_questions_arrive_and_become_report_rows(endpoint: SimpleNamespace, catalogue: Catalogue) -> None:
    """Of the two comparisons one reply is wrong and cannot be read; all others are right."""
    wrong = [question.task for question, _, _ in turns()].index("PC")
    endpoint.step = lambda n: reply("Perhaps.") if n == wrong else right(n)
    assert run() == f"{PLACE}: 10 questions answered by 12 requests (12 stop); `dvc repro` grades them"
    show, training = frames(FRAMES, [], 5), read_jsonl(QUESTIONS / "train.jsonl", Question)
    for (question, number, turn), body in zip(turns(), endpoint.bodies, strict=True):
        assert (body["model"], body["temperature"], body["max_completion_tokens"]) == ("some-maker/sees-1", 0, 1024)
        assert [m["role"] for m in body["messages"]] == ["user", "assistant", "user"][: 2 * number + 1]
        text = turn.user if number else instruction(catalogue, Shown.FRAMES, training, question.task) + turn.user
        pictures = [] if number else [show(video) for video in question.videos]
        assert text.count("{tactile}") == len(pictures)
        for own in pictures:
            text = text.replace("{tactile}", "#" * len(own), 1)
        content = body["messages"][-1]["content"]
        assert "".join(part.get("text", "#") for part in content) == text
        shown = [part["image_url"]["url"] for part in content if "text" not in part]
        assert shown == [url for own in pictures for url in own]
    second = [n for _, n, _ in turns()].index(1)
    assert endpoint.bodies[second]["messages"][0] == endpoint.bodies[second - 1]["messages"][0]
    assert {(s.task, s.parsed) for s in graded() if not s.correct} == {("PC", False)}
    runpy.run_path(str(ROOT / "stages" / "report.py"), run_name="__main__")
    report = load_report(Path("reports/smoke-scenes"))
    rows = report.scores[report.scores["encoder"].eq("some-maker/sees-1") & report.scores["seed"].eq("all")]
    found = {r["task"]: (r["touch"], r["n"], r["accuracy"], r["unread"]) for r in rows.to_dict("records")}
    assert found == {**dict.fromkeys(("OPD", "PSS", "POM", "PSR"), ("frames", 2, 1, 0)), "PC": ("frames", 2, 0.5, 1)}
    (source,) = report.provenance["vision"]
    assert (source["endpoint"], source["served_as"], source["ended"]) == (URL, ["sees-1-of-may"], {"stop": 12})
    assert set(report.effects["part"]) <= {"language"}, "what parts bring is about our own system alone"
    assert not [f for f in PLACE.iterdir() if KEY.encode() in f.read_bytes()]


def twice(dialogue: Dialogue) -> Dialogue:
    return dialogue.model_copy(update={"turns": 2 * dialogue.turns})


def test_examples_are_the_first_of_each_answer_at_most_three(endpoint: SimpleNamespace, catalogue: Catalogue) -> None:
    training = read_jsonl(QUESTIONS / "train.jsonl", Question)
    longer = [q.model_copy(update={"dialogues": (*map(twice, q.dialogues),)}) for q in training]
    for task, count in {"PC": 3, "PSS": 1, "POM": 3, "PSR": 0}.items():
        first = {q.gold.choice: q for q in reversed(training) if q.task == task}
        chosen = sorted(first.values(), key=training.index)[:count]
        text = instruction(catalogue, Shown.FRAMES, [*longer, *training], task)
        replies = [t.assistant for q in chosen for d in q.dialogues if d.opd is Opd.ALL for t in d.turns]
        assert re.findall(r"\nAnswer: (.*?)(?=\nQuestion: |\nNow the)", text, re.DOTALL) == replies
        assert all(f"{p.spoken} ({', '.join(p.levels)})" in text for p in catalogue.properties)
        assert "{tactile}" not in text


FAILURES = {
    r"401.*Incorrect key: \[key\]": httpx2.Response(401, json={"error": {"message": f"Incorrect key: {KEY}"}}),
    "Welcome.*URL": httpx2.Response(200, html="<html>\n<p>Welcome"),
    "no chat completion": reply("", choices=[]),
    "nobody listens": httpx2.ConnectError("nobody listens"),
}


@pytest.mark.parametrize("words", FAILURES)
def test_a_failing_endpoint_is_one_line_and_loses_nothing(endpoint: SimpleNamespace, words: str) -> None:
    """Not even where the run was killed while it wrote a reply: that one is asked for again."""
    endpoint.step = lambda n: right(n) if n < 4 else FAILURES[words]
    assert re.search(f"^{URL}: .*{words}", run(refused=True))
    assert len(endpoint.bodies) == 5, "nothing is asked after that"
    lines = (PLACE / "cache.jsonl").read_bytes().splitlines(keepends=True)
    (PLACE / "cache.jsonl").write_bytes(b"".join(lines[:3]) + lines[3][: len(lines[3]) // 2])
    endpoint.step = lambda n: right(n - 2)
    assert "10 questions answered by 9 requests" in run()
    assert endpoint.bodies[5] == endpoint.bodies[3]
    assert all(s.correct for s in graded())
    assert "by 0 requests" in run()


SAYS_NOTHING = {
    "nothing": reply(" \n"),
    "refusal": reply(None, refusal="I will not."),
    "length": reply(None, "length", usage=None),
    "content_filter": httpx2.Response(400, json={"error": {"message": "no", "code": "content_filter"}}),
}


@pytest.mark.parametrize("ended", SAYS_NOTHING)
def test_no_answer_is_counted_and_not_asked_for_again(endpoint: SimpleNamespace, ended: str) -> None:
    # A question of one turn, and the first of two turns: nobody asks the second.
    tasks = [question.task for question, _, _ in turns()]
    spoilt = [tasks.index("PC"), tasks.index("PSR")]
    order = [i for i in range(12) if i != spoilt[1] + 1]
    endpoint.step = lambda n: SAYS_NOTHING[ended] if order[n] in spoilt else right(order[n])
    assert re.search(f"by 11 requests .*2 {ended}", run())
    assert re.search(f"by 0 requests .*2 {ended}", run())
    lost = {turns()[i][0].question_id for i in spoilt}
    assert {s.question_id for s in graded() if not s.parsed} == lost
    said = {p.question_id: p for p in read_jsonl(PLACE / "0.jsonl", Prediction)}
    assert sorted(said[i].outputs for i in lost) == [("",), ("", "")]
    assert {said[i].truncated for i in lost} == {ended == "length"}


def test_outdated_answers_are_left_out_aloud(endpoint: SimpleNamespace, caplog: pytest.LogCaptureFixture) -> None:
    run()
    for expected in (0, 10):  # The other way round, and back.
        write_jsonl(QUESTIONS / "evaluation.jsonl", read_jsonl(QUESTIONS / "evaluation.jsonl", Question)[::-1])
        assert len({s.question_id for s in graded()}) == expected
    assert f"{PLACE}: no answers to the questions of seed 0 as they are now" in caplog.text
    np.save(FRAMES / "references.npy", np.ones(3))
    assert graded() == []
    assert f"{PLACE}: saw other frames than there are now; run `octopi answer-with` again" in caplog.text
    (PLACE / "source.json").write_text("{}")
    with pytest.raises(SystemExit, match=r"source.json: does not say who answered; run `octopi answer-with` again"):
        graded()


def test_photos_by_command_and_what_is_missing(endpoint: SimpleNamespace) -> None:
    assert "name the folder" in run("--input", "photos", refused=True)
    assert "OPENAI_API_KEY" in run("--endpoint", f"https://example.org/v1?key={KEY}", refused=True)
    assert endpoint.bodies == []
    # Unlike pictures: a request that is the same again has its answer already.
    for shade, name in enumerate({o for question, _, _ in turns() for o in question.objects}):
        Image.new("L", (8, 8), shade).save(f"{name}.png")
    run("--input", "photos", ".")
    assert all(s.shown is Shown.PHOTOS and s.correct for s in graded())


def test_no_stage_can_ask_a_network() -> None:
    for name in ("grade", "report"):
        assert "pipeline/evaluation/answer_with.py" not in closure(ROOT / "stages" / f"{name}.py")

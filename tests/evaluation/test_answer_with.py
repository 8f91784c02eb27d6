"""`octopi answer-with` through OpenAI's client, in front of an endpoint that answers well, badly, or not at all."""

from __future__ import annotations

import base64
import functools
import io
import itertools
import json
import re
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import openai
import pytest
from PIL import Image
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.io import read_jsonl, read_table, write_jsonl, write_table
from pipeline.core.records import Opd, Part, Prediction, Question, Turn
from pipeline.evaluation.answer_with import instruction
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.report.load import Report, load_report
from pipeline.running.errors import UserError
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Frame
from tests.closure import ROOT, closure
from tests.fake_run import fake_params, write_run

pytestmark = pytest.mark.slow
URL, KEY = "http://127.0.0.1:1/v1", "sk-a-key-that-nobody-may-see"
PLACE = Path("external/smoke-scenes/some-maker-sees-1-frames")
KEPT = (7, 3, 1)
"""Frames that were kept of the first, second and third video, and so on."""
DRAWN = {7: [0, 1, 2, 4, 5], 3: [0, 1, 2], 1: [0]}
"""Of so many, five at uniform intervals from the first, each once."""


class Endpoint:
    """Keeps what it is sent, and answers the n-th request (from 0) as the test's `step` says."""

    def __init__(self) -> None:
        self.step: Callable[[int], httpx2.Response | Exception] = lambda n: reply("I cannot tell.")
        self.bodies: list[dict[str, Any]] = []

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        assert request.url.path == "/v1/chat/completions"
        assert request.headers["Authorization"] == f"Bearer {KEY}"
        self.bodies.append(json.loads(request.content))
        answer = self.step(len(self.bodies) - 1)
        if isinstance(answer, Exception):
            raise answer
        return answer


def reply(content: Any, ended: Any = "stop", refusal: Any = None, **more: Any) -> httpx2.Response:
    message = {"role": "assistant", "content": content, "refusal": refusal}
    choices = [{"index": 0, "message": message, "finish_reason": ended}]
    usage = {"prompt_tokens": 9, "completion_tokens": 5, "total_tokens": 14}
    whole = {"id": "1", "object": "chat.completion", "created": 1, "model": "sees-1-of-may", "usage": usage}
    return httpx2.Response(200, json={**whole, "choices": choices, **more})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, catalogue: Catalogue) -> Path:
    """A run down to its answers, with frames of noise for the videos of the test objects."""
    root = tmp_path_factory.mktemp("run")
    full = ("ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[all]", "ablation.touch=[]")
    params = write_run(root, fake_params(*full, "questions.evaluation={opd:2,pc:2,pss:2,pom:2,psr:2}"))
    assert params.frames.per_video == 5
    data = root / "data"
    split = read_table(data / "splits" / "0.parquet", Assignment)
    training = build_questions(
        pool_of(Part.TRAIN, split, catalogue), {"PC": 9, "PSS": 1, "POM": 12}, seed=0, distinct=True
    )
    write_jsonl(data / "questions" / "0" / "train.jsonl", training)
    videos = sorted(a.video_id for a in split if a.part is Part.TEST)
    kept = [(v, i) for n, v in enumerate(videos) for i in range(KEPT[n % 3])]
    frames = [Frame(video_id=v, frame_index=2 * i, score=0, row=row) for row, (v, i) in enumerate(kept)]
    write_table(data / "frames" / "frames.parquet", Frame, frames)
    pixels = np.random.default_rng(0).integers(0, 256, (len(kept), 16, 16, 3), np.uint8)
    np.save(data / "frames" / "frames.npy", pixels)
    return root


@pytest.fixture
def endpoint(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Endpoint:
    """It, and a copy of the run as the working directory."""
    shutil.copytree(made, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    endpoint = Endpoint()
    client = httpx2.Client(transport=httpx2.MockTransport(endpoint))
    monkeypatch.setattr(openai, "OpenAI", functools.partial(openai.OpenAI, http_client=client, max_retries=0))
    return endpoint


def asked() -> list[Question]:
    return read_jsonl(Path("data/questions/0/evaluation.jsonl"), Question)


def turns() -> list[tuple[Question, int, Turn]]:
    """What has to be asked, in order."""
    return [(q, n, t) for q in asked() for d in q.dialogues if d.opd is Opd.ALL for n, t in enumerate(d.turns)]


def right(n: int) -> httpx2.Response:
    return reply(turns()[n][2].assistant)


def run(*more: str, shown: str = "frames", refused: bool = False, url: str = URL) -> str:
    """Run the command; what it said, in one line."""
    arguments = ["answer-with", "--endpoint", url, "--model", "some-maker/sees-1", "--input", shown, *more]
    done = CliRunner().invoke(app, arguments)
    assert isinstance(done.exception, UserError) if refused else done.exit_code == 0, (done.output, done.exception)
    said = str(done.exception) if refused else done.output.strip()
    assert "\n" not in said
    assert KEY not in said
    return said


def shown_in(content: list[dict[str, Any]]) -> tuple[str, list[list[Image.Image]]]:
    """The text of a message with `{tactile}` for each run of pictures, and these pictures."""
    text, pictures = "", []
    for kind, parts in itertools.groupby(content, lambda part: part["type"]):
        if kind == "text":
            text += "".join(part["text"] for part in parts)
        else:
            urls = [re.fullmatch(r"data:image/(png|jpeg);base64,(.*)", part["image_url"]["url"]) for part in parts]
            pictures.append([Image.open(io.BytesIO(base64.b64decode(url[2])), formats=[url[1]]) for url in urls])
            text += "{tactile}"
    return text, pictures


def graded() -> list[GradedVision]:
    runpy.run_path(str(ROOT / "stages" / "grade.py"), run_name="__main__")
    return read_table(Path("data/graded_vision.parquet"), GradedVision)


def reported() -> Report:
    runpy.run_path(str(ROOT / "stages" / "report.py"), run_name="__main__")
    return load_report(Path("reports/smoke-scenes"))


def test_frames_and_questions_arrive_whole_and_become_rows_of_the_report(
    endpoint: Endpoint, catalogue: Catalogue
) -> None:
    """Of the two comparisons one reply is wrong and cannot be read; all others are right."""
    wrong = [question.task for question, _, _ in turns()].index("PC")
    endpoint.step = lambda n: reply("Perhaps.") if n == wrong else right(n)
    assert run() == f"{PLACE}: 10 questions answered by 12 requests (12 stop); `dvc repro` grades them"
    pixels, index = np.load("data/frames/frames.npy"), read_table(Path("data/frames/frames.parquet"), Frame)
    training = read_jsonl(Path("data/questions/0/train.jsonl"), Question)
    for (question, number, turn), body in zip(turns(), endpoint.bodies, strict=True):
        assert (body["model"], body["temperature"], body["max_completion_tokens"]) == ("some-maker/sees-1", 0, 1024)
        assert [m["role"] for m in body["messages"]] == ["user", "assistant", "user"][: 2 * number + 1]
        before = "" if number else instruction(catalogue, Shown.FRAMES, training, question.task)
        text, pictures = shown_in(body["messages"][-1]["content"])
        assert text == before + turn.user
        assert len(pictures) == turn.user.count("{tactile}") == (0 if number else len(question.videos))
        for video, found in zip(question.videos, pictures, strict=False):
            rows = [f.row for f in index if f.video_id == video]
            np.testing.assert_array_equal([np.asarray(p) for p in found], [pixels[rows[i]] for i in DRAWN[len(rows)]])
    second = [n for _, n, _ in turns()].index(1)
    assert endpoint.bodies[second]["messages"][0] == endpoint.bodies[second - 1]["messages"][0]
    scores, report = graded(), reported()
    assert len(scores) == 2 * 4 + 8
    assert {(s.task, s.parsed) for s in scores if not s.correct} == {("PC", False)}
    assert not [f for f in PLACE.iterdir() if KEY.encode() in f.read_bytes()]
    rows = report.scores[report.scores["encoder"].eq("some-maker/sees-1") & report.scores["seed"].eq("all")]
    found = {(r["task"], r["measure"]): (r["n"], r["accuracy"], r["unread"]) for r in rows.to_dict("records")}
    whole = dict.fromkeys((("PSS", "choice"), ("POM", "choice"), ("PSR", "choice"), ("OPD", "combined")), (2, 1.0, 0))
    assert {**whole, ("PC", "choice"): (2, 0.5, 1)}.items() <= found.items()
    assert set(rows["touch"]) == {"frames"}
    (source,) = report.provenance["vision"]
    assert (source["endpoint"], source["served_as"], source["ended"]) == (URL, ["sees-1-of-may"], {"stop": 12})
    assert set(report.effects["part"]) <= {"language"}, "what parts bring is about our own system alone"


def test_examples_are_the_first_of_each_answer_and_at_most_three(endpoint: Endpoint, catalogue: Catalogue) -> None:
    training = read_jsonl(Path("data/questions/0/train.jsonl"), Question)
    for task, count in {"PC": 3, "PSS": 1, "POM": 3, "PSR": 0}.items():
        first = {q.gold.choice: q for q in reversed(training) if q.task == task}
        chosen = sorted(first.values(), key=training.index)[:count]
        text = instruction(catalogue, Shown.FRAMES, training, task)
        replies = [t.assistant for q in chosen for d in q.dialogues if d.opd is Opd.ALL for t in d.turns]
        assert re.findall(r"\nAnswer: (.*?)(?=\nQuestion: |\nNow the)", text, re.DOTALL) == replies
        assert all(f"{p.spoken} ({', '.join(p.levels)})" in text for p in catalogue.properties)
        assert "{tactile}" not in text


FAILURES = {
    "key": (httpx2.Response(401, json={"error": {"message": f"Incorrect key: {KEY}"}}), r"401.*Incorrect key: \[key\]"),
    "a page": (httpx2.Response(200, html="<html>\n<p>Welcome"), "Welcome.*URL"),
    "no choice": (reply("", choices=[]), "no chat completion"),
    "nobody": (httpx2.ConnectError("nobody listens"), "nobody listens"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_failing_endpoint_is_one_line_and_loses_nothing(endpoint: Endpoint, name: str) -> None:
    """Not even where the run was killed while it wrote a reply: that one is asked for again."""
    failure, words = FAILURES[name]
    endpoint.step = lambda n: right(n) if n < 4 else failure
    assert re.search(f"^{URL}: .*{words}", run(refused=True))
    assert len(endpoint.bodies) == 5, "nothing is asked after that"
    cache = PLACE / "cache.jsonl"
    lines = cache.read_bytes().splitlines(keepends=True)
    cache.write_bytes(b"".join(lines[:3]) + lines[3][: len(lines[3]) // 2])
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
def test_no_answer_is_counted_and_not_asked_for_again(endpoint: Endpoint, ended: str) -> None:
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


@pytest.fixture
def photos(endpoint: Endpoint) -> Path:
    """Of each object photos in a colour of its own: of one three files in a folder, of the others a file."""
    folder = Path("my photos")
    for number, name in enumerate(sorted({o for q in asked() for o in q.objects})):
        colour = (20 + 60 * number % 230, 40, 90 * number % 200)
        (folder / name).mkdir(parents=True)
        if number:
            exif = Image.Exif()
            exif[0x0112], exif[0x010F] = 6, "A camera's maker"
            Image.new("RGB", (2000, 1000), colour).save(folder / f"{name}.JPG", format="JPEG", exif=exif)
        else:
            for i in range(7):
                Image.new("RGB", (8, 8 + i), colour).save(folder / name / f"{i}.png")
            (folder / name / ".hidden.png").write_bytes(b"")
            (folder / name / "notes.txt").write_text("no picture")
    return folder


def test_photos_stand_in_place_of_the_videos_of_their_objects(photos: Path, endpoint: Endpoint) -> None:
    endpoint.step = right
    run(str(photos), shown="photos")
    objects, seen = sorted({o for q in asked() for o in q.objects}), set()
    for (question, number, turn), body in zip(turns(), endpoint.bodies, strict=True):
        text, pictures = shown_in(body["messages"][-1]["content"])
        assert text.endswith(turn.user)
        for name, found in zip(question.objects if number == 0 else (), pictures, strict=True):
            place = objects.index(name)
            seen.add(place)
            sizes = [(512, 1024)] if place else [(8, 8 + i) for i in DRAWN[7]]
            assert [p.size for p in found] == sizes, "upright, no larger than need be, five of seven"
            for picture in found:
                wanted = (20 + 60 * place % 230, 40, 90 * place % 200)
                np.testing.assert_allclose(np.asarray(picture).mean((0, 1)), wanted, atol=3)
                assert not picture.getexif()
    assert {0, 1} <= seen
    assert all(s.shown is Shown.PHOTOS and s.correct for s in graded())


def test_bad_inputs(photos: Path, endpoint: Endpoint) -> None:
    """Each is one line that names the file or the option, and asks nothing."""
    name = sorted({o for q in asked() for o in q.objects})[1]
    (photos / f"{name}.JPG").write_bytes(b"no picture")
    endpoint.step = right
    assert f"{name}.JPG: not a picture" in run(str(photos), shown="photos", refused=True)
    (photos / f"{name}.JPG").unlink()
    before = len(endpoint.bodies)
    assert f"no photo of {name};" in run(str(photos), shown="photos", refused=True)
    assert "name the folder" in run(shown="photos", refused=True)
    write_table(Path("other/frames.parquet"), Frame, [])
    np.save("other/frames.npy", np.zeros((0, 16, 16, 3), np.uint8))
    assert "no frame of" in run("other", refused=True)
    assert "OPENAI_API_KEY" in run(refused=True, url=f"https://example.org/v1?key={KEY}")
    assert len(endpoint.bodies) == before


def test_answers_to_other_questions_or_frames_are_left_out_aloud(
    endpoint: Endpoint, caplog: pytest.LogCaptureFixture
) -> None:
    run()
    write_jsonl(Path("data/questions/0/evaluation.jsonl"), asked()[::-1])
    assert graded() == []
    assert f"{PLACE}: no answers to the questions of seed 0 as they are now" in caplog.text
    assert reported().provenance["vision"] == []
    write_jsonl(Path("data/questions/0/evaluation.jsonl"), asked()[::-1])
    assert graded() != []
    np.save("data/frames/references.npy", np.ones(3))
    assert graded() == []
    assert f"{PLACE}: saw other frames than there are now; run `octopi answer-with` again" in caplog.text
    Path(PLACE / "source.json").write_text("{}")
    with pytest.raises(SystemExit, match=r"source.json: does not say who answered; run `octopi answer-with` again"):
        graded()


def test_no_stage_can_ask_a_network() -> None:
    for name in ("grade", "report"):
        assert "pipeline/evaluation/answer_with.py" not in closure(ROOT / "stages" / f"{name}.py")

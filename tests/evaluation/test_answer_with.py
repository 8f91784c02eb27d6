"""`octopi answer-with` against a server on this machine that speaks the protocol: well, badly, or not at all."""

from __future__ import annotations

import base64
import io
import json
import re
import runpy
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
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
from tests.conftest import deaf_port
from tests.fake_run import fake_params, write_run

pytestmark = pytest.mark.slow
KEY = "sk-a-key-that-nobody-may-see"
PLACE = Path("external/smoke-scenes/some-maker-sees-1-frames")
KEPT = (7, 3, 1)
"""Frames that were kept of the first, second and third video, and so on."""
DRAWN = {7: [0, 1, 2, 4, 5], 3: [0, 1, 2], 1: [0]}
"""Of so many, five at uniform intervals from the first, each once."""
Response = tuple[int, dict[str, str], bytes]
Step = Callable[[int], Response]


class Server:
    """Keeps what it is sent, and answers the n-th request (from 0) as the test's `step` says."""

    def __init__(self) -> None:
        self.step: Step = lambda n: reply("I cannot tell.")
        self.bodies: list[dict[str, Any]] = []
        self.headers: list[Any] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                outer.bodies.append(body)
                outer.headers.append(self.headers)
                status, headers, content = outer.step(len(outer.bodies) - 1)
                # A client may wait no more.
                with suppress(OSError):
                    self.send_response(status)
                    for name, value in {"Content-Length": str(len(content)), **headers}.items():
                        self.send_header(name, value)
                    self.end_headers()
                    self.wfile.write(content)

            def log_message(self, *_: Any) -> None: ...

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/v1"


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    thread = threading.Thread(target=server.http.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.http.shutdown()
    thread.join()
    server.http.server_close()


def as_json(content: Any, status: int = 200, **headers: str) -> Response:
    return status, {"Content-Type": "application/json", **headers}, json.dumps(content).encode()


def answered(message: Any, ended: Any = "stop", **more: Any) -> Response:
    choices = [{"index": 0, "message": message, "finish_reason": ended}]
    usage = {"prompt_tokens": 9, "completion_tokens": 5, "total_tokens": 14}
    whole = {"id": "1", "object": "chat.completion", "created": 1, "model": "sees-1-of-may", "usage": usage}
    return as_json({**whole, "choices": choices, **more})


def reply(content: Any, ended: Any = "stop", **more: Any) -> Response:
    return answered({"role": "assistant", "content": content}, ended, **more)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, catalogue: Catalogue) -> Path:
    """A run down to its answers, with frames of noise for the videos of the test objects."""
    root = tmp_path_factory.mktemp("run")
    full = ("ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[all]", "ablation.touch=[]")
    params = write_run(root, fake_params(*full, "questions.evaluation={opd:2,pc:2,pss:2,pom:2,psr:2}"))
    assert params.frames.per_video == 5
    data = root / "data"
    split = read_table(data / "splits" / "0.parquet", Assignment)
    pool = pool_of(Part.TRAIN, split, catalogue)
    training = build_questions(pool, {"PC": 9, "PSS": 1, "POM": 12}, seed=0, distinct=True)
    write_jsonl(data / "questions" / "0" / "train.jsonl", training)
    videos = sorted(a.video_id for a in split if a.part is Part.TEST)
    kept = [(v, i) for n, v in enumerate(videos) for i in range(KEPT[n % 3])]
    frames = [Frame(video_id=v, frame_index=2 * i, score=0, row=row) for row, (v, i) in enumerate(kept)]
    write_table(data / "frames" / "frames.parquet", Frame, frames)
    pixels = np.random.default_rng(0).integers(0, 256, (len(kept), 16, 16, 3), np.uint8)
    np.save(data / "frames" / "frames.npy", pixels)
    return root


@pytest.fixture
def project(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it as the working directory."""
    shutil.copytree(made, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    return tmp_path


def asked() -> list[Question]:
    return read_jsonl(Path("data/questions/0/evaluation.jsonl"), Question)


def turns() -> list[tuple[Question, int, Turn]]:
    """What has to be asked, in order."""
    return [(q, n, t) for q in asked() for d in q.dialogues if d.opd is Opd.ALL for n, t in enumerate(d.turns)]


def right(n: int) -> Response:
    return reply(turns()[n][2].assistant)


def run(server: Server, *more: str, shown: str = "frames", status: int = 0) -> str:
    """Run the command; what it said, in one line."""
    arguments = ["answer-with", "--endpoint", server.url, "--model", "some-maker/sees-1", "--input", shown, *more]
    done = CliRunner().invoke(app, arguments)
    if status:
        assert isinstance(done.exception, UserError), done.output
        said = str(done.exception)
    else:
        assert done.exit_code == 0, (done.output, done.exception)
        said = done.output.strip()
    assert "\n" not in said
    return said


def shown_in(content: list[dict[str, Any]]) -> tuple[str, list[list[Image.Image]]]:
    """The text of a message with `{tactile}` for each run of pictures, and these pictures."""
    text, pictures, last = "", [], "text"
    for part in content:
        if part["type"] == "text":
            text += part["text"]
        else:
            kind, _, data = part["image_url"]["url"].partition(";base64,")
            picture = Image.open(io.BytesIO(base64.b64decode(data, validate=True)))
            assert kind == f"data:image/{picture.format.lower()}"
            if last == "text":
                text += "{tactile}"
                pictures.append([])
            pictures[-1].append(picture)
        last = part["type"]
    return text, pictures


def graded() -> list[GradedVision]:
    runpy.run_path(str(ROOT / "stages" / "grade.py"), run_name="__main__")
    return read_table(Path("data/graded_vision.parquet"), GradedVision)


def reported() -> Report:
    runpy.run_path(str(ROOT / "stages" / "report.py"), run_name="__main__")
    return load_report(Path("reports/smoke-scenes"))


def test_frames_and_questions_arrive_whole(project: Path, server: Server, catalogue: Catalogue) -> None:
    server.step = right
    said = run(server)
    assert said == f"{PLACE}: 10 questions answered by 12 requests (12 stop); `dvc repro` grades them"
    pixels, index = np.load("data/frames/frames.npy"), read_table(Path("data/frames/frames.parquet"), Frame)
    training = read_jsonl(Path("data/questions/0/train.jsonl"), Question)
    kinds = {t: list(dict.fromkeys(q.gold.choice for q in training if q.task == t)) for t in ("PC", "PSS", "POM")}
    assert {t: len(found) for t, found in kinds.items()} == {"PC": 3, "PSS": 1, "POM": 6}
    first = {(q.task, q.gold.choice): q for q in reversed(training)}
    examples = {t: [first[t, c] for c in kinds[t][:3]] for t in kinds}
    for (question, number, turn), body in zip(turns(), server.bodies, strict=True):
        assert (body["model"], body["temperature"], body["max_completion_tokens"]) == ("some-maker/sees-1", 0, 1024)
        assert [m["role"] for m in body["messages"]] == ["user", "assistant", "user"][: 2 * number + 1]
        before = instruction(catalogue, Shown.FRAMES, examples.get(question.task, [])) if number == 0 else ""
        assert all(f"{p.spoken} ({', '.join(p.levels)})" in before for p in catalogue.properties) or number
        text, pictures = shown_in(body["messages"][-1]["content"])
        assert text == before + turn.user
        assert len(pictures) == turn.user.count("{tactile}") == (0 if number else len(question.videos))
        for video, found in zip(question.videos, pictures, strict=False):
            rows = [f.row for f in index if f.video_id == video]
            wanted = [pixels[rows[i]] for i in DRAWN[len(rows)]]
            np.testing.assert_array_equal([np.asarray(p) for p in found], wanted)
    second = [n for _, n, _ in turns()].index(1)
    before, after = (server.bodies[i]["messages"] for i in (second - 1, second))
    assert after[0] == before[0], "the first turn stands before the second as it was asked"
    assert {h["Authorization"] for h in server.headers} == {f"Bearer {KEY}"}
    predictions = read_jsonl(PLACE / "0.jsonl", Prediction)
    assert [p.question_id for p in predictions] == [q.question_id for q in asked()]
    scores = graded()
    assert len(scores) == 2 * 4 + 8
    assert all(s.correct and s.parsed and (s.model, s.shown) == ("some-maker/sees-1", "frames") for s in scores)
    assert not [f for f in PLACE.iterdir() if KEY.encode() in f.read_bytes()]


def test_published_prompts_ask_for_one_class_a_property(project: Path, server: Server, catalogue: Catalogue) -> None:
    # Medium is the middle class; who does not know, or names two, has told no class.
    told = ["Medium.", "smooth", "unknown", "It is hard", "rough or smooth", "no bumps"]
    server.step = lambda n: reply(told[n % 6])
    assert "2 questions answered by 6 requests" in run(server, "--prompt", "published")
    texts = [shown_in(body["messages"][0]["content"])[0] for body in server.bodies[:3]]
    assert all(len(body["messages"]) == 1 for body in server.bodies)
    choices = ("hard, soft or medium", "rough, smooth or medium", "having big bumps, small bumps or no bumps")
    told_of = "{tactile}Classify the object as %s? Respond unknown if you are not sure. Short answer:"
    assert texts == [told_of % classes for classes in choices]
    scores = {(s.question_id, s.measure): s for s in graded()}
    read = [{p.name: scores[q.question_id, p.name] for p in catalogue.properties} for q in asked() if q.task == "OPD"]
    assert {s.model for s in scores.values()} == {"some-maker/sees-1, published prompts"}
    assert [[s.parsed for s in found.values()] for found in read] == [[True, True, False], [True, False, True]]
    first, second = (catalogue.labels(q.objects[0]) for q in asked() if q.task == "OPD")
    assert [read[0]["hardness"].correct, read[0]["roughness"].correct] == [first[0] == 1, first[1] == 0]
    assert [read[1]["hardness"].correct, read[1]["bumpiness"].correct] == [second[0] == 2, second[2] == 0]


FAILURES: dict[str, tuple[Step, str]] = {
    "key": (lambda n: as_json({"error": {"message": f"Incorrect key: {KEY}"}}, 401), r"401.*Incorrect key: \[key\]"),
    "a page": (lambda n: (200, {"Content-Type": "text/html"}, b"<html>\n<p>Welcome"), "Welcome.*URL"),
    "no choice": (lambda n: answered(None, choices=[]), "no chat completion"),
}


@pytest.mark.parametrize("name", FAILURES)
def test_a_failing_endpoint_is_one_line_and_loses_nothing(project: Path, server: Server, name: str) -> None:
    """Not even where the run was killed while it wrote a reply: that one is asked for again."""
    failure, words = FAILURES[name]
    server.step = lambda n: right(n) if n < 4 else failure(n)
    said = run(server, status=1)
    assert re.search(f"^{server.url}: .*{words}", said), said
    assert KEY not in said
    assert len(server.bodies) == 5, "nothing is asked after that"
    cache = PLACE / "cache.jsonl"
    lines = cache.read_bytes().splitlines(keepends=True)
    cache.write_bytes(b"".join(lines[:3]) + lines[3][: len(lines[3]) // 2])
    server.step = lambda n: right(n - 2)
    assert "10 questions answered by 9 requests" in run(server)
    assert server.bodies[5] == server.bodies[3]
    assert all(s.correct for s in graded())
    server.http.server_close()
    assert "by 0 requests" in run(server), "what is known needs no server"


SAYS_NOTHING: dict[str, tuple[Response, str]] = {
    "empty": (reply(" \n"), "nothing"),
    "refused": (answered({"role": "assistant", "content": None, "refusal": "I will not."}), "refusal"),
    "thought too long": (reply(None, "length", usage=None), "length"),
    "status 400": (as_json({"error": {"message": "no", "code": "content_filter"}}, 400), "content_filter"),
}


@pytest.mark.parametrize("name", SAYS_NOTHING)
def test_no_answer_is_counted_and_not_asked_for_again(project: Path, server: Server, name: str) -> None:
    bad, ended = SAYS_NOTHING[name]
    # A question of one turn, and the first of two turns: nobody asks the second.
    tasks = [question.task for question, _, _ in turns()]
    spoilt = [tasks.index("PC"), tasks.index("PSR")]
    order = [i for i in range(12) if i != spoilt[1] + 1]
    server.step = lambda n: bad if order[n] in spoilt else right(order[n])
    assert re.search(f"by 11 requests .*2 {ended}", run(server))
    assert re.search(f"by 0 requests .*2 {ended}", run(server))
    lost = {turns()[i][0].question_id for i in spoilt}
    scores = graded()
    assert len(scores) == 16
    assert {s.question_id for s in scores if not s.parsed} == lost == {s.question_id for s in scores if not s.correct}
    said = {p.question_id: p for p in read_jsonl(PLACE / "0.jsonl", Prediction)}
    assert sorted(said[i].outputs for i in lost) == [("",), ("", "")]
    assert {said[i].truncated for i in lost} == {ended == "length"}


@pytest.fixture
def photos(project: Path) -> Path:
    """Of each object photos in a colour of its own: of one three files in a folder, of the others a file."""
    folder = project / "my photos"
    objects = sorted({o for q in asked() for o in q.objects})
    for number, name in enumerate(objects):
        colour = (20 + 60 * number % 230, 40, 90 * number % 200)
        if number:
            exif = Image.Exif()
            exif[0x0112], exif[0x010F] = 6, "A camera's maker"
            folder.mkdir(exist_ok=True)
            Image.new("RGB", (2000, 1000), colour).save(folder / f"{name}.JPG", format="JPEG", exif=exif)
        else:
            (folder / name).mkdir(parents=True)
            for i in range(7):
                Image.new("RGB", (8, 8 + i), colour).save(folder / name / f"{i}.png")
            (folder / name / ".hidden.png").write_bytes(b"")
            (folder / name / "notes.txt").write_text("no picture")
    return folder


def test_photos_stand_in_place_of_the_videos_of_their_objects(project: Path, photos: Path, server: Server) -> None:
    server.step = right
    run(server, str(photos), shown="photos")
    objects, seen = sorted({o for q in asked() for o in q.objects}), set()
    for (question, number, turn), body in zip(turns(), server.bodies, strict=True):
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


def test_the_published_prompts_show_each_sample_a_photo_of_its_own(project: Path, photos: Path, server: Server) -> None:
    """Of the first object there are seven photos, which differ in height."""
    one, name = next(q for q in asked() if q.task == "OPD"), min(o for q in asked() for o in q.objects)
    order = (4, 0, 1, 2, 6, 5, 3)
    of_one = [{"question_id": str(n), "videos": (f"{name}_{n}",), "objects": (name,)} for n in order]
    write_jsonl(Path("data/questions/0/evaluation.jsonl"), [one.model_copy(update=own) for own in of_one])
    run(server, str(photos), "--prompt", "published", shown="photos")
    pictures = [shown_in(body["messages"][0]["content"])[1] for body in server.bodies[::3]]
    assert [[p.height - 8 for p in found] for (found,) in pictures] == [[n] for n in order]


def test_bad_inputs(
    project: Path, photos: Path, server: Server, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is one line that names the file or the option, and asks nothing."""
    name = sorted({o for q in asked() for o in q.objects})[1]
    (photos / f"{name}.JPG").write_bytes(b"no picture")
    server.step = right
    assert f"{name}.JPG: not a picture" in run(server, str(photos), shown="photos", status=1)
    (photos / f"{name}.JPG").unlink()
    before = len(server.bodies)
    assert f"no photo of {name};" in run(server, str(photos), shown="photos", status=1)
    assert "name the folder" in run(server, shown="photos", status=1)
    write_table(Path("other/frames.parquet"), Frame, [])
    np.save("other/frames.npy", np.zeros((0, 16, 16, 3), np.uint8))
    assert "no frame of" in run(server, "other", status=1)
    other = catalogue.model_copy(update={"properties": catalogue.properties[:2]})
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.evaluation.answer_with.load_catalogue", lambda _: other)
        assert "--prompt published: is about hardness" in run(server, "--prompt", "published", status=1)
    server.url = f"https://example.org/v1?key={KEY}"
    said = run(server, status=1)
    assert "OPENAI_API_KEY" in said
    assert KEY not in said
    with deaf_port() as port:
        server.url = f"http://127.0.0.1:{port}/v1"
        assert server.url in run(server, status=1)
    assert len(server.bodies) == before


def test_it_is_a_row_of_the_report_with_where_it_comes_from(project: Path, server: Server) -> None:
    """Of the two comparisons one is right and one cannot be read; all else is right."""
    wrong = [question.task for question, _, _ in turns()].index("PC")
    server.step = lambda n: reply("Perhaps.") if n == wrong else right(n)
    run(server)
    graded()
    report = reported()
    rows = report.scores[report.scores["encoder"].eq("some-maker/sees-1") & report.scores["seed"].eq("all")]
    found = {(r["task"], r["measure"]): (r["n"], r["accuracy"], r["unread"]) for r in rows.to_dict("records")}
    whole = dict.fromkeys((("PSS", "choice"), ("POM", "choice"), ("PSR", "choice"), ("OPD", "combined")), (2, 1.0, 0))
    assert {**whole, ("PC", "choice"): (2, 0.5, 1)}.items() <= found.items()
    assert set(rows["touch"]) == {"frames"}
    (source,) = report.provenance["vision"]
    assert (source["endpoint"], source["served_as"], source["ended"]) == (server.url, ["sees-1-of-may"], {"stop": 12})
    assert set(report.effects["part"]) <= {"language"}, "what parts bring is about our own system alone"


def test_answers_to_other_questions_or_frames_are_left_out_aloud(
    project: Path, server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    run(server)
    write_jsonl(Path("data/questions/0/evaluation.jsonl"), asked()[::-1])
    assert graded() == []
    assert f"{PLACE}: no answers to the questions of seed 0 as they are now" in caplog.text
    report = reported()
    assert "some-maker/sees-1" not in set(report.scores["encoder"])
    assert report.provenance["vision"] == []
    write_jsonl(Path("data/questions/0/evaluation.jsonl"), asked()[::-1])
    run(server)
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

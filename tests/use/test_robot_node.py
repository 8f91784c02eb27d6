"""The example node: its ROS side against a double of rclpy, its HTTP side against a served model."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.use.serve import make_app
from pipeline.use.server import Failed
from pipeline.videos.decoding import decode
from tests.closure import ROOT, imported
from tests.conftest import deaf_port
from tests.use.fake import FakeOctopi, digest, running
from tests.use.videos import press

FILE = ROOT / "examples" / "robot_node.py"


class Node:
    """What of rclpy's Node the example uses; parameters come from the launch file `given`."""

    given: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.said: list[str] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, default))

    def create_subscription(self, kind: type, topic: str, callback: Any, depth: int, *, callback_group: Any) -> Any:
        return SimpleNamespace(topic=topic, callback=callback)

    def get_logger(self) -> Any:
        return SimpleNamespace(error=self.said.append)


class Goal:
    """A goal's handle: how it ended, and what was fed back."""

    def __init__(self, question: str, *videos: Path, cancelled_after: int = 10**6) -> None:
        self.request = SimpleNamespace(question=question, videos=[str(v) for v in videos])
        self.ends, self.texts, self._most = list[str](), list[str](), cancelled_after
        self.publish_feedback = lambda feedback: self.texts.append(feedback.text)
        for how in ("succeed", "abort", "canceled"):
            setattr(self, how, partial(self.ends.append, how))

    @property
    def is_cancel_requested(self) -> bool:
        return len(self.texts) >= self._most


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The example, with doubles in the places of what ROS installs."""

    class Ask:
        Feedback = SimpleNamespace

        class Result(SimpleNamespace):
            answer = error = ""

    def server(node: Any, kind: Any, name: str, execute: Any, **_: Any) -> Any:
        assert (kind, name) == (Ask, "ask_touch")
        return SimpleNamespace(execute=execute)

    doubles = {
        "rclpy": {},
        "rclpy.action": {"ActionServer": server, "CancelResponse": SimpleNamespace(ACCEPT=2)},
        "rclpy.callback_groups": {"ReentrantCallbackGroup": object},
        "rclpy.executors": {"MultiThreadedExecutor": object},
        "rclpy.node": {"Node": Node},
        "octopi_msgs": {},
        "octopi_msgs.action": {"Ask": Ask},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CompressedImage": SimpleNamespace},
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, content in doubles.items():
            patch.setitem(sys.modules, name, ModuleType(name))
            vars(sys.modules[name]).update(content)
        spec = importlib.util.spec_from_file_location("robot_node", FILE)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module


@pytest.fixture(scope="module")
def served() -> Iterator[str]:
    """`octopi serve`, with a token."""
    with running(make_app(FakeOctopi(), "finetuned-with-all-0", token="secret of the robot")) as port:
        yield f"http://127.0.0.1:{port}"


@pytest.fixture
def node(example: ModuleType, served: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("OCTOPI_TOKEN", "secret of the robot")
    monkeypatch.setattr(Node, "given", {"url": f"{served}/", "rate": 10.0, "seconds": 2.0})
    return example.TouchNode()


def test_it_imports_nothing_of_ours() -> None:
    assert imported(FILE) == set()


def test_a_question_about_files_is_answered_piece_by_piece(node: Any, tmp_path: Path) -> None:
    videos = [press(tmp_path / "a.mp4"), press(tmp_path / "b.mkv", turned=True)]
    goal = Goal("Is {tactile} softer than {tactile} ?", *videos)
    result = node.server.execute(goal)
    assert (goal.ends, result.error) == (["succeed"], "")
    shown = [digest(video.read_bytes()) for video in videos]
    assert result.answer == f"Is {{tactile}} softer than {{tactile}} ? | {shown[0]} | {shown[1]} "
    assert goal.texts[-1] == result.answer
    assert len(goal.texts) >= 7
    assert all(later.startswith(earlier) for earlier, later in zip(goal.texts, goal.texts[1:], strict=False))


def test_without_files_the_last_pictures_of_the_sensor_are_asked_about(node: Any, tmp_path: Path) -> None:
    goal = Goal("Soft?")
    assert node.server.execute(goal).error == "no picture of the sensor has come; is the topic right?"
    assert (goal.ends, node.said) == (["abort"], ["no picture of the sensor has come; is the topic right?"])
    for grey in range(60, 240, 3):
        jpeg = cv2.imencode(".jpg", np.full((64, 96, 3), grey, np.uint8))[1]
        node.subscription.callback(SimpleNamespace(data=jpeg.tobytes()))
    (film := tmp_path / "film.mp4").write_bytes(node.record())
    shown = [frame.mean() for frame in decode(film)]
    assert len(shown) == 20, "two seconds at ten frames a second"
    np.testing.assert_allclose(shown, range(180, 240, 3), atol=6)
    goal = Goal("Soft?")
    assert node.server.execute(goal).answer == f"{{tactile}} Soft? | {digest(film.read_bytes())} "
    assert goal.ends == ["succeed"]


def test_a_goal_can_be_cancelled(node: Any, tmp_path: Path) -> None:
    goal = Goal("one two three four five", press(tmp_path / "a.mp4"), cancelled_after=2)
    result = node.server.execute(goal)
    assert (goal.ends, result.answer, result.error) == (["canceled"], "{tactile} ", "cancelled")


def test_what_goes_wrong_is_one_line_of_the_server(node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (notes := tmp_path / "notes.mp4").write_text("no video")
    video = press(tmp_path / "a.mp4")
    for goal, told, answer in (
        (Goal("Soft?", notes), "video", ""),
        (Goal("{tactile} {tactile}?", video), "2 {tactile} for 1 video;", ""),
        (Goal("Soft?", tmp_path / "none.mp4"), "none.mp4", ""),
        (Goal("crash", video), str(Failed()), "{tactile} crash "),  # What came is kept, but it is no answer.
    ):
        result = node.server.execute(goal)
        assert (goal.ends, result.answer) == (["abort"], answer)
        assert told in result.error
        assert "\n" not in result.error
    monkeypatch.setenv("OCTOPI_TOKEN", "another")
    assert "token" in node.server.execute(Goal("Soft?", notes)).error
    with deaf_port() as port:
        node.url = f"http://127.0.0.1:{port}"
        assert "is `octopi serve` running?" in node.server.execute(Goal("Soft?", notes)).error

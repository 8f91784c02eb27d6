"""The example node: its ROS side against a double of rclpy, its HTTP side against a served model."""

import importlib.util
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from pipeline.use.serve import make_app
from pipeline.use.server import Failed
from tests.closure import ROOT, imported
from tests.frame_rules import decode
from tests.use.fake import FakeOctopi, digest, running
from tests.use.videos import press

FILE = ROOT / "examples" / "robot_node.py"


class Node:
    """What of rclpy's Node the example uses; parameters come from the launch file `given`."""

    given: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.create_subscription, self.get_logger = MagicMock(), MagicMock()

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, default))


class Goal(MagicMock):
    """A goal's handle, which keeps what the node calls on it."""

    @property
    def ends(self) -> list[str]:
        return [name for name, *_ in self.method_calls if name in ("succeed", "abort", "canceled")]

    @property
    def texts(self) -> list[str]:
        return [call.args[0].text for call in self.publish_feedback.call_args_list]


def goal(question: str, *videos: Path, cancelled: bool = False) -> Goal:
    request = SimpleNamespace(question=question, videos=[str(video) for video in videos])
    return Goal(request=request, is_cancel_requested=cancelled)


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    """The example, with doubles in the places of what ROS installs."""
    names = ("rclpy", "rclpy.action", "rclpy.callback_groups", "rclpy.executors", "rclpy.node")
    doubles = {name: MagicMock() for name in (*names, "octopi_msgs", "octopi_msgs.action", "sensor_msgs.msg")}
    doubles["rclpy.node"].Node = Node
    result = partial(SimpleNamespace, answer="", error="")
    doubles["octopi_msgs.action"].Ask = SimpleNamespace(Feedback=SimpleNamespace, Result=result)
    with pytest.MonkeyPatch.context() as patch:
        for name, double in {**doubles, "sensor_msgs": MagicMock()}.items():
            patch.setitem(sys.modules, name, double)
        spec = importlib.util.spec_from_file_location("robot_node", FILE)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module


@pytest.fixture(scope="module")
def served() -> Iterator[str]:
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
    videos = [press(tmp_path / "a.mp4"), press(tmp_path / "b.mkv", begin=12)]
    asked = goal("Is {tactile} softer than {tactile} ?", *videos)
    result = node.execute(asked)
    assert (asked.ends, result.error) == (["succeed"], "")
    shown = [digest(video.read_bytes()) for video in videos]
    assert result.answer == f"Is {{tactile}} softer than {{tactile}} ? | {shown[0]} | {shown[1]} "
    assert asked.texts[-1] == result.answer
    assert len(asked.texts) >= 7
    assert all(later.startswith(earlier) for earlier, later in zip(asked.texts, asked.texts[1:], strict=False))
    stopped = goal("Is it soft?", videos[0], cancelled=True)
    result = node.execute(stopped)
    assert (stopped.ends, result.answer, result.error) == (["canceled"], "", "cancelled")


def test_without_files_the_last_pictures_of_the_sensor_are_asked_about(node: Any, tmp_path: Path) -> None:
    nothing = goal("Soft?")
    assert node.execute(nothing).error == "no picture of the sensor has come; is the topic right?"
    assert nothing.ends == ["abort"]
    take = node.create_subscription.call_args.args[2]
    for grey in range(60, 240, 3):
        jpeg = cv2.imencode(".jpg", np.full((64, 96, 3), grey, np.uint8))[1]
        take(SimpleNamespace(data=jpeg.tobytes()))
    (film := tmp_path / "film.mp4").write_bytes(node.record())
    shown = [frame.mean() for frame in decode(film)]
    assert len(shown) == 20, "two seconds at ten frames a second"
    np.testing.assert_allclose(shown, range(180, 240, 3), atol=6)
    assert node.execute(goal("Soft?")).answer == f"{{tactile}} Soft? | {digest(film.read_bytes())} "


def test_what_goes_wrong_is_one_line_of_the_server(node: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video = press(tmp_path / "a.mp4")
    for asked, told, answer in (
        (goal("{tactile} {tactile}?", video), "2 {tactile} for 1 video;", ""),
        (goal("Soft?", tmp_path / "none.mp4"), "none.mp4", ""),
        (goal("crash", video), str(Failed()), "{tactile} crash "),  # What came is kept, but it is no answer.
    ):
        result = node.execute(asked)
        assert (asked.ends, result.answer) == (["abort"], answer)
        assert told in result.error
        assert "\n" not in result.error
    monkeypatch.setenv("OCTOPI_TOKEN", "another")
    assert "token" in node.execute(goal("Soft?", video)).error
    node.url = "http://127.0.0.1:9"  # Where nothing listens.
    assert "is `octopi serve` running?" in node.execute(goal("Soft?", video)).error

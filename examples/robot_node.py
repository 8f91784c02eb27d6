"""A ROS 2 node that asks a served Octopi about touches.

An action and no service: an answer takes seconds, comes piece by piece, and can be cancelled. `octopi serve` runs
beside it; the node needs OpenCV and the interface `octopi_msgs/action/Ask` (docs/robot.md), and nothing of Octopi.
"""

import base64
import collections
import json
import mimetypes
import os
import pathlib
import tempfile
import urllib.error
import urllib.request

import cv2
import numpy as np
import rclpy
from octopi_msgs.action import Ask
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

TIMEOUT = 120


class TouchNode(Node):
    """Action `ask_touch`. Parameters: `url` of the server; `topic`, `rate` (frames/s), `seconds` of the sensor."""

    def __init__(self):
        super().__init__("octopi")
        self.url = self.declare_parameter("url", "http://127.0.0.1:8000").value.rstrip("/")
        topic = self.declare_parameter("topic", "/gelsight/image/compressed").value
        self.rate = self.declare_parameter("rate", 25.0).value
        seconds = self.declare_parameter("seconds", 8.0).value
        self.frames = collections.deque(maxlen=max(1, round(self.rate * seconds)))
        # Pictures come in, and goals are cancelled, while an answer is waited for.
        group = ReentrantCallbackGroup()
        self.subscription = self.create_subscription(
            CompressedImage, topic, self.frames.append, 10, callback_group=group
        )
        self.server = ActionServer(
            self,
            Ask,
            "ask_touch",
            self.execute,
            callback_group=group,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def execute(self, handle):
        """Send a goal to the server; its answer so far is the feedback."""
        answer, result = "", Ask.Result()
        try:
            videos = [pathlib.Path(name) for name in handle.request.videos]
            touches = [touch(v.read_bytes(), v.name) for v in videos] or [touch(self.record(), "touch.mp4")]
            for piece in self.stream(handle.request.question, touches):
                if handle.is_cancel_requested:
                    handle.canceled()
                    result.answer, result.error = answer, "cancelled"
                    return result
                answer += piece
                handle.publish_feedback(Ask.Feedback(text=answer))
            handle.succeed()
        except (OSError, ValueError) as error:
            result.error = explain(error)
            self.get_logger().error(result.error)
            handle.abort()
        result.answer = answer
        return result

    def record(self):
        """The last pictures of the topic as a video."""
        pictures = [cv2.imdecode(np.frombuffer(m.data, np.uint8), cv2.IMREAD_COLOR) for m in list(self.frames)]
        if not pictures or any(picture is None for picture in pictures):
            raise ValueError("no picture of the sensor has come; is the topic right?")
        height, width = pictures[0].shape[:2]
        with tempfile.TemporaryDirectory() as folder:
            file = os.path.join(folder, "touch.mp4")
            writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*"mp4v"), self.rate, (width, height))
            for picture in pictures:
                writer.write(picture)
            writer.release()
            return pathlib.Path(file).read_bytes()

    def stream(self, question, touches):
        """Ask the server in OpenAI's form and yield the answer's pieces as they come."""
        with self.call("/v1/models") as response:
            model = json.load(response)["data"][0]["id"]
        content = [*touches, {"type": "text", "text": question}]
        body = {"model": model, "stream": True, "messages": [{"role": "user", "content": content}]}
        with self.call("/v1/chat/completions", body) as response:
            for line in response:
                data = line.decode().strip().removeprefix("data:").strip()
                if data == "[DONE]":
                    return
                if not data:
                    continue
                event = json.loads(data)
                if "error" in event:
                    raise ValueError(event["error"]["message"])
                for choice in event["choices"]:
                    yield choice["delta"].get("content") or ""
        raise ValueError("the answer broke off; see the server's log")

    def call(self, path, body=None):
        """A request with the token of `OCTOPI_TOKEN`, where the server wants one."""
        headers = {"Content-Type": "application/json"}
        if token := os.environ.get("OCTOPI_TOKEN"):
            headers["Authorization"] = f"Bearer {token}"
        data = None if body is None else json.dumps(body).encode()
        return urllib.request.urlopen(urllib.request.Request(self.url + path, data, headers), timeout=TIMEOUT)


def touch(video, name):
    """A video as a part of a message."""
    kind = mimetypes.guess_type(name)[0] or "video/mp4"
    return {"type": "video_url", "video_url": {"url": f"data:{kind};base64,{base64.b64encode(video).decode()}"}}


def explain(error):
    """One line on what went wrong; the server's own where it sent one."""
    if isinstance(error, urllib.error.HTTPError):
        try:
            return json.load(error)["error"]["message"]
        except (ValueError, KeyError, TypeError):
            return f"the server answers with status {error.code}"
    if isinstance(error, urllib.error.URLError):
        return f"the server does not answer ({error.reason}); is `octopi serve` running?"
    return str(error)


def main():
    """Run the node until it is interrupted."""
    rclpy.init()
    rclpy.spin(TouchNode(), executor=MultiThreadedExecutor())


if __name__ == "__main__":
    main()

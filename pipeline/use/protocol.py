"""OpenAI's chat completions, as far as a model of touch can keep them: requests in, a question with videos out."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, field_validator

from pipeline.core.errors import first_problem
from pipeline.language.chat import TACTILE
from pipeline.use.media import Refused, from_base64

MESSAGES, CHARACTERS = 64, 20_000
"""The longest conversation, and the longest text of one part of it."""
Json = dict[str, Any]
Said = tuple[str, tuple[bytes, ...], str]
"""A question, its videos, and the answer."""


class _Url(BaseModel):
    url: str


class _Text(BaseModel):
    type: Literal["text"]
    text: str = Field(max_length=CHARACTERS)


class _Video(BaseModel):
    type: Literal["video_url"]
    video_url: _Url


class _Image(BaseModel):  # A touch as well, from a client that knows pictures only.
    type: Literal["image_url"]
    image_url: _Url


class Message(BaseModel):
    """One turn."""

    role: Literal["system", "developer", "user", "assistant"]
    content: list[Annotated[_Text | _Video | _Image, Field(discriminator="type")]] = Field(
        min_length=1, max_length=MESSAGES
    )

    @field_validator("content", mode="before")
    @classmethod
    def _text_alone_is_one_part(cls, content: object) -> object:
        return [{"type": "text", "text": content}] if isinstance(content, str) else content


class ChatRequest(BaseModel):
    """The body of a request.

    Answers are greedy, so `temperature`, `top_p` and `seed` change nothing and are let through, as is what a client
    says about itself. What would change the answer and cannot be kept (`n`, `tools`, ...) is refused.
    """

    model: str = Field(max_length=200)
    messages: Annotated[list[Message], Field(min_length=1, max_length=MESSAGES)]
    stream: bool = False
    max_tokens: int | None = Field(default=None, ge=1)
    max_completion_tokens: int | None = Field(default=None, ge=1)
    n: Literal[1] | None = None
    stop: Annotated[list[str], Field(max_length=0)] | None = None
    tools: Annotated[list[Any], Field(max_length=0)] | None = None
    functions: Annotated[list[Any], Field(max_length=0)] | None = None
    logprobs: Literal[False] | None = None
    response_format: dict[Literal["type"], Literal["text"]] | None = None


def read_request(body: bytes) -> ChatRequest:
    """Read a body; where it has not the form, it is Refused with the first place that is wrong."""
    try:
        return ChatRequest.model_validate_json(body)
    except ValidationError as error:
        # Cut, since a message may quote what was sent.
        raise Refused(first_problem(error)[:300]) from None


def read_conversation(messages: Sequence[Message]) -> list[Said]:
    """Turn messages into exchanges; the last is the question, whose answer is "".

    A video stands where its part stands between two texts. Where a text of the message says `{tactile}`, videos stand
    at those marks in order, and where there is one text without a mark, in front of it.

    System messages are left out: the model was trained under its own and knows no other.

    Raises:
        Refused: where user and assistant do not take turns, the assistant sends a video, or one is no base64.
    """
    turns = [(i, m) for i, m in enumerate(messages) if m.role in ("user", "assistant")]
    if len(turns) % 2 == 0 or any(m.role != ("user", "assistant")[place % 2] for place, (_, m) in enumerate(turns)):
        raise Refused("messages: user and assistant must take turns, the user first and last")
    said = [_read(message, f"messages.{i}") for i, message in turns]
    if any(videos for _, videos in said[1::2]):
        raise Refused("messages: an assistant's message brings a video; only the user's may")
    answers = [*(text for text, _ in said[1::2]), ""]
    return [(text, videos, answer) for (text, videos), answer in zip(said[::2], answers, strict=True)]


def _read(message: Message, place: str) -> tuple[str, tuple[bytes, ...]]:
    """The text of a message with its marks, and its videos; `place` is what an error calls it."""
    texts = [part.text for part in message.content if isinstance(part, _Text)]
    # Then videos get no mark by their own place in the message.
    placed = sum(bool(text.strip()) for text in texts) == 1 or any(TACTILE in text for text in texts)
    text, videos = "", []
    for i, part in enumerate(message.content):
        if isinstance(part, _Text):
            piece = part.text
        else:
            url = part.video_url if isinstance(part, _Video) else part.image_url
            videos.append(from_base64(url.url, f"{place}.content.{i}"))
            piece = "" if placed else TACTILE
        apart = text and piece and not text[-1].isspace() and not piece[0].isspace()
        text += f" {piece}" if apart else piece
    return text, tuple(videos)


class Reply:
    """The answer to one request, in OpenAI's form; token counts are left out, since the model hands out text.

    `finish_reason` is `stop` also where an answer was cut at its longest, which the text does not tell. `notes`, which
    OpenAI's has not, is what should make one doubt the answer: of a stream its last chunk has it.
    """

    def __init__(self, model: str) -> None:
        self.notes: list[str] = []
        self.head: Json = {"id": f"chatcmpl-{uuid.uuid4().hex}", "created": int(time.time()), "model": model}

    def whole(self, text: str) -> Json:
        """A `chat.completion`."""
        return self._made("chat.completion", "stop", message={"role": "assistant", "content": text, "refusal": None})

    def chunk(self, delta: Mapping[str, str], finish: str | None = None) -> Json:
        """A `chat.completion.chunk`."""
        return self._made("chat.completion.chunk", finish, delta=delta)

    def _made(self, kind: str, finish: str | None, **said: Mapping[str, str | None]) -> Json:
        choice = {"index": 0, **said, "logprobs": None, "finish_reason": finish}
        return {**self.head, "object": kind, "choices": [choice], **({"notes": self.notes} if finish else {})}


def model_entry(name: str, created: int) -> Json:
    """An entry of `/v1/models`."""
    return {"id": name, "object": "model", "created": created, "owned_by": "octopi-pipeline"}


def error_body(message: str, status: int) -> Json:
    """An error in OpenAI's form."""
    kinds = {401: "authentication_error", 404: "not_found_error", 429: "rate_limit_error"}
    kind = kinds.get(status, "server_error" if status >= 500 else "invalid_request_error")
    return {"error": {"message": message, "type": kind, "param": None, "code": None}}

"""OpenAI's chat completions, as far as a model of touch can keep them: requests in, a question with videos out."""

from __future__ import annotations

import base64
import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, BaseModel, BeforeValidator, Field, ValidationError, field_validator

from pipeline.language.chat import TACTILE
from pipeline.running.errors import UserError, first_problem
from pipeline.use.encoding import Verdict

MESSAGES, CHARACTERS = 64, 20_000
"""The longest conversation, and the longest text of one part of it."""
Json = dict[str, Any]
Said = tuple[str, tuple[bytes, ...], str]
"""A question, its videos, and the answer."""


def from_base64(value: object) -> bytes:
    """Bytes of base64 or of a `data:...;base64,` URI; ValueError for all else: no path or address here can be read."""
    head, mark, data = str(value).partition(";base64,")
    try:
        return base64.b64decode(data if mark and head.startswith("data:") else str(value), validate=True)
    except ValueError:
        raise ValueError("broken base64; send the file's bytes as data:video/mp4;base64,... in one line") from None


class _Url(BaseModel):
    url: Annotated[bytes, BeforeValidator(from_base64), Field(min_length=1)]


class _Text(BaseModel):
    type: Literal["text"]
    text: str = Field(max_length=CHARACTERS)


class _Touch(BaseModel):  # A client that knows pictures only sends a video as one.
    type: Literal["video_url", "image_url"]
    video_url: _Url = Field(validation_alias=AliasChoices("video_url", "image_url"))


class Message(BaseModel):
    """One turn."""

    role: Literal["system", "developer", "user", "assistant"]
    content: list[Annotated[_Text | _Touch, Field(discriminator="type")]] = Field(min_length=1)

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
    messages: list[Message] = Field(max_length=MESSAGES)
    stream: bool | None = None
    max_tokens: int | None = Field(default=None, ge=1)
    max_completion_tokens: int | None = Field(default=None, ge=1)
    n: Literal[1] | None = None
    stop: Annotated[list[str], Field(max_length=0)] | None = None
    tools: Annotated[list[Any], Field(max_length=0)] | None = None
    logprobs: Literal[False] | None = None
    response_format: dict[Literal["type"], Literal["text"]] | None = None


def read_request(body: bytes) -> ChatRequest:
    """Read a body; UserError with the first place that is wrong where it has not the form."""
    try:
        return ChatRequest.model_validate_json(body)
    except ValidationError as error:
        # Cut, since a message may quote what was sent.
        raise UserError(first_problem(error)[:300]) from None


def read_conversation(messages: Sequence[Message]) -> list[Said]:
    """Turn messages into exchanges; the last is the question, whose answer is "".

    A message's videos stand at the `{tactile}` marks in its texts, in order. Without marks they stand in front of a
    single text; among several texts, each video stands where its part does.

    System messages are left out: the model was trained under its own and knows no other.

    Raises:
        UserError: where user and assistant do not take turns, or the assistant sends a video.
    """
    turns = [m for m in messages if m.role in ("user", "assistant")]
    if len(turns) % 2 == 0 or any(m.role != ("user", "assistant")[i % 2] for i, m in enumerate(turns)):
        raise UserError("messages: user and assistant must take turns, the user first and last")
    said: list[Said] = []
    for message in turns:
        videos = tuple(part.video_url.url for part in message.content if isinstance(part, _Touch))
        texts = [part.text for part in message.content if isinstance(part, _Text)]
        placed = sum(bool(text.strip()) for text in texts) == 1 or any(TACTILE in text for text in texts)
        text = ""
        for part in message.content:
            piece = part.text if isinstance(part, _Text) else "" if placed else TACTILE
            apart = text and piece and not text[-1].isspace() and not piece[0].isspace()
            text += f" {piece}" if apart else piece
        if message.role == "user":
            said.append((text, videos, ""))
        elif videos:
            raise UserError("messages: an assistant's message brings a video; only the user's may")
        else:
            said[-1] = (*said[-1][:2], text)
    return said


class Reply:
    """The answer to one request, in OpenAI's form; token counts are left out, since the model hands out text.

    `finish_reason` is `stop` even where an answer was cut at its maximum length, which the text does not show. `notes`,
    an addition to OpenAI's form, says what should make one doubt the answer, `heads` what the property heads say to the
    question, and `touches` their probabilities for each of its videos; in a stream the last chunk has them.
    """

    def __init__(self, model: str) -> None:
        self.notes: list[str] = []
        self.verdict: Verdict | None = None
        self.touches: list[Json] = []
        self.head: Json = {"id": f"chatcmpl-{uuid.uuid4().hex}", "created": int(time.time()), "model": model}

    def whole(self, text: str) -> Json:
        """A `chat.completion`."""
        message = {"role": "assistant", "content": text, "refusal": None}
        return {**self.chunk(message, "stop", "message"), "object": "chat.completion"}

    def chunk(self, said: Mapping[str, str | None], finish: str | None = None, called: str = "delta") -> Json:
        """A `chat.completion.chunk`."""
        choice = {"index": 0, called: said, "logprobs": None, "finish_reason": finish}
        heads = self.verdict.shown if self.verdict else ""
        more = {"notes": self.notes, "heads": heads, "touches": self.touches} if finish else {}
        return {**self.head, "object": "chat.completion.chunk", "choices": [choice], **more}

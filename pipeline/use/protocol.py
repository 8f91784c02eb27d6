"""OpenAI's chat completions, as far as a model of touch can keep them: requests in, a question with videos out."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, BaseModel, Field, ValidationError, field_validator

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


class _Touch(BaseModel):  # A client that knows pictures only sends a video as one.
    type: Literal["video_url", "image_url"]
    video_url: _Url = Field(validation_alias=AliasChoices("video_url", "image_url"))


class Message(BaseModel):
    """One turn."""

    role: Literal["system", "developer", "user", "assistant"]
    content: list[Annotated[_Text | _Touch, Field(discriminator="type")]] = Field(min_length=1, max_length=MESSAGES)

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
    stream: bool | None = None
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

    A message's videos stand at the `{tactile}` marks in its texts, in order. Without marks they stand in front of a
    single text; among several texts, each video stands where its part does.

    System messages are left out: the model was trained under its own and knows no other.

    Raises:
        Refused: where user and assistant do not take turns, the assistant sends a video, or one is no base64.
    """
    turns = [(i, m) for i, m in enumerate(messages) if m.role in ("user", "assistant")]
    if len(turns) % 2 == 0 or any(m.role != ("user", "assistant")[place % 2] for place, (_, m) in enumerate(turns)):
        raise Refused("messages: user and assistant must take turns, the user first and last")
    said: list[Said] = []
    for number, message in turns:
        texts = [part.text for part in message.content if isinstance(part, _Text)]
        placed = sum(bool(text.strip()) for text in texts) == 1 or any(TACTILE in text for text in texts)
        text, videos = "", []
        for i, part in enumerate(message.content):
            piece = part.text if isinstance(part, _Text) else "" if placed else TACTILE
            if isinstance(part, _Touch):
                videos.append(from_base64(part.video_url.url, f"messages.{number}.content.{i}"))
            apart = text and piece and not text[-1].isspace() and not piece[0].isspace()
            text += f" {piece}" if apart else piece
        if message.role == "user":
            said.append((text, tuple(videos), ""))
        elif videos:
            raise Refused("messages: an assistant's message brings a video; only the user's may")
        else:
            said[-1] = (*said[-1][:2], text)
    return said


class Reply:
    """The answer to one request, in OpenAI's form; token counts are left out, since the model hands out text.

    `finish_reason` is `stop` even where an answer was cut at its maximum length, which the text does not show. `notes`,
    an addition to OpenAI's form, says what should make one doubt the answer; in a stream the last chunk has it.
    """

    def __init__(self, model: str) -> None:
        self.notes: list[str] = []
        self.head: Json = {"id": f"chatcmpl-{uuid.uuid4().hex}", "created": int(time.time()), "model": model}

    def whole(self, text: str) -> Json:
        """A `chat.completion`."""
        message = {"role": "assistant", "content": text, "refusal": None}
        return {**self.chunk(message, "stop", "message"), "object": "chat.completion"}

    def chunk(self, said: Mapping[str, str | None], finish: str | None = None, called: str = "delta") -> Json:
        """A `chat.completion.chunk`."""
        choice = {"index": 0, called: said, "logprobs": None, "finish_reason": finish}
        notes = {"notes": self.notes} if finish else {}
        return {**self.head, "object": "chat.completion.chunk", "choices": [choice], **notes}


def error_body(message: str, status: int) -> Json:
    """An error in OpenAI's form."""
    kinds = {401: "authentication_error", 404: "not_found_error", 429: "rate_limit_error"}
    kind = kinds.get(status, "server_error" if status >= 500 else "invalid_request_error")
    return {"error": {"message": message, "type": kind, "param": None, "code": None}}

"""The one exception that a person is meant to read."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from pydantic import ValidationError

EXTRAS = {
    **dict.fromkeys(("dvc", "hydra", "matplotlib", "mlflow", "omegaconf", "open_clip", "openai"), "train"),
    **dict.fromkeys(("pandas", "pyarrow", "sentencepiece", "statsmodels"), "train"),
    **dict.fromkeys(("fastapi", "starlette", "uvicorn"), "serve"),
    "rosbags": "robot",
    "ray": "ray",
}
"""By module, the extra of pyproject.toml that installs it; the core goes without."""


class UserError(Exception):
    """Bad input: one line that names the file or key and how to mend it.

    Stages and the command line print it without a traceback and exit with status 1. No address in it has a password.
    """

    def __init__(self, line: object = "") -> None:
        super().__init__(without_secrets(str(line)))


SECRET = re.compile(
    # What is hidden before an @: in a web address everything, since a token may stand there alone; in other addresses
    # only what has a colon that does not begin a port.
    r"(?P<web>https?:/{1,2})[^\s/?#]*@"
    r"|(?P<other>\b[a-z][\w+.-]*:/{1,2})[^\s/:@]*:(?!\d*(?:[/?#\s]|$))\S*@"
    r"|(?P<key>[?&;](?:pass(?:word|wd)?|pwd|token|secret|api_?key)=)[^\s&;#'\"]+",
    re.IGNORECASE,
)


def without_secrets(text: str) -> str:
    """A text in which no address has a password, a token or what may be one."""
    return SECRET.sub(lambda found: f"{next(filter(None, found.groups()))}***{'' if found['key'] else '@'}", text)


def readable(text: str) -> str:
    """A text that every file and terminal takes: bytes of a file's name that are no UTF-8 stand in it as escapes."""
    return text.encode("utf-8", "backslashreplace").decode()


def counted(number: int, noun: str) -> str:
    """ "1 video", "2 videos"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question about the closest known name, with a blank behind it; empty where none is close."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {close[0]}? " if close else ""


def first_problem(error: ValidationError) -> str:
    """The first problem of a validation in one line: the key, where there is one, and what is wrong with it."""
    detail = error.errors(include_url=False)[0]
    key, message = ".".join(map(str, detail["loc"])), " ".join(detail["msg"].removeprefix("Value error, ").split())
    return f"{key}: {message}" if key else message

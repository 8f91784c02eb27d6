"""A trained model, ready to be asked: the same code that the evaluation runs, from a video's file to the answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from pipeline.runtime import DeviceName, DtypeName
from pipeline.use.results import Choice, Comparison, Description, Exchange, Matching, Ranking, Touch, Video


class Octopi:
    """A model that feels: `Octopi.from_pretrained("models/finetuned-with-all-0").ask("...{tactile}...", ["a.mov"])`.

    Attributes:
        card: What the folder's config.json says.
        properties: The catalogue's properties.
        names: The names of the catalogue's objects.
    """

    card: Mapping[str, Any]
    properties: tuple[str, ...]
    names: tuple[str, ...]

    @classmethod
    def from_pretrained(
        cls,
        folder: Path | str,
        *,
        base: Path | str | None = None,
        device: DeviceName = "auto",
        dtype: DtypeName = "auto",
    ) -> Self:
        raise NotImplementedError

    def ask(
        self,
        question: str,
        videos: Sequence[Video] = (),
        *,
        history: Sequence[Exchange] = (),
        max_new_tokens: int | None = None,
    ) -> str:
        raise NotImplementedError

    def stream(
        self,
        question: str,
        videos: Sequence[Video] = (),
        *,
        history: Sequence[Exchange] = (),
        max_new_tokens: int | None = None,
    ) -> Iterator[str]:
        raise NotImplementedError

    def ask_all(self, asked: Sequence[tuple[str, Sequence[Video]]], *, max_new_tokens: int | None = None) -> list[str]:
        raise NotImplementedError

    def look(self, video: Video) -> Touch:
        raise NotImplementedError

    def describe(self, video: Video) -> Description:
        raise NotImplementedError

    def describe_all(self, videos: Sequence[Video]) -> list[Description]:
        raise NotImplementedError

    def compare(self, a: Video, b: Video, property: str) -> Comparison:
        raise NotImplementedError

    def rank(self, videos: Sequence[Video], property: str) -> Ranking:
        raise NotImplementedError

    def match(self, videos: Sequence[Video], names: Sequence[str]) -> Matching:
        raise NotImplementedError

    def scenario(self, question: str, videos: Sequence[Video]) -> Choice:
        raise NotImplementedError

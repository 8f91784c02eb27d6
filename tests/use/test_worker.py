"""Questions that wait are answered in one batch, each as it would be alone."""

import asyncio
import threading
from collections.abc import AsyncGenerator, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pipeline.language.generate import Stream
from pipeline.running.errors import UserError
from pipeline.use.model import Octopi
from pipeline.use.server import Failed, Worker
from tests.conftest import HUNG

QUESTIONS = (("Describe this. {tactile}", 1, None), ("Is it soft?", 1, 3), ("Which is softer?", 2, 20), ("Why?", 3, 1))


async def everything(pieces: AsyncGenerator[Any]) -> str:
    return "".join([piece async for piece in pieces]).strip()


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many were answered at once, batch by batch."""
    sizes: list[int] = []
    together = Stream.together

    def counted(streams: Sequence[Stream], left: Collection[int]) -> Iterator[tuple[int, str | None]]:
        sizes.append(len(streams))
        return together(streams, left)

    monkeypatch.setattr(Stream, "together", staticmethod(counted))
    return sizes


def test_what_waits_is_one_batch_answered_as_alone(octopi: Octopi, files: list[Path], batches: list[int]) -> None:
    """Beside one that is refused, one that breaks, one that is given up before its turn, and one in the middle."""
    alone = [octopi.ask(q, files[:n], max_new_tokens=most) for q, n, most in QUESTIONS]

    async def ask() -> list[Any]:
        worker, gate = Worker(), threading.Event()
        first = asyncio.ensure_future(everything(worker.answer(lambda: [str(gate.wait(HUNG))])))

        def queue(question: str, count: int, most: int | None = None) -> AsyncGenerator[Any]:
            asked = partial(octopi.stream, question, files[:count], max_new_tokens=most)
            return worker.answer(asked)

        asked = [queue(*each) for each in QUESTIONS]
        refused, never, halfway = queue("{tactile}", 0), queue("Never?", 1), queue("Halfway?", 1)
        broken = worker.answer(lambda: iter([1 / 0]))
        begun = asyncio.ensure_future(anext(never))
        await asyncio.sleep(0)
        begun.cancel()
        await asyncio.gather(begun, return_exceptions=True)
        gate.set()
        whole = [asyncio.ensure_future(everything(pieces)) for pieces in asked]
        await anext(halfway)
        await halfway.aclose()
        failed = await asyncio.gather(everything(refused), everything(broken), return_exceptions=True)
        found = [await first, *map(type, failed), await asyncio.gather(*whole)]
        await asyncio.to_thread(worker.stop)
        return found

    *failed, answered = asyncio.run(ask())
    assert failed == ["True", UserError, Failed]
    assert answered == [text.strip() for text in alone]
    assert batches[-1] == len(QUESTIONS) + 1


def test_who_asks_moments_later_is_in_the_same_batch(
    octopi: Octopi, files: list[Path], batches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.use.server.PAUSE", 5.0)

    async def ask() -> None:
        worker, found = Worker(), []
        for _ in range(2):
            found.append(worker.answer(lambda: octopi.stream("Why?", files[:1])))
            await asyncio.sleep(0.2)  # The thread has taken the first one by now.
        await asyncio.gather(*map(everything, found))
        await asyncio.to_thread(worker.stop)

    asyncio.run(ask())
    assert batches == [2]


def test_a_batch_that_breaks_fails_all(octopi: Octopi, files: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    async def ask() -> list[Any]:
        worker = Worker()
        asked = [worker.answer(lambda: octopi.stream("Why?", files[:1])) for _ in range(3)]
        found = await asyncio.gather(*map(everything, asked), return_exceptions=True)
        monkeypatch.undo()
        after = await everything(worker.answer(lambda: octopi.stream("Why?", files[:1])))
        await asyncio.to_thread(worker.stop)
        return [*map(type, found), after]

    monkeypatch.setattr("pipeline.language.generate.greedy_tokens", lambda *_: iter([1 / 0]))
    assert asyncio.run(ask()) == [Failed] * 3 + [octopi.ask("Why?", files[:1]).strip()]

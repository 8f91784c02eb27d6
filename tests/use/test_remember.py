"""Touches are remembered and recognised: the cosine against scikit-learn's, and a trained model's own videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics.pairwise import cosine_similarity

from pipeline.core.errors import UserError
from pipeline.use.memory import TOUCHES, Remembered, most_similar
from pipeline.use.model import Octopi
from tests.conftest import refused

CLASSES = ("soft", "rough", "no bumps")


def touches(vectors: np.ndarray, names: list[str]) -> list[Remembered]:
    rows = zip(names, vectors.tolist(), strict=True)
    return [Remembered(name=n, classes=CLASSES, encoder="e", embedding=tuple(v)) for n, v in rows]


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_the_most_similar_comes_first_by_its_nearest_touch(scale: float) -> None:
    rng = np.random.default_rng(0)
    known = rng.normal(size=(40, 16)) * scale
    known[7] = 0  # As of a frame that says nothing: like nothing, and no division by zero.
    names = [f"object {i % 13}" for i in range(40)]
    for query in (*rng.normal(size=(5, 16)), known[3], -known[3], np.zeros(16)):
        found = most_similar(query, touches(known, names))
        cosines = cosine_similarity(query[None], known)[0]
        best = {name: max(c for c, n in zip(cosines, names, strict=True) if n == name) for name in names}
        assert {s.name: s.similarity for s in found} == pytest.approx(best, abs=1e-12)
        assert [s.similarity for s in found] == sorted((s.similarity for s in found), reverse=True)


def test_a_remembered_touch_is_recognised(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    names = ["my ice", "my millet", "my towel"]
    memory = tmp_path / "touches"
    assert [octopi.remember(n, f, memory) for n, f in zip(names, files, strict=True)] == [1, 2, 3]
    for name, file in zip(names, files, strict=True):
        found = octopi.recognise(file, memory)
        assert (found.objects[0].name, found.touches, len(found.objects)) == (name, 3, 3)
        assert found.objects[0].similarity == pytest.approx(1, abs=1e-6)
        assert found.objects[0].classes == tuple(octopi.describe(file, sentence=False).levels.values())
    assert octopi.remember(names[0], files[1], memory) == 4
    assert len(octopi.recognise(files[0], memory).objects) == 3, "an object is named once"


def test_a_question_begins_with_what_is_remembered(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    memory = tmp_path / "touches"
    for name, file in zip(("my ice", "my millet"), files, strict=False):
        octopi.remember(name, file, memory)
    told = octopi.reminded("Which is softer?", files[:2], memory)
    ice, millet = (", ".join(octopi.recognise(file, memory).objects[0].classes) for file in files[:2])
    assert told == f"{ice} is my ice. {millet} is my millet. {{tactile}} {{tactile}} Which is softer?"
    assert octopi.ask("Which is softer?", files[:2], memory=memory) == octopi.ask(told, files[:2])


def test_what_is_no_memory_is_refused_and_stays(octopi: Octopi, files: list[Path], tmp_path: Path) -> None:
    memory = tmp_path / "touches"
    with refused("no memory of touches; `octopi remember"):
        octopi.recognise(files[0], memory)
    with refused("name is empty"):
        octopi.remember(" ", files[0], memory)
    octopi.remember("my ice", files[0], memory)
    written = (memory / TOUCHES).read_text()
    still = np.full((20, 64, 64, 3), 90, np.uint8)
    with pytest.raises(UserError, match="press"):
        octopi.remember("nothing", still, memory)
    assert (memory / TOUCHES).read_text() == written
    (memory / TOUCHES).write_text(written[:-20])
    with refused("line 1: not a Remembered"):
        octopi.remember("my millet", files[1], memory)
    (memory / TOUCHES).write_text(written.replace('"encoder":"', '"encoder":"another'))
    for call in (lambda: octopi.recognise(files[0], memory), lambda: octopi.remember("a", files[1], memory)):
        with refused("another encoder's"):
            call()

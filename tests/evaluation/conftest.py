"""Made-up questions and answers that several tests of evaluation share."""

import itertools
from typing import Any

from hypothesis import strategies as st

from pipeline.evaluation.intervals import Objects
from pipeline.evaluation.records import Graded

About = tuple[Objects, ...]
OBJECTS = [f"object{i}" for i in range(6)]
PAIRS = list(itertools.combinations(OBJECTS, 2))


@st.composite
def designs(draw: st.DrawFn) -> About:
    """Questions about one to three of up to seven objects."""
    names = "abcdefg"[: draw(st.integers(2, 7))]
    sets = st.lists(st.sampled_from(names), min_size=1, max_size=min(3, len(names)), unique=True)
    return tuple(tuple(row) for row in draw(st.lists(sets, min_size=2, max_size=24)))


def single(objects: int, each: int) -> About:
    return tuple((f"{o:02}",) for o in range(objects) for _ in range(each))


def graded(
    task: str, right: list[bool], *, measure: str = "choice", unread: int = 0, objects: Any = None, **system: Any
) -> list[Graded]:
    """One answer a question of the full system, or of another; the last `unread` could not be read."""
    about = objects or (PAIRS if measure == "choice" else [(o,) for o in OBJECTS] * 3)
    whose = {"encoder": "finetuned", "lora": "with", "opd": "all", "touch": "real", "seed": 0} | system
    whose |= {"trained": whose["seed"], "task": task, "measure": measure, "truncated": False, "expected": "a"}
    read = [i < len(right) - unread for i in range(len(right))]
    return [
        Graded(question_id=f"{task}-{i:03}", correct=own, parsed=read[i], objects=about[i], predicted="", **whose)
        for i, own in enumerate(right)
    ]

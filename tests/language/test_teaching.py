"""Teaching: its phases follow what was measured, and a kill changes nothing of what is learnt."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from pipeline.config import LanguageConfig, MaxUpdates, PassMarks, RuntimeConfig, TeachConfig
from pipeline.errors import UserError
from pipeline.language.base import load_tokenizer
from pipeline.language.teach.training import COURSE, PHASES, Course, teach
from pipeline.training.trainer import Trained
from tests.language.test_training import AtStep


def atmost(updates: int) -> MaxUpdates:
    return MaxUpdates(plain=updates, several=updates, whole=updates)


SMALL = TeachConfig(
    rank=2, alpha=4, warmup=1, batch_size=4, micro_batch_size=2, max_updates=atmost(2), check_every=1, check_items=4
)
RUNTIME = RuntimeConfig(device="cpu", save_steps=1)


def run(language: LanguageConfig, *callbacks: AtStep) -> Trained:
    config = SMALL.model_copy(update={"base": language.weights})
    return teach(config, language, RUNTIME, stage="teach", seed=0, callbacks=callbacks)[2]


@pytest.fixture
def course(language: LanguageConfig) -> Course:
    marks = PassMarks(plain=0.9, several=0.8, whole=0.95)
    config = SMALL.model_copy(update={"max_updates": atmost(100), "batch_size": 40, "pass_marks": marks})
    return Course(config, load_tokenizer(Path(language.weights)), "", seed=3)


def test_a_phase_begins_when_the_one_before_is_passed(course: Course) -> None:
    log: list[dict[str, float]] = []
    course.log = lambda: log
    assert [course.phase(s) for s in (0, 99, 100, 199, 200, 500)] == ["plain"] * 2 + ["several"] * 2 + ["whole"] * 2
    log += [{"step": 20, "eval_plain_items": 0.5}, {"step": 40, "eval_plain_items": 0.95}]
    assert [course.phase(s) for s in (39, 40, 139, 140)] == ["plain", "several", "several", "whole"]
    # Enough for a phase, but measured in the one before: it does not count.
    log += [{"step": 40, "eval_several_items": 1.0}, {"step": 60, "eval_several_items": 0.8}]
    assert [course.phase(s) for s in (40, 59, 60)] == ["several", "several", "whole"]
    log += [{"step": 80, "eval_whole_items": 0.94}]
    assert course.ended("whole") == 160, "the last phase has a mark of its own"
    log += [{"step": 100, "eval_whole_items": 0.95}]
    assert course.ended("whole") == 100


def test_the_rate_falls_in_the_last_phase(course: Course) -> None:
    course.config = course.config.model_copy(update={"warmup": 4})
    log: list[dict[str, float]] = [{"step": 40, "eval_plain_items": 1.0}, {"step": 60, "eval_several_items": 1.0}]
    course.log = lambda: log
    rates = [course.rate(step) for step in (0, 3, 39, 60, 110, 160, 200)]
    assert rates == pytest.approx([0.25, 1, 1, 1, 0.55, 0.1, 0.1])


def test_an_update_holds_its_phase_and_reviews(course: Course) -> None:
    lengths = []
    for phase, forms in COURSE.items():
        assert sum(forms.values()) == pytest.approx(1)
        drawn = course._draw_update(1, phase)
        assert drawn == course._draw_update(1, phase), "what is drawn follows from the seed"
        assert len(drawn) == 40
        lengths.append(sum(len(e.input_ids) for e in drawn))
    assert lengths == sorted(lengths)
    assert [COURSE[phase].get("several", 0) > 0 for phase in PHASES] == [False, True, True]


def test_a_killed_teaching_goes_on_with_the_same_phase(language: LanguageConfig, checkpoints: Path) -> None:
    whole = run(language)
    exams = [(m.step, m.name) for m in whole.history if m.name.endswith("_items")]
    assert exams == list(enumerate(["plain_items"] * 2 + ["several_items"] * 2 + ["whole_items"] * 2, start=1))

    def die() -> None:
        raise KeyboardInterrupt

    for folder in checkpoints.iterdir():
        shutil.rmtree(folder)
    with pytest.raises(KeyboardInterrupt):
        run(language, AtStep(3, die))
    assert list(checkpoints.rglob("trainer_state.json"))
    resumed = run(language)
    assert resumed.history == whole.history
    assert all(torch.equal(resumed.state[name], value) for name, value in whole.state.items())


def test_bfloat16_on_a_processor_that_was_not_named(language: LanguageConfig, checkpoints: Path) -> None:
    """The adapters stay in float32 there, and `auto` finds the processor."""
    config = SMALL.model_copy(update={"base": language.weights, "max_updates": atmost(1)})
    half = language.model_copy(update={"dtype": "bfloat16"})
    llm, _, trained = teach(config, half, RuntimeConfig(device="auto"), stage="teach", seed=0)
    assert {value.dtype for value in trained.state.values()} == {torch.float32}
    assert next(p.dtype for n, p in llm.named_parameters() if "base_layer" in n) == torch.bfloat16
    assert all(value.isfinite().all() for value in trained.state.values())


def test_a_broken_tokenizer_of_the_base_is_named_by_its_key(language: LanguageConfig, tmp_path: Path) -> None:
    shutil.copytree(language.weights, tmp_path / "base")
    (tmp_path / "base" / "tokenizer.json").write_text("{}")
    with pytest.raises(UserError, match=r"\Ateach.base: the tokenizer in [^\n]*\Z"):
        run(language.model_copy(update={"weights": str(tmp_path / "base")}))

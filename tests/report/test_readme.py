"""What a report's README says is put together by rule: each rule, and what it must not claim."""

from __future__ import annotations

from typing import Any

import pytest

from pipeline.report.provenance import beyond_paper
from pipeline.report.readme import CHANCE, MOST_LINES, finding, render_readme, sections
from pipeline.scales import compose
from tests.closure import ROOT
from tests.report.conftest import effect, report, score


def test_who_made_the_figures_comes_first_with_size_and_teaching() -> None:
    text = render_readme(report([score()], settings="Looked at before."), ["effects.png"])
    first = text.splitlines()[2]
    assert first.startswith(
        "A 2.2 M-parameter Llama, taught by hand, made these figures in place of the paper's Vicuna"
    )
    assert "a 1.1 M-parameter CLIP with visual prompt tuning" in first
    assert "real videos of 2 test objects, under 1 seed" in first
    assert first.endswith("Looked at before.")
    head = next(line for line in text.splitlines() if line.startswith("| Task"))
    assert "Measured here (2.2 M-parameter model)" in head
    assert "Published (Vicuna 13b)" in head
    assert "other models on other questions about other objects" in text


def test_a_large_base_is_no_stand_in_and_has_no_teaching_noted() -> None:
    said = sections(report([score()], language={"parameters": 6_738_415_616, "taught": ""}))
    assert said["finding"][0].startswith("A 6.7 B-parameter Llama made these figures.")
    assert "not noted" in said["stands_on"][0]


def test_above_and_below_chance_are_said_only_where_the_whole_interval_is() -> None:
    rows = [
        score("PC", accuracy=0.6, low=0.5, high=0.7, chance=0.3),
        score("PSS", accuracy=0.5, low=0.2, high=0.8, chance=0.3),
        score("POM", accuracy=0.1, low=0.05, high=0.15, chance=0.3),
    ]
    said = finding(report(rows))[1]
    assert "lies above chance in 1 of 3 tasks (PC) and below it in POM" in said
    assert "best in PC with 60.0 [50.0, 70.0] % (chance 30.0)" in said
    assert "worst in POM with 10.0 [5.0, 15.0] %" in said
    assert finding(report([rows[1]]))[1] == "The full system's interval lies above chance in 0 of 1 task."
    assert "above chance in 0 of 1" in finding(report([score("PC", low=None, high=None)]))[1]
    assert finding(report([]))[1] == "No answer of the full system was graded."
    # Nothing is best that is no better than a guess.
    nothing = [score(task, accuracy=0.0, low=0.0, high=0.3) for task in ("PC", "PSS")]
    assert "best" not in finding(report(nothing))[1]
    some = finding(report([*nothing, score("POM", accuracy=0.9, low=0.8, high=1.0)]))[1]
    assert "Against chance it is best in POM with 90.0 [80.0, 100.0] %" in some


TOUCH = {"part": "touch", "change": "real - swapped"}


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([], "Whether answers depend on touch was not tested."),
        (
            [effect(**TOUCH, p_holm=0.01, low=0.02)],
            "Answers use touch in PC: with real touch, against touch that was swapped, accuracy differs by +10.0 to",
        ),
        ([effect(**TOUCH, low=0.02)], "Answers may use touch: with real touch, against touch that was swapped"),
        ([effect(**TOUCH)], "That answers use touch is not shown: with real touch, against touch that was swapped"),
        ([effect(**TOUCH, p_holm=0.01, difference=-0.1, low=-0.2)], "That answers use touch is not shown"),
        (
            [effect(**TOUCH, low=0.02, objects=5)],
            "none is significant after Holm's adjustment (5 objects are too few for that).",
        ),
    ],
)
def test_whether_touch_is_used(rows: list[dict[str, Any]], expected: str) -> None:
    assert expected in finding(report([score()], rows))[2]


def test_a_task_at_chance_shows_no_touch() -> None:
    """Without touch its answers may be no choice at all: the difference is then of form."""
    guessed = score("PSS", low=0.2)
    unread = effect(**TOUCH, task="PSS", p_holm=0.01, difference=0.3, low=0.2)
    assert "That answers use touch is not shown" in finding(report([guessed], [unread]))[2]
    used = finding(report([guessed, score("PC")], [unread, effect(**TOUCH, p_holm=0.01, low=0.02)]))[2]
    assert "Answers use touch in PC:" in used
    assert "In PSS real touch brings no more than chance" in used


def test_effects_that_hold_are_named_and_those_that_do_not_are_not() -> None:
    none = finding(report([score()], [effect(), effect("opd", "all - none", smallest_effect=0.12)]))[2]
    assert "None of 2 effects of LoRA and OPD is significant after Holm's adjustment; even before it" in none
    assert "the smallest that this design could have found is 12 points" in none
    some = finding(report([score()], [effect(p_holm=0.001), effect("opd", "all - none")]))[2]
    assert "Of 2 effects of LoRA and OPD these hold up (Holm): LoRA in PC +10.0 points." in some
    assert "opd in PC" not in some


def test_heads_and_rules_are_the_line_that_the_language_model_is_held_to() -> None:
    against = {"part": "language", "change": "full system - heads and rules"}
    rows = [effect(**against, difference=-0.17, p_holm=0.01), effect(**against, task="PSS", difference=0.04)]
    said = finding(report([score()], rows))[2]
    assert "differs from them by -17.0 to +4.0 points, task by task, and is behind in PC (Holm)." in said
    assert "effects of" not in said, "it is no part that is left out"
    even = finding(report([score()], rows[1:]))[2]
    assert "is in no task ahead or behind (Holm)." in even
    assert "heads and plain rules" not in finding(report([score()], [effect()]))[2]


def test_a_gain_that_ends_at_chance_is_one_of_form() -> None:
    guessed, formed = score("PSS", low=0.2), effect(task="PSS", p_holm=0.001, difference=0.3)
    only = finding(report([guessed], [formed]))[2]
    assert "None of 1 effects of LoRA holds up." in only
    assert "answers are no better than chance even so: LoRA in PSS +30.0 points." in only
    both = finding(report([guessed, score("PC")], [formed, effect(p_holm=0.001)]))[2]
    assert "these hold up (Holm): LoRA in PC +10.0 points. Significant too, but" in both
    worse = finding(report([guessed], [effect(task="PSS", p_holm=0.001, difference=-0.3)]))[2]
    assert "these hold up (Holm): LoRA in PSS -30.0 points." in worse, "a loss is no matter of form"


def test_a_readme_stays_short_whatever_is_measured() -> None:
    tasks = [score(f"T{i}", variant=v) for i in range(60) for v in ("finetuned with all", "finetuned with none")]
    text = render_readme(report(tasks), ["curves.png", "effects.png"])
    assert text.count("\n") <= MOST_LINES
    assert "T59" in text
    assert "On the page" in text
    assert "## Physical understanding" not in text


@pytest.mark.parametrize("part", ["language", "encoder"])
def test_random_base_models_are_said_to_be_chance_first(part: str) -> None:
    """By what the models are, whatever the scale is called."""
    said = report([score()])
    said.provenance["base_models"][part]["folder"] = "data/weights/tiny-llama"
    assert finding(said)[0].startswith(f"{CHANCE} A 2.2 M-parameter Llama")
    for folder in ("data/weights/smollm2", "weights/tiny-llama", "elsewhere/data/weights/tiny-clip", "data/taught"):
        said.provenance["base_models"][part]["folder"] = folder
        assert "tiny and random" not in finding(said)[0]
    assert "tiny and random" not in finding(report([score()], scale="smoke"))[0]


def test_spoilt_test_objects_are_no_headline() -> None:
    note = "They were looked at while recipes changed."
    spoilt = render_readme(report([score()], split="development", settings=note), ["effects.png"])
    head, _, rest = spoilt.partition("## On test objects that were looked at")
    assert "| Task" not in head
    assert "![What encoder" not in head
    assert note in rest.split("| Task")[0]
    kfold = render_readme(report([score()], split="kfold", settings=note), ["curves.png"])
    assert "| Task" in kfold.split("## What the figures stand on")[0]


def test_what_the_figures_stand_on_is_said_in_words() -> None:
    went_on = {"language.start": "pipeline/pretrained/octopi-small"}
    said = report([], settings="", facts_told=True, intervals="Known to be narrow.", beyond_paper=went_on)
    assert "its training went on from `octopi-small`, which was trained before" in finding(said)[0]
    facts = "\n".join(sections(said)["stands_on"])
    for words in ("2 (a, b), 4 videos, split `paper`", "Nothing is noted", "Known to be narrow.", "ask for touch"):
        assert words in facts


def test_a_report_names_what_the_paper_does_not_train() -> None:
    assert beyond_paper(compose("paper-7b", [], ROOT / "conf")) == {}
    found = beyond_paper(compose("small", ["lora.given=0.7"], ROOT / "conf"))
    assert found["questions.restate"] is True
    assert (found["lora.given"], found["questions.wording"]) == (0.7, "class")
    facts = "\n".join(sections(report([], beyond_paper=found))["stands_on"])
    assert all(f"`{key}={value}`" in facts for key, value in found.items())
    assert "the paper has not" not in "\n".join(sections(report([], beyond_paper={}))["stands_on"])

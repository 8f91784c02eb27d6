"""What a report's README says is put together by rule: each rule, and what it must not claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.report.provenance import beyond_paper, provenance
from pipeline.report.readme import CHANCE, MOST_LINES, finding, render_readme, sections
from pipeline.scales import compose
from pipeline.videos.catalogue import load_catalogue
from tests.closure import ROOT
from tests.report.conftest import effect, report, score


def test_who_made_the_figures_comes_first_with_size_and_teaching() -> None:
    text = render_readme(report([score()], settings="Looked at before."), ["effects.png"])
    first, head = text.splitlines()[2], next(line for line in text.splitlines() if line.startswith("| Task"))
    made = "A 2.2 M-parameter Llama, taught by hand, made these figures in place of the paper's Vicuna"
    for words in (made, "a 1.1 M-parameter CLIP", "real videos of 2 test objects, under 1 seed", "Looked at before."):
        assert words in first
    assert "Measured here (2.2 M-parameter model)" in head
    assert "Published (Vicuna 13b)" in head
    large = sections(report([score()], language={"parameters": 6_738_415_616, "taught": ""}))
    assert large["finding"][0].startswith("A 6.7 B-parameter Llama made these figures."), "no stand-in"
    assert "not noted" in large["stands_on"][0]


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
RULES = {"part": "language", "change": "full system - heads and rules"}
REMOVED = effect(part="touch", change="real - removed", p_holm=0.01, low=0.02)
USED = effect(**TOUCH, p_holm=0.01, low=0.02)
FORMED = effect(task="PSS", p_holm=0.001, difference=0.3)
SWAPPED = "with real touch, against touch that was swapped"


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        ([], "Whether answers depend on touch was not tested."),
        ([USED], f"Answers use touch in PC: {SWAPPED}, accuracy differs by +10.0 to"),
        ([effect(**TOUCH, low=0.02)], f"Answers may use touch: {SWAPPED}"),
        ([effect(**TOUCH)], f"That answers use touch is not shown: {SWAPPED}"),
        # Without frames answers may fail; that they depend on which touch only another object's shows, or else noise.
        ([REMOVED, effect(**TOUCH)], "task by task. In PC answers need frames; that they depend on which touch is not"),
        ([REMOVED], "That answers use touch is not shown: with real touch, against touch that was removed, accuracy"),
        ([REMOVED, effect(**TOUCH, low=0.02)], "1 of 1 intervals of `real - swapped` lie above 0, none is significant"),
        ([REMOVED, {**USED, "change": "real - noise"}, effect(**TOUCH)], "That answers use touch is not shown"),
        ([REMOVED, {**USED, "change": "real - noise"}], "Answers use touch in PC: with real touch, against touch that"),
        ([effect(**TOUCH, p_holm=0.01, difference=-0.1, low=-0.2)], "That answers use touch is not shown"),
        (
            [effect(**TOUCH, low=0.02, objects=5)],
            "lie above 0, none is significant after Holm's adjustment (5 objects are too few for that).",
        ),
        # Without touch, answers to PSS may be no choice at all: the difference is then of form.
        ([{**USED, "task": "PSS"}], "That answers use touch is not shown"),
        ([{**USED, "task": "PSS"}, USED], "In PSS real touch brings no more than chance"),
        (
            [effect(), effect("opd", "all - none", smallest_effect=0.12)],
            "None of 2 effects of LoRA and OPD is significant after Holm's adjustment; before it, the smallest "
            "effect that any of them detects with 80 % power is 12 points",
        ),
        (
            [effect(p_holm=0.001), effect("opd", "all - none")],
            "Of 2 effects of LoRA and OPD these hold up (Holm): LoRA in PC +10.0 points.",
        ),
        (
            [effect(**RULES, difference=-0.17, p_holm=0.01), effect(**RULES, task="PSS", difference=0.04)],
            "differs from them by -17.0 to +4.0 points, task by task, and is behind in PC (Holm).",
        ),
        ([effect(**RULES)], "is in no task ahead or behind (Holm)."),
        (
            [FORMED],
            "None of 1 effects of LoRA holds up. Significant too, but answers are no better than chance even so: LoRA "
            "in PSS +30.0 points.",
        ),
        ([FORMED, effect(p_holm=0.001)], "these hold up (Holm): LoRA in PC +10.0 points. Significant too, but"),
        # A loss is no matter of form.
        ([{**FORMED, "difference": -0.3}], "these hold up (Holm): LoRA in PSS -30.0 points."),
    ],
)
def test_what_effects_show_of_touch_and_of_parts(effects: list[dict[str, Any]], expected: str) -> None:
    """Answers to PC are better than chance, those to PSS are not."""
    said = finding(report([score("PC"), score("PSS", low=0.2)], effects))[2]
    assert expected in said
    assert ("effects of" in said) == any(e["part"] in ("lora", "opd") for e in effects), "heads and rules are no part"


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


@pytest.mark.parametrize(("backbone", "before"), [("[scenes]", "ablation: "), ("[clip,scenes]", "noted here, beside ")])
def test_the_base_encoder_is_what_its_backbones_read(tmp_path: Path, backbone: str, before: str) -> None:
    """`encoder.weights` names a random CLIP, which counts only where a backbone reads it."""
    tuned = ("encoder.recipe=tuned", "encoder.reference=subtract", "language.weights=weights/a")
    params = compose("smoke", [*tuned, f"encoder.backbone={backbone}"], ROOT / "conf")
    (tmp_path / "params.yaml").touch()
    (tmp_path / "conf").symlink_to(ROOT / "conf")
    said = report([], **provenance(params, load_catalogue(ROOT / params.data.catalogue), [], [], [], tmp_path))
    text = render_readme(said, [])
    assert f"{before}a convolutional network with synthetic pretraining." in text
    assert ("tiny-clip" in text) == ("tiny and random" in text) == ("clip" in backbone)


def test_every_setting_that_is_not_papers_is_counted_and_named_in_the_fold() -> None:
    def beyond(scale: str, *overrides: str) -> dict[str, Any]:
        return beyond_paper(compose(scale, overrides, ROOT / "conf"), ROOT / "conf")

    idle = ("encoder.feature_stage=1", "pretrain.steps=1", "questions.inexact=0.5", "questions.wording=texts", "seed=1")
    assert beyond("paper-13b", *idle) == {}, "and batches are computed in other parts"
    assert beyond("paper-7b", "lora.rank=3", "frames.fraction=0.9") == {"frames.fraction": 0.9, "lora.rank": 3}
    found = beyond("small", "lora.given=0.7", "pretrain.steps=1")
    assert (found["lora.given"], found["pretrain.steps"], found["align.begin_with_words"]) == (0.7, 1, True)
    assert "encoder.embedding" not in found, "CLIP's alone"
    # The start has its connector, and without facts none is inexact; a place of this machine is not told.
    begun = beyond("finetune", "questions.facts=false", "language.start=/home/me/model")
    assert (begun["language.start"], begun["lora.skip_contradicted"]) == ("model", True)
    assert not {"align.begin_with_words", "language.normalize_touch", "questions.inexact"} & {*begun}


def test_what_the_figures_stand_on_is_said_in_words() -> None:
    found = {"questions.restate": True, "lora.dropout": 0.0, "lora.target_modules": ["q", "k"]}
    found |= {"language.start": "pipeline/pretrained/octopi-small"}
    said = report([], settings="", facts_told=True, intervals="Known to be narrow.", beyond_paper=found)
    assert "its training went on from `octopi-small`, which was trained before" in finding(said)[0]
    text = render_readme(said, [])
    told = ["2 (a, b), 4 videos, split `paper`", "Nothing is noted", "Known to be narrow.", "ask for touch"]
    fold = "questions: `restate=True`; lora: `dropout=0.0`, `target_modules=[q, k]`; language: `start=pipeline/pre"
    assert all(words in text for words in (*told, "in 4 settings", fold))
    assert "<details>" not in render_readme(report([], beyond_paper={}), []), "nothing is otherwise"

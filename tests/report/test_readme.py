"""What a report's README says, and each rule of what it may claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.report.provenance import beyond_paper, provenance
from pipeline.report.readme import finding, render_readme
from pipeline.scales import compose
from pipeline.videos.catalogue import load_catalogue
from tests.closure import ROOT
from tests.report.conftest import effect, report, score

TOUCH = {"part": "touch", "change": "real - swapped"}
RULES = {"part": "language", "change": "full system - heads and rules"}


def test_what_was_found_and_what_it_stands_on() -> None:
    rows = [score("OPD", "combined", low=0.5), score("PC"), score("PSS", low=0.0, high=0.2)]
    effects = [effect(**RULES, difference=-0.17, p_holm=0.01), effect(), effect(**TOUCH, p_holm=0.01)]
    found = {"questions.restate": True, "lora.dropout": 0.0, "language.start": "pipeline/pretrained/octopi-small"}
    folds = {"folds": {"of": 5, "tested": [0, 2], "trained": 0}, "replicates": 2}
    noted = {"settings": "Looked at before.", "facts_told": True, "intervals": "Known to be narrow."}
    text = render_readme(report(rows, effects, beyond_paper=found, **folds, **noted), ["effects.png", "map.png"])
    first, stands_on = text.split("## What the figures stand on")
    assert "in 2 of 3 tasks (OPD, PC) and below it in PSS" in first
    assert "PC full system - heads and rules -17.0, PC real - swapped +10.0 points" in first
    assert "went on from `octopi-small`" in first
    assert "(3 of 5 folds are still to be run)" in first
    told = ("a 2.2 M-parameter Llama, taught by hand", "2 of 5 folds (0, 2)", "Looked at before.", "to be narrow.")
    assert all(fact in stands_on for fact in told)
    assert "**Matching questions** say what the named objects are like" in stands_on
    assert "questions: `restate=True`; lora: `dropout=0.0`; language: `start=" in stands_on
    assert "sha256 `cccccccccccccccc`" in stands_on


def test_nothing_measured_or_otherwise_is_said_so() -> None:
    text = render_readme(report(language={"parameters": 6_738_415_616, "taught": ""}), [])
    assert text.count("No answer of the full system was graded.") == 2
    assert "not tested" in text
    assert "place of the paper's" not in text, "a Vicuna is no stand-in"
    assert "<details>" not in text, "nothing is otherwise"


@pytest.mark.parametrize(
    ("effects", "shown"),
    [
        ([effect(**TOUCH, p_holm=0.01)], "PC real - swapped +10.0"),
        ([effect(**TOUCH)], ""),
        ([effect(**TOUCH, objects=5)], "(5 objects are too few for that)"),
        # A gain that only reaches chance is one of form; a loss is not.
        ([effect(**TOUCH, task="PSS", p_holm=0.01)], ""),
        ([effect(task="PSS", p_holm=0.01, difference=-0.3)], "PSS with - without -30.0"),
        ([effect(p_holm=0.01), effect("opd", "all - none")], "PC with - without +10.0 points; "),
        ([effect("touch", "real - removed", p_holm=0.01)], "`real - swapped` can show, which was not tested"),
    ],
)
def test_only_what_is_significant_and_above_chance_holds_up(effects: list[dict[str, Any]], shown: str) -> None:
    """Answers to PC are better than chance, those to PSS are not."""
    said = finding(report([score("PC"), score("PSS", low=0.2)], effects))[2]
    assert shown in said
    assert ("none holds up" in said) == (shown == "" or "too few" in shown)


@pytest.mark.parametrize("part", ["language", "encoder"])
def test_random_base_models_are_said_to_be_chance_first(part: str) -> None:
    """By what the models are, whatever the scale is called."""
    said = report([score()])
    random = {"data/weights/tiny-llama": True, "data/weights/smollm2": False, "elsewhere/data/weights/tiny-clip": False}
    for folder, known in random.items():
        said.provenance["base_models"][part]["folder"] = folder
        assert finding(said)[0].startswith("The base models are tiny and random") == known
    assert "tiny and random" not in finding(report([score()], scale="smoke"))[0]


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

"""The registry of tables, published figures in columns of their own, and each rule of what a README may claim."""

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from pipeline.core.records import Part
from pipeline.report import load
from pipeline.report.build import dataset_frame
from pipeline.report.load import KEYS, load_report, published, read_frame
from pipeline.report.provenance import beyond_paper, provenance
from pipeline.report.readme import finding, render_readme
from pipeline.report.tables import FIVE_TASKS, SHIPPED_TABLE, TABLES, headline, side_by_side, task_title
from pipeline.scales import compose
from pipeline.tasks import TASKS
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Assignment
from tests.conftest import ROOT, fake_videos, refused
from tests.report.conftest import effect, report, score

PRINTED = [f"Published {model} % (n, ~ inferred)" for model in ("7b", "13b", "PG-InstructBLIP")]
BY_KEY = {table.key: table for table in TABLES}


def build(key: str, *rows: dict[str, object], dataset: str = load.DATASET) -> pd.DataFrame:
    return BY_KEY[key].build(report(rows, dataset=dataset))


def test_the_papers_combinations_and_annotations(catalogue: Catalogue) -> None:
    """Also those that no object has by its ratings: the paper's counts add up to its 74 objects."""
    rows = dataset_frame(catalogue, [], []).set_index("table").loc["property_combinations"]
    assert (len(rows), rows["objects"].sum(), rows["published"].sum()) == (27, 74, 74)
    unseen = rows[rows["objects"] == 0].set_index("row")["published"]
    assert dict(unseen[unseen > 0]) == {"soft, smooth, big bumps": 1, "soft, rough, big bumps": 3}
    other = catalogue.model_copy(update={"language": catalogue.language.model_copy(update={"dataset": "another"})})
    own = dataset_frame(other, [], []).set_index("table").loc["property_combinations"]
    assert own["objects"].min() > 0, "of four properties of five classes there would be 625"
    numbers = zip(catalogue.objects, [5] * 42 + [6] * 26 + [7] * 6, strict=True)
    videos = [video for o, number in numbers for video in fake_videos([o], number)]
    rows = dataset_frame(catalogue, videos, []).set_index(["table", "row"])
    assert dict(rows.loc["videos_per_object"]["objects"]) == {"5": 42, "6": 26, "7": 6}
    assert [*rows.loc["annotations"]["annotations"]] == [3 * 408] * 3, "by three raters: the paper's over 1,200"


def test_effects_are_written_in_points_and_what_is_unknown_is_empty() -> None:
    rows = effect(difference=-0.125, low=-0.3, high=0.05), effect("opd", "all - none", low=None, high=None, p=None)
    shown = BY_KEY["effects"].build(report(effects=rows))
    assert list(shown["Difference, points [95 %]"]) == ["-12.5 [-30.0, +5.0]", "+10.0"]
    assert list(shown["p"]) == ["0.200", ""]
    assert list(shown["Smallest that could be found, before Holm"]) == ["25.0", "25.0"]
    assert BY_KEY["touch_effects"].build(report(effects=rows)).empty
    assert list(build("touch", score(unread=None))["Unread %"]) == [""], "it was not counted"


@pytest.mark.parametrize(
    ("key", "systems"),
    [
        ("understanding", ["Octopi (full system)", "without OPD"]),
        ("encoder_understanding", ["Octopi (full system)", "base encoder"]),
        ("lora_understanding", ["Octopi (full system)", "without LoRA"]),
    ],
)
def test_each_of_the_papers_tables_changes_one_part_only(key: str, systems: list[str]) -> None:
    axes = itertools.product(("base", "finetuned"), ("without", "with"), ("none", "needed", "all"))
    shown = build(key, *(score(variant=" ".join(v)) for v in axes), score(seed="0"), score(touch="swapped"))
    assert list(shown["System"]) == systems
    assert all(shown[PRINTED[0]])


def test_all_other_variants_are_those_that_no_table_of_an_ablation_has() -> None:
    axes = itertools.product(("base", "finetuned"), ("without", "with"), ("none", "needed", "all"))
    shown = build("variants", *(score(variant=" ".join(v)) for v in axes))
    left = ["finetuned with needed", "finetuned without none", "base with none", "base without all"]
    found = [" ".join(row) for row in shown[["Encoder", "LoRA", "OPD"]].itertuples(index=False)]
    assert {v.replace("finetuned", "fine-tuned") for v in left} < {*found}
    assert len(found) == 12 - 4


def test_tasks_stand_where_they_belong_whole_answers_first() -> None:
    heads = {"variant": "finetuned  ", "measure": "combined"}
    rows = [score(task, variant="finetuned with all") for task in ("PSR", "POM", "PC")]
    rows += [score("OPD", m) for m in ("hardness", "combined")]
    rows += [score("heads", **heads), score("heads_validation", **heads)]
    whole_report = report(rows)
    tasks = {key: list(t.build(whole_report).get("Task", [])) for key, t in BY_KEY.items()}
    assert tasks["understanding"] == [task_title("PC"), task_title("POM")]
    assert tasks["reasoning"] == [task_title("PSR")]
    whole = ["OPD", "PC", "POM", "PSR"]
    assert list(headline(whole_report.scores)["task"]) == whole
    assert tasks["touch"] == [task_title(task) for task in whole]
    assert tasks["heads"] == [task_title(task) for task in ("heads", "heads_validation")]
    assert list(build("description", *rows)["Measure"]) == ["all properties right", "hardness", "all properties right"]
    assert list(build("description", *rows)["Published CLIP % (n, ~ inferred)"]) == ["", "", "57.89 (~38)"]


def test_nothing_measured_is_no_table() -> None:
    assert not any(table.block(report()) for table in (FIVE_TASKS, SHIPPED_TABLE, *TABLES))


def test_a_new_task_is_in_all_tables_of_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    toy = SimpleNamespace(title="Telling toys apart", trained=True, measure="choice", told="")
    monkeypatch.setitem(TASKS, "TOY", toy)
    for table in (FIVE_TASKS, BY_KEY["understanding"], BY_KEY["touch"]):
        assert list(table.build(report([score("TOY")]))["Task"]) == ["Telling toys apart (TOY)"]
    assert build("reasoning", score("TOY")).empty


def test_read_and_compared_answers_stand_side_by_side() -> None:
    rows = score("PC", strict=0.25), score("PC", variant="base with all", strict=0.0), score("PSR")
    shown = build("strict", *rows)
    assert list(shown["As published %"]) == ["25.0", "0.0"]
    assert list(shown["Measured % [95 %]"]) == ["50.0 [35.0, 65.0]"] * 2
    assert build("strict", score("PC"), score("PSR")).empty, "nothing was compared"


def test_reports_stand_side_by_side_with_every_row_of_the_paper() -> None:
    """7b measured two rows, 13b three others and, by seed and with other touch, what belongs to no row."""
    small = report([score("PC"), score("OPD", "combined")])
    large = report(
        [
            score("PC", accuracy=0.6, low=0.4, high=0.8, n=150),
            score("PC", variant="base with all"),
            score("heads", "hardness", variant="finetuned  "),
            score("PSS", seed="0"),
            score("PSS", touch="swapped"),
        ]
    )
    reports = {"7b here": small, "13b here": large}
    few = side_by_side(reports, every=False).set_index("Task")
    heads = [f"Measured {name} % [95 %] (n)" for name in reports]
    assert list(few.columns) == [*PRINTED[:2], *heads]
    assert list(few.index) == [task_title(task) for task in ("OPD", "PC", "PSS", "POM", "PSR")]
    compared = ["48.10 (~158)", "55.06 (~158)", "50.0 [35.0, 65.0] (40)", "60.0 [40.0, 80.0] (150)"]
    assert list(few.loc["Property Comparison (PC)"]) == compared
    assert list(few.loc["Property Superlative Selection (PSS)"][heads]) == ["", ""]
    every = side_by_side(reports, every=True)
    cells = published()
    answered = cells[cells["model"].isin(["7b", "13b", "CLIP"])]
    fruit = every[every["Task"].str.endswith(", avocados")]
    assert len(every) - len(fruit) == len(answered.drop_duplicates(list(KEYS))) == 32
    pressed = fruit.set_index("System")[PRINTED[1:]].T.to_dict("list")
    assert len(fruit) == 5
    assert pressed["Octopi (full system): all properties right"] == ["35.50 (200)", "0.00 (200)"]
    assert pressed["Octopi (full system): bumpiness"] == ["64.00 (200)", "9.50 (200)"]
    base = every[every["System"].eq("base encoder") & every["Task"].eq("Property Comparison (PC)")]
    assert base[heads].to_numpy().tolist() == [["", "50.0 [35.0, 65.0] (40)"]]
    assert (every[heads] != "").sum().tolist() == [2, 3]


def test_reports_about_other_data_stand_beside_what_is_published_of_these() -> None:
    fruit, paper = report([score("RIPE"), score("PC")], dataset="avocados"), report([score("PC")])
    own = report([score("PC")], dataset="Other")
    rows = side_by_side({"fruit": fruit, "own": own, "paper": paper}, every=False).set_index("Task")
    heads, here = [f"Measured {name} % [95 %] (n)" for name in ("fruit", "own", "paper")], "50.0 [35.0, 65.0] (40)"
    assert list(rows.columns) == [*PRINTED, *heads]
    assert list(rows.loc["Property Comparison (PC)"]) == ["48.10 (~158)", "55.06 (~158)", "", "", "", here]
    assert list(rows.loc["Ripeness Classification (RIPE), avocados"]) == ["", "63.00 (100)", "", here, "", ""]
    assert list(rows.loc["Property Comparison (PC), Other"]) == ["", "", "", "", here, ""]
    assert heads[1] not in side_by_side({"own": own, "paper": paper}, every=True)
    assert side_by_side({"own": own}, every=True).empty


@pytest.mark.parametrize("dataset", load.DATASETS)
def test_published_keys_are_unique_percentages_of_n_and_of_registered_tasks(catalogue: Catalogue, dataset: str) -> None:
    cells = published(dataset)
    assert not cells.duplicated([*KEYS, "model"]).any()
    answered = cells[cells["model"].isin(["7b", "13b", "CLIP"])]
    asked = answered["n"].str.removeprefix("~").str.split("/").explode().astype(int)
    # Percentages of the same questions share their n; two printed digits leave so much of a question open.
    whole = answered["value"][asked.index] * asked / 100
    assert ((whole - whole.round()).abs() <= 0.005 * asked / 100 + 1e-9).all()
    assert (answered["n"].str.startswith("~") == (dataset == load.DATASET)).all(), "the paper counts avocados alone"
    theirs = {"OPD", "PC", "PSS", "POM", "PSR", "heads"} if dataset == load.DATASET else {"OPD", "RIPE"}
    assert set(answered["task"]) == theirs
    assert theirs <= {*TASKS, "heads"}
    for row in cells[cells["model"] == "chance"].to_dict("records"):
        assert row["value"] == pytest.approx(100 * TASKS[row["task"]].chance(catalogue)[row["measure"]], abs=0.005)
    assert published("Other").empty
    assert {*pd.read_csv(Path(load.__file__).with_name("published.csv"))["dataset"]} == {*load.DATASETS}


def test_a_folder_that_is_no_report_or_lacks_a_column_is_one_line(tmp_path: Path) -> None:
    with refused("no report"):
        load_report(tmp_path)
    (tmp_path / "scores.csv").write_text("task,measure\nPC,choice\n")
    with refused(r"scores.csv: lacks encoder, lora"):
        read_frame(tmp_path / "scores.csv", load.SCORE_COLUMNS)


TOUCH = {"part": "touch", "change": "real - swapped"}
RULES = {"part": "language", "change": "full system - heads and rules"}


def test_what_was_found_and_what_it_stands_on() -> None:
    rows = [score("OPD", "combined", low=0.5), score("PC"), score("PSS", low=0.0, high=0.2)]
    effects = [effect(**RULES, difference=-0.17, p_holm=0.01), effect(), effect(**TOUCH, p_holm=0.01)]
    found = {"questions.restate": True, "lora.dropout": 0.0, "language.start": "pipeline/pretrained/octopi-small"}
    folds = {"folds": {"of": 5, "tested": [0, 2], "trained": 0}, "replicates": 2}
    noted = {"settings": "Looked at before.", "facts_told": True, "intervals": "Known to be narrow."}
    noted["evaluated"] = [{"folder": name, "sha256": "", "facts": name == "like"} for name in ("like", "unlike")]
    text = render_readme(report(rows, effects, beyond_paper=found, **folds, **noted), ["effects.png", "map.png"])
    first, stands_on = text.split("## What the figures stand on")
    assert "in 2 of 3 tasks (OPD, PC) and below it in PSS" in first
    assert "PC full system - heads and rules -17.0, PC real - swapped +10.0 points" in first
    assert "went on from `octopi-small`" in first
    assert "(3 of 5 folds are still to be run)" in first
    told = ("a 2.2 M-parameter Llama, taught by hand", "2 of 5 folds (0, 2)", "Looked at before.", "to be narrow.")
    assert all(fact in stands_on for fact in told)
    assert "**Matching questions** say what the named objects are like" in stands_on
    assert "**Matching questions** do not say to `unlike`" in stands_on
    assert "`like`" not in stands_on.split("## Where it comes from")[0]
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
        (
            [effect("touch", "real - removed", p_holm=0.01)],
            "depend on what was touched, and was not tested",
        ),
    ],
)
def test_only_what_is_significant_and_above_chance_holds_up(effects: list[dict[str, Any]], shown: str) -> None:
    """Answers to PC are better than chance, those to PSS are not."""
    said = finding(report([score("PC"), score("PSS", low=0.2)], effects))[2]
    assert shown in said
    assert ("none holds up" in said) == (shown == "" or "too few" in shown)


@pytest.mark.parametrize("part", ["language", "encoder"])
def test_random_base_models_are_said_to_be_chance_first(part: str) -> None:
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


@pytest.mark.parametrize(("wanted", "told"), [("test", 1), ("all", 2)])
def test_a_report_counts_the_objects_that_trained_models_are_asked_about(
    catalogue: Catalogue, tmp_path: Path, wanted: str, told: int
) -> None:
    (tmp_path / "params.yaml").touch()
    params = compose("evaluate", [f"evaluate.objects={wanted}"], ROOT / "conf")
    videos = fake_videos(dict.fromkeys([*catalogue.objects][:2], 3))
    split = [Assignment(video_id=v.video_id, object_id=v.object_id, part=Part.TEST) for v in videos[:3]]
    said = provenance(params, catalogue, videos, [split], [], tmp_path)
    assert (len(said["test_objects"]), said["test_videos"]) == (told, 3 * told)


def test_every_setting_that_is_not_papers_is_counted_and_named_in_the_fold() -> None:
    def beyond(scale: str, *overrides: str) -> dict[str, Any]:
        return beyond_paper(compose(scale, overrides, ROOT / "conf"), ROOT / "conf")

    idle = ("encoder.feature_stage=1", "pretrain.steps=1", "questions.wording=texts", "seed=1")
    assert beyond("paper-13b", *idle) == {}, "and batches are computed in other parts"
    assert beyond("paper-7b", "lora.rank=3", "frames.fraction=0.9") == {"frames.fraction": 0.9, "lora.rank": 3}
    found = beyond("small", "questions.plainly=0.7", "pretrain.steps=1")
    assert (found["questions.plainly"], found["pretrain.steps"], found["align.begin_with_words"]) == (0.7, 1, True)
    assert "encoder.embedding" not in found, "CLIP's alone"
    # The start has its connector; a place of this machine is not told.
    begun = beyond("small", "language.start=/home/me/model", "lora.samples=480")
    assert (begun["language.start"], begun["lora.samples"]) == ("model", 480)
    assert not {"align.begin_with_words", "language.normalize_touch"} & {*begun}

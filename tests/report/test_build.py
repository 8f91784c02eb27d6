"""A whole report from a made-up run: its files, its figures recomputed, runs that lack something, equal bytes."""

import itertools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from safetensors.torch import load_file

from pipeline.config.params import load_params
from pipeline.core.io import read_jsonl, read_table, write_table
from pipeline.core.records import Part, Prediction, Question
from pipeline.encoder.records import Classification
from pipeline.evaluation.calibration import fit_temperature
from pipeline.evaluation.records import Graded, GradedVision, Shown
from pipeline.report.build import MOST_METRICS, finish_report, without_places, write_report
from pipeline.report.figures import STYLE, draw_effects
from pipeline.report.load import DATASET, load_report
from pipeline.report.page import data_tables, write_page
from pipeline.report.provenance import base_model, digest
from pipeline.report.tables import TABLES
from pipeline.videos.catalogue import Catalogue
from tests.checkpoints import contents, edit, model_folder
from tests.closure import ROOT
from tests.fake_run import fake_params, write_run

pytestmark = pytest.mark.slow
FILES = {
    *("README.md", "params.yaml", "provenance.json", "metrics.json", "samples.json", "scores.csv", "effects.csv"),
    *("calibration.csv", "curves.csv", "confusion.csv", "map.csv", "described.csv", "dataset.csv", "audit.csv"),
    *(f"figures/{name}.png" for name in ("effects", "confusion", "curves", "map")),
}
ONE = ("ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[all]", "ablation.touch=[]")


def test_everything_that_was_promised_is_there_in_the_folder_that_dvc_knows(written: Path) -> None:
    assert set(contents(written)) == FILES
    stage = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"]["report"]
    assert stage["outs"] == [{"reports/${scale}-${data.source}": {"cache": False}}]
    text = (written / "README.md").read_text()
    assert set(re.findall(r"\]\(([^)#]+)\)", text)) == {*FILES, "../index.html"} - {"README.md", "metrics.json"}
    assert all(table.title in text for table in TABLES if table.key != "ratings"), "no model was adapted"


@pytest.mark.parametrize("path", ["/home/me/my videos", "'/home/me/my videos'", "~/my videos", "/home/me/my videos/"])
def test_a_report_names_no_place_of_the_machine(path: str) -> None:
    text = "# By hand\ndata:\n  dir: {}\n  catalogue: pipeline/physiclear\ntracking:\n  uri: {}\n"
    assert without_places(text.format(path, "http://me:secret@host")) == text.format("my videos", "''")
    shown = base_model(Path(), path.strip("'"))["folder"]
    assert shown == base_model(Path("/home/me"), "my videos")["folder"] == "my videos"


def test_classes_may_read_like_nothing_or_like_numbers(written: Path, tmp_path: Path) -> None:
    report = Path(shutil.copytree(written, tmp_path / "report"))
    lines = ("seed,video_id,property,rated,predicted", "0,v0,roughness,None,1", "0,v1,roughness,1,None")
    (report / "confusion.csv").write_text("\n".join(lines) + "\n")
    places = ("encoder,method,video_id,x,y,roughness", "base,PCA,v0,1,2,None", "base,PCA,v1,1e-3,4,1")
    (report / "map.csv").write_text("\n".join(places) + "\n")
    edit(report / "provenance.json", properties={"roughness": ["None", "1"]})
    drawn = ("confusion.png", "map.png")
    for name in drawn:
        (report / "figures" / name).unlink()
    finish_report(report)
    assert {name for name in drawn if (report / "figures" / name).is_file()} == {*drawn}


def test_confusion_and_metrics_are_the_heads_on_test_videos(written: Path) -> None:
    run, frame = written.parents[1], pd.read_csv(written / "confusion.csv")
    said = [run / "data" / "encoder" / str(seed) / "classifications.parquet" for seed in (0, 1)]
    found = [c for file in said for c in read_table(file, Classification) if c.part is Part.TEST]
    assert len(frame) == len(found)
    assert (frame["rated"] == frame["predicted"]).sum() == sum(c.expected == c.predicted for c in found)
    metrics = json.loads((written / "metrics.json").read_text())
    rough = [c.expected == c.predicted for c in found if c.property == "roughness"]
    assert metrics["encoder_roughness"] == pytest.approx(np.mean(rough), abs=1e-6)
    assert {"OPD", "PC", "PSS", "POM", "PSR", "encoder_combined"} <= set(metrics)
    assert len(metrics) <= MOST_METRICS


def test_what_is_said_of_each_test_video_stands_beside_its_labels(written: Path, catalogue: Catalogue) -> None:
    data, levels = written.parents[1] / "data", {p.name: p.levels for p in catalogue.properties}
    frame = pd.read_csv(written / "described.csv").set_index(["seed", "video_id"])
    for seed in (0, 1):
        said = read_table(data / "encoder" / str(seed) / "classifications.parquet", Classification)
        for c in (c for c in said if c.part is Part.TEST):
            row, words = frame.loc[(seed, c.video_id)], levels[c.property]
            assert (row[c.property], row[f"{c.property}, heads"]) == (words[c.expected], words[c.predicted])
            others = [o for o in said if o.property == c.property and o.part is Part.VALIDATION]
            power = np.array(c.probabilities) ** (1 / fit_temperature(others))
            assert row[f"{c.property}, probability"] == pytest.approx(power[c.predicted] / power.sum(), abs=1e-4)
        answers = read_jsonl(data / "answers" / f"finetuned-with-all-{seed}" / "real.jsonl", Prediction)
        told = {a.question_id: " ".join(a.outputs[0].split()) for a in answers}
        questions = read_jsonl(data / "questions" / str(seed) / "evaluation.jsonl", Question)
        own = frame.loc[seed]["sentence"].dropna()
        assert len(own) > 3
        assert dict(own) == {q.videos[0]: told[q.question_id] for q in questions if q.task == "OPD"}


def test_curves_name_their_stages_as_dvc_does(written: Path) -> None:
    curves = pd.read_csv(written / "curves.csv")
    assert {"finetune_encoder@0", "align@base-none-1", "lora@finetuned-all-0"} <= set(curves["stage"])
    assert curves[curves["stage"] == "align@base-none-1"]["value"].tolist() == [4 / (1 + s / 9) for s in range(1, 9)]


def test_provenance_counts_and_hashes_the_models(written: Path, tmp_path: Path) -> None:
    said = load_report(written).provenance
    language = said["base_models"]["language"]
    assert (language["kind"], language["taught"]) == ("Llama", "drawn at random and taught nothing")
    stored = load_file(model_folder("tiny-llama") / "model.safetensors")
    assert language["parameters"] == sum(t.numel() for t in stored.values())
    assert said["test_objects"] == ["bath_towel", "hairbrush_bristles", "ice_block", "toilet_brush_bristles"]
    assert (said["seeds"], said["folds"], said["properties"]["roughness"][0]) == ([0, 1], None, "smooth")
    folder = Path(shutil.copytree(model_folder("tiny-llama"), tmp_path / "m"))
    (folder / ".when").write_text("downloaded now")
    assert digest(folder) == language["sha256"], "hidden files do not count"
    (folder / "y").write_text("more")
    assert digest(folder) != language["sha256"]
    absent = base_model(tmp_path, "nowhere")
    assert (absent["parameters"], absent["sha256"], absent["taught"]) == (0, "unknown", "")


def test_samples_are_the_first_right_and_wrong_answer_of_each_task(written: Path) -> None:
    data, said = written.parents[1] / "data", load_report(written).samples
    every = read_table(data / "graded.parquet", Graded)
    full = [g for g in every if (g.variant.key, g.touch) == ("finetuned-with-all-0", "real")]
    graded = [g for g in full if g.measure == ("combined" if g.task == "OPD" else "choice")]
    for task in ("OPD", "PC", "PSS", "POM", "PSR"):
        for right in (True, False):
            wanted = sorted(g.question_id for g in graded if g.task == task and g.correct is right)[:1]
            assert [s["question_id"] for s in said["samples"] if (s["task"], s["right"]) == (task, right)] == wanted
    assert said["samples"][0]["videos"]
    assert "[video A]" in " ".join(said["samples"][0]["asked"])
    assert "{tactile}" not in json.dumps(said)


def test_the_data_sets_tables_count_objects_and_set_the_papers_beside(written: Path) -> None:
    shown = {block.key: block.frame for block in data_tables(written, DATASET)}
    counts = shown["property_counts"].set_index("")
    parts = {"With videos": "6", "Train": "4", "Validation": "1", "Test": "1"}
    soft = {"Objects": "11", "Percent": "14.86", **parts, "Published": "26.0"}
    assert dict(counts.loc["hardness: soft"]) == soft
    assert counts["With videos"].astype(int).sum() == 3 * 19
    assert list(shown["video_lengths"][""]) == ["average", "median", "minimum", "maximum"]
    assert list(shown["annotator_agreement"]["Published"]) == ["0.894", "0.979", "0.792"]
    assert shown["audit"]["Findings"].tolist() == ["3"]
    others = {block.key: block.frame for block in data_tables(written, "Other")}
    assert "Published" not in others["annotator_agreement"]


def test_two_writes_are_equal_to_the_byte_whatever_another_run_left(written: Path) -> None:
    """DVC removes no output of a seed that params.yaml names no more."""
    before, root = contents(written), written.parents[1]
    (written / "figures" / "of_last_year.png").write_bytes(b"")
    places = ("encoder/9", "models/with/finetuned-all-9", "models/without/finetuned-all-9")
    left = [root / "data" / place for place in places]
    for folder in left:
        shutil.copytree(folder.with_name(f"{folder.name[:-1]}0"), folder)
    try:
        write_report(load_params(root / "params.yaml"), root)
        assert contents(written) == before
    finally:
        for folder in left:
            shutil.rmtree(folder)


def test_a_run_that_measured_nothing_says_so_and_shows_no_picture_of_its_videos(tmp_path: Path) -> None:
    objects = "scenes.objects=[baseball,rug,pillow]"
    params = write_run(tmp_path, fake_params(objects, *ONE, "data.source=videos", "data.dir=elsewhere"))
    for file in ("audit/audit.csv", "encoder/0/classifications.parquet", "questions/0/evaluation.jsonl"):
        (tmp_path / "data" / file).unlink()
    write_report(params, tmp_path)
    report = load_report(tmp_path / "reports" / params.report_name)
    assert report.scores.empty
    assert report.effects.empty
    assert json.loads((report.folder / "metrics.json").read_text()) == {}
    assert set(contents(report.folder)) == FILES - {f"figures/{name}.png" for name in ("effects", "confusion", "map")}


def evaluated(root: Path, model: str, *right: int, shown: Shown = Shown.TOUCH) -> None:
    """What one more model that was trained before answered to 40 comparisons in each set, so many of them rightly."""
    said = {"task": "PC", "measure": "choice", "model": model, "shown": shown, "parsed": True}
    said |= {"truncated": False, "expected": "yes", "predicted": "yes"}
    rows = [
        GradedVision(question_id=f"PC-{i}-{s}", correct=i < count, objects=(f"o{i}", f"p{i}"), seed=s, **said)
        for s, count in enumerate(right)
        for i in range(40)
    ]
    file = root / "data" / "evaluated.parquet"
    write_table(file, GradedVision, [*(read_table(file, GradedVision) if file.is_file() else ()), *rows])


def test_the_shipped_models_answers_come_first_and_the_plumbing_is_folded(tmp_path: Path) -> None:
    params = write_run(tmp_path, fake_params(*ONE, "questions.evaluation={opd:4,pc:4,pss:4,pom:0,psr:4}"))
    metrics = write_report(params, tmp_path)
    assert [name for name in metrics if name.isupper()] == ["OPD", "PC", "PSS", "PSR"]
    usual = load_report(tmp_path / "reports" / params.report_name)
    assert "Models that were trained before" not in (usual.folder / "README.md").read_text()
    evaluated(tmp_path, "octopi-small", 30)
    write_report(params, tmp_path)
    report = load_report(tmp_path / "reports" / params.report_name)
    text = (report.folder / "README.md").read_text()
    first = ("Models that were trained before", "<details>", "The full system's interval", "</details>")
    places = [text.index(words) for words in first]
    assert places == sorted(places)
    assert "| Property Comparison (PC) | octopi-small, as it is | 75.0 [" in text[: places[1]]
    assert len(report.scores) == len(usual.scores) + 2, "of its seed, and over all"
    page = write_page(tmp_path).read_text()
    order = [page.index(f'id="{params.report_name}-{part}"') for part in ("shipped", "tasks", "stands-on")]
    assert order == sorted(order)
    assert "75.0 [" in page[order[0] : order[1]]


def test_the_learning_curve_is_a_table_and_a_figure(tmp_path: Path) -> None:
    params = write_run(tmp_path, fake_params(*ONE, "ablation.train=false", "questions.evaluation={pc:4}"))
    for model, right in (("m", 10), ("m, adapted by 20", 30), ("m, adapted by 3", 20)):
        evaluated(tmp_path, model, right)
        evaluated(tmp_path, model, right, shown=Shown.CLASSES)
    write_report(params, tmp_path)
    folder = tmp_path / "reports" / params.report_name
    text = (folder / "README.md").read_text()
    assert re.findall(r"\(PC\) \| (\d+) \| (m|its heads[^|]*) \| (\S+) ", text) == [
        ("3", "m", "50.0"),
        ("3", "its heads and rules alone", "50.0"),
        ("20", "m", "75.0"),
        ("20", "its heads and rules alone", "75.0"),
    ]
    assert text.count("| m, as it is | 25.0") == 1
    assert "ratings.png" in [f.name for f in (folder / "figures").iterdir()]


def test_a_run_that_trains_nothing_reports_models_that_were_trained_before(tmp_path: Path) -> None:
    only = ("ablation.train=false", "questions.evaluation={opd:0,pc:4,pss:0,pom:0,psr:0}")
    params = write_run(tmp_path, fake_params(*ONE, *only))
    evaluated(tmp_path, "octopi-7b", 20, 25, 30)
    assert write_report(params, tmp_path) == {"octopi-7b_PC": 0.625}
    text = (tmp_path / "reports" / params.report_name / "README.md").read_text()
    assert "| octopi-7b, as it is | 62.5 [" in text
    assert "| 120 (40) | 50.0 to 75.0 (3) |" in text
    assert "full system" not in text
    page = write_page(tmp_path).read_text()
    assert "62.5 [" in page
    assert f'id="{params.report_name}-tasks"' not in page


def test_titles_of_effects_lie_in_the_figure_and_not_on_each_other() -> None:
    effects = load_report(ROOT / "reports" / "small-videos").effects
    assert effects["change"].str.len().max() > 50, "a long one is among them"
    with rc_context(STYLE):
        figure = draw_effects(effects)
        FigureCanvasAgg(figure).draw()
    boxes = [axes.title.get_window_extent() for axes in figure.axes]
    assert all(figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1 for box in boxes)
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))

"""Another lab's data: a made-up catalogue with a fourth property of four classes and no optional column."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import yaml
from safetensors.numpy import load_file

from pipeline.core.io import read_jsonl, read_table
from pipeline.core.records import Part, Question
from pipeline.report.build import write_report
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment
from tests.closure import ROOT
from tests.fake_run import fake_params, write_run
from tests.project import OBJECTS, REDUCED, Project, copy_project
from tests.report.conftest import rows_of
from tests.tasks.shared import drafted, grade

PHYSICLEAR = ROOT / "pipeline" / "physiclear"
LEVELS = ["not sticky", "slightly sticky", "sticky", "very sticky"]
PARTS = ("train",) * 4 + ("validation",) + ("test",) * 4


def write_catalogue(folder: Path, *, name: str = "stickiness", split: str = "mine") -> Path:
    """Nine of PhysiCLeAR's objects, their ratings, and ratings of `name` by a number of people of its own."""
    language = yaml.safe_load((PHYSICLEAR / "properties.yaml").read_text())
    del language["dataset"]
    for prop in language["properties"]:
        del prop["cues"]
    words = {"more": "stickier", "less": "less sticky", "most": "stickiest", "least": "least sticky"}
    told = {
        "alone": "Overall, it is {level} to the touch.",
        "phrases": [[f"it lets go like number {n}"] for n in range(4)],
    }
    language["properties"].append({"name": name, "levels": LEVELS, **words, **told})
    language["unstructured"] = language["unstructured"].replace(" and", ",").replace(".", f", and {{{name}}}.")
    language["structured"] = language["structured"].replace(".", f" that is {{{name}}}.")
    target, other = {name: [2, 3]}, {name: [0, 1]}
    language["scenarios"] = [{"name": "note", "question": "Which one holds a note?", "target": target, "other": other}]
    folder.mkdir(parents=True)
    (folder / "properties.yaml").write_text(yaml.safe_dump(language, sort_keys=False))
    known = load_catalogue(PHYSICLEAR).objects
    rows = [f"object_id,split_{split},name,hardness,roughness,bumpiness,{name},ripeness_thing"]
    for number, (object_id, part) in enumerate(zip(OBJECTS, PARTS, strict=True)):
        ratings = ",".join(" ".join(map(str, r)) for r in known[object_id].ratings)
        rows.append(f'{object_id},{part},"{known[object_id].name}",{ratings},{number % 4} {number % 4},{number % 3}')
    (folder / "objects.csv").write_text("\n".join(rows))
    return folder


@pytest.fixture(scope="module")
def pool(tmp_path_factory: pytest.TempPathFactory) -> Pool:
    """Of a catalogue whose fourth property has a name of two words."""
    catalogue = load_catalogue(write_catalogue(tmp_path_factory.mktemp("other") / "catalogue", name="surface_tack"))
    return Pool(Part.TEST, catalogue, {o: [f"{o}_0"] for o in catalogue.objects})


@pytest.mark.parametrize("task", list(TASKS))
def test_every_task_asks_about_it_and_reads_its_own_answers(pool: Pool, task: str) -> None:
    questions = drafted(task, pool, 1)
    assert any("surface_tack" in q.gold.properties for q in questions)
    for question in questions:
        assert all(len(labels) == 4 for labels in question.gold.labels)
        for dialogue in question.dialogues:
            said = " ".join(part for turn in dialogue.turns for part in (turn.user, turn.assistant))
            assert "_" not in said, "a name is spoken in words"
            outputs = [turn.assistant for turn in dialogue.turns]
            assert all(s.correct for s in grade(question, *outputs, catalogue=pool.catalogue)), outputs


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """The chain up to the embeddings, by another backbone; later stages know nothing of the catalogue."""
    project = copy_project(tmp_path_factory.mktemp("other") / "project")
    write_catalogue(project.folder / "my catalogue")
    few = ("questions.train={opd:8,pc:24,pss:24,pom:6}", "questions.evaluation={opd:8,pc:24,pss:24,pom:6,psr:4}")
    timm = (
        *("encoder.recipe=tuned", "encoder.backbone=[timm,scenes]", "encoder.weights=data/weights/efficientnet-lite0"),
        *("pretrain.objects=16", "pretrain.steps=3"),
    )
    project.run("octopi", "scale", *REDUCED, *few, *timm, "data.catalogue='my catalogue'", "split.name=mine")
    project.run("dvc", "repro", "questions", "embed")
    return project


def test_the_chain_runs_on_it(project: Project) -> None:
    data = project.folder / "data"
    for part in ("train", "evaluation"):
        asked = read_jsonl(data / "questions" / "0" / f"{part}.jsonl", Question)
        about = Counter(q.task for q in asked if "stickiness" in q.gold.properties)
        assert {"OPD", "PC", "PSS", "POM"} <= about.keys()
        assert ("PSR" in about) == (part == "evaluation")
        assert all(len(labels) == 4 for q in asked for labels in q.gold.labels)
        assert any("stickiness of both" in turn.user for q in asked for d in q.dialogues for turn in d.turns)
    heads = load_file(data / "encoder" / "0" / "encoder.safetensors")
    assert [len(heads[f"heads.{i}.bias"]) for i in range(4)] == [3, 3, 3, 4]
    assert "heads.4.bias" not in heads
    assert "dependence" in heads, "the recipe `tuned` decides the properties together"
    embeddings = load_file(data / "embeddings" / "finetuned-0" / "embeddings.safetensors")
    assert all(np.isfinite(value).all() for value in embeddings.values())
    splits = Counter(a.part for a in read_table(data / "splits" / "0.parquet", Assignment))
    assert splits == {Part.TRAIN: 8, Part.VALIDATION: 2, Part.TEST: 8}


def test_the_report_has_its_rows(tmp_path: Path) -> None:
    """For the fourth property wherever there are rows for properties, and nothing of the paper's."""
    folder = write_catalogue(tmp_path / "catalogue", split="paper")
    params = fake_params(f"data.catalogue='{folder}'", f"scenes.objects=[{','.join(OBJECTS)}]")
    write_run(tmp_path, params)
    write_report(params, tmp_path)
    report, name = tmp_path / "reports" / params.report_name, "stickiness"
    scores = rows_of(report / "scores.csv")
    chances = {row["measure"]: float(row["chance"]) for row in scores if row["task"] in ("OPD", "heads")}
    expected = dict.fromkeys(("hardness", "roughness", "bumpiness"), 1 / 3) | {name: 1 / 4, "combined": 1 / 108}
    assert chances == pytest.approx(expected, abs=1e-6)
    assert {"OPD", "heads"} <= {row["task"] for row in scores if row["measure"] == name}
    videos = {row["video_id"] for row in rows_of(report / "confusion.csv") if row["property"] == name}
    heads = next(row for row in scores if (row["task"], row["measure"]) == ("heads", name))
    assert len(videos) == float(heads["n"])
    dataset = rows_of(report / "dataset.csv")
    counts = {row["row"]: int(row["objects"]) for row in dataset if row["row"].startswith(f"{name}: ")}
    assert [*counts.items()] == [(f"{name}: {level}", n) for level, n in zip(LEVELS, (3, 2, 2, 2), strict=True)]
    together = [row for row in dataset if row["table"] == "property_combinations"]
    assert sum(int(row["objects"]) for row in together) == len(OBJECTS)
    assert all(row["row"].endswith(tuple(LEVELS)) for row in together)
    assert not any(row["published"] for row in dataset)
    readme = (report / "README.md").read_text()
    assert "48.10" not in readme, "the paper's figures are about another data set"
    assert name in readme


def test_the_documented_fourth_property_is_valid(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "data.md").read_text()
    # Lists indent their blocks.
    example, sentences = map(dedent, re.findall(r"^ *```yaml\n(.*?)^ *```$", page, re.M | re.S))
    language = yaml.safe_load((PHYSICLEAR / "properties.yaml").read_text())
    del language["dataset"]
    language["properties"] += yaml.safe_load(example)
    language.update(yaml.safe_load(sentences))
    (tmp_path / "properties.yaml").write_text(yaml.safe_dump(language, sort_keys=False))
    lines = (PHYSICLEAR / "objects.csv").read_text().splitlines()
    (tmp_path / "objects.csv").write_text("\n".join([f"{lines[0]},stickiness", *(f"{line},3 2" for line in lines[1:])]))
    four = load_catalogue(tmp_path)
    assert four.property_names == ("hardness", "roughness", "bumpiness", "stickiness")
    assert four.structured((2, 0, 0, 1)).endswith("a hard and smooth surface with no bumps that is slightly sticky.")

"""What stands in examples/ does what it says."""

import re
import runpy
import shlex
from pathlib import Path

import nbclient
import nbformat
import pandas as pd
import pytest

from pipeline.core.io import read_jsonl, read_table
from pipeline.core.records import Part, Question
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment
from tests.closure import ROOT
from tests.project import copy_project
from tests.use.shared import Made

EXAMPLES = ROOT / "examples"


def test_the_walk_of_a_new_sensor(tmp_path: Path) -> None:
    """As typed from its README, to the questions; from there on tests/chain walks."""
    project = copy_project(tmp_path / "project")
    (project.folder / "examples").mkdir()
    (project.folder / "examples" / "new_sensor").symlink_to(EXAMPLES / "new_sensor")
    readme = (EXAMPLES / "new_sensor" / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", readme, re.DOTALL)
    typed = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    last = typed.index(["octopi", "repro"])
    assert [words[:2] for words in typed[last + 1 :]] == [["octopi", "adapt"], ["octopi", "describe"]]
    for command in typed[:last]:
        output = project.run(*command)
        if command[1] == "data":
            assert "error" not in output, "its videos can be trusted"
    project.run("dvc", "repro", "questions")
    catalogue = load_catalogue(EXAMPLES / "new_sensor")
    data = project.folder / "data"
    parts = {a.object_id: a.part for a in read_table(data / "splits" / "0.parquet", Assignment)}
    listed = pd.read_csv(EXAMPLES / "new_sensor" / "objects.csv").set_index("object_id")["split_lab"]
    assert parts == {name: Part(part) for name, part in listed.items()}, "each object has videos, and its part"
    asked = read_jsonl(data / "questions" / "0" / "evaluation.jsonl", Question)
    assert {q.task for q in asked} == {"OPD", "PC", "PSS", "POM", "PSR"}
    words = " ".join(turn.assistant for q in asked for d in q.dialogues for turn in d.turns)
    for prop in catalogue.properties:
        assert any(level in words for level in prop.levels), "answers speak the lab's words"
    assert "moderately hard" not in words


def test_the_script_runs(made: Made, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(made.videos / f"{name}_0.avi") for name in ("ice_block", "millet")]
    monkeypatch.setattr("sys.argv", ["ask.py", *files, str(made.folder)])
    runpy.run_path(str(EXAMPLES / "ask.py"), run_name="__main__")
    answer, *rest = capsys.readouterr().out.splitlines()
    assert answer
    assert [line for line in rest if not line.startswith(" ")] == files
    assert sum("hardness: " in line for line in rest) == 2


def test_the_notebook_runs(made: Made) -> None:
    notebook = nbformat.read(EXAMPLES / "touch.ipynb", as_version=4)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in cells), "none is committed"
    for ours, theirs in (
        ("pipeline/pretrained/octopi-small", str(made.folder)),
        ("examples", str(made.videos)),
        ("*.mp4", "*.avi"),
    ):
        assert sum(ours in cell.source for cell in cells) == 1
        for cell in cells:
            cell.source = cell.source.replace(ours, theirs)
    place = {"metadata": {"path": str(made.folder.parents[1])}}
    done = nbclient.NotebookClient(notebook, timeout=None, resources=place).execute()
    shown = [
        "".join(o.get("text", "") or o.data["text/plain"] for o in cell.outputs if o.get("name") != "stderr")
        for cell in done.cells
        if cell.cell_type == "code"
    ]
    names = [video.name for video in sorted(made.videos.glob("*.avi"))[:3]]
    assert shown[0] == "('hardness', 'roughness', 'bumpiness')"
    assert "hardness: soft" in shown[1]
    assert all(name in shown[1] for name in names)
    plots = [
        o.data["image/png"] for cell in done.cells for o in cell.get("outputs", ()) if "image/png" in o.get("data", ())
    ]
    assert len(plots) == 1, "of the press"
    assert "from 0 to 2" in shown[3], "the heads' verdict"
    assert shown[4].strip(), "an answer"
    recognised = dict(eval(shown[5]))
    assert max(recognised, key=recognised.__getitem__) == names[0].removesuffix(".avi")

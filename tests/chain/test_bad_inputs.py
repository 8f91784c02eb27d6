"""Bad inputs, each through the command that a person types: one line that names it, and no file touched.

Of what the tests next to the code refuse, a few rows of each kind take the whole way here.
"""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch

from pipeline.cli import main
from pipeline.config.params import PARAMS_FILE, load_params, validate
from pipeline.core.runtime import PORTABLE
from pipeline.scales import write_params
from tests.closure import ROOT
from tests.conftest import moving_square, write_video


def put(name: str, content: str | bytes | None) -> None:
    """A file of the working directory with this content; none for None."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def with_data(**changes: str) -> None:
    values = load_params(PARAMS_FILE).model_dump(mode="json")
    values["data"].update(changes)
    write_params(validate(values, str(PARAMS_FILE)), PARAMS_FILE)


def catalogued(name: str, content: str | bytes) -> None:
    """params.yaml names catalogue/, which is PhysiCLeAR's but for one file."""
    with_data(catalogue="catalogue")
    for file in ("objects.csv", "properties.yaml"):
        put(f"catalogue/{file}", (ROOT / "pipeline/physiclear" / file).read_bytes())
    put(f"catalogue/{name}", content)


def videos(name: str, content: str | bytes) -> None:
    with_data(source="videos", dir="videos")
    write_video(Path("videos/baseball_0.avi"), moving_square(8, 0))
    put(f"videos/{name}", content)


def contents() -> dict[Path, bytes]:
    """Files of the working directory, but for what locks, Git and an audit's findings, errors among them."""
    files = (path for path in Path().rglob("*") if path.is_file() and path.name != "audit.csv")
    return {file: file.read_bytes() for file in files if file.parts[0] not in ("runs", ".dvc", ".git", "checkpoints")}


NOT_THERE = "(no such file|does not exist).*dvc repro"
STAGES = ("split.py", "grade.py", "embed.py", "lora.py finetuned all 0", "report.py", "package.py")
COMMANDS = {
    "scale huge": "paper-7b, rehearsal, small, smoke",
    "scale smoke frames.per_vido=1": "frames.per_vido.*did you mean per_video",
    "scale smoke align.batch_size=10": "align.*does not divide",
    "stages/align.py nonsense all 0": "'nonsense'; usage: stages/align.py {finetuned,base} {none",
    **dict.fromkeys((f"stages/{stage}" for stage in STAGES), NOT_THERE),
    "publish": "dvc.lock: no such file",
    "ask params.yaml": "is a file; write the question",
    "serve nothing --host 0.0.0.0": "token",
    "diff nowhere": "nowhere: no commit",
}
PARAMS = {
    "": "empty; `octopi scale smoke",
    "seed: 1\nseed: 2\n": ".*seed stands twice",
    None: "no such file",
}
OBJECTS = "object_id,name,hardness,roughness,bumpiness\nball,a ball,3,1,1\n"
MINE, FRAMES = "scale smoke data.catalogue=catalogue", "stages/extract_frames.py"
RUG = "rug: {modulus: 1, colour: red}"
ROWS: list[tuple[str, str, Callable[[], object]]] = [
    *((command, words, bool) for command, words in COMMANDS.items()),
    *(
        ("stages/split.py", f"params.yaml: {words}", partial(put, "params.yaml", text))
        for text, words in PARAMS.items()
    ),
    *((command, "params.yaml: not YAML", partial(put, "params.yaml", "scale: [")) for command in ("publish", "repro")),
    # What DVC writes.
    ("repro", "dvc.lock.*git checkout", partial(put, "dvc.lock", "stages: 3\n")),
    # What stages before them left.
    ("stages/split.py", "videos.parquet: not a readable table", partial(put, "data/videos.parquet", "?")),
    ("stages/grade.py", "line 1: not a Question", partial(put, "data/questions/0/evaluation.jsonl", "?\n")),
    (MINE, "objects.csv.*line 2.*hardness.*0 to 2", partial(catalogued, "objects.csv", OBJECTS)),
    ("stages/synthesize.py", "colour: .*docs/scenes.md", partial(catalogued, "scenes.yaml", RUG)),
    (FRAMES, "rug.avi.*<object>_<number>.*rename.*videos.csv", partial(videos, "rug.avi", b"x")),
    ("data check videos", "rug_0.avi", partial(videos, "rug_0.avi", b"not a video")),
    ("data audit videos --split 'Not a name!'", "allowed: paper, release", partial(videos, "notes.txt", "")),
]


@pytest.mark.parametrize(("command", "words", "prepare"), ROWS)
def test_a_bad_input_gets_its_line_and_touches_nothing(
    command: str,
    words: str,
    prepare: Callable[[], object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In a project that knows how to run everything, and has no data."""
    monkeypatch.chdir(tmp_path)
    # Torch's libraries choose their kernels at their first use, for this process's later tests, too.
    torch.ones(8, 8).exp() @ torch.ones(8, 8)
    torch.conv2d(torch.ones(1, 1, 8, 8), torch.ones(1, 1, 3, 3))
    for variable in PORTABLE.items():
        monkeypatch.setenv(*variable)  # NumPy is imported already.
    for name in ("conf", "pipeline", "stages"):
        Path(name).symlink_to(ROOT / name)
    for name in ("dvc.yaml", "params.yaml"):
        shutil.copy(ROOT / name, name)
    subprocess.run(["git", "init", "--quiet"], check=True)
    put(".dvc/config", "[core]\nanalytics = false\n")
    prepare()
    capsys.readouterr()
    before, typed = contents(), shlex.split(command)
    monkeypatch.setattr(sys, "argv", typed if typed[0].endswith(".py") else ["octopi", *typed])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(typed[0], run_name="__main__") if typed[0].endswith(".py") else main()
    out, err = capsys.readouterr()
    said = [line for line in err.splitlines() if line and not re.match(r"WARNING|W\d{4} ", line)]  # torch's
    if isinstance(ended.value.code, str):
        said.append(ended.value.code)
    else:
        assert ended.value.code == 1
    if typed[0] == "data":
        said += [line for line in out.splitlines() if line.startswith("error")]
    (line,) = said
    assert re.search(words, line)
    assert contents() == before

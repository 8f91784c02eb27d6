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
from pathlib import Path

import pytest
import torch

from pipeline.cli import main
from pipeline.core.runtime import PORTABLE
from tests.closure import ROOT


def put(name: str, content: str | None) -> None:
    """A file of the working directory with this content; none for None."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if content is not None:
        path.write_text(content)


def contents() -> dict[Path, bytes]:
    """Files of the working directory, but for locks and Git."""
    files = (path for path in Path().rglob("*") if path.is_file())
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
}
QUESTIONS = "data/questions/0/evaluation.jsonl"
ROWS: list[tuple[str, str, str, str | None]] = [
    *((command, words, "", None) for command, words in COMMANDS.items()),
    # With a file of this content, or without it.
    ("stages/split.py", "params.yaml: empty; `octopi scale smoke", "params.yaml", ""),
    ("stages/split.py", "params.yaml: .*seed stands twice", "params.yaml", "seed: 1\nseed: 2\n"),
    ("stages/split.py", "params.yaml: no such file", "params.yaml", None),
    *((command, "params.yaml: not YAML", "params.yaml", "scale: [") for command in ("publish", "repro")),
    ("repro", "dvc.lock.*git checkout", "dvc.lock", "stages: 3\n"),
    ("stages/split.py", "videos.parquet: not a readable table", "data/videos.parquet", "?"),
    ("stages/grade.py", "line 1: not a Question", QUESTIONS, "?\n"),
]


@pytest.mark.parametrize(("command", "words", "file", "content"), ROWS)
def test_a_bad_input_gets_its_line_and_touches_nothing(
    command: str,
    words: str,
    file: str,
    content: str | None,
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
    if file:
        put(file, content)
    capsys.readouterr()
    before, typed = contents(), shlex.split(command)
    monkeypatch.setattr(sys, "argv", typed if typed[0].endswith(".py") else ["octopi", *typed])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(typed[0], run_name="__main__") if typed[0].endswith(".py") else main()
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines if line and not re.match(r"WARNING|W\d{4} ", line)]  # torch's
    if isinstance(ended.value.code, str):
        said.append(ended.value.code)
    else:
        assert ended.value.code == 1
    (line,) = said
    assert re.search(words, line)
    assert contents() == before

"""Bad inputs as a table, each through the command that a person types: one line that names it, and no file touched.

Of what the tests next to the code refuse, a few rows of each kind take the whole way here.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from pipeline.cli import main
from pipeline.config.params import PARAMS_FILE, load_params, validate
from pipeline.scales import write_params
from tests.checkpoints import write_clip, write_llama
from tests.closure import ROOT
from tests.conftest import moving_square, write_video


class BadInput(NamedTuple):
    """A row: `prepare` makes the input in the working directory, `words` is a regular expression for its line."""

    command: str
    words: str
    prepare: Callable[[], object] = bool
    arguments: Sequence[str] = ()
    """Further ones, which may hold blanks."""


def put(name: str, content: str | bytes | None) -> None:
    """A file of the working directory with this content; none for None."""
    path = Path(name)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


def with_data(**changes: str) -> None:
    """Change the section `data` of params.yaml."""
    values = load_params(PARAMS_FILE).model_dump(mode="json")
    values["data"].update(changes)
    write_params(validate(values, str(PARAMS_FILE)), PARAMS_FILE)


def catalogued(name: str, content: str | bytes) -> None:
    """params.yaml names catalogue/, which is PhysiCLeAR's but for one file."""
    Path("catalogue").mkdir()
    with_data(catalogue="catalogue")
    for file in ("objects.csv", "properties.yaml"):
        shutil.copy(ROOT / "pipeline/physiclear" / file, "catalogue")
    put(f"catalogue/{name}", content)


def videos(name: str, content: str | bytes) -> None:
    """A folder videos/ with a good video and this file."""
    with_data(source="videos", dir="videos")
    write_video(Path("videos/baseball_0.avi"), moving_square(8, 0))
    put(f"videos/{name}", content)


def spoilt(write: Callable[[Path], Path], file: str, length: int | None) -> None:
    """weights/ as `write` makes it, with one file cut to its first bytes, or taken away."""
    write(Path("weights"))
    put(f"weights/{file}", None if length is None else (Path("weights") / file).read_bytes()[:length])


NOT_THERE = "(no such file|does not exist).*dvc repro"
SCALES = {
    "huge": "paper-7b, rehearsal, small, smoke",
    "smoke frames.per_vido=1": "frames.per_vido.*did you mean per_video",
    "smoke frames.fraction=1.5": "frames.fraction.*less than or equal to 1",
    "smoke align.batch_size=10": "align.*does not divide",
    "smoke data.dir=elsewhere": "data.dir.*data/scenes/videos",
    "smoke justaword": "key=value",
    "smoke encoder.weights=nowhere": "hf download timm",
    "smoke scenes.objects=[bath_towel,ice_block]": "no video of a training object",
}
PARAMS: dict[str | bytes | None, str] = {
    "": "octopi scale smoke",
    "scale: [": "not YAML",
    "seed: 1\nseed: 2\n": "seed stands twice",
    b"\xff\xfes": "not UTF-8",
    None: "no such file",
}
CATALOGUES: tuple[tuple[str, str | bytes, str], ...] = (
    ("objects.csv", "ball;a ball\n", "missing"),
    ("objects.csv", "object_id,name,hardness,roughness,bumpiness\nball,a ball,3,1,1\n", "line 2.*hardness.*0 to 2"),
    ("properties.yaml", "properties: [", ""),
    ("properties.yaml", b"\xff\xfe", ""),
    ("scenes.yaml", "rug: {modulus: 1, colour: red}", "rug: colour: .*docs/scenes.md"),
    ("scenes.yaml", b"rug: \xff\xfe", "correct it, or remove it"),
)
VIDEOS: tuple[tuple[str, str | bytes, str], ...] = (
    ("rug.avi", b"x", "rug.avi.*<object>_<number>.*rename.*videos.csv"),
    ("rug_0.avi", b"not a video", "videos/rug_0.avi"),
    ("videos.csv", "file,object_id\ngone.mov,rug\n", "line 2: no video 'gone.mov' in the folder; correct the line"),
)
STAGES = {
    "align.py nonsense all 0": "encoder is 'nonsense'; allowed: finetuned, base.*python stages/",
    "align.py finetuned all": "2 values instead of 3.*python stages/",
    "lora.py finetuned al 0": "opd is 'al'; allowed: none, needed, all.*python stages/",
    "finetune_encoder.py -1": "seed is '-1'.*python stages/",
    **dict.fromkeys(("split.py", "audit.py", "questions.py", "grade.py"), NOT_THERE),
    **dict.fromkeys(("finetune_encoder.py 0", "embed.py", "align.py finetuned all 0", "report.py"), NOT_THERE),
    **dict.fromkeys(("lora.py finetuned all 0", "answer.py finetuned with all 0", "package.py"), NOT_THERE),
}
LEFT = {
    ("split.py", "data/videos.parquet"): "videos.parquet: not a readable table.*dvc repro",
    ("questions.py", "data/splits/0.parquet"): "0.parquet: not a readable table.*dvc repro",
    ("align.py finetuned all 0", "data/questions/0/train.jsonl"): "train.jsonl, line 1: not a Question.*dvc repro",
    ("grade.py", "data/questions/0/evaluation.jsonl"): "evaluation.jsonl, line 1: not a Question.*dvc repro",
}
"""What stages before them left, as garbage."""
COMMANDS = {
    "weights gpt": "smollm2",
    "publish": "dvc.lock: no such file",
    "ask --model nothing": "nothing: .*|holds no",
    "describe videos --csv t.csv --model nothing": "nothing: .*|holds no",
    "export nothing there": "nothing: .*|holds no",
    "serve nothing": "nothing: .*|holds no",
    "demo nothing": "nothing: .*|holds no",
    "ask --model stages": "stages: holds no .*so it is no trained model",
    "ask --model nothing --device gpu": "allowed: auto, cpu, cuda, mps",
    "ask params.yaml": "is a file; write the question",
    "ask --json": "--json takes a question",
    "serve nothing --host 0.0.0.0": "token",
    "import bag none.bag --topic /a --out out": "none.bag",
    "diff nowhere": "nowhere: no commit",
    "page": "report",
}


def bad_inputs() -> Iterator[BadInput]:
    """Every row."""
    yield from (BadInput(f"scale {arguments}", words) for arguments, words in SCALES.items())
    yield BadInput("scale smoke", "split.name.*Side ways.*pattern", arguments=["split.name='Side ways'"])
    for text, words in PARAMS.items():
        for command in ("publish", "repro", "stages/split.py"):
            yield BadInput(command, f"params.yaml.*{words}|{words}.*params.yaml", partial(put, "params.yaml", text))
    for name, content, words in CATALOGUES:
        command = "stages/synthesize.py" if name == "scenes.yaml" else "scale smoke data.catalogue=catalogue"
        yield BadInput(command, f"{name}.*{words}", partial(catalogued, name, content))
    for name, content, words in VIDEOS:
        yield BadInput("stages/extract_frames.py", words, partial(videos, name, content))
    yield BadInput("data check videos", "rug_0.avi", partial(videos, "rug_0.avi", b"not a video"))
    good = partial(videos, "notes.txt", "")
    yield BadInput("data audit videos --split", "allowed: paper, release", good, ["Not a name!"])
    for scale, write, file, length in (
        ("language.weights=weights", write_llama, "model.safetensors", 99),
        ("language.weights=weights", write_llama, "config.json", 1),
        ("language.weights=weights", write_llama, "tokenizer.json", None),
        ("encoder.weights=weights frames.pixels=32", write_clip, "open_clip_model.safetensors", 99),
    ):
        yield BadInput(f"scale smoke {scale}", file, partial(spoilt, write, file, length))
    yield from (BadInput(f"stages/{arguments}", words) for arguments, words in STAGES.items())
    for (stage, file), words in LEFT.items():
        yield BadInput(f"stages/{stage}", words, partial(put, file, "garbage\n"))
    # What DVC writes.
    for text in ("stages: 3\n", "<<<<<<< HEAD\na: 1\n", b"\xff\xfe"):
        yield BadInput("repro", "dvc.lock.*git checkout dvc.lock", partial(put, "dvc.lock", text))
    for text in ("stages: {split: 3}\n", b"\xff\xfe"):
        yield BadInput("publish", "dvc.lock: .*restore it from Git", partial(put, "dvc.lock", text))
    yield from (BadInput(command, words) for command, words in COMMANDS.items())


def prepare_folder(folder: Path) -> None:
    """A project that knows how to run everything, and has no data."""
    folder.mkdir(parents=True)
    for name in ("conf", "pipeline", "stages"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("dvc.yaml", "params.yaml"):
        shutil.copy(ROOT / name, folder)
    subprocess.run(["git", "init", "--quiet"], cwd=folder, check=True)
    (folder / ".dvc").mkdir()
    (folder / ".dvc" / "config").write_text("[core]\nanalytics = false\n")


def contents(folder: Path, *parts: str) -> dict[str, str]:
    """Hash of every file of a folder, or of parts of it, but for what locks, caches and Git keep for themselves."""
    found = {}
    for root in [folder / part for part in parts] or [folder]:
        for file in [root] if root.is_file() else sorted(root.rglob("*")):
            if file.is_file() and not {"runs", ".dvc", ".git", "checkpoints"} & set(file.relative_to(root).parts):
                with file.open("rb") as stream:
                    found[str(file.relative_to(folder))] = hashlib.file_digest(stream, "sha256").hexdigest()
    return found


def refuse(row: BadInput) -> dict[str, str]:
    """Give the input to its `octopi` command or stage, in this process and the working directory; say what was wrong,
    by column of the drill's table, empty where all is well."""
    row.prepare()
    before = contents(Path())
    words = [*row.command.split(), *row.arguments]
    script = words[0].endswith(".py")
    out, err, status = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", words if script else ["octopi", *words]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            runpy.run_path(words[0], run_name="__main__") if script else main()
        except SystemExit as ended:
            status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
            if isinstance(ended.code, str):
                print(ended.code, file=err)
        except Exception as error:
            status = -1
            print(f"Traceback: {type(error).__name__}: {error}", file=err)
    said = [line for line in err.getvalue().splitlines() if line and not line.startswith("WARNING")]
    if row.command.startswith("data"):
        said += [line for line in out.getvalue().splitlines() if line.startswith("error")]
    after = contents(Path())
    # An audit writes its findings, errors among them.
    touched = [p for p in sorted({*before, *after} - {"audit.csv"}) if before.get(p) != after.get(p)]
    fits = len(said) == 1 and re.search(row.words, said[0])
    return {
        "lost": "" if status == 1 else f"status {status}",
        "wrong_line": "" if fits else f"expected {row.words}, got {said}",
        "different": ", ".join(touched),
    }

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


def with_params(file: Path, **changes: object) -> None:
    """Change params.yaml: values by section and key, with two underscores between them."""
    values = load_params(file).model_dump(mode="json")
    for name, value in changes.items():
        section, key = name.split("__")
        values[section][key] = value
    write_params(validate(values, str(file)), file)


def catalogued(name: str, content: str | bytes) -> None:
    """params.yaml names catalogue/, which is PhysiCLeAR's but for one file."""
    Path("catalogue").mkdir()
    with_params(PARAMS_FILE, data__catalogue="catalogue")
    for file in ("objects.csv", "properties.yaml"):
        shutil.copy(ROOT / "pipeline/physiclear" / file, "catalogue")
    put(f"catalogue/{name}", content)


def videos(**files: str | bytes) -> None:
    """A folder videos/ with a good video and these files, in whose names two underscores stand for the dot."""
    with_params(PARAMS_FILE, data__source="videos", data__dir="videos")
    write_video(Path("videos/baseball_0.avi"), moving_square(8, 0))
    for name, content in files.items():
        put(f"videos/{name.replace('__', '.')}", content)


def spoilt(write: Callable[[Path], Path], file: str, change: Callable[[bytes], bytes | None]) -> None:
    """weights/ as `write` makes it, with one file changed or taken away."""
    write(Path("weights"))
    put(f"weights/{file}", change((Path("weights") / file).read_bytes()))


NOT_THERE = "(no such file|does not exist).*dvc repro"
LLAMA = "scale smoke language.weights=weights"
TABLE = "object_id,name,hardness,roughness,bumpiness\n"
SCALES = {
    "huge": "paper-7b, small, smoke",
    "smoke frames.per_vido=1": "frames.per_vido.*did you mean per_video",
    "smoke frames.size=64": "frames.size is called frames.pixels now",
    "smoke frames.fraction=1.5": "frames.fraction.*less than or equal to 1",
    "smoke split.name=kfold split.folds=3 ablation.seeds=[0,1,3]": r"ablation.seeds \[0, 1, 3\].*3 folds",
    "smoke ablation.opd=[none]": "ablation.opd.*lacks the full system's value all",
    "smoke align.batch_size=10": "align.*does not divide",
    "smoke data.dir=elsewhere": "data.dir.*data/scenes/videos",
    "smoke encoder.learning_rate=nan": "encoder.learning_rate",
    "smoke runtime.device=tpu": "runtime.device.*'cuda'",
    "smoke encoder.epochs=true": "encoder.*epochs is true",
    "smoke justaword": "key=value",
    "smoke encoder.weights=nowhere": "hf download timm",
    "smoke language.weights=nowhere": "hf download lmsys",
    "smoke language.start=models/nothing": "language.start: models/nothing holds no trained model",
    "smoke scenes.objects=[unicorn]": "scenes.objects: unicorn",
    "smoke scenes.objects=[bath_towel,ice_block]": "no video of a training object",
    "smoke cross_validation.models=[papers]": "models.0 is 'papers': Input should be",
}
PARAMS: dict[str | bytes | None, str] = {
    "": "octopi scale smoke",
    "scale: [": "not YAML",
    "scale: smoke\n": "missing",
    "seed: 1\nseed: 2\n": "seed stands twice",
    b"\xff\xfes": "not UTF-8",
    None: "no such file",
}
CATALOGUES: tuple[tuple[str, str | bytes, str], ...] = (
    ("objects.csv", TABLE, "no object"),
    ("objects.csv", "ball;a ball\n", "missing"),
    ("objects.csv", f"{TABLE}ball,a ball,1,1,1\nball,a bowl,1,1,1\n", "line 3.*ball.*twice"),
    ("objects.csv", f"{TABLE}ball,a ball,3,1,1\n", "line 2.*hardness.*0 to 2"),
    ("objects.csv", f"{TABLE}ball,a ball, red,1,1,1\n", "line 2.*quotation marks"),
    ("objects.csv", f"{TABLE}../../evil,a ball,1,1,1\n", "line 2.*'../../evil'.*letters, digits"),
    ("properties.yaml", "properties: [", ""),
    ("properties.yaml", "properties: []\nunstructured: x\nstructured: y\n", ""),
    ("properties.yaml", b"\xff\xfe", ""),
    ("scenes.yaml", "yoyo: {modulus: 1}", "yoyo is not in objects.csv; correct or remove the entry"),
    ("scenes.yaml", "rug: {modulus: .nan}", "rug: modulus: Input should be"),
    ("scenes.yaml", "rug: {modulus: 1, colour: red}", "rug: colour: .*docs/scenes.md"),
    ("scenes.yaml", b"rug: \xff\xfe", "correct it, or remove it"),
)
VIDEOS: tuple[tuple[dict[str, str | bytes], str], ...] = (
    ({"rug__avi": b"x"}, "rug.avi.*<object>_<number>.*rename.*videos.csv"),
    ({"rug_0__avi": b"", "rug_00__mp4": b""}, "rug_0.*rug_0.*keep one"),
    ({"rug_0__avi": b"not a video"}, "videos/rug_0.avi"),
    ({"videos__csv": "name,object_id\na.mov,rug\n"}, "column file is missing"),
    ({"videos__csv": "file,object_id\ngone.mov,rug\n"}, "line 2: no video 'gone.mov' in the folder; correct the line"),
    ({"videos__csv": b"file,object_id\n\xe9.avi,rug\n"}, "no CSV in UTF-8"),
)
STAGES = {
    "align.py nonsense all 0": "encoder is 'nonsense'; allowed: finetuned, base.*python stages/",
    "align.py finetuned all ²": "seed is '²'.*python stages/",
    "align.py finetuned all": "2 values instead of 3.*python stages/",
    "lora.py finetuned al 0": "opd is 'al'; allowed: none, needed, all.*python stages/",
    "answer.py finetuned with all 0 1": "5 values instead of 4.*python stages/",
    "finetune_encoder.py -1": "seed is '-1'.*python stages/",
    "cross_validate.py paperr": "model is 'paperr'; allowed: constant, .*python stages/",
    **dict.fromkeys(("split.py", "audit.py", "questions.py", "cross_validate.py constant", "grade.py"), NOT_THERE),
    **dict.fromkeys(("finetune_encoder.py 0", "embed.py", "align.py finetuned all 0", "report.py"), NOT_THERE),
    **dict.fromkeys(("lora.py finetuned all 0", "answer.py finetuned with all 0", "package.py"), NOT_THERE),
}
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
    for files, words in VIDEOS:
        yield BadInput("stages/extract_frames.py", words, partial(videos, **files))
    yield BadInput("data check videos", "rug_0.avi", partial(videos, rug_0__avi=b"not a video"))
    yield BadInput("data audit videos --split", "allowed: paper, release", videos, ["Not a name!"])
    # Folders of weights.
    for change in (lambda data: data[:-9], lambda data: b"garbage", lambda data: None):
        yield BadInput(
            LLAMA, "model.safetensors|has no weights", partial(spoilt, write_llama, "model.safetensors", change)
        )
    for file in ("config.json", "tokenizer.json"):
        for change in (lambda data: b"{", lambda data: b"[]", lambda data: None):
            yield BadInput(LLAMA, file, partial(spoilt, write_llama, file, change))
    clip = "scale smoke encoder.weights=weights frames.pixels=32"
    for file, words in (("open_clip_model.safetensors", "open_clip_model"), ("open_clip_config.json", "config.json")):
        yield BadInput(clip, words, partial(spoilt, write_clip, file, lambda data: data[:-9]))
    # Stages: their command line, and what the stages before them left.
    yield from (BadInput(f"stages/{arguments}", words) for arguments, words in STAGES.items())
    for stage, file in (("split.py", "data/videos.parquet"), ("questions.py", "data/splits/0.parquet")):
        broken = partial(put, file, b"garbage")
        yield BadInput(f"stages/{stage}", f"{file}: not a readable table.*dvc repro", broken)
    for stage, file in (("align.py finetuned all 0", "train"), ("grade.py", "evaluation")):
        broken = partial(put, f"data/questions/0/{file}.jsonl", "garbage\n")
        yield BadInput(f"stages/{stage}", f"{file}.jsonl, line 1: not a Question.*dvc repro", broken)
    # What DVC writes.
    for text in ("{", "stages: 3\n", "<<<<<<< HEAD\na: 1\n", b"\xff\xfe", "a: 1\na: 1\n"):
        yield BadInput("repro", "dvc.lock.*git checkout dvc.lock", partial(put, "dvc.lock", text))
    for text in ("{", "stages: {split: 3}\n", b"\xff\xfe"):
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


def run_here(command: str, arguments: Sequence[str]) -> tuple[int, str, str]:
    """Run `octopi COMMAND`, or a stage's script, in this process; return status, stdout, stderr."""
    words = [*command.split(), *arguments]
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
    return status, out.getvalue(), err.getvalue()


def refuse(row: BadInput) -> dict[str, str]:
    """Give the input to its command in this process, in the working directory; return what was wrong about its end."""
    row.prepare()
    before = contents(Path())
    try:
        status, out, err = run_here(row.command, row.arguments)
    except Exception as error:
        status, out, err = -1, "", f"Traceback: {type(error).__name__}: {error}"
    said = [line for line in err.splitlines() if line and not line.startswith("WARNING")]
    if row.command.startswith("data"):
        said += [line for line in out.splitlines() if line.startswith("error")]
    after = contents(Path())
    # An audit writes its findings, errors among them.
    touched = [p for p in sorted({*before, *after} - {"audit.csv"}) if before.get(p) != after.get(p)]
    fits = len(said) == 1 and re.search(row.words, said[0])
    return {
        "lost": "" if status == 1 else f"status {status}",
        "wrong_line": "" if fits else f"expected {row.words}, got {said}",
        "different": ", ".join(touched),
    }

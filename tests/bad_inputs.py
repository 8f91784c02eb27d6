"""Bad inputs as a table, each through the command that a person types: one line that names it, and no file touched.

Most rows are those of the tests next to the code that refuses them; here they take the whole way.
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
from typing import Any, NamedTuple
from unittest import mock

from pipeline.cli import main
from pipeline.config.params import PARAMS_FILE, load_params, validate
from pipeline.scales import write_params
from tests import test_config
from tests.checkpoints import write_clip, write_llama
from tests.closure import ROOT
from tests.conftest import moving_square, write_video
from tests.scenes import test_recipes
from tests.videos import test_catalogue, test_hard_videos, test_videos


class BadInput(NamedTuple):
    """A row: `prepare` makes the input in the working directory, `words` are regular expressions for its line."""

    command: str
    words: Sequence[str]
    prepare: Callable[[], object] = bool
    arguments: Sequence[str] = ()
    """Further ones, which may hold blanks."""
    status: int = 1


def of_test(test: Any) -> list[Any]:
    """The rows that a parametrised test has."""
    return list(test.pytestmark[0].args[1])


def literal(words: Sequence[str]) -> list[str]:
    return [re.escape(word) for word in words]


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


def catalogued(*lines: str, described: Sequence[str] = (), **files: str | bytes) -> None:
    """params.yaml names catalogue/, which has these objects (PhysiCLeAR's without) and files."""
    Path("catalogue").mkdir()
    with_params(PARAMS_FILE, data__catalogue="catalogue")
    shutil.copy(ROOT / "pipeline/physiclear/objects.csv", "catalogue")
    shutil.copy(ROOT / "pipeline/physiclear/properties.yaml", "catalogue")
    if lines:
        test_catalogue.write(Path("catalogue"), *lines, described=described)
    for name, content in files.items():
        put(f"catalogue/{name}.yaml", content)


def videos(make: Callable[..., object], *arguments: Any) -> None:
    """A folder videos/ that `make` fills."""
    Path("videos").mkdir()
    with_params(PARAMS_FILE, data__source="videos", data__dir="videos")
    make(Path("videos"), *arguments)


def listed(folder: Path, text: str) -> None:
    test_videos.listed(folder, "")
    (folder / test_videos.LIST_FILE).write_bytes(text.encode("latin-1"))


def good(folder: Path) -> None:
    for seed, name in enumerate(("baseball_0", "potato_0")):
        write_video(folder / f"{name}.avi", moving_square(8, seed))


def hard_video(name: str, make: Callable[[Path, Path], object], folder: Path) -> None:
    make(folder / name, write_video(folder.parent / "good.avi", moving_square(31)))


def spoilt(write: Callable[[Path], Path], file: str, change: Callable[[bytes], bytes | None]) -> None:
    """weights/ as `write` makes it, with one file changed or taken away."""
    write(Path("weights"))
    put(f"weights/{file}", change((Path("weights") / file).read_bytes()))


NOT_THERE = "(no such file|does not exist).*dvc repro"
CLIP, LLAMA = "scale smoke encoder.weights=weights frames.pixels=32", "scale smoke language.weights=weights"


def bad_inputs() -> Iterator[BadInput]:
    """Every row."""
    # Scales and params.yaml.
    for overrides, words in of_test(test_config.test_wrong_override_is_one_line_with_key_and_mend):
        yield BadInput("scale smoke", literal(words), arguments=overrides)
    for text, word in of_test(test_config.test_broken_params_file):
        for command in ("publish", "repro", "stages/split.py"):
            yield BadInput(command, ["params.yaml", re.escape(word)], partial(put, "params.yaml", text))
    for arguments, words in of_test(test_config.test_missing_inputs_are_named):
        yield BadInput(f"scale {arguments}", [words])
    for objects, override, words in of_test(test_config.test_too_few_objects_are_found_before_any_training):
        if words:
            yield BadInput(f"scale smoke scenes.objects=[{objects}] {override}", [words])
    yield BadInput("scale huge", ["paper-7b, small, smoke"])
    # Catalogues, scenes, videos.
    check = "data check videos --catalogue catalogue"
    for lines, words in of_test(test_catalogue.test_a_bad_table_is_one_clear_line):
        yield BadInput(check, literal(words), partial(catalogued, *lines))
    for described, words in of_test(test_catalogue.test_a_bad_description_is_one_clear_line):
        objects = (test_catalogue.SHORT, test_catalogue.BALL)
        yield BadInput(
            "stages/split.py", ["descriptions", *literal(words)], partial(catalogued, *objects, described=described)
        )
    for text in ("properties: [", "properties: []\nunstructured: x\nstructured: y\n", "", b"\xff\xfe"):
        yield BadInput(
            "scale smoke data.catalogue=catalogue", ["properties.yaml"], partial(catalogued, properties=text)
        )
    for text, words in of_test(test_recipes.test_bad_entries_are_refused_in_one_line):
        yield BadInput("stages/synthesize.py", ["scenes.yaml", words], partial(catalogued, scenes=text))
    for make, words in of_test(test_videos.test_bad_names_are_one_line_with_their_mend):
        yield BadInput("stages/extract_frames.py", literal(words), partial(videos, make))
    for text, words in of_test(test_videos.test_bad_lists_are_one_line_with_their_mend):
        yield BadInput("stages/extract_frames.py", literal([words]), partial(videos, listed, text))
    for name, make, words in of_test(test_hard_videos.test_files_that_are_no_good_are_named):
        bad = partial(videos, partial(hard_video, name, make))
        yield BadInput("data check videos", [name, re.escape(words)], bad)
        yield BadInput("stages/extract_frames.py", [f"videos/{name}", re.escape(words)], bad)
    for split in ("nonsense", "Not a name!"):
        yield BadInput("data audit videos --split", ["allowed: paper, release"], partial(videos, good), [split])
    # Folders of weights.
    for command, write, stem in ((CLIP, write_clip, "open_clip_model"), (LLAMA, write_llama, "model")):
        file = f"{stem}.safetensors"
        for change in (lambda data: data[:-9], lambda data: b"garbage", lambda data: b"", lambda data: None):
            yield BadInput(command, [f"{file}|has no weights"], partial(spoilt, write, file, change))
    for file in ("config.json", "tokenizer.json"):
        for change in (lambda data: b"{", lambda data: b"[]", lambda data: None, lambda data: b"\xff"):
            yield BadInput(LLAMA, [file], partial(spoilt, write_llama, file, change))
    for change in (lambda data: b"{", lambda data: b"[]", lambda data: None):
        yield BadInput(CLIP, ["config.json"], partial(spoilt, write_clip, "open_clip_config.json", change))
    yield BadInput("weights gpt", ["smollm2"])
    # Stages: their command line, and what the stages before them left.
    for arguments, words in (
        ("align.py nonsense all 0", "encoder is 'nonsense'; allowed: finetuned, base"),
        ("align.py finetuned All 0", "opd is 'All'"),
        ("align.py finetuned all ²", "seed is '²'"),
        ("align.py finetuned all 00", "seed is '00'"),
        ("align.py finetuned all", "2 values instead of 3"),
        ("lora.py finetuned al 0", "opd is 'al'; allowed: none, needed, all"),
        ("lora.py", "0 values instead of 3"),
        ("answer.py finetuned with all x", "seed is 'x'; allowed: 0, 1"),
        ("answer.py finetuned with all 0 1", "5 values instead of 4"),
        ("finetune_encoder.py -1", "seed is '-1'"),
        ("cross_validate.py paperr", "model is 'paperr'; allowed: constant, "),
    ):
        yield BadInput(f"stages/{arguments}", [words, "python stages/"])
    for stage in (
        *("split.py", "audit.py", "questions.py", "cross_validate.py constant", "grade.py"),
        *("finetune_encoder.py 0", "embed.py", "align.py finetuned all 0", "lora.py finetuned all 0", "report.py"),
        *("answer.py finetuned with all 0", "package.py"),
    ):
        yield BadInput(f"stages/{stage}", [NOT_THERE])
    for content in (b"garbage", b""):
        for stage, file in (("split.py", "data/videos.parquet"), ("questions.py", "data/splits/0.parquet")):
            broken = partial(put, file, content)
            yield BadInput(f"stages/{stage}", [f"{file}: not a readable table.*dvc repro"], broken)
    for stage, file in (("align.py finetuned all 0", "train"), ("grade.py", "evaluation")):
        broken = partial(put, f"data/questions/0/{file}.jsonl", "garbage\n")
        yield BadInput(f"stages/{stage}", [f"{file}.jsonl, line 1: not a Question.*dvc repro"], broken)
    # What DVC writes.
    for text in ("{", "stages: 3\n", "- a\n", "<<<<<<< HEAD\na: 1\n", b"\xff\xfe", "a: 1\na: 1\n"):
        locked = partial(put, "dvc.lock", text)
        yield BadInput("repro", ["dvc.lock", "git checkout dvc.lock"], locked)
    yield BadInput("publish", ["dvc.lock: no such file"])
    for text in ("{", "stages: 3\n", "stages: {split: 3}\n", "<<<<<<< HEAD\na: 1\n", b"\xff\xfe"):
        yield BadInput("publish", ["dvc.lock: .*restore it from Git"], partial(put, "dvc.lock", text))
    # A trained model, and what is done with it.
    for command in ("ask", "describe videos --csv t.csv", "export nothing there", "serve nothing", "demo nothing"):
        where = " --model nothing" if command.startswith(("ask", "describe")) else ""
        yield BadInput(f"{command}{where}", ["nothing: .*|holds no"])
    yield BadInput("ask --model stages", ["stages: holds no .*so it is no trained model"])
    yield BadInput("ask --model nothing --device gpu", ["allowed: auto, cpu, cuda, mps"])
    yield BadInput("ask params.yaml", ["is a file; write the question"])
    yield BadInput("ask --json", ["--json takes a question"])
    yield BadInput("serve nothing --host 0.0.0.0", ["token"])
    yield BadInput("import bag none.bag --topic /a --out out", ["none.bag"])
    yield BadInput("diff nowhere", ["nowhere: no commit"])
    yield BadInput("page", ["report"])


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
    fits = len(said) == 1 and all(re.search(word, said[0]) for word in row.words)
    return {
        "lost": "" if status == row.status else f"status {status}",
        "wrong_line": "" if fits else f"expected {list(row.words)}, got {said}",
        "different": ", ".join(touched),
    }

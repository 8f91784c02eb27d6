"""Atomic reading and writing of everything that stages exchange.

A file appears under its name only when it is whole: it is written beside its place and then renamed.
Tables are Parquet with one column a field, dialogues are JSON lines, weights are safetensors.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import json
import os
import re
import shutil
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from pipeline.core.records import Record
from pipeline.running.errors import UserError, first_problem

if TYPE_CHECKING:
    import pyarrow as pa
    import torch

R = TypeVar("R", bound=Record)
ROOT = Path(__file__).parents[2]
"""Where the project lies: dvc.yaml, pipeline/, stages/."""
REST = re.compile(r"\..+\.(\d{1,9})\.part(\.\w+)?")
"""The name of an unfinished file or folder: `.NAME.PID.part`, of the process that is writing what will be NAME."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` that becomes `path` if the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def remove_rests(folder: Path) -> None:
    """Remove what killed processes left unfinished anywhere below a folder; nothing else would ever remove it."""
    for place, folders, files in os.walk(folder):  # os.walk skips folders that vanish meanwhile.
        for name in (*folders, *files):
            _remove_rest(Path(place, name))


def runs(process: int) -> bool:
    """Whether a process runs. One that ended keeps its number until it is reaped, which some containers never do."""
    import psutil

    try:
        return bool(psutil.Process(process).status() != psutil.STATUS_ZOMBIE)
    except psutil.AccessDenied:  # Another user's.
        return True
    except psutil.NoSuchProcess:
        return False


def _remove_rest(path: Path) -> None:
    """Remove a file or folder that is unfinished and whose process has ended."""
    process = REST.fullmatch(path.name)
    if process is None or runs(int(process[1])):
        return
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Give an empty folder beside `folder` that takes its place if the block succeeds.

    What a killed process left of the same folder is removed.
    """
    for rest in folder.parent.glob(f".{glob.escape(folder.name)}.*.part"):
        _remove_rest(rest)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: object) -> None:
    """Write `value` as indented JSON with a final newline, atomically."""
    write_text(path, json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def check_made(path: Path) -> None:
    """Raise UserError where a file that the chain makes is not there."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; `dvc repro` makes it")


def read_json(path: Path) -> Any:
    """Read a JSON file; raise UserError where it is missing or broken."""
    check_made(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # Or not UTF-8.
        raise UserError(f"{path}: not JSON ({error}); delete it and run `dvc repro`") from None


def write_jsonl(path: Path, records: Iterable[Record]) -> None:
    """Write one record a line, atomically."""
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        for record in records:
            stream.write(record.model_dump_json() + "\n")


def read_jsonl(path: Path, model: type[R]) -> list[R]:
    """Read records written by `write_jsonl`; a bad line is a UserError that names it."""
    check_made(path)
    records = []
    with path.open(encoding="utf-8") as stream:
        for number, line in enumerate(stream, 1):
            try:
                records.append(model.model_validate_json(line))
            except ValidationError as error:
                raise UserError(
                    f"{path}, line {number}: not a {model.__name__} ({first_problem(error)}); "
                    "delete the file and run `dvc repro`"
                ) from None
    return records


def write_table(path: Path, model: type[R], records: Iterable[R]) -> None:
    """Write records as a Parquet table with the schema of `model`, atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    hints = typing.get_type_hints(model)
    schema = pa.schema([(name, _arrow(hints[name])) for name in model.model_fields])
    table = pa.Table.from_pylist([record.model_dump(mode="json") for record in records], schema=schema)
    with atomic(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def read_table(path: Path, model: type[R]) -> list[R]:
    """Read records written by `write_table`; raise UserError where the schema does not fit."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_made(path)
    try:
        table = pq.read_table(path, partitioning=None)
    except (pa.ArrowInvalid, OSError) as error:
        raise UserError(f"{path}: not a readable table ({error}); delete it and run `dvc repro`") from None
    if table.schema.names != list(model.model_fields):
        raise UserError(
            f"{path}: columns {table.schema.names}, expected {list(model.model_fields)}; delete it and run `dvc repro`"
        )
    return [model.model_validate(row) for row in table.to_pylist()]


def write_csv(path: Path, model: type[R], records: Iterable[R]) -> None:
    """Write records of plain fields as CSV, one column a field, atomically."""
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(model.model_fields), lineterminator="\n")
        writer.writeheader()
        writer.writerows(record.model_dump(mode="json") for record in records)


def read_csv(path: Path, model: type[R]) -> list[R]:
    """Read what `write_csv` wrote; a missing file or a row that is no `model` is a UserError."""
    check_made(path)
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            return [model.model_validate(row) for row in csv.DictReader(stream)]
    except ValidationError as error:
        raise UserError(f"{path}: not a table of {model.__name__} ({first_problem(error)}); run `dvc repro`") from None


def save_tensors(path: Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str] | None = None) -> None:
    """Write named tensors as safetensors, atomically."""
    from safetensors.torch import save_file

    with atomic(path) as temporary:
        save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, temporary, dict(metadata or {}))


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Read a safetensors file; a missing file or another format (a pickle, say) is a UserError."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    check_made(path)
    try:
        return dict(load_file(path))
    except SafetensorError as error:
        raise UserError(
            f"{path}: not a safetensors file ({error}); pickled checkpoints are refused because they can run "
            "code: convert it with safetensors.torch.save_file, or run `dvc repro` again"
        ) from None


def tensor_shapes(path: Path, mend: str = "get it again") -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors in a safetensors file; only its header is read, and held to the file's length.

    A broken file is a UserError that ends with `mend`.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as stored:
            return {name: tuple(stored.get_slice(name).get_shape()) for name in stored.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise UserError(f"{path} is cut off or not a safetensors file ({error}); {mend}") from None


def sha256(file: Path) -> str:
    """The SHA-256 of a file's bytes, in hexadecimal digits."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def fingerprint(*parts: BaseModel | str | int | Path) -> str:
    """A short hash of settings and of input files (or all files of folders), by which unfinished work is known again.

    A checkpoint of one training is so never taken for another's.
    """
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, BaseModel):
            digest.update(json.dumps(part.model_dump(mode="json"), sort_keys=True).encode())
        elif isinstance(part, Path):
            for file in sorted(part.iterdir()) if part.is_dir() else [part]:
                if file.is_file():
                    digest.update(file.name.encode())
                    digest.update(bytes.fromhex(sha256(file)))
        else:
            digest.update(str(part).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:16]


def code_of(stage: str) -> list[Path]:
    """All files of code that dvc.yaml lists for a stage, or `stage@key`, but those that .dvcignore leaves out.

    Their bytes are part of a checkpoint's key, so that work begun by another version of the code is not resumed.
    """
    import yaml

    stages = yaml.safe_load((ROOT / "dvc.yaml").read_text(encoding="utf-8"))["stages"]
    deps = stages.get(stage.partition("@")[0], {}).get("deps", [])
    listed = [ROOT / d for d in deps if d.split("/")[0] in ("pipeline", "stages")]
    files = [f for path in listed for f in ([path] if path.is_file() else sorted(path.rglob("*"))) if f.is_file()]
    return [f for f in files if f.suffix != ".pyc" and (f.suffix != ".md" or f.parent.name == "templates")]


def _arrow(hint: Any) -> pa.DataType:
    """The column type of a field's annotation; texts of an enumeration are texts."""
    import pyarrow as pa

    origin = typing.get_origin(hint)
    if origin in (tuple, types.UnionType):  # Of one type; or of one and None, which every column may hold.
        first = _arrow(typing.get_args(hint)[0])
        return pa.list_(first) if origin is tuple else first
    if origin is typing.Literal or issubclass(hint, str):
        return pa.string()
    return {int: pa.int64(), float: pa.float64(), bool: pa.bool_()}[hint]

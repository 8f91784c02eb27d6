"""What every DVC stage does around its one library call: parameters, lock, clear errors, a line at each end, cost."""

from __future__ import annotations

import atexit
import errno
import hashlib
import json
import logging
import os
import re
import shlex
import shutil
import sys
import time
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from operator import attrgetter
from pathlib import Path
from typing import Any, NoReturn

import yaml
from filelock import FileLock, Timeout

from pipeline.config import Params
from pipeline.config.params import CHAIN, PARAMS_FILE, load_params
from pipeline.core.io import code_of, remove_rests, sha256, write_json, write_text
from pipeline.core.layout import CHECKPOINTS, DATA, MODELS, REPORTS, RUNS, embeddings_dir
from pipeline.core.records import Measurement
from pipeline.core.runtime import cores, limit_threads, processor, use_kernels
from pipeline.running.errors import EXTRAS, UserError
from pipeline.running.parallel import end_with_parent, use_backend
from pipeline.running.progress import quiet_libraries

TF32_VARIABLES = ("NVIDIA_TF32_OVERRIDE", "TORCH_ALLOW_TF32_CUBLAS_OVERRIDE")
"""Variables that turn TF32, which has float16's precision, on or off. They change results; some containers set them."""

_ended_well = False


@atexit.register  # Before other libraries are loaded, so that it comes behind all that they have to do at the end.
def _leave() -> None:
    """End a stage's process that ended well at once: Python would take a million objects apart, for two seconds."""
    if _ended_well and Path(sys.argv[0]).absolute().parent.name == "stages":
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


@dataclass
class Stage:
    """A running stage. `metrics` are written beside its cost when it ends well."""

    name: str
    params: Params
    started: float = field(default_factory=time.time)
    """Seconds since 1970."""
    metrics: dict[str, float] = field(default_factory=dict)

    def finish_training(self, history: Sequence[Measurement]) -> None:
        """Put the last value of each curve among the metrics.

        In a distributed training only the main process goes on from here: the others have nothing to write.
        """
        if not main_process():
            sys.exit(0)
        self.metrics |= {m.name: m.value for m in history}
        self.metrics["steps"] = max((m.step for m in history), default=0)


def matrix_key(**axes: type[StrEnum] | None) -> list[Any]:
    """Which stage of a matrix this process is: a value of each axis, in order, from the command line.

    Args:
        axes: The values of an axis; None for an axis of seeds.

    Too few or too many values, or one that an axis lacks, end the process with one line and status 1.
    """

    class Parser(ArgumentParser):
        def error(self, message: str) -> NoReturn:
            sys.exit(f"{self.prog}: {message}; {' '.join(self.format_usage().split())}")

    parser = Parser(sys.argv[0], add_help=False)
    for axis, values in axes.items():
        parser.add_argument(axis, type=values or int, choices=values)
    return list(vars(parser.parse_args()).values())


def launch(launcher: str) -> None:
    """Go on in processes of `runtime.launcher`, which takes this process's place: its number, status and signals.

    `python`, and a process that a launcher started, go on as they are. The latter ends with its launcher: a killed
    `accelerate launch` of one process would leave it running.
    """
    command, marked = shlex.split(launcher) or ["python"], os.environ.get("OCTOPI_LAUNCHED")
    if marked or "RANK" in os.environ:
        if marked != str(os.getpid()):  # Equal where the launcher runs this script in its own process.
            end_with_parent(os.getppid(), grace=5)
    elif command != ["python"]:
        os.environ["OCTOPI_LAUNCHED"] = str(os.getpid())
        try:
            os.execvp(command[0], [*command, *sys.argv])
        except OSError as error:
            raise UserError(f"runtime.launcher: {launcher}: {error.strerror}; set it to python") from None


@contextmanager
def stage(name: str, key: str | None = None, *, launched: bool = False, of_variants: bool = False) -> Iterator[Stage]:
    """Run the body as the DVC stage `name` (with `@key` in a matrix).

    Args:
        launched: Whether `runtime.launcher` starts it; this process ends there.
        of_variants: Whether it belongs to this run's own models: with `ablation.train=false` it leaves empty folders
            and ends.

    What computes is imported in the body, since libraries choose their kernels when they are loaded, and `kernels`
    of params.yaml chooses first.

    A UserError, a disk that cannot be read or written, or want of memory ends it with one line and status 1. So does a
    change of params.yaml, code or catalogue while it runs: DVC would take the new files for what the outputs were made
    from. Metrics, time and memory go to runs/, where tracking reads them. No stage depends on that, so results stay
    identical from run to run.
    """
    global _ended_well
    started = time.time()
    full = f"{name}@{key}" if key else name
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    quiet_libraries()
    try:
        for variable in TF32_VARIABLES:
            if variable in os.environ:
                raise UserError(f"{variable} is set, which changes the format that numbers are computed in; unset it")
        params = load_params()
        use_kernels(params.kernels)
        if of_variants and not params.ablation.train:
            empty = _paths(Stage(full, params))
            if name == "embed":
                empty = [embeddings_dir(e, seed) for e in params.ablation.encoders for seed in params.ablation.seeds]
            for folder in empty:  # Not quite empty, of which DVC would warn.
                write_text(folder / "not_trained", "")
            print(f"{full}: nothing to do, since ablation.train is false", flush=True)
            sys.exit(0)
        if launched:
            launch(params.runtime.launcher)
        running = Stage(full, params, started)
        limit_threads(params.runtime.threads)
        use_backend(params.runtime.parallel)
        with alone(full) if main_process() else nullcontext():
            if main_process():
                for folder in (DATA, RUNS, REPORTS, MODELS):
                    remove_rests(folder)
                print(f"{full}: starts ({params.report_name})", flush=True)
            before = _read_by(name, params)
            yield running
            changed = {file for file, _ in before.items() ^ _read_by(name, params).items()}
            if changed or load_params() != params:
                file = os.path.relpath(min(changed, default=PARAMS_FILE))
                raise UserError(
                    f"{file} was changed while it ran; the outputs come from the old version, so run the stage again"
                )
            _write_run(running)
            shutil.rmtree(CHECKPOINTS / full, ignore_errors=True)
            said = ", ".join(f"{k} {v:g}" for k, v in list(running.metrics.items())[:4])
            print(f"{full}: done in {time.time() - started:.1f} s{': ' if said else ''}{said}", flush=True)
        _ended_well = True
    except Exception as error:
        if (line := one_line(error)) is None:
            raise
        sys.exit(f"{full}: {line}")


def _read_by(name: str, params: Params) -> dict[Path, str]:
    """Hashes of a stage's code and of the catalogue, which people edit; `invent` writes the catalogue."""
    catalogue = [] if name == "invent" else Path(params.data.catalogue).glob("*")
    return {file: sha256(file) for file in (*code_of(name), *catalogue) if file.is_file()}


NO_MEMORY = ("out of memory", "can't allocate memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""How torch says it, on a GPU and on a processor: by a RuntimeError."""


def one_line(error: Exception) -> str | None:
    """What a person is told of bad input, of a missing extra, or of what the operating system refused; else None."""
    said = str(error)
    if isinstance(error, UserError):
        return said
    if isinstance(error, ModuleNotFoundError) and (extra := EXTRAS.get(str(error.name).partition(".")[0])):
        return f"{error.name} is not installed, which this takes; run pip install 'octopi-pipeline[{extra}]'"
    if isinstance(error, MemoryError) or any(words in said for words in NO_MEMORY):
        return "out of memory; lower the batch sizes in params.yaml"
    number = error.errno if isinstance(error, OSError) else None
    # Safetensors ends with the system's number; torch says that it could not write a file, and not why.
    if found := re.search(r"\(os error (\d+)\)|iostream error|PytorchStreamWriter failed", said):
        number = int(found[1] or number or errno.EIO)
    where = getattr(error, "filename", None) or f"{DATA}/ or {CHECKPOINTS}/"
    mend = "free space on the disk, or make it readable and writable, and run again"
    return None if number is None else f"{where}: {os.strerror(number)}; {mend}"


def running_stages() -> list[str]:
    """Names of the stages that run in this folder at the moment, in whichever process."""
    running = []
    for file in sorted((RUNS / "locks").glob("*.lock")):
        try:
            with FileLock(file, timeout=0):
                pass
        except Timeout:
            running.append(file.stem)
    return running


@contextmanager
def alone(name: str) -> Iterator[None]:
    """Let one process at a time run a stage: a killed `dvc` leaves its stage running, and both would write.

    Raises:
        UserError: where another process runs it; the caller puts the stage's name before the line.
    """
    (RUNS / "locks").mkdir(parents=True, exist_ok=True)
    try:
        # `running_stages` holds it for a moment, to look.
        with FileLock(RUNS / "locks" / f"{name}.lock", timeout=1):
            yield
    except Timeout:
        raise UserError("is still running in another process; wait for it or stop it") from None


def main_process() -> bool:
    """Whether this is the only process, or the first of a distributed training."""
    return os.environ.get("RANK", "0") == "0"


def _write_run(running: Stage) -> None:
    """Write runs/NAME.json: times, device, most memory in MiB (a GPU's, if one was used), metrics, outputs by hash."""
    import resource

    import psutil

    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
    device, torch = f"{processor()}, {cores()} cores", sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized() and (most := torch.cuda.max_memory_allocated()):
        device, peak = torch.cuda.get_device_name(), most / 2**20
    write_json(
        RUNS / f"{running.name}.json",
        {
            "started": datetime.fromtimestamp(running.started, UTC).isoformat(timespec="milliseconds"),
            "ended": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "startup_seconds": round(running.started - psutil.Process().create_time(), 3),
            "seconds": round(time.time() - running.started, 3),
            "device": device,
            "peak_memory_mb": round(peak, 1),
            "metrics": running.metrics,
            # As dvc.lock will have them: other runs' have others.
            "outs": {str(path): _md5(path) for path in _paths(running) if path.exists()},
        },
    )


def _paths(running: Stage) -> list[Path]:
    """The outputs of a stage, by dvc.yaml."""
    name, _, key = running.name.partition("@")
    listed = yaml.safe_load(CHAIN.read_bytes())["stages"].get(name, {}) if CHAIN.is_file() else {}
    outs = [next(iter(o)) if isinstance(o, dict) else o for kind in ("outs", "metrics") for o in listed.get(kind, ())]
    # A stage of a matrix is called by its values with hyphens between, as what it writes is.
    named = re.sub(r"\$\{item\..*\}", key, "\n".join(outs))
    found = re.sub(r"\$\{([\w.]+)\}", lambda name: str(attrgetter(name[1])(running.params)), named)
    return [Path(path) for path in found.splitlines()]


def _md5(path: Path) -> str:
    """The MD5 by which DVC knows a file, or a folder: that of a list of its files in JSON."""
    if path.is_file():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "md5").hexdigest()
    files = sorted((file.relative_to(path).as_posix(), file) for file in path.rglob("*") if file.is_file())
    # As .dvcignore has it: models that no run made.
    files = [(name, file) for name, file in files if path != MODELS or not name.startswith("octopi-")]
    listed = [{"md5": _md5(file), "relpath": name} for name, file in files]
    return f"{hashlib.md5(json.dumps(listed).encode()).hexdigest()}.dir"

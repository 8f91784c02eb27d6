"""What there is to track: the stages of the plan, what DVC recorded of them, and the key of the whole. No MLflow."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pipeline.params import PARAMS_FILE, Params
from pipeline.errors import UserError
from pipeline.plan import Encoder, Lora, Plan

CODE_SUFFIXES = frozenset({".py", ".csv", ".yaml"})
NOT_RESULTS = ("pipeline/tracking/", "pipeline/benchmarks/", "stages/publish.py")
"""Code that no result depends on: a change there starts no new reproduction."""


@dataclass(frozen=True)
class PlannedStage:
    """One DVC stage of the plan."""

    name: str
    key: str = ""
    """What stands behind the @ in DVC's name; empty for a stage that runs once."""
    axes: tuple[tuple[str, str], ...] = ()
    """The ablation axes that the stage uses, with its values on them."""
    trained: str = ""
    """Folder (relative to the root) of what a training stage made; empty for other stages."""

    @property
    def title(self) -> str:
        """The stage as DVC calls it, e.g. `align@finetuned-all-0`."""
        return f"{self.name}@{self.key}" if self.key else self.name


@dataclass(frozen=True)
class LockEntry:
    """What dvc.lock says about a stage that has run."""

    deps: Mapping[str, str]
    """Path to hash."""
    params: Mapping[str, str]
    """Flattened values of the keys that the stage depends on."""
    digest: str
    """Hash of the whole entry: command, dependencies, parameters and outputs."""


def planned_stages(plan: Plan) -> list[PlannedStage]:
    """The stages of a plan in the order they run, without `publish` itself."""
    return [
        *(PlannedStage("synthesize", key) for key in plan.scenes),
        *(PlannedStage(name) for name in ("extract_frames", "split", "audit", "questions")),
        *(PlannedStage("pretrain", key, trained=f"data/pretrained/{key}") for key in plan.pretrain),
        *(PlannedStage("cross_validate", name) for name in plan.cross_validation),
        PlannedStage("compare_encoders"),
        *(
            PlannedStage(
                "finetune_encoder", str(s), _axes(encoder=Encoder.FINETUNED.value, seed=s), f"data/encoder/{s}"
            )
            for s in plan.encoder_seeds
        ),
        *(PlannedStage("embed", key, _axes(encoder=job.encoder.value)) for key, job in plan.embeddings.items()),
        *(
            PlannedStage(
                stage,
                key,
                _axes(encoder=job.encoder.value, lora=lora.value, opd=job.opd.value, seed=job.seed),
                f"data/{stage}/{key}",
            )
            for stage, lora, jobs in (("align", Lora.WITHOUT, plan.align), ("lora", Lora.WITH, plan.lora))
            for key, job in jobs.items()
        ),
        *(
            PlannedStage(
                stage,
                key,
                _axes(encoder=v.encoder.value, lora=v.lora.value, opd=v.opd.value, seed=v.seed, touch=v.touch.value),
            )
            for stage in ("answer", "grade")
            for key, v in plan.variants.items()
        ),
        *(PlannedStage(name) for name in ("stability", "report")),
    ]


def read_lock(root: Path) -> dict[str, LockEntry]:
    """The entries of dvc.lock by DVC's stage name that were made with today's params.yaml.

    Entries of other scales may be among them: those whose names or parameters agree.

    Raises:
        UserError: where one of the two files is missing or not YAML.
    """
    today = set(flatten(_read_yaml(root / PARAMS_FILE)))
    stages = _read_yaml(root / "dvc.lock").get("stages") or {}
    entries = {
        name: LockEntry(
            deps={dep["path"]: str(dep.get("md5", "")) for dep in entry.get("deps", ())},
            params=dict(pair for values in (entry.get("params") or {}).values() for pair in flatten(values or {})),
            digest=digest(json.dumps(entry, sort_keys=True, default=str).encode()),
        )
        for name, entry in stages.items()
    }
    return {name: entry for name, entry in entries.items() if entry.params.items() <= today}


def reproduction_key(root: Path) -> str:
    """16 hex digits that name a reproduction: its parameters, its chain, its code and its videos.

    The code is hashed from the files, not from dvc.lock: a training that runs for the first time has no entry there
    yet, and must find the same key as the publishing that comes after it.
    """
    files = [PARAMS_FILE, Path("dvc.yaml"), Path("data/videos.parquet"), *_code(root)]
    parts = (f"{path.as_posix()}\n{_file_digest(root / path)}" for path in files)
    return digest("\n".join(parts).encode())[:16]


def flatten(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys and printable values of a nested mapping; lists become JSON."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)


def settings(params: Params) -> dict[str, str]:
    """Everything that a person sets, flattened; the plan that follows from it is left out."""
    return dict(flatten(params.model_dump(mode="json", exclude={"plan"})))


def digest(content: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def tree_digest(folder: Path) -> str:
    """Hash over names and contents of all files below a folder; of nothing where it is absent."""
    files: Iterable[Path] = sorted(p for p in folder.rglob("*") if p.is_file())
    return digest("\n".join(f"{p.relative_to(folder).as_posix()}\n{_file_digest(p)}" for p in files).encode())


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `dvc repro` makes it") from None
    except yaml.YAMLError as error:
        raise UserError(f"{path}: not YAML ({' '.join(str(error).split())}); restore it from Git") from None
    return content or {}


def _axes(**values: object) -> tuple[tuple[str, str], ...]:
    return tuple((name, str(value)) for name, value in values.items())


def _code(root: Path) -> list[Path]:
    found = (p.relative_to(root) for folder in ("pipeline", "stages") for p in (root / folder).rglob("*"))
    return sorted(p for p in found if p.suffix in CODE_SUFFIXES and not p.as_posix().startswith(NOT_RESULTS))


def _file_digest(path: Path) -> str:
    return digest(path.read_bytes()) if path.is_file() else ""

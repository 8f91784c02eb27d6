"""Where a report comes from: all that is needed to make it again, and nothing that changes by itself."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from pipeline.params import PARAMS_FILE, Params
from pipeline.records import Video

CODE = ("pipeline", "stages", "conf", "dvc.yaml")
"""What a result can depend on. A commit of the report alone does not change the report's revision."""
PACKAGES = ("torch", "transformers", "peft", "open_clip_torch", "dvc")
UNKNOWN = "unknown"


class Weights(BaseModel):
    """A folder of pretrained weights."""

    model_config = ConfigDict(frozen=True)

    folder: str
    """As params.yaml has it."""
    sha256: str
    """Over its files' names and hashes, hidden ones left out; "unknown" where it is not there."""


class Provenance(BaseModel):
    """The content of provenance.json."""

    model_config = ConfigDict(frozen=True)

    scale: str
    source: str
    split: str
    revision: str
    """The last Git commit that touches `CODE`; "unknown" without Git."""
    dirty: bool
    """Whether `CODE` differs from that commit."""
    params_sha256: str
    data_sha256: str
    """Over the rows of videos.parquet, so over every video's hash."""
    weights: tuple[Weights, ...]
    python: str
    packages: dict[str, str]


def provenance(params: Params, videos: Sequence[Video], weights: Iterable[str], root: Path) -> Provenance:
    """Describe the report of `root` that was made with these folders of pretrained weights."""
    rows = "\n".join(video.model_dump_json() for video in videos)
    revision = _git(root, "log", "-1", "--format=%H", "--", *CODE)
    return Provenance(
        scale=params.scale,
        source=params.data.source,
        split=params.split.name,
        revision=revision or UNKNOWN,
        dirty=bool(_git(root, "status", "--porcelain", "--", *CODE)),
        params_sha256=hashlib.sha256((root / PARAMS_FILE).read_bytes()).hexdigest(),
        data_sha256=hashlib.sha256(rows.encode()).hexdigest(),
        weights=tuple(Weights(folder=folder, sha256=_digest(root / folder)) for folder in weights),
        python=platform.python_version(),
        packages={name: _version(name) for name in PACKAGES},
    )


def _digest(folder: Path) -> str:
    found = {path.relative_to(folder): path for path in folder.rglob("*") if path.is_file()}
    # Downloads leave hidden files that tell when they were made.
    files = sorted(name for name in found if not any(part.startswith(".") for part in name.parts))
    total = hashlib.sha256()
    for name in files:
        with found[name].open("rb") as stream:
            total.update(f"{name.as_posix()} {hashlib.file_digest(stream, 'sha256').hexdigest()}\n".encode())
    return total.hexdigest() if files else UNKNOWN


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return UNKNOWN

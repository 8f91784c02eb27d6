"""Where a report comes from: all that is needed to make it again, and nothing that changes by itself."""

from __future__ import annotations

import hashlib
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from pipeline.config import PARAMS_FILE, Params
from pipeline.records import Video

CODE = ("pipeline", "stages", "conf", "dvc.yaml")
"""What a result can depend on. A commit of the report alone does not change the report's revision."""
PACKAGES = ("torch", "transformers", "peft", "open_clip_torch", "dvc")
UNKNOWN = "unknown"


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
    python: str
    packages: dict[str, str]


def provenance(params: Params, videos: Sequence[Video], root: Path) -> Provenance:
    """Describe the report of `root`."""
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
        python=platform.python_version(),
        packages={name: _version(name) for name in PACKAGES},
    )


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

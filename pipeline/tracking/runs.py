"""The names and tags that live logging and publishing find each other's runs by."""

from __future__ import annotations

import subprocess
from pathlib import Path

from pipeline.params import Params
from pipeline.tracking.reproduction import PlannedStage
from pipeline.tracking.store import KEY, STAGE


def common_tags(params: Params, root: Path, key: str) -> dict[str, str]:
    """Tags that all runs of a reproduction carry."""
    return {
        KEY: key,
        "octopi.scale": params.scale,
        "octopi.source": params.data.source,
        "octopi.split": params.split.name,
        "mlflow.source.git.commit": revision(root),
        "mlflow.user": "octopi",
    }


def stage_tags(stage: PlannedStage) -> dict[str, str]:
    """Tags that tell a child from its siblings."""
    return {STAGE: stage.title, **{f"octopi.{axis}": value for axis, value in stage.axes}}


def parent_name(params: Params, key: str) -> str:
    """What the dashboard calls a reproduction."""
    return f"{params.report_name} {key[:8]}"


def revision(root: Path) -> str:
    """The checked-out Git commit, or "unknown"."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()

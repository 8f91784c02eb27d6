"""What dvc.lock holds of each stage, and how two of them differ. Hashes are DVC's; what has one is never opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import yaml

from pipeline.errors import UserError
from pipeline.tracking.committed import LOCK_FILE
from pipeline.tracking.reproduction import flatten


@dataclass(frozen=True)
class Locked:
    """One stage as it ran last."""

    command: str
    deps: Mapping[str, str]
    """Path to hash, as `outs`; a folder's hash ends in `.dir`."""
    outs: Mapping[str, str]
    params: Mapping[str, str]
    """Dotted key to value, of what the stage depends on."""


@dataclass(frozen=True)
class Change:
    """Something that differs; None on the side that lacks it."""

    name: str
    old: str | None
    new: str | None


@dataclass(frozen=True)
class StageChange:
    """A stage that both have and that differs; only what differs is listed."""

    stage: str
    command: bool
    deps: tuple[Change, ...]
    outs: tuple[Change, ...]
    params: tuple[Change, ...]


def read_locked(content: bytes | None, where: str) -> dict[str, Locked]:
    """The stages of a dvc.lock by DVC's names; none of an absent file.

    Raises:
        UserError: where it is no YAML, or not of DVC's shape; `where` says whose it is.
    """
    stages = load_yaml(content, f"{LOCK_FILE} of {where}").get("stages") or {}
    try:
        return {
            str(name): Locked(
                command=str(entry.get("cmd", "")),
                deps=_hashes(entry.get("deps")),
                outs=_hashes(entry.get("outs")),
                params=dict(pair for values in (entry.get("params") or {}).values() for pair in flatten(values or {})),
            )
            for name, entry in stages.items()
        }
    except (AttributeError, KeyError, TypeError):
        raise UserError(f"{LOCK_FILE} of {where}: not as DVC writes it; restore it from Git") from None


def load_yaml(content: bytes | None, what: str) -> dict[str, Any]:
    """A mapping in YAML; empty for an absent file.

    Raises:
        UserError: for anything else.
    """
    try:
        found = yaml.load(content or b"", Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise UserError(f"{what}: not YAML ({' '.join(str(error).split())}); restore it from Git") from None
    if not isinstance(found or {}, dict):
        raise UserError(f"{what}: not a mapping; restore it from Git")
    return found or {}


def changes(old: Mapping[str, str], new: Mapping[str, str]) -> tuple[Change, ...]:
    """What differs between two mappings, in the order of the new one; what only the old one has comes last."""
    names = dict.fromkeys([*new, *old])
    return tuple(Change(name, old.get(name), new.get(name)) for name in names if old.get(name) != new.get(name))


def changed_stages(old: Mapping[str, Locked], new: Mapping[str, Locked]) -> list[StageChange]:
    """The stages that both have and that differ, in the new one's order."""
    found = [
        StageChange(
            name,
            old[name].command != stage.command,
            changes(old[name].deps, stage.deps),
            changes(old[name].outs, stage.outs),
            changes(old[name].params, stage.params),
        )
        for name, stage in new.items()
        if name in old
    ]
    return [stage for stage in found if stage.command or stage.deps or stage.outs or stage.params]


def _hashes(entries: list[dict[str, Any]] | None) -> dict[str, str]:
    return {str(e["path"]): str(e.get("md5") or e.get("checksum") or e.get("etag") or "") for e in entries or ()}

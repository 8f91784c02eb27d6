"""Everything that differs between two states of the project."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.comparison.accuracies import Tested, tested_accuracies
from pipeline.comparison.cached import Cache
from pipeline.comparison.figures import Figures, moved_figures
from pipeline.comparison.locked import (
    Change,
    Locked,
    StageChange,
    changed_stages,
    changes,
    load_yaml,
    read_locked,
)
from pipeline.params import PARAMS_FILE
from pipeline.revisions import Disk, Tree, find_commit
from pipeline.tracking.committed import LOCK_FILE
from pipeline.tracking.reproduction import flatten

PLAN = "plan."


@dataclass(frozen=True)
class Comparison:
    """What differs, in the order in which a reviewer asks."""

    old: str
    new: str
    """The names of the two states."""
    parameters: tuple[Change, ...]
    """Of params.yaml; the plan, which follows from the rest, only where nothing else changed."""
    inputs: tuple[Change, ...]
    """Files and folders that stages read and no stage makes: code, catalogue, weights, real videos."""
    appeared: tuple[str, ...]
    """Stages that only the new state has run."""
    vanished: tuple[str, ...]
    stages: tuple[StageChange, ...]
    """In both and not the same."""
    figures: Figures
    tested: Tested

    @property
    def differs(self) -> bool:
        """Whether anything does but what the notes say."""
        figures = self.figures.moved or self.figures.origins or self.figures.files
        return bool(self.parameters or self.appeared or self.vanished or self.stages or figures)


def compare(root: Path, old: str, new: str = "") -> Comparison:
    """Compare two Git revisions of the project in `root`; an empty `new` is the working tree.

    Nothing is checked out and nothing is run: parameters, dvc.lock and reports are read from Git, scores from DVC's
    cache.

    Raises:
        UserError: for an unknown revision, a folder outside Git, or a broken file.
    """
    before = find_commit(root, old)
    after: Tree = find_commit(root, new) if new else Disk(root)
    one, other = _Kept.read(before), _Kept.read(after)
    return Comparison(
        old=before.name,
        new=after.name,
        parameters=_parameters(one.params, other.params),
        inputs=_inputs(one.stages, other.stages),
        appeared=tuple(name for name in other.stages if name not in one.stages),
        vanished=tuple(name for name in one.stages if name not in other.stages),
        stages=tuple(changed_stages(one.stages, other.stages)),
        figures=moved_figures(before, after),
        tested=tested_accuracies(one.stages, other.stages, (before.name, after.name), Cache(root)),
    )


@dataclass(frozen=True)
class _Kept:
    params: Mapping[str, str]
    stages: Mapping[str, Locked]

    @classmethod
    def read(cls, tree: Tree) -> _Kept:
        # params.yaml of another revision may not be valid today: it is read, not checked.
        files, name = tree.read([str(PARAMS_FILE), LOCK_FILE]), tree.name
        params = load_yaml(files.get(str(PARAMS_FILE)), f"{PARAMS_FILE} of {name}")
        return cls(dict(flatten(params)), read_locked(files.get(LOCK_FILE), name))


def _parameters(old: Mapping[str, str], new: Mapping[str, str]) -> tuple[Change, ...]:
    found = changes(old, new)
    return tuple(change for change in found if not change.name.startswith(PLAN)) or found


def _inputs(old: Mapping[str, Locked], new: Mapping[str, Locked]) -> tuple[Change, ...]:
    """Stages that last ran with different versions of a file have several hashes of it."""
    return changes(_read_by(old), _read_by(new))


def _read_by(stages: Mapping[str, Locked]) -> dict[str, str]:
    made = {path for stage in stages.values() for path in stage.outs}
    found: dict[str, set[str]] = {}
    for stage in stages.values():
        for path, oid in stage.deps.items():
            # A stage may read the folder that others' folders are in.
            if path not in made and not any(out.startswith(f"{path}/") for out in made):
                found.setdefault(path, set()).add(oid)
    return {path: ", ".join(sorted(oids)) for path, oids in sorted(found.items())}

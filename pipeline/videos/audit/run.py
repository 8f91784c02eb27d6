"""The whole audit: of a folder as it lies there, or of what the chain has read already."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path

from pipeline.config import FramesConfig, SplitConfig
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_parallel
from pipeline.videos.audit.files import check_files
from pipeline.videos.audit.labels import check_labels
from pipeline.videos.audit.leakage import check_leakage
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import VideoFile, list_videos
from pipeline.videos.frames.probe import probe
from pipeline.videos.frames.scan import scan
from pipeline.videos.records import Assignment, Finding, Probe, Severity, finding
from pipeline.videos.split import MORE, assign, few

AUDIT_FILE = "audit.csv"


def audit_folder(folder: Path, catalogue: Catalogue, split: SplitConfig | None = None) -> list[Finding]:
    """Everything about a folder of videos, errors first; decodes every file once and raises nothing about them.

    With a split also what leaks between its parts, with kfold of every fold.
    """
    probes, wrong = _scan_all(list_videos(folder, catalogue).files)
    splits = []
    if split is not None and probes:
        try:
            folds = range(split.folds if split.fold_of(0) is not None else 1)
            splits = [assign(catalogue, probes, split, fold) for fold in folds]
        except UserError as error:
            wrong.append(finding("split", split.name, str(error), severity=Severity.ERROR))
    return audit_chain(folder, probes, splits, catalogue, wrong)


def audit_chain(
    folder: Path,
    probes: Sequence[Probe],
    splits: Sequence[Sequence[Assignment]],
    catalogue: Catalogue,
    wrong: Sequence[Finding] = (),
) -> list[Finding]:
    """The audit of what is decoded and split already, errors first; opens no video.

    There is one split, or with kfold one a fold; `wrong` is what decoding and splitting found.
    """
    listing = list_videos(folder, catalogue)
    found = list(listing.findings)
    for name in listing.unknown_objects:
        for close in get_close_matches(name, catalogue.objects, n=1, cutoff=0.9):
            found.append(finding("spelling", name, "not in the catalogue", f"{close}?", Severity.WARNING))
    found += [*wrong, *check_labels(catalogue), *check_files(probes, catalogue)]
    for fold, assigned in enumerate(splits):
        parts = {a.object_id: a.part for a in assigned}
        if said := few(parts, parts):
            found.append(finding("objects", f"split {fold}", said, MORE))
    found += check_leakage(probes, splits, catalogue)
    # Most findings are the same under every split.
    return by_severity(dict.fromkeys(found))


def check_folder(folder: Path, catalogue: Catalogue) -> list[Finding]:
    """What is wrong or odd about the files of a folder, errors first; labels and leaks are left to the audit."""
    listing = list_videos(folder, catalogue)
    probes, wrong = _scan_all(listing.files)
    return by_severity([*listing.findings, *wrong, *check_files(probes, catalogue)])


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Errors first, then warnings, as `Severity` lists them; otherwise in the order found."""
    order = list(Severity)
    return sorted(findings, key=lambda f: order.index(f.severity))


def stop_on_errors(findings: Sequence[Finding], path: Path) -> None:
    """Raise UserError with the first error, and how many there are."""
    if errors := [f for f in findings if f.severity is Severity.ERROR]:
        first, more = errors[0], f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise UserError(f"{first.check}: {first.item}: {first.measured}{more}; all findings stand in {path}")


def summary(findings: Sequence[Finding]) -> dict[str, float]:
    """How many findings there are of each severity, as flat metrics."""
    counts = Counter(f.severity for f in findings)
    return {f"{severity}s": counts[severity] for severity in (Severity.ERROR, Severity.WARNING)}


def _scan_all(files: Sequence[VideoFile]) -> tuple[list[Probe], list[Finding]]:
    results = list(run_parallel(_probe, files, "videos", "video"))
    return [r for r in results if isinstance(r, Probe)], [r for r in results if isinstance(r, Finding)]


def _probe(file: VideoFile) -> Probe | Finding:
    # The pictures are not wanted here: the smallest size, and hardly any of them.
    found = scan(file, FramesConfig(pixels=16, fraction=0.01))
    return found if isinstance(found, Finding) else probe(file, found)

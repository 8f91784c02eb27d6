"""Choosing a scale: whether what it needs is there, what it costs, and writing params.yaml, whole or not at all."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path
from typing import Any

import yaml

from pipeline import weights
from pipeline.config import Params
from pipeline.config.params import PARAMS_FILE, compose, scale_names
from pipeline.core.io import write_text
from pipeline.core.layout import answers_dir, encoder_dir, trained_dir
from pipeline.core.records import Lora, Part, TouchInput
from pipeline.encoder.recipes import check_recipe
from pipeline.language.start import objects_met
from pipeline.running.errors import UserError
from pipeline.running.parallel import check_backend
from pipeline.scales.memory import launched
from pipeline.scenes.invented import catalogue_of
from pipeline.tasks.questions import counts_by_task
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.files import list_videos, raise_errors
from pipeline.videos.split import assign_objects, untested
from pipeline.weights.backbones import check_encoder
from pipeline.weights.check import check_encoder_files, check_language_files

__all__ = ["check_inputs", "check_objects", "compose", "prune", "scale_names", "write_params"]
HEADER = "# Written by `octopi scale`; change it with that command, or edit conf/ and run it again.\n"


def check_inputs(params: Params) -> str:
    """Raise UserError where videos, catalogue, objects, tasks or weights are not there; return as `check_objects`."""
    catalogue = catalogue_of(params)
    check_recipe(params.encoder.recipe)
    counts_by_task(params.questions, "train")
    counts_by_task(params.questions, "evaluation")
    launcher = shlex.split(params.runtime.launcher)
    if not launcher or shutil.which(launcher[0]) is None:
        raise UserError(f"runtime.launcher: no program {params.runtime.launcher!r}; set it to python, or install it")
    launched(params.runtime.launcher)
    check_backend(params.runtime.parallel)
    folder = Path(params.data.dir)
    if params.data.source == "videos" and folder.is_file():
        raise UserError(f"data.dir: {folder} is a file; name the folder that the videos are in")
    if params.data.source == "videos" and not folder.is_dir():
        raise UserError(
            f"data.dir: {folder} does not exist; import the public data set (README, Real videos, real weights) or "
            "name the folder with data.dir=..."
        )
    lacking = check_objects(params, catalogue)
    encoder, language = Path(params.encoder.weights), Path(params.language.weights)
    check_encoder(encoder, params.frames.pixels, params.encoder.backbone)
    check_encoder_files(encoder, params.encoder.backbone)
    weights.check_language(language, "language.weights")
    check_language_files(language, "language.weights")
    return lacking


def check_objects(params: Params, catalogue: Catalogue) -> str:
    """Raise UserError where too few objects have videos for what was chosen; return a line on those that have none."""
    if params.data.source == "scenes":
        present = set(params.scenes.objects or catalogue.objects)
    else:
        folder = Path(params.data.dir)
        listing = list_videos(folder, catalogue)
        present = {file.object_id for file in listing.files}
        if not present:
            raise_errors(folder, listing.findings)
    lacking = ""
    for seed in params.ablation.seeds:
        parts = assign_objects(catalogue, present, params.split, seed)
        training, tested = (sorted(o for o in present if parts.get(o) == part) for part in (Part.TRAIN, Part.TEST))
        objects_met(params.language.start, {o: parts[o] for o in present if o in parts})
        fold = params.split.fold_of(seed)
        where = f"split.name={params.split.name}" + (f", fold {fold}" if fold is not None else "")
        if fold is None and (absent := untested(parts, present)):
            lacking = f"{where}: {absent}"
        if len(training) < 3:
            mend = "raise split.train_objects" if params.split.train_objects else "choose another split.name"
            raise UserError(
                f"{where}: {len(training)} training objects have videos, but questions about three objects need three; "
                f"add objects, or {mend}"
            )
        if len(tested) == 1 and TouchInput.SWAPPED in params.ablation.touch:
            raise UserError(
                f"ablation.touch: swapped gives a test object the touch of another, but with {where} only {tested[0]} "
                "has videos; leave swapped out, or add test objects"
            )
    return lacking


def write_params(params: Params, path: Path = PARAMS_FILE) -> bool:
    """Write params.yaml if that changes it; return whether it did."""
    lines = params.model_dump(mode="json")
    for name, section in lines.items():
        if isinstance(section, dict):
            # A section of one or two keys stands in one line, and so does a mapping within a longer one.
            inner = {key: _Line(v) if isinstance(v, dict) else v for key, v in section.items()}
            lines[name] = _Line(section) if len(section) <= 2 else inner
    text = HEADER + yaml.dump(lines, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)
    if path.is_file() and path.read_bytes() == text.encode():
        return False
    write_text(path, text)
    return True


class _Line(dict[str, Any]):
    """A short section, or a mapping within one."""


class _Dumper(yaml.SafeDumper):
    """Writes lists, and mappings within a section, in one line, so that params.yaml stays readable."""


_Dumper.add_representer(
    list, lambda dumper, data: dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=True)
)
_Dumper.add_representer(
    _Line, lambda dumper, data: dumper.represent_mapping("tag:yaml.org,2002:map", data.items(), flow_style=True)
)


def prune(params: Params, root: Path) -> None:
    """Remove outputs of variants that params.yaml no longer names; DVC's cache brings them back when asked for.

    Stages that read a whole folder (`embed`, `grade`, `report`) would otherwise rerun because of what they do not use.
    """
    variants = params.ablation.variants()
    keep = {root / encoder_dir(seed) for seed in params.ablation.seeds} | {root / answers_dir(v) for v in variants}
    keep |= {root / trained_dir(v._replace(lora=lora)) for v in variants for lora in Lora}
    for folder in {path.parent for path in keep}:
        for entry in folder.glob("*"):
            if entry.is_dir() and entry not in keep:
                shutil.rmtree(entry)

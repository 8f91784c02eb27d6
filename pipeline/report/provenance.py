"""Where a report comes from and what its figures stand on: facts that files say, and nothing that changes by itself."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Sequence
from importlib import metadata
from math import prod
from pathlib import Path
from typing import Any

import yaml

from pipeline.config import EncoderConfig, Params
from pipeline.config.params import CONF, PARAMS_FILE, compose
from pipeline.core.io import ROOT, code_of, read_json, sha256, tensor_shapes
from pipeline.core.layout import SHIPPED
from pipeline.core.records import Part
from pipeline.evaluation.intervals import coverage_note
from pipeline.report.render import WORDS
from pipeline.training.card import front_matter
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Video
from pipeline.weights.backbones import BACKBONES, reads_weights

PACKAGES = ("torch", "transformers", "peft", "open_clip_torch", "scipy", "scikit-learn", "dvc")
NOTES = Path(__file__).with_name("notes.yaml")
"""What only people know about a report: whether its settings were chosen on its test objects before."""
UNTOLD = {
    *("scale", "seed", "kernels", "data", "invent", "scenes", "split", "ablation", "evaluate"),
    *("packaged", "tracking", "runtime", "weights", "evaluation"),
    *("micro_batch_size", "embed_batch_size", "generation_batch_size"),
}
"""Sections and keys of params.yaml that change no result, or that other facts of a report are about."""


def provenance(
    params: Params,
    catalogue: Catalogue,
    videos: Sequence[Video],
    splits: Sequence[Sequence[Assignment]],
    asked: Sequence[tuple[str, ...]],
    root: Path,
) -> dict[str, Any]:
    """The content of provenance.json, for the report of `root` as it stands.

    Args:
        catalogue: for the data set's name and its properties.
        videos: all that decode; their hashes are hashed.
        splits: those that differ, for the test objects; one a fold.
        asked: the objects of each question, for what is known of the intervals.
    """
    rows = "\n".join(video.model_dump_json() for video in videos)
    test = {a.video_id: a.object_id for assignments in splits for a in assignments if a.part is Part.TEST}
    if not params.ablation.train and params.evaluate.objects == "all":
        test = {video.video_id: video.object_id for video in videos}
    seeds, split = params.ablation.seeds, params.split
    based = ["language"] if params.ablation.train else []
    if based and reads_weights(params.encoder):
        based.insert(0, "encoder")
    backbones = [BACKBONES[name] for name in params.encoder.backbone]
    folds = sorted({fold for seed in seeds if (fold := split.fold_of(seed)) is not None})
    notes: dict[str, str] = yaml.safe_load(NOTES.read_text(encoding="utf-8")).get(catalogue.language.dataset, {})
    return {
        "report": params.report_name,
        "scale": params.scale,
        "source": params.data.source,
        "dataset": catalogue.language.dataset,
        "properties": {p.name: list(p.levels) for p in catalogue.properties},
        "split": split.name,
        "test_objects": sorted(set(test.values())),
        "test_videos": len(test),
        "videos": len(videos),
        "seeds": list(seeds),
        "folds": {"of": split.folds, "tested": folds, "trained": split.train_objects} if folds else None,
        "replicates": len({split.replicate_of(seed) for seed in seeds}),
        # What people noted about its test objects. Other data has other objects.
        "settings": notes.get(f"{params.report_name}/{split.name}", ""),
        "intervals": coverage_note(asked),
        "facts_told": params.questions.facts,
        "beyond_paper": beyond_paper(params, root / CONF) if based else {},
        "evaluated": evaluated(params.evaluate.models),
        "command": "dvc repro",
        # Not the commit, which names itself no file that it holds; runs in MLflow have it.
        "code_sha256": hash_of(code_of("report")),
        "params_sha256": sha256(root / PARAMS_FILE),
        "data_sha256": hashlib.sha256(rows.encode()).hexdigest(),
        "encoder": encoder_words(params.encoder) if based else "",
        "base_models": {part: base_model(root, getattr(params, part).weights) for part in based},
        # In words, those of the base encoder's backbones that the chain pretrains itself.
        "own_backbones": [own.words for own in backbones if based and own.key != "weights"],
        "python": ".".join(platform.python_version_tuple()[:2]),
        "packages": {name: metadata.version(name) for name in PACKAGES},
    }


def evaluated(models: Sequence[str]) -> list[dict[str, Any]]:
    """The models of `evaluate.models`: folder, the hash of config.json, which has those of all other files, and whether
    matching questions tell them what the named objects are like."""
    places = {model: SHIPPED if model == SHIPPED.name else Path(model) for model in models}
    configs = {model: place / "config.json" for model, place in places.items()}
    return [
        {"folder": named(m), "sha256": sha256(c), "facts": read_json(c)["facts"]}
        if c.is_file()
        else {"folder": named(m), "sha256": "unknown"}
        for m, c in configs.items()
    ]


def beyond_paper(params: Params, conf: Path) -> dict[str, Any]:
    """The settings that have an effect and are not those of `paper-7b` in the folder `conf`, by their keys."""
    encoder, start = params.encoder, params.language.start
    void = UNTOLD | ({"begin_with_words", "normalize_touch"} if start else set())
    void |= {"wording"} if params.questions.wording == "texts" else set()  # Whole texts are how the paper describes.
    read = {"scenes": ["pretrain"], "timm": ["feature_stage"], "clip": ["prompts", "prompt_layers", "embedding"]}
    void |= {key for name, keys in read.items() if name not in encoder.backbone for key in keys}
    void -= {"embedding"} if encoder.embedding == "logits" else set()
    own, papers = (each.model_dump(mode="json") for each in (params, compose("paper-7b", conf=conf)))
    own["language"]["start"] = named(start)
    return {
        f"{section}.{key}": value
        for section in own
        if section not in void
        for key, value in own[section].items()
        if value != papers[section][key] and key not in void
    }


def encoder_words(config: EncoderConfig) -> str:
    """What the fine-tuned tactile encoder is, in words."""
    words = {
        "paper": "the base CLIP with visual prompt tuning",
        "release": "the base CLIP with visual prompt tuning as the published code has it",
        "tuned": " beside ".join(BACKBONES[name].words for name in config.backbone) + ", tuned on the properties",
    }.get(config.recipe, f"an encoder of the recipe `{config.recipe}`")
    words += ", on pictures of the difference to the untouched gel" if config.reference == "subtract" else ""
    return words + ("; the language model gets its heads' logits" if config.embedding == "logits" else "")


def base_model(root: Path, folder: str) -> dict[str, Any]:
    """Folder, kind, size in parameters, hash of a base model, and what its card says that it was taught.

    `parameters` are counted from the headers of its safetensors files. Where files are missing, they are 0 and the
    hash is "unknown".
    """
    where, kind = root / folder, "model"
    if (where / "open_clip_config.json").is_file():
        kind = "CLIP"
    elif (where / "config.json").is_file():
        config = json.loads((where / "config.json").read_text(encoding="utf-8"))
        name = str(config.get("model_type") or config.get("architecture", kind))
        kind = WORDS["architectures"].get(name, name)
    return {
        "folder": named(folder),
        "kind": kind,
        "parameters": sum(prod(s) for file in where.glob("*.safetensors") for s in tensor_shapes(file).values()),
        "sha256": digest(where),
        "taught": str(front_matter(where).get("taught", "")),
    }


def named(folder: str) -> str:
    """A folder as a report names it: of a place of this machine the last part alone."""
    return Path(folder).name if folder.startswith("~") or Path(folder).is_absolute() else folder


def digest(folder: Path) -> str:
    """SHA-256 over the names and hashes of a folder's files, hidden ones (downloads leave them) left out."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    shown = [file for file in files if not any(part.startswith(".") for part in file.relative_to(folder).parts)]
    return hash_of(shown, folder) if shown else "unknown"


def hash_of(files: Sequence[Path], folder: Path = ROOT) -> str:
    """SHA-256 over the names in `folder` and the hashes of files."""
    listed = "".join(f"{file.relative_to(folder).as_posix()} {sha256(file)}\n" for file in files)
    return hashlib.sha256(listed.encode()).hexdigest()

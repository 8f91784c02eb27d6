"""Trained models in MLflow: each variant's folder as a model to load and serve, the best one by an alias."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from importlib.metadata import requires, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.config import Params
from pipeline.config.params import PACKAGE
from pipeline.core.card import front_matter
from pipeline.core.io import read_table
from pipeline.core.records import Classification, Part, Variant
from pipeline.core.stage import DATA

NAME, ALIAS = "octopi", "best"


def log_model(client: Any, run: str, params: Params, variant: Variant, folder: Path) -> None:
    """Log a variant's packaged folder as a model of its run.

    Its requirements are this package's, in the installed versions. No input example is logged: MLflow would try it, and
    loading the model may take more memory than a machine with a dashboard has.
    """
    import mlflow.pyfunc
    from mlflow.models import ModelSignature
    from mlflow.types import ColSpec, Schema
    from mlflow.types.schema import Array, DataType

    text = DataType.string
    inputs, outputs = [ColSpec(text, "question"), ColSpec(Array(text), "videos")], [ColSpec(text, "answer")]
    card = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    licence = str(front_matter(folder).get("license", ""))
    about = {"variant": variant.key, "scale": params.report_name, "license": licence}
    names = [re.split(r"[^\w.-]", line)[0] for line in requires("octopi-pipeline") or () if "extra ==" not in line]
    mlflow.set_tracking_uri(client.tracking_uri)
    with mlflow.start_run(run, log_system_metrics=False), TemporaryDirectory() as temporary:
        # Where DVC's cache hands out links, MLflow refuses them: they lead out of the folder.
        real = shutil.copytree(folder, Path(temporary, folder.name))
        # The shipped model lies among the code, but is none.
        aside = shutil.ignore_patterns("pretrained", "__pycache__")
        code = shutil.copytree(PACKAGE, Path(temporary, PACKAGE.name), ignore=aside)
        mlflow.pyfunc.log_model(
            name=NAME,
            python_model=str(PACKAGE / "use" / "mlflow_model.py"),
            artifacts={"folder": str(real)},
            model_config={"base": "", "device": "auto", "dtype": "auto"},
            code_paths=[str(code)],
            # A build's own mark, as in 2.6.0+cpu, is known to no registry.
            pip_requirements=[f"{name}=={version(name).partition('+')[0]}" for name in names],
            signature=ModelSignature(Schema(inputs), Schema(outputs)),
            tags=about,
            metadata={**about, "base": card.get("base", {})},
            model_type="pyfunc",
        )


def register(client: Any, params: Params, runs: Sequence[tuple[Variant, str]]) -> str:
    """Give the best variant's model the alias `best` in the registry; the same one is not registered again.

    The best is chosen by validation alone, never by test questions: among variants that are the system as the paper
    proposes it (else all), the one whose seed's property heads are right on most validation videos. Language models are
    not scored on validation questions, so nothing finer is known.

    Args:
        client: MLflow's client.
        runs: Variants whose models are logged, with their runs; one at least.

    Returns:
        The address to load it by.
    """
    from mlflow.exceptions import MlflowException

    variant, run = max(runs, key=lambda pair: (pair[0].full, _validated(pair[0].seed), -pair[0].seed))
    name = f"{NAME}-{params.report_name}"
    address = f"models:/{name}@{ALIAS}"
    try:
        if client.get_model_version_by_alias(name, ALIAS).run_id == run:
            return address
    except MlflowException:
        if not client.search_registered_models(f"name = '{name}'"):
            client.create_registered_model(name, description=f"Touch for language models, scale {params.report_name}.")
    found = client.search_logged_models([client.get_run(run).info.experiment_id], f"source_run_id = '{run}'")[0]
    tags = {"variant": variant.key}
    made = client.create_model_version(name, found.artifact_location, run, tags=tags, model_id=found.model_id)
    client.set_registered_model_alias(name, ALIAS, made.version)
    return address


def _validated(seed: int) -> float:
    """Share of validation videos of which the heads have all properties right; 0 where nothing is known."""
    file = DATA / "encoder" / str(seed) / "classifications.parquet"
    right: dict[str, bool] = {}
    for row in read_table(file, Classification) if file.is_file() else ():
        if row.part is Part.VALIDATION:
            right[row.video_id] = right.get(row.video_id, True) and row.predicted == row.expected
    return sum(right.values()) / len(right) if right else 0.0

"""Trained models in MLflow: each variant's folder as a model to load and serve, the best one by an alias."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipeline.config import Params
from pipeline.config.params import PACKAGE
from pipeline.core.card import front_matter
from pipeline.core.io import read_table
from pipeline.core.records import Classification, Part, Variant, Video
from pipeline.core.stage import DATA

MODELS = Path("models")
NAME, ALIAS = "octopi", "best"
NEEDED = (
    *("accelerate", "av", "filelock", "mlflow", "numpy", "open_clip_torch", "opencv-contrib-python-headless"),
    *(
        "pandas",
        "peft",
        "platformdirs",
        "psutil",
        "pyarrow",
        "pydantic",
        "pyyaml",
        "safetensors",
        "scipy",
        "scikit-learn",
    ),
    *("statsmodels", "threadpoolctl", "timm", "tokenizers", "torch", "torchvision", "tqdm", "transformers"),
)
"""Distributions that answering imports; a test holds it to what the code imports."""
QUESTION = "Describe the touch. {tactile}"


def packaged(variant: Variant) -> Path | None:
    """The folder of a variant, or None where none was made."""
    folder = MODELS / variant.key
    return folder if (folder / "config.json").is_file() else None


def log_model(client: Any, run: str, params: Params, variant: Variant, folder: Path) -> None:
    """Log a variant's folder as a model of its run.

    By MLflow's client and not by `mlflow.pyfunc.log_model`, which would load the model to try the example: minutes, and
    memory that a machine with a dashboard need not have, where the weights are billions.
    """
    import mlflow.pyfunc
    from mlflow.entities import LoggedModelOutput
    from mlflow.models import Model, ModelSignature
    from mlflow.types import ColSpec, Schema
    from mlflow.types.schema import Array, DataType

    text = DataType.string
    inputs, outputs = [ColSpec(text, "question"), ColSpec(Array(text), "videos")], [ColSpec(text, "answer")]
    card = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    licence = str(front_matter(folder).get("license", ""))
    about = {"variant": variant.key, "scale": params.report_name, "license": licence}
    experiment = client.get_run(run).info.experiment_id
    made = client.create_logged_model(experiment, NAME, source_run_id=run, tags=about, model_type="pyfunc")
    with TemporaryDirectory() as temporary:
        saved = Path(temporary, "model")
        # Where DVC's cache hands out links, MLflow refuses them: they lead out of the folder.
        real = shutil.copytree(folder, Path(temporary, folder.name))
        # The model that is shipped is no code of this one.
        aside = shutil.ignore_patterns("pretrained", "__pycache__")
        code = shutil.copytree(PACKAGE, Path(temporary, PACKAGE.name), ignore=aside)
        mlflow.pyfunc.save_model(
            saved,
            mlflow_model=Model(made.artifact_location, run_id=run, model_uuid=made.model_id, model_id=made.model_id),
            python_model=str(PACKAGE / "use" / "mlflow_model.py"),
            artifacts={"folder": str(real)},
            model_config={"base": "", "device": "auto", "dtype": "auto"},
            code_paths=[str(code)],
            # A build's own mark, as in 2.6.0+cpu, is known to no registry.
            pip_requirements=[f"{name}=={version(name).partition('+')[0]}" for name in NEEDED],
            signature=ModelSignature(Schema(inputs), Schema(outputs)),
            input_example=_example(params),
            metadata={**about, "base": card.get("base", {})},
        )
        client.log_model_artifacts(made.model_id, str(saved))
    client.finalize_logged_model(made.model_id, "READY")
    client.log_outputs(run, [LoggedModelOutput(made.model_id, step=0)])


def register(client: Any, params: Params, runs: Sequence[tuple[Variant, str]]) -> str:
    """Give the best variant's model the alias `best` in the registry; the same one is not registered again.

    Best by validation, and by nothing that test questions say: among variants that are the system as the paper proposes
    it (else all), the one whose seed's property heads are right on most validation videos. Language models are not
    scored on validation questions, so nothing finer is known.

    Args:
        client: MLflow's client.
        runs: Variants whose models are logged, with their runs.

    Returns:
        The address to load it by; empty where there is none.
    """
    from mlflow.exceptions import MlflowException

    if not runs:
        return ""
    variant, run = max(runs, key=lambda pair: (pair[0].full, _validated(pair[0].seed), -pair[0].seed))
    name = f"{NAME}-{params.report_name}"
    address = f"models:/{name}@{ALIAS}"
    try:
        if client.get_model_version_by_alias(name, ALIAS).run_id == run:
            return address
    except MlflowException:
        registered = {model.name for model in client.search_registered_models(f"name = '{name}'")}
        if name not in registered:
            client.create_registered_model(name, description=f"Touch for language models, scale {params.report_name}.")
    found = client.search_logged_models([client.get_run(run).info.experiment_id], f"source_run_id = '{run}'")[0]
    made = client.create_model_version(
        name, found.artifact_location, run, tags={"variant": variant.key}, model_id=found.model_id
    )
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


def _example(params: Params) -> Any:
    """A question about the first video; without one where the videos are not there."""
    import pandas as pd

    videos = read_table(DATA / "videos.parquet", Video) if (DATA / "videos.parquet").is_file() else []
    file = next((path for v in videos if (path := Path(params.data.dir) / v.path).is_file()), None)
    touch = [base64.b64encode(file.read_bytes()).decode()] if file else []
    return pd.DataFrame({"question": [QUESTION if touch else "What can you feel?"], "videos": [touch]})

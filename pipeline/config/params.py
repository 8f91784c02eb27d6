"""The only reader of params.yaml and of the scales in conf/, and their errors in one line."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from pipeline.config import Params
from pipeline.running.errors import UserError, did_you_mean

PARAMS_FILE, CHAIN, CONF = Path("params.yaml"), Path("dvc.yaml"), Path("conf")
PACKAGE = Path(__file__).parents[1]
QUOTED = r"""'.*'|".*\""""


def check_code(folder: Path) -> None:
    """Raise UserError where a folder has a `pipeline` of its own, which dvc.lock records, and another one runs."""
    own = folder / PACKAGE.name
    if (own / "running" / "stage.py").is_file() and not own.samefile(PACKAGE):
        raise UserError(
            f"{PACKAGE} would run, but dvc.lock records {own.resolve()}; activate the environment of that folder "
            "(`make install` there makes it)"
        )


def in_project() -> None:
    """Raise UserError where this is not the project's folder, or the code that runs is not the project's own.

    dvc.lock records the code in the folder, whichever environment is active. In the copy that DVC makes for an
    experiment the process starts again, with the copy's code: what is recorded is then what runs.
    """
    here, script = Path.cwd(), Path(sys.argv[0]).absolute()
    if not any(path.exists() for path in (CHAIN, PARAMS_FILE, CONF)):
        above = next((f"{folder}, " for folder in here.parents if (folder / CHAIN).is_file()), "")
        raise UserError(f"{here} has no {CHAIN}; go to {above}the project's folder")
    try:
        check_code(here)
        check_code(script.parents[1] if script.parent.name == "stages" else here)
    except UserError:
        first, rest = str(here), os.environ.get("PYTHONPATH", "")
        if main_folder() == here or rest.startswith(first):
            raise
        path = os.pathsep.join(filter(None, (first, rest)))
        os.execve(sys.executable, sys.orig_argv, {**os.environ, "PYTHONPATH": path})


def main_folder() -> Path:
    """The project's folder; for the copy of it that DVC runs an experiment in, and then deletes, what was copied."""
    here, root = Path.cwd(), Path(os.environ.get("DVC_ROOT", "")).resolve()
    return root if here.is_relative_to(root / ".dvc" / "tmp" / "exps") else here


def load_params(path: Path = PARAMS_FILE) -> Params:
    """Read and check params.yaml; for this folder's, `in_project` must hold."""
    if path == PARAMS_FILE:
        in_project()
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=OneKeyLoader)
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8; save it as such, or `octopi scale smoke` rewrites it") from None
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `octopi scale smoke` writes it") from None
    except yaml.YAMLError as error:
        raise UserError(
            f"{path}: not YAML ({' '.join(str(error).split())}); `octopi scale smoke` rewrites it"
        ) from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: empty; `octopi scale smoke` writes it")
    return validate(values, str(path))


def scale_names(conf: Path = CONF) -> list[str]:
    """Names of the scales that conf/ holds."""
    return sorted(f.stem for f in conf.glob("*.yaml") if f.stem != "base")


def compose(name: str, overrides: Sequence[str] = (), conf: Path = CONF) -> Params:
    """Compose a scale with `key=value` overrides by Hydra and validate the result.

    Raises:
        UserError: for an unknown scale or key, a value out of range, or an override that is not `key=value`.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    scales = scale_names(conf)
    if name not in scales:
        raise UserError(f"scale {name!r} is not known; allowed: {', '.join(scales)}")
    forced, texts = list[str](), dict[str, str]()
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals:
            raise UserError(f"{override!r} is no override; write key=value, for example split.name=kfold")
        if kind_of(key.lstrip("+").split(".")) is str and not re.fullmatch(QUOTED, value, re.DOTALL):
            # As it stands: Hydra's grammar would read brackets, commas or blanks of a path.
            texts[key.lstrip("+")] = value
        else:
            # Every key may be set; whether it exists is the validation's matter, since that knows what is allowed.
            forced.append(override if key.startswith("+") else f"++{override}")
    # A recipe brings its own values; they give way to what is set beside it.
    if (conf / "recipe" / f"{texts.get('encoder.recipe')}.yaml").is_file():
        forced.insert(0, f"recipe={texts['encoder.recipe']}")
    try:
        with initialize_config_dir(str(conf.resolve()), version_base=None):
            composed = hydra_compose(name, overrides=forced)
        for key, value in texts.items():
            OmegaConf.update(composed, key, value, force_add=True)
        values = OmegaConf.to_container(composed, resolve=True)
    except (HydraException, OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"scale {name}: {' '.join(str(error).split())}") from None
    assert isinstance(values, dict)
    params = validate({str(k): v for k, v in values.items()}, f"scale {name}")
    if params.scale != name:
        raise UserError(
            f"{conf / name}.yaml: it calls itself {params.scale}, and would replace its reports; write scale: {name}"
        )
    return params


class OneKeyLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Refuses a key that stands twice, of which YAML readers take the last one silently."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping as PyYAML does, unless a key repeats."""
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} stands twice", key.start_mark)
            seen.add(key.value)
        values: dict[Any, Any] = super().construct_mapping(node, deep)
        return values


def validate(values: Mapping[str, Any], origin: str) -> Params:
    """Check values against the schema; `origin` begins the line about the first that is wrong."""
    try:
        return Params.model_validate(values)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
    key, kind, message = ".".join(map(str, detail["loc"])), detail["type"], detail["msg"].removeprefix("Value error, ")
    if kind == "extra_forbidden":
        known = list(getattr(kind_of(detail["loc"][:-1]), "model_fields", ()))
        hint = did_you_mean(str(detail["loc"][-1]), known)
        line = f"{key} is not a parameter; {hint}allowed here: {', '.join(known)}"
    elif kind == "missing":
        line = f"{key} is missing; run `octopi scale` again to write a whole params.yaml"
    elif kind == "value_error":
        line = f"{key}: {message}" if key else message
    else:
        line = f"{key} is {detail['input']!r}: {message}"
    raise UserError(f"{origin}: {line}")


def kind_of(key: Iterable[int | str]) -> Any:
    """The type of a section or parameter, by the parts of its name; None where there is none of that name."""
    kind: Any = Params
    for part in key:
        kind = kind.model_fields.get(str(part)) if isinstance(kind, type) and issubclass(kind, BaseModel) else None
        kind = kind and kind.annotation
    return kind

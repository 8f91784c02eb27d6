"""What a run may be told: the validated shape of params.yaml, and its only reader.

`conf/` holds the scales, `octopi scale` composes one of them into params.yaml, and every stage loads that file
through `load_params` and passes on only the section that a function needs.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ValidationError, model_validator

from pipeline.encoder.candidates import CONTESTANTS
from pipeline.errors import UserError
from pipeline.plan import Plan, resolve_plan
from pipeline.config import (
    SCENES_DIR,
    AblationConfig,
    CrossValidationConfig,
    DataConfig,
    EncoderConfig,
    FramesConfig,
    LanguageConfig,
    LoraTrainConfig,
    PretrainConfig,
    QuestionsConfig,
    RuntimeConfig,
    ScenesConfig,
    Section,
    Seed,
    SplitConfig,
    TrackingConfig,
    TrainConfig,
)

PARAMS_FILE = Path("params.yaml")

S = TypeVar("S", bound=Section)


class Settings(Section):
    """All that a person sets: params.yaml without what follows from it."""

    scale: Literal["smoke", "small", "paper-7b", "paper-13b"]
    seed: Seed = 0
    data: DataConfig
    scenes: ScenesConfig
    frames: FramesConfig
    split: SplitConfig
    questions: QuestionsConfig
    encoder: EncoderConfig
    pretrain: PretrainConfig
    cross_validation: CrossValidationConfig
    language: LanguageConfig
    align: TrainConfig
    lora: LoraTrainConfig
    ablation: AblationConfig
    tracking: TrackingConfig
    runtime: RuntimeConfig

    @model_validator(mode="after")
    def _scenes_have_their_place(self) -> Self:
        if self.data.source == "scenes" and Path(self.data.dir) != SCENES_DIR:
            raise ValueError(f"data.dir must be {SCENES_DIR} where data.source is scenes (set data.source=videos?)")
        return self

    @model_validator(mode="after")
    def _contestants_have_their_settings(self) -> Self:
        models = self.cross_validation.models
        borrowed = [n for n in models if CONTESTANTS[n].kind == "gradient" and not CONTESTANTS[n].settings]
        if borrowed and self.encoder.recipe == "release":
            raise ValueError(
                f"cross_validation.models: {borrowed[0]} would be trained with the settings of encoder.recipe=release; "
                "compare it under recipe paper or strong"
            )
        return self

    @property
    def report_name(self) -> str:
        """The folder in reports/ that this scale and source report into."""
        return f"{self.scale}-{self.data.source}"


class Params(Settings):
    """The whole of params.yaml."""

    plan: Plan
    """Resolved from data.source and ablation by `octopi scale`; DVC makes one stage of each entry."""

    @model_validator(mode="after")
    def _plan_is_resolved(self) -> Self:
        if self.plan != plan_of(self):
            raise ValueError(
                "plan does not follow from ablation and encoder.recipe; run `octopi scale` again instead of editing it"
            )
        return self


def plan_of(settings: Settings) -> Plan:
    """What DVC has to make stages of."""
    return resolve_plan(
        settings.data.source,
        settings.ablation.plan,
        settings.ablation.seeds,
        pretrained=settings.encoder.recipe == "strong",
        compared={name: CONTESTANTS[name].pretrained for name in settings.cross_validation.models},
        counterfactuals=settings.ablation.counterfactuals,
    )


def resolve(values: Mapping[str, Any], origin: str) -> Params:
    """Validate composed settings and add the plan that follows from them; `origin` begins an error's line."""
    settings = _validate(Settings, values, origin)
    return Params(**{name: getattr(settings, name) for name in Settings.model_fields}, plan=plan_of(settings))


def load_params(path: Path = PARAMS_FILE) -> Params:
    """Read and check params.yaml."""
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; `octopi scale smoke` writes it") from None
    except yaml.YAMLError as error:
        raise UserError(
            f"{path}: not YAML ({' '.join(str(error).split())}); `octopi scale smoke` rewrites it"
        ) from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: empty; `octopi scale smoke` writes it")
    return _validate(Params, values, str(path))


def explain(error: ValidationError) -> str:
    """The first problem of a validation in one line: key, value, what is allowed."""
    detail = error.errors(include_url=False)[0]
    key = ".".join(str(part) for part in detail["loc"])
    if detail["type"] == "extra_forbidden":
        known = _known_keys(detail["loc"])
        close = difflib.get_close_matches(str(detail["loc"][-1]), known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        return f"{key} is not a parameter; {hint}allowed here: {', '.join(known)}"
    message = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "missing":
        return f"{key} is missing; run `octopi scale` again to write a whole params.yaml"
    if detail["type"] == "value_error":
        return f"{key}: {message}" if key else message
    return f"{key} is {detail['input']!r}: {message}"


def _validate(model: type[S], values: Mapping[str, Any], origin: str) -> S:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UserError(f"{origin}: {explain(error)}") from None


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    model: type[BaseModel] = Params
    for part in location[:-1]:
        annotation = model.model_fields[str(part)].annotation
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return [name for name in model.model_fields if name != "plan"]

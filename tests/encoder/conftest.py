"""What several tests of encoders share."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook

from pipeline.config import EncoderConfig, RecipeName
from pipeline.encoder import frame_classifier
from pipeline.encoder.data import EncoderData
from pipeline.videos.catalogue import Catalogue
from tests.encoders import PARTS, config, encoder_data, write_timm

Hook = Callable[[Callable[[int, torch.optim.Optimizer], None]], None]


@pytest.fixture
def before_updates() -> Iterator[Hook]:
    """Has something called before each update of any optimiser, with the number of updates made and the optimiser."""
    handles = []

    def register(call: Callable[[int, torch.optim.Optimizer], None]) -> None:
        made = iter(range(10**6))
        handles.append(register_optimizer_step_pre_hook(lambda optimizer, *_: call(next(made), optimizer)))

    yield register
    for handle in handles:
        handle.remove()


def gradient(optimizer: torch.optim.Optimizer) -> torch.Tensor:
    """Of all that it changes, in one row."""
    return torch.cat([p.grad.flatten() for group in optimizer.param_groups for p in group["params"]])


def setting_of(recipe: RecipeName, weights: Path, **changes: object) -> EncoderConfig:
    """Of a recipe; `tuned` stands on a tiny network of timm's."""
    if recipe != "tuned":
        return config(weights, recipe, **changes)
    return config(write_timm(Path("timm")), recipe, backbone=("timm",), feature_stage=2, **changes)


def relabelled(data: EncoderData, object_id: str) -> EncoderData:
    """Another rating of one object, as a corrected objects.csv has it."""
    own = data.catalogue.objects[object_id]
    other = own.model_copy(update={"ratings": tuple((0 if level else 2,) * 3 for level in own.labels)})
    assert other.labels != own.labels
    objects = {**data.catalogue.objects, object_id: other}
    return replace(data, catalogue=data.catalogue.model_copy(update={"objects": objects}))


def killed_at(updates: Collection[int], begun: list[int]) -> Callable[[int, torch.optim.Optimizer], None]:
    def kill(number: int, _: torch.optim.Optimizer) -> None:
        begun.append(number)
        if number in updates:
            raise KeyboardInterrupt

    return kill


@pytest.fixture
def data(catalogue: Catalogue, tmp_path: Path) -> EncoderData:
    """Five videos to train on, two to choose by."""
    return encoder_data(tmp_path, catalogue, PARTS)


@pytest.fixture
def few_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_classifier, "STRENGTHS", (1e-3, 1e-2))
    monkeypatch.setattr(frame_classifier, "FOLDS", 2)

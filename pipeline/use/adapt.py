"""A trained model's copy for another sensor, by that sensor's unlabelled videos."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import torch

from pipeline.core.io import atomic_folder, sha256, write_json, write_text
from pipeline.running.errors import UserError
from pipeline.training.card import CARD_FILE
from pipeline.training.embeddings import STATISTICS_FILE
from pipeline.use.folder import CONFIG, ENCODER_DIR
from pipeline.use.model import Octopi

CARD = """# {name}, fitted to another sensor

A copy of `{name}`. Its embeddings are standardised by the mean and deviation of {count} frames of another sensor's
videos, without any label. Weights and property heads are the original's, whose card has their licences and what they
were trained on. This copy was tested on nothing.
"""


def adapt(model: Octopi, videos: Sequence[Path], to: Path) -> None:
    """Copy a model's folder for the sensor of these videos: their frames' mean and deviation standardise embeddings.

    No label is needed: another sensor shifts and scales embeddings, and these say by how much. The property heads look
    at the pictures themselves, and stay as they are.

    Raises:
        UserError: for a model that does not standardise, too few or unusable videos, or where `to` is there already.
    """
    if not model.config.encoder.standardize:
        raise UserError("encoder.standardize was off in training, so there is nothing to adapt; train the model anew")
    if to.exists():
        raise UserError(f"{to}: is there already; name a folder that is not")
    features = torch.cat([model.touched(video).features for video in videos]).double()
    if len(features) < 2:
        raise UserError("one frame has no deviation; name more videos")
    std, mean = torch.std_mean(features, dim=0, correction=0)
    known = model.encoder.statistics
    # A dimension that is constant in these frames gives no estimate of its scale, so the old scale stays.
    scale = known.scale * torch.where(std > 0, std, 1.0)
    with atomic_folder(to) as made:
        shutil.copytree(model.folder, made, dirs_exist_ok=True)
        statistics = made / ENCODER_DIR / STATISTICS_FILE
        # The features are standardised already, so the new mean and deviation come on top of the old ones.
        known._replace(mean=known.mean + mean * known.scale, scale=scale).save(statistics)
        write_text(made / CARD_FILE, CARD.format(name=model.name, count=len(features)))
        own = {f.relative_to(made).as_posix(): sha256(f) for f in (statistics, made / CARD_FILE)}
        config = model.config.model_copy(update={"files": {**model.config.files, **own}, "scores": {}})
        write_json(made / CONFIG, config.model_dump(mode="json"))

"""The encoder of a trained model: from a video to embeddings for its language model, and to classes by its heads."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pipeline.config import EncoderConfig
from pipeline.core.io import fingerprint
from pipeline.core.records import Encoder
from pipeline.encoder.embed import standardize
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.evaluation.calibration import rescale
from pipeline.running.errors import UserError
from pipeline.training.embeddings import STATISTICS_FILE, Statistics
from pipeline.training.trainable import load_trainable
from pipeline.use.folder import BACKBONE_DIR, CONFIG, ENCODER_DIR, SCENES, TRAINED, ModelConfig, distance
from pipeline.use.frames import name_of, read_touch
from pipeline.use.results import Touch, Video
from pipeline.videos.catalogue import Catalogue

REMEMBERED = 2**28
"""Bytes of pictures that are kept, so that a conversation about them goes on at once: some 150 videos at 224 pixels."""


class EncodedVideo(NamedTuple):
    """A video as the language model is given it."""

    name: str
    """What notes and errors call it."""
    touch: Touch
    """Its frames, and all notes on them."""
    touched: bool
    """Whether anything touches the sensor."""
    features: torch.Tensor
    """float32, frames x dim."""
    raw: torch.Tensor
    """float32, frames x dim: as the encoder has them, neither standardised nor read by heads."""


class Classified(NamedTuple):
    """Predictions of the property heads, in the catalogue's order of properties."""

    probabilities: tuple[tuple[float, ...], ...] = ()
    """Calibrated, of each class."""
    levels: tuple[int, ...] = ()
    """The predicted classes."""


class Verdict(NamedTuple):
    """What follows from the property heads by a plain rule, without the language model."""

    said: str
    """Worded as a right answer is."""
    shown: str
    """With the classes, and their probabilities or expected classes."""


class VideoEncoder:
    """The tactile encoder and heads of a folder, with what embeddings are standardised by."""

    def __init__(self, folder: Path, config: ModelConfig, catalogue: Catalogue, device: torch.device) -> None:
        self.place, self.config, self.catalogue, self.device = folder / ENCODER_DIR, config, catalogue, device
        self.statistics = Statistics.load(self.place / STATISTICS_FILE)
        if self.statistics.frames != fingerprint(config.frames):
            raise UserError(
                f"{folder / CONFIG}: its frame settings are not those of training; copy the whole folder again"
            )
        self._encoded: OrderedDict[str, EncodedVideo] = OrderedDict()

    @torch.inference_mode()
    def encode(self, video: Video) -> EncodedVideo:
        """A video's frames and their embeddings; UserError for what is no video, is damaged as a whole or too short."""
        key, config = _key(video), self.config
        if key not in self._encoded:
            touch, name = read_touch(video, config.frames, config.quiet), name_of(video)
            raw = self._encoder(*self._pictures(touch)).float().cpu()
            if not raw.isfinite().all():
                raise UserError(f"{name}: its embedding is not finite; check the video")
            standard = standardize(raw, self.statistics)
            far, usual = distance(standard.double().numpy()), config.usual
            if usual is not None and far > usual:
                unlike = f"{far:.1f} deviations from its mean, where its own videos reach {usual:.1f}"
                touch = touch.model_copy(update={"notes": (*touch.notes, f"unlike training: {unlike}")})
            features = standard if config.encoder.standardize else raw
            self._encoded[key] = EncodedVideo(name, touch, touch.strength > config.quiet, features, raw)
        self._encoded.move_to_end(key)
        touches = [encoded.touch for encoded in self._encoded.values()]
        sizes = [t.frames.nbytes + t.reference.nbytes + t.difference.nbytes for t in touches]
        while len(sizes) > 1 and sum(sizes) > REMEMBERED:
            self._encoded.popitem(last=False)
            sizes.pop(0)
        return self._encoded[key]

    @torch.inference_mode()
    def classify(self, video: Video) -> Classified:
        """What the property heads say of a video."""
        frames, numbers = self._pictures(self.encode(video).touch)
        logits = self.classifier(frames[None], numbers[None])["logits"].cpu()
        parts = logits.double().split([len(p.levels) for p in self.catalogue.properties], dim=1)
        probabilities = tuple(
            tuple(rescale(part.softmax(1)[0].numpy(), self.config.temperatures[p.name]).tolist())
            for part, p in zip(parts, self.catalogue.properties, strict=True)
        )
        return Classified(probabilities, tuple(self.classifier.decide(logits)[0].tolist()))

    def _pictures(self, touch: Touch) -> tuple[torch.Tensor, torch.Tensor]:
        """What the encoder takes: frames, or their differences to the reference, and their places in the video."""
        pictures = touch.difference if self.config.encoder.reference == "subtract" else touch.frames
        return torch.from_numpy(pictures).to(self.device), torch.tensor(touch.numbers, device=self.device)

    @property
    def _own(self) -> EncoderConfig:
        """The encoder's settings with the folder's own files."""
        files = {"weights": str(self.place / BACKBONE_DIR), "pretrained": str(self.place / SCENES)}
        return self.config.encoder.model_copy(update=files)

    @cached_property
    def classifier(self) -> PropertyClassifier:
        """The fine-tuned encoder with its property heads."""
        classifier = property_classifier(self._own, [len(p.levels) for p in self.catalogue.properties])
        if not self.config.heads:
            classifier.heads.requires_grad_(False)  # So that the file need not have them.
        load_trainable(classifier, self.place / TRAINED)
        return classifier.to(self.device).eval()

    @cached_property
    def _encoder(self) -> FrameEncoder:
        if self.config.encoder_used is Encoder.FINETUNED:
            return self.classifier.encoder
        return base_encoder(self._own).to(self.device).eval()


def _key(video: Video) -> str:
    """By which a video is known again: its place, size and time of change, or an array's bytes."""
    if isinstance(video, np.ndarray):
        return f"{video.shape} {video.dtype} {sha256(np.ascontiguousarray(video).data).hexdigest()}"
    try:
        status = Path(video).stat()
    except (OSError, TypeError, ValueError):
        return str(video)
    return f"{Path(video).resolve()} {status.st_size} {status.st_mtime_ns} {status.st_ino}"

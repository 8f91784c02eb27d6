"""The encoders and baselines that a cross-validation can compare: what each is made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from pipeline.config import EncoderConfig
from pipeline.core.errors import UserError, did_you_mean
from pipeline.weights import check_encoder

Kind = Literal["constant", "frame_heads", "gradient", "tuned"]


@dataclass(frozen=True)
class Candidate:
    """One model. What does not concern its kind has no meaning."""

    title: str
    kind: Kind
    """`constant`: the training objects' most frequent combination. `frame_heads`: a per-frame classifier on
    frozen features. `gradient`: trained by the Trainer. `tuned`: that recipe."""
    backbone: tuple[str, ...] = ()
    """Whose features: names in `pipeline.weights.BACKBONES`; none stands for the chain's own `encoder.backbone`."""
    recipe: Literal["paper", "release", "scratch"] = "paper"
    """`gradient`: which. `scratch` trains the network of the backbone `scenes` end to end from random weights."""
    reference: Literal["chain", "none", "own"] = "none"
    """What is subtracted from a frame: as `encoder.reference` says, nothing, or its video's own no-contact picture."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """`gradient`: what differs from the section `encoder`; as the recipe's file in conf/ has it."""
    frames: int | None = None
    """Frames a video, where not `frames.per_video`."""

    @property
    def settings_of(self) -> str:
        """The recipe whose settings in the section `encoder` it is trained with; "" where there are none."""
        return "tuned" if self.kind == "tuned" else "paper" if self.kind == "gradient" and not self.settings else ""


PRETRAINED = Candidate(
    "pretrained on synthetic pictures, frame classifier, decided jointly", "frame_heads", ("scenes",), reference="own"
)
PAPER = Candidate("CLIP with visual prompts, three heads", "gradient", ("clip",))
RELEASE = {"epochs": 40, "batch_size": 4, "learning_rate": 1e-3, "weight_decay": 0.01, "max_grad_norm": 0.0}

CANDIDATES: dict[str, Candidate] = {
    "constant": Candidate("the training objects' most frequent combination of classes", "constant"),
    "backbone": Candidate("the frozen backbones, frame classifier, decided jointly", "frame_heads", reference="chain"),
    "backbone-tuned": Candidate("the same tuned on the properties", "tuned", reference="chain"),
    "probe": Candidate("frozen CLIP, frame classifier, decided jointly", "frame_heads", ("clip",)),
    "probe-difference": Candidate(
        "frozen CLIP on difference pictures, likewise", "frame_heads", ("clip",), reference="own"
    ),
    "paper": PAPER,
    "paper-difference": replace(PAPER, title="the paper's recipe on difference pictures", reference="own"),
    "release": replace(PAPER, title="the published code's recipe", recipe="release", settings=RELEASE),
    "scratch": replace(
        PAPER, title="the pretrained network's layers, from scratch", backbone=(), recipe="scratch", reference="own"
    ),
    "pretrained": PRETRAINED,
    "pretrained-one-frame": replace(PRETRAINED, title="one frame a video", frames=1),
    "pretrained-ten-frames": replace(PRETRAINED, title="ten frames a video", frames=10),
}


def check_candidates(names: Sequence[str], config: EncoderConfig, size: int) -> None:
    """Raise UserError where a name of `cross_validation.models` is none, or lacks weights or settings in `encoder`."""
    for name in names:
        if name not in CANDIDATES:
            hint = did_you_mean(name, CANDIDATES)
            raise UserError(f"cross_validation.models: {name} is no model; {hint}known: {', '.join(CANDIDATES)}")
        candidate = CANDIDATES[name]
        try:
            check_encoder(Path(config.weights), size, candidate.backbone)
        except UserError as error:
            needed = " and ".join(candidate.backbone)
            raise UserError(f"cross_validation.models: {name} needs {needed}; leave it out, or: {error}") from None
        if candidate.settings_of not in ("", config.recipe):
            raise UserError(
                f"cross_validation.models: {name} would be trained with the settings of "
                f"encoder.recipe={config.recipe}; compare it under recipe {candidate.settings_of}"
            )


def needs_pretraining(config: EncoderConfig, models: Sequence[str]) -> bool:
    """Whether the encoder, or one of the compared models, has the backbone `scenes`."""
    return "scenes" in config.backbone or any("scenes" in CANDIDATES[name].backbone for name in models)

"""The encoders and baselines that a cross-validation can compare: what each is made of."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from pipeline.errors import UserError

Kind = Literal["constant", "trees", "frame_heads", "gradient"]


@dataclass(frozen=True)
class Candidate:
    """One model. What does not concern its kind has no meaning."""

    title: str
    kind: Kind
    """`constant`: the training objects' most frequent combination. `trees`: hand-made features of whole frames and
    tree ensembles. `frame_heads`: the recipe `pretrained`'s heads on frozen features of single frames. `gradient`:
    trained by the Trainer."""
    encoder: Literal["clip", "scenes", "untrained"] = "clip"
    """`scenes`: pretrained on synthetic pictures; `untrained`: the same network with random weights."""
    recipe: Literal["paper", "release", "scratch"] = "paper"
    """`gradient`: which. `scratch` trains the network of the recipe `pretrained` end to end from random weights."""
    reference: Literal["none", "own", "mean"] = "none"
    """What is subtracted from a frame: nothing, its video's own no-contact picture, or the mean of the training
    videos' ones."""
    joint: bool = True
    """`frame_heads`: whether the properties are decided together."""
    pooled: bool = False
    """`frame_heads`: whether features, and not probabilities, are averaged over frames."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """`gradient`: what differs from the section `encoder`; as the recipe's file in conf/ has it."""
    frames: int | None = None
    """Frames a video, where not `frames.per_video`."""
    objects: int | None = None
    """Training objects, drawn from those of the fold; None takes all."""
    parent: str = field(default="", kw_only=True)
    """The model that this one changes in one thing."""

    @property
    def pretrained(self) -> bool:
        """Whether it needs the encoder that synthetic pictures have pretrained."""
        return self.encoder == "scenes" and self.kind == "frame_heads"


PRETRAINED = Candidate(
    "pretrained on synthetic pictures, frame classifier, decided jointly", "frame_heads", "scenes", reference="own"
)
PAPER = Candidate("CLIP with visual prompts, three heads", "gradient")
RELEASE = {"epochs": 40, "batch_size": 4, "learning_rate": 1e-3, "weight_decay": 0.01}
LEARNING_CURVE = (10, 20, 30, 40)

CANDIDATES: dict[str, Candidate] = {
    "constant": Candidate("the training objects' most frequent combination of classes", "constant"),
    "trees": Candidate("hand-made features of five uniform frames, random trees, decided jointly", "trees"),
    "probe": Candidate("frozen CLIP, frame classifier, decided jointly", "frame_heads"),
    "probe-difference": Candidate("frozen CLIP on difference pictures, likewise", "frame_heads", reference="own"),
    "paper": PAPER,
    "paper-difference": replace(PAPER, title="the paper's recipe on difference pictures", reference="own"),
    "release": replace(PAPER, title="the published code's recipe", recipe="release", settings=RELEASE),
    "scratch": replace(PAPER, title="the pretrained network's layers, from scratch", recipe="scratch", reference="own"),
    "pretrained": PRETRAINED,
    "pretrained-untrained": replace(PRETRAINED, title="without pretraining", encoder="untrained", parent="pretrained"),
    "pretrained-raw": replace(
        PRETRAINED, title="without each video's own reference", reference="mean", parent="pretrained"
    ),
    "pretrained-independent": replace(PRETRAINED, title="without the joint decision", joint=False, parent="pretrained"),
    "pretrained-pooled": replace(
        PRETRAINED, title="features averaged in place of probabilities", pooled=True, parent="pretrained"
    ),
    "pretrained-one-frame": replace(PRETRAINED, title="one frame a video", frames=1, parent="pretrained"),
    "pretrained-ten-frames": replace(PRETRAINED, title="ten frames a video", frames=10, parent="pretrained"),
    **{
        f"pretrained-{count}-objects": replace(
            PRETRAINED, title=f"{count} training objects", objects=count, parent="pretrained"
        )
        for count in LEARNING_CURVE
    },
}


def check_candidates(names: Sequence[str], recipe: str) -> None:
    """Raise UserError where a name of `cross_validation.models` is none, or lacks settings under this recipe."""
    for name in names:
        if name not in CANDIDATES:
            close = difflib.get_close_matches(name, CANDIDATES, n=1)
            hint = f"did you mean {close[0]}? " if close else ""
            raise UserError(f"cross_validation.models: {name} is no model; {hint}known: {', '.join(CANDIDATES)}")
        if CANDIDATES[name].kind == "gradient" and not CANDIDATES[name].settings and recipe == "release":
            raise UserError(
                f"cross_validation.models: {name} would be trained with the settings of encoder.recipe=release; "
                "compare it under recipe paper or pretrained"
            )


def needs_pretraining(recipe: str, models: Sequence[str]) -> bool:
    """Whether the encoder's recipe, or one of the compared models, begins with synthetic pretraining."""
    return recipe == "pretrained" or any(CANDIDATES[name].pretrained for name in models)

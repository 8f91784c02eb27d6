"""The encoders and their rivals that a cross-validation can compare: what each is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

Kind = Literal["constant", "trees", "votes", "gradient"]


@dataclass(frozen=True)
class Contestant:
    """One model. What does not concern its kind has no meaning."""

    title: str
    kind: Kind
    """`constant`: the training objects' most frequent combination. `trees`: hand-made features of whole frames and
    tree ensembles. `votes`: the strong recipe's heads on frozen features of frames. `gradient`: trained by the
    Trainer."""
    encoder: Literal["clip", "scenes", "untrained"] = "clip"
    """`scenes`: pretrained on them; `untrained`: the same network with random weights."""
    recipe: Literal["paper", "release", "scratch"] = "paper"
    """`gradient`: which. `scratch` trains the strong recipe's network end to end from random weights."""
    reference: Literal["none", "own", "mean"] = "none"
    """What is subtracted from a frame: nothing, its video's own no-contact picture, or the mean of the training
    videos' ones."""
    joint: bool = True
    """`votes`: whether the properties are decided together."""
    pooled: bool = False
    """`votes`: whether features, and not probabilities, are averaged over frames."""
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
        """Whether it needs the encoder that scenes have pretrained."""
        return self.encoder == "scenes" and self.kind == "votes"


STRONG = Contestant("pretrained on scenes, frames vote, decided jointly", "votes", "scenes", reference="own")
PAPER = Contestant("CLIP with visual prompts, three heads", "gradient")
RELEASE = {"epochs": 40, "batch_size": 4, "learning_rate": 1e-3, "weight_decay": 0.01}
LEARNING_CURVE = (10, 20, 30, 40)

CONTESTANTS: dict[str, Contestant] = {
    "constant": Contestant("the training objects' most frequent combination of classes", "constant"),
    "trees": Contestant("hand-made features of five uniform frames, random trees, decided jointly", "trees"),
    "probe": Contestant("frozen CLIP, frames vote, decided jointly", "votes"),
    "probe-difference": Contestant("frozen CLIP on difference pictures, likewise", "votes", reference="own"),
    "paper": PAPER,
    "paper-difference": replace(PAPER, title="the paper's recipe on difference pictures", reference="own"),
    "release": replace(PAPER, title="the published code's recipe", recipe="release", settings=RELEASE),
    "scratch": replace(PAPER, title="the strong recipe's network, from scratch", recipe="scratch", reference="own"),
    "strong": STRONG,
    "strong-untrained": replace(STRONG, title="without pretraining", encoder="untrained", parent="strong"),
    "strong-raw": replace(STRONG, title="without each video's own reference", reference="mean", parent="strong"),
    "strong-independent": replace(STRONG, title="without the joint decision", joint=False, parent="strong"),
    "strong-pooled": replace(STRONG, title="features averaged in place of votes", pooled=True, parent="strong"),
    "strong-one-frame": replace(STRONG, title="one frame a video", frames=1, parent="strong"),
    "strong-ten-frames": replace(STRONG, title="ten frames a video", frames=10, parent="strong"),
    **{
        f"strong-{count}-objects": replace(STRONG, title=f"{count} training objects", objects=count, parent="strong")
        for count in LEARNING_CURVE
    },
}

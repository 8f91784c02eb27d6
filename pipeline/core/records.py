"""The typed records that stages hand to each other.

Each table or JSON-lines file holds one kind of record; `pipeline.core.io` writes and reads them and
checks every row against the model.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from pipeline.core.errors import readable

Share = Annotated[float, AfterValidator(lambda value: round(value, 6))]
"""A figure of a report."""
Optional = Annotated[Share | None, BeforeValidator(lambda value: None if value == "" else value)]
"""Empty in a CSV where it is None."""


class Record(BaseModel):
    """An immutable row; unknown fields are an error, so a stale file is noticed when it is read."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Part(StrEnum):
    """The part of a split that a video belongs to."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"
    UNUSED = "unused"


class Opd(StrEnum):
    """How much an answer describes before it concludes (the ablation axis OPD)."""

    NONE = "none"
    NEEDED = "needed"
    ALL = "all"


class Encoder(StrEnum):
    """Which tactile encoder a variant uses (the ablation axis encoder)."""

    FINETUNED = "finetuned"
    BASE = "base"
    WORDS = "words"
    """The fine-tuned one; its heads' classes, as text, stand in the place of embeddings."""


class Lora(StrEnum):
    """Whether the language model was fine-tuned end to end (the ablation axis LoRA)."""

    WITH = "with"
    WITHOUT = "without"


class Touch(StrEnum):
    """What the language model is given: the question's videos, or an input ablation in their place."""

    REAL = "real"
    REMOVED = "removed"
    """No tactile embedding at all: the two delimiters stand next to each other."""
    SWAPPED = "swapped"
    """A video of another object."""
    NOISE = "noise"
    """Normal noise with each dimension's mean and deviation."""


class Shown(StrEnum):
    """What a model that the chain did not train is shown."""

    FRAMES = "frames"
    """The kept frames of the question's videos."""
    PHOTOS = "photos"
    """Photos of the question's objects."""
    TOUCH = "touch"
    """The run's tactile videos; only the shipped model is asked this way."""
    CLASSES = "classes"
    """The classes that the shipped model's property heads predict; rules answer from them, without a language model."""
    STANDARDISED = "touch, standardised"
    """As `TOUCH`, with embeddings standardised over the run's videos (without labels)."""


class Variant(NamedTuple):
    """One answering system of the ablation."""

    encoder: Encoder
    lora: Lora
    opd: Opd
    seed: int

    @property
    def key(self) -> str:
        """Its name in folders and behind the @ of its stages, such as `finetuned-with-all-0`."""
        return f"{self.encoder}-{self.lora}-{self.opd}-{self.seed}"

    @property
    def full(self) -> bool:
        """Whether it is the system as the paper proposes it."""
        return (self.encoder, self.lora, self.opd) == (Encoder.FINETUNED, Lora.WITH, Opd.ALL)


class Video(Record):
    """One tactile video that decodes."""

    video_id: str
    """`<object>_<number>`, the file's stem."""
    object_id: str
    path: str
    """Relative to the data folder, so that a table does not depend on where the folder lies."""
    sha256: str
    frames: int = Field(ge=1)
    """Frames that really decode, not what the header says."""
    fps: float = Field(ge=0)
    width: int = Field(ge=1)
    """Pixels."""
    height: int = Field(ge=1)
    """Pixels."""


class Probe(Video):
    """What one decode of a video measured on the side, for the audit. Brightness is in 8-bit steps."""

    session: str
    """The recording session as videos.csv names it; empty where it does not."""
    header_frames: int
    """Frames that the file's header promises."""
    hdr: bool
    """Whether its brightness follows PQ or HLG: such pictures look flat beside others."""
    rotation: int
    """Counterclockwise rotation in degrees that the metadata ask for; kept frames are already turned."""
    irregular: float
    """Longest over shortest time per frame between probed frames; 1 for an even rate, 0 where unknown."""
    kept: int
    """Frames that the selection kept."""
    brightness: float
    """Mean of the reference's brightness plane."""
    brightness_step: float
    """Largest change of the mean brightness between neighbouring probed frames."""
    saturated: float
    """Share of values at 0 or 255 where contact is strongest."""
    contact: float
    """Largest contact strength in a probed frame (`pipeline.videos.frames.reference.contact_strength`)."""
    quiet: float
    """Smallest contact strength in a probed frame after the reference: what noise alone gives in a quiet part."""
    contact_end: float
    """Contact strength in the last frame."""
    starts_touching: bool
    """Whether the reference had to be taken from the end."""
    unsteady: int
    """First frames that are left out, since the light still changes in them; all of them where it never is steady."""
    untouched: tuple[int, ...]
    """Numbers of the frames that the reference is the mean of."""
    thumbnail: tuple[float, ...]
    """The reference, 6 x 8 x (brightness, two colour differences), flattened."""
    signature: tuple[float, ...]
    """Mean brightness of the third of the video with most contact minus that of the rest: 18 x 24, mean 0, norm 1."""


class Severity(StrEnum):
    """What a finding of the audit means for the chain: errors stop it, warnings go to the report."""

    ERROR = "error"
    WARNING = "warning"
    INFO = "info"


class Finding(Record):
    """One result of the audit: a row of audit.csv."""

    check: str
    item: Annotated[str, AfterValidator(readable)]
    """What it is about: a file (relative to the data folder), an object, a class, or the whole folder."""
    measured: Annotated[str, AfterValidator(readable)]
    expected: str = ""
    severity: Severity


def finding(check: str, item: str, measured: str, expected: str = "", severity: Severity = Severity.INFO) -> Finding:
    """A finding, by the order of its fields."""
    return Finding(check=check, item=item, measured=measured, expected=expected, severity=severity)


class Frame(Record):
    """One kept frame; row `row` of the frame tensor (uint8, frames x size x size x RGB)."""

    video_id: str
    frame_index: int = Field(ge=0)
    """Position in the video, in decoding order."""
    score: float = Field(ge=0)
    """What the selection went by: `salient` sums absolute differences in brightness to the frame before, over all
    pixels (8-bit steps); `release` counts changed grey pixels; `contact` takes the contact strength; 0 where there
    was nothing to choose by."""
    row: int = Field(ge=0)


class Assignment(Record):
    """Which part of the split a video is in."""

    video_id: str
    object_id: str
    part: Part


class Turn(Record):
    """One exchange. `{tactile}` in `user` marks where the next video of the question goes."""

    user: str
    assistant: str
    described: int = 0
    """Characters at the beginning of `assistant` that describe; what stands behind them is concluded from them."""


class Dialogue(Record):
    """A question as asked and answered under one OPD mode."""

    opd: Opd
    turns: tuple[Turn, ...] = Field(min_length=1)


class Gold(Record):
    """The content of the right answer, independent of its wording."""

    choice: str
    """PC yes/no/same; PSS and PSR a letter; POM the option numbers of a), b), c), as in "312"; OPD empty."""
    labels: tuple[tuple[int, ...], ...]
    """One tuple of class indices a video, in the catalogue's order of properties."""
    properties: tuple[str, ...]
    """The properties that the question is about; OPD and POM name all."""


class Question(Record):
    """One question in every OPD mode that applies; all ablation variants share its id."""

    question_id: str
    task: str
    """Name of the task in `pipeline.tasks.TASKS`."""
    part: Part
    videos: tuple[str, ...]
    objects: tuple[str, ...]
    dialogues: tuple[Dialogue, ...]
    gold: Gold

    def dialogue(self, opd: Opd) -> Dialogue | None:
        """The dialogue of one OPD mode, or None where the task has none in that mode."""
        return next((d for d in self.dialogues if d.opd == opd), None)


class Prediction(Record):
    """The raw text that a variant generated, one entry a turn."""

    question_id: str
    task: str
    outputs: tuple[str, ...]
    truncated: bool
    """Whether a turn ran into the token limit before the end token."""
    tokens: int = Field(ge=0)
    """Tokens generated, over all turns."""


class Score(Record):
    """One graded measure of one answer; OPD has one a property and `combined`, other tasks `choice`."""

    question_id: str
    task: str
    measure: str
    correct: bool
    parsed: bool
    """False where the grader found no answer; such an answer counts as wrong."""
    truncated: bool
    expected: str
    predicted: str
    """Empty where nothing could be parsed."""
    objects: tuple[str, ...]
    tokens: int = Field(default=0, ge=0)
    """Tokens generated for the answer, over all turns; 0 where no language model answered."""
    strict: bool | None = None
    """Whether the published code's own comparison of texts calls it right; None where that code has none."""


class Graded(Score):
    """A score, and the variant that it belongs to."""

    encoder: Encoder
    lora: Lora
    opd: Opd
    seed: int
    """The replicate: with folds, all their answers together count as those of one seed."""
    trained: int
    """The seed of `ablation.seeds` under which the model was trained; with folds it says the fold."""
    touch: Touch

    @property
    def variant(self) -> Variant:
        """The answering system."""
        return Variant(self.encoder, self.lora, self.opd, self.trained)


class VisionModel(Record):
    """A model behind an endpoint that answered about pictures, and how it was asked: a source.json."""

    model: str
    """As it was asked for."""
    served_as: tuple[str, ...]
    """What the endpoint called it."""
    endpoint: str
    shown: Shown
    per_video: int
    """Most pictures in place of a video."""
    temperature: float
    max_tokens: int
    first: str
    """Day of the first reply, and of the last; UTC."""
    last: str
    ended: dict[str, int]
    """How many replies ended with `stop`, `length`, `content_filter`, `refusal`, `nothing` (no text), `unsaid`, or
    another word of the endpoint's."""
    questions: dict[str, str]
    """By seed, the fingerprint of the file of questions that it answered."""
    published: bool = False
    """Whether it was asked the paper's three prompts alone; else as the full system is, with classes and examples."""
    folder: str = ""
    """Where its pictures lay."""
    frames: str = ""
    """Fingerprint of the frames that it saw (`frames_key`); empty for photos."""


class GradedVision(Score):
    """A score of a model that the chain did not train."""

    model: str
    shown: Shown
    seed: int
    """As in `Graded`."""


class Classification(Record):
    """The heads' prediction for one video and one property."""

    video_id: str
    object_id: str
    part: Part
    property: str
    expected: int = Field(ge=0)
    predicted: int = Field(ge=0)
    probabilities: tuple[float, ...]


class Measurement(Record):
    """One logged value of a training: a point of a curve."""

    step: int = Field(ge=0)
    name: str
    value: float


Flip = Literal["none", "horizontal", "vertical", "both"]
"""How a clip is mirrored in training."""


class Embedding(Record):
    """Row `row` of the embedding tensor: one frame seen one way."""

    video_id: str
    frame_index: int = Field(ge=0)
    flip: Flip
    row: int = Field(ge=0)


MIDDLE, GAIN = 128, 2
"""Pictures of `encoder.reference=subtract` show the difference to the untouched sensor doubled, and 128 where there is
none: 99.9 % of the real data's differences lie within 50 of 255 steps."""
TENSOR = "embeddings"
"""The embedding tensor's name in its file: float32, rows x dim."""
TENSOR_FILE, INDEX_FILE = "embeddings.safetensors", "index.parquet"


ALL_SEEDS = "all"
"""In place of a seed: the mean over seeds."""
# Values of the column `task` in rows that are no task's own accuracy.
HEADS, VALIDATION_HEADS = "heads", "heads_validation"
"""The fine-tuned encoder's property heads on test and on validation videos."""
RECALL = "heads_recall"
"""Of each class's test videos, the share that the heads put into it."""


class ScoreRow(Record):
    """One accuracy; all shares from 0 to 1."""

    task: str
    measure: str
    encoder: str
    """For a vision-only model the model's name."""
    lora: str = ""
    opd: str = ""
    touch: str = ""
    """For a vision-only model, what it was shown in place of touch."""
    seed: str
    """A number or `all`."""
    n: int
    """Questions, or videos; not multiplied by seeds."""
    sets: int
    """Distinct sets of objects that questions are about: many questions about one pair say little about other pairs."""
    right: Share
    """Right answers; over seeds their mean, which need not be whole."""
    unread: Share
    """Answers that could not be read, which count as wrong; over seeds their mean."""
    accuracy: Share
    low: Optional = None
    """Lower end of the 95 % interval over objects; None where the questions cannot show that objects differ."""
    high: Optional = None
    chance: Optional
    """None where there is nothing to guess among."""
    strict: Optional = None
    """Accuracy by the published code's comparison of texts; None where that code has none, or nobody wrote a text."""


class EffectRow(Record):
    """The effect of changing one part of the full system, on the same questions; differences from -1 to 1."""

    part: str
    """`encoder`, `lora`, `opd` or `touch`."""
    change: str
    """Such as `with - without`."""
    task: str
    measure: str
    difference: Share
    low: Optional = None
    """Lower end of the 95 % interval for new objects and, with several seeds, new seeds; None as in `ScoreRow`."""
    high: Optional = None
    p: Optional = None
    """Two-sided p value of the sign-flip test over objects. It takes few values (with seven objects none below 2/128)
    and holds for these runs alone, so it may disagree with the interval."""
    p_holm: Optional = None
    """Holm's adjustment over all rows of the report."""
    smallest_effect: Optional = None
    """Minimum detectable effect: the smallest true difference found with a power of 80 %; above 1 there is none."""
    n: int
    objects: int
    seeds: int

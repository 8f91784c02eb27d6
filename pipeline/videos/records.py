"""What is known of a video: a row each of videos, of what the audit measured, of kept frames, of the split."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, Field

from pipeline.core.records import Part, Record
from pipeline.running.errors import readable


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

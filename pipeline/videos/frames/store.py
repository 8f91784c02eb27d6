"""The frames that were kept of all videos, as later stages read them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from pipeline.core.io import fingerprint, read_table
from pipeline.running.errors import UserError
from pipeline.videos.frames.subtraction import Pictures, subtract
from pipeline.videos.records import Frame

FRAMES_FILE = "frames.npy"
REFERENCES_FILE = "references.npy"
TABLE_FILE = "frames.parquet"
PROBES_FILE = "probes.parquet"


def frames_key(folder: Path) -> str:
    """A short hash of which frames a folder holds, and of the pictures of their untouched sensor."""
    return fingerprint(folder / TABLE_FILE, folder / REFERENCES_FILE)


class FrameStore:
    """The kept frames of all videos, as `extract_frames` wrote them, memory-mapped; only what is drawn is read.

    The reference `subtract` gives pictures of the difference to each video's no-contact reference.
    """

    def __init__(self, folder: Path, reference: Literal["none", "subtract"] = "none") -> None:
        self.index = read_table(folder / TABLE_FILE, Frame)
        self.pixels: Pictures = np.load(folder / FRAMES_FILE, mmap_mode="r")
        """uint8, frames x side x side x RGB."""
        self._rows: dict[str, list[int]] = defaultdict(list)
        for frame in self.index:
            self._rows[frame.video_id].append(frame.row)
        self.references: Pictures | None = None
        """uint8, videos x side x side x RGB, in the order of the index; None where they are not wanted."""
        if reference == "subtract":
            self.references = np.load(folder / REFERENCES_FILE, mmap_mode="r")
        self._place = {video_id: place for place, video_id in enumerate(self._rows)}
        expected = len(self._place) if self.references is None else len(self.references)
        if len(self.index) != len(self.pixels) or len(self._place) != expected:
            raise UserError(f"{folder}: {TABLE_FILE} and its pictures differ in length; run `dvc repro extract_frames`")

    def rows(self, video_id: str) -> list[int]:
        """Rows of a video's kept frames in the index, in time order."""
        return self._rows[video_id]

    def pictures(self, video_id: str, positions: Sequence[int] | None = None) -> Pictures:
        """What an encoder is shown of a video: uint8, positions x side x side x RGB; all kept frames by default."""
        rows = self._rows[video_id]
        frames: Pictures = np.asarray(self.pixels[rows if positions is None else [rows[p] for p in positions]])
        if self.references is None:
            return frames
        return subtract(frames, self.references[self._place[video_id]])

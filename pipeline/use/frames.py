"""Decoding of a video and selection of its frames for a trained model, by the chain's own code."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np

from pipeline.config import FramesConfig
from pipeline.core.records import GAIN, MIDDLE
from pipeline.running.errors import UserError
from pipeline.training.sampling import sample_evaluation
from pipeline.use.results import Touch, Video
from pipeline.videos.audit.files import FOUND, unsteady
from pipeline.videos.decoding import SUFFIXES
from pipeline.videos.files import VideoFile, is_video
from pipeline.videos.frames.scan import scan
from pipeline.videos.frames.subtraction import subtract
from pipeline.videos.records import Finding

FEWEST = 2
"""Minimum number of frames in a video: contact shows as a change between frames."""
TOUCHED = 8
"""Steps of difference to the untouched sensor, of 255, from which a pixel counts as touched."""
FPS = 25


def name_of(video: Video) -> str:
    """What notes and errors call a video."""
    return "the array" if isinstance(video, np.ndarray) else str(Path(video))


def read_touch(video: Video, frames: FramesConfig, quiet: float) -> Touch:
    """Decode a video, choose its frames and say what they show.

    Args:
        quiet: Contact strength that noise alone gives.

    Raises:
        UserError: for what is no video, is damaged as a whole or too short.
    """
    with _as_file(video) as path:
        name = name_of(video)
        found = scan(VideoFile(path, name, object_id="", video_id=path.stem), frames)
    if isinstance(found, Finding):
        raise UserError(f"{name}: {found.measured}")
    if found.frames < FEWEST or not found.kept:
        raise UserError(f"{name}: {found.frames} frames show no touch; record from before the contact to its end")
    chosen = [found.kept[place] for place in sample_evaluation(len(found.kept), frames.per_video)]
    pictures = np.stack([kept.image for kept in chosen])
    difference = subtract(pictures, found.reference)
    beyond = np.abs(difference.astype(np.int16) - MIDDLE).max(axis=3) > GAIN * TOUCHED
    notes, header = list[str](), found.look.header
    if found.contact <= quiet:
        notes.append(f"nothing touches the sensor: strength {found.contact:.2f}, where noise alone has {quiet:.2f}")
    elif found.contact <= FOUND * (noise := max(quiet, found.quiet)):
        notes.append(f"little touches the sensor: strength {found.contact:.2f}, where noise alone has {noise:.2f}")
    if found.unsteady:
        notes.append(f"the light is {unsteady(found.unsteady, found.frames)}")
    if header.hdr:
        notes.append("recorded in HDR, which looks flat beside other videos; record or export it in SDR")
    if header.frames > found.frames:
        notes.append(f"damaged: only {found.frames} of its {header.frames} frames decode")
    return Touch(
        frames=pictures,
        numbers=tuple(kept.index for kept in chosen),
        reference=found.reference,
        difference=difference,
        contact=float(beyond.mean(axis=(1, 2)).max()),
        strength=found.contact,
        notes=tuple(notes),
    )


@contextmanager
def _as_file(video: Video) -> Iterator[Path]:
    """The file of a video. An array is first written to a lossless file, so that both are decoded by the same code."""
    if not isinstance(video, np.ndarray | str | os.PathLike):
        raise UserError(f"a {type(video).__name__} is no video; give a file, or an array of uint8")
    if not isinstance(video, np.ndarray):
        path = Path(video)
        # A pipe or a device is not opened: reading it may never end.
        if not os.path.isfile(path):  # pathlib's raises where a name is too long.
            raise UserError(f"{path}: no such file; name a video")
        if not is_video(path):
            raise UserError(f"{path}: no video by its name ({', '.join(SUFFIXES)}); rename or convert it")
        yield path
        return
    if video.dtype != np.uint8 or video.ndim != 4 or video.shape[3] != 3 or not all(video.shape):
        raise UserError(
            f"an array of {video.dtype} and shape {video.shape} is no video; give uint8, frames x height x width x RGB"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "array.mkv"
        with av.open(os.fspath(path), "w") as container:
            stream = container.add_stream("ffv1", rate=FPS)
            stream.height, stream.width, stream.pix_fmt = *video.shape[1:3], "bgr0"
            for picture in video:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
            container.mux(stream.encode(None))
        yield path

"""Writing videos as the real ones were written: MPEG-4 part 2, a keyframe every twelve frames, 200 kbit/s.

Most fine detail of a frame without contact comes from coding: blocks of 8 x 8 pixels whose brightness is right to a
step or two, copied from frame to frame until the next keyframe. PyAV's own libavcodec has this encoder in every build.
"""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt

from pipeline.running.errors import UserError

KEY_EVERY = 12
"""Frames from one keyframe to the next: in each of the public videos looked at, and libavcodec's own default."""
BITS_A_SECOND = 200_000
"""libavcodec's default. Videos like the public ones need 40 to 120 thousand at the encoder's best quality, so they get
that quality."""


def write_film(path: Path, frames: Iterable[npt.NDArray[np.uint8]], fps: float) -> None:
    """Write frames of one size (height x width x BGR, uint8); UserError where the file cannot be written.

    Equal frames give equal files on one machine.
    """
    rate = Fraction(fps).limit_denominator(min(1000, int(65535 / fps)))  # MPEG-4 has no larger numerator.
    try:
        with av.open(f"file:{path}", "w", options={"fflags": "+bitexact"}) as container:
            stream = container.add_stream("mpeg4", rate=rate)
            stream.pix_fmt, stream.bit_rate = "yuv420p", BITS_A_SECOND
            stream.codec_context.gop_size = KEY_EVERY
            stream.codec_context.thread_count = 1
            for number, frame in enumerate(frames):
                if number == 0:
                    stream.height, stream.width = frame.shape[:2]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
            container.mux(stream.encode(None))
    except (OSError, av.FFmpegError) as problem:
        raise UserError(f"{path}: cannot be written ({problem}); is the folder writable, the disk full?") from None

"""Videos that clients send: as base64 only, checked in a process of their own, handed on as files.

FFmpeg believes what a header says and takes memory for it. So a second process, whose memory and time are limited,
reads and decodes each video first; what it cannot do there never reaches the process that holds the model. The model is
then given a file, as everywhere else, so that a touch over HTTP is decoded by the code that decoded the training's.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import av

from pipeline.core.errors import UserError
from pipeline.videos.decoding import CONTAINERS, SUFFIXES, video_stream

DATA_URI = re.compile(r"data:[\w.+/-]*(?:;[\w.+/=-]+)*;base64,", re.ASCII)
SUFFIX = {b"RIFF": ".avi", b"\x1aE\xdf\xa3": ".mkv"}
PREFIX = "octopi-"
PLACE = re.compile(rf"\S*{PREFIX}\w+/video(\d+)\.\w+")
"""A file of `Gate`, in a message."""
SPARE_BYTES = 1 << 30
"""Memory that checking a video may take beyond what the interpreter and its libraries have."""


@dataclass(frozen=True)
class Limits:
    """What one request may bring."""

    body_bytes: int = 32 * 2**20
    """Size of the whole request as sent, base64 included; the published videos have at most 0.12 MB each."""
    videos: int = 8
    """Videos in a request, those of earlier turns included."""
    seconds: float = 120.0
    """Length of a video, by its own time stamps."""
    frames: int = 3000
    """Frames of a video."""
    pixels: int = 10_000_000
    """Pixels of a frame: width x height."""
    check_seconds: int = 20
    """Time to read and decode one video."""


class Refused(UserError):
    """A request that is not worked on."""

    def __init__(self, message: str, status: int = 422) -> None:
        super().__init__(message)
        self.status = status
        """As HTTP numbers it: 413 for what is too much, 422 for what cannot be used."""


def from_base64(text: str, place: str = "video") -> bytes:
    """Bytes of a base64 text or a `data:...;base64,` URI.

    Args:
        text: Nothing else is taken, so that no path or address of the server can be read.
        place: What an error calls it.

    Raises:
        Refused: where it is a path, an address, or broken.
    """
    # A path has at most 4096 characters; the pattern is not searched through megabytes.
    head = DATA_URI.match(text, 0, 4096)
    if head is None and ":" in text[:4096]:
        raise Refused(f"{place}: no data URI; send the video itself as data:video/mp4;base64,...")
    try:
        data = base64.b64decode(text[head.end() :] if head else text, validate=True)
    except (binascii.Error, ValueError):
        raise Refused(
            f"{place}: broken base64; encode the file's bytes with the standard alphabet, in one line"
        ) from None
    if not data:
        raise Refused(f"{place}: empty; send the video's bytes")
    return data


class Gate:
    """Where videos come in. One checking process serves all; it is started when needed and again when it died."""

    def __init__(self, limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self._lock = threading.RLock()
        self._checker: subprocess.Popen[str] | None = None

    @contextmanager
    def files(self, videos: Sequence[bytes]) -> Iterator[list[Path]]:
        """Checked videos as files, which are gone after the block.

        Raises:
            Refused: for the first that is too long, too large, no video, or made to harm.
        """
        if len(videos) > self.limits.videos:
            message = f"{len(videos)} videos; a request may bring at most {self.limits.videos}, earlier turns included"
            raise Refused(message, 413)
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=PREFIX))) if videos else Path()
            paths = []
            for number, data in enumerate(videos, 1):
                paths.append(folder / f"video{number}{SUFFIX.get(data[:4], '.mov')}")
                paths[-1].write_bytes(data)
                self._check(paths[-1], f"video {number}")
            yield paths

    def close(self) -> None:
        """End the checking process."""
        with self._lock:
            if self._checker is not None:
                self._checker.kill()
                self._checker.communicate()
                self._checker = None

    def _check(self, path: Path, place: str) -> None:
        with self._lock:
            if self._checker is None or self._checker.poll() is not None:
                self.close()
                self._checker = subprocess.Popen(
                    [sys.executable, "-m", "pipeline.use.media", json.dumps(asdict(self.limits))],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    text=True,
                    # Ctrl-C is the server's to handle: answers in flight finish.
                    start_new_session=True,
                    env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                )
            answer = ""
            with suppress(OSError):
                print(path, file=self._checker.stdin, flush=True)
                answer = self._checker.stdout.readline() if self._checker.stdout else ""
            if not answer:
                self.close()
                message = f"{place}: takes too long or too much memory to decode; send a shorter or smaller one"
                raise Refused(message, 413)
        found = json.loads(answer)
        if found["status"]:
            raise Refused(f"{place}: {found['message']}", found["status"])


def check(path: Path, limits: Limits) -> None:
    """Read a video's header, then decode it whole; it is Refused at the first limit, or where it is no video."""
    too_long = Refused(f"longer than {limits.frames} frames or {limits.seconds:g} s; cut it to the touch", 413)
    try:
        # FFmpeg decodes the first frames to know their form; it may not take memory for more than these pixels.
        with av.open(str(path), options={**CONTAINERS, "max_pixels": str(limits.pixels)}) as container:
            stream = video_stream(container)
            promised = max(stream.frames, len(stream.index_entries))
            seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
            if promised > limits.frames or seconds > limits.seconds:
                raise too_long
            if not all(0 < each.width * each.height <= limits.pixels for each in container.streams.video):
                message = f"frames are damaged or have more than {limits.pixels} pixels; make them smaller"
                raise Refused(message, 413)
        # Now as the library opens it, so that what passes here does no harm there.
        with av.open(str(path), options=CONTAINERS) as container:
            stream = video_stream(container)
            stream.thread_type, stream.codec_context.thread_count = "NONE", 1
            decoded = 0
            for count, packet in enumerate(container.demux(stream)):
                # A last packet, which is empty, fetches what the decoder holds back.
                if max(count, decoded) > limits.frames:
                    raise too_long
                try:
                    for frame in packet.decode():
                        decoded += 1
                        if frame.width * frame.height > limits.pixels:
                            raise Refused(f"frames have more than {limits.pixels} pixels; make them smaller", 413)
                        if (frame.time or 0) > limits.seconds:
                            raise too_long
                except MemoryError:
                    raise
                except (av.FFmpegError, ValueError):
                    continue  # What is damaged is left out, as players do.
            if not decoded:
                raise Refused("no frame of it decodes; record it again")
    except MemoryError:
        raise Refused("takes too much memory to decode; send a shorter or smaller one", 413) from None
    except (av.FFmpegError, ValueError):
        raise Refused(f"no video that can be read; send one of {', '.join(SUFFIXES)}") from None


def main() -> None:
    """Check the files that standard input names, one a line; answer each with a line of JSON. End with the parent."""
    limits = Limits(**json.loads(sys.argv[1]))
    with suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + SPARE_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    for line in sys.stdin:
        # Nothing handles the alarm, so it ends this process, in the middle of a decoder if need be.
        signal.alarm(limits.check_seconds)
        answer = {"status": 0, "message": ""}
        try:
            check(Path(line.rstrip("\n")), limits)
        except Refused as error:
            answer = {"status": error.status, "message": str(error)}
        signal.alarm(0)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()

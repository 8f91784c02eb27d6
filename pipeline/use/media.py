"""Videos that clients send: checked in a process of their own, handed on as files.

FFmpeg believes what a header says and takes memory for it, and a broken file may end it. So a second process, whose
memory and time are limited, decodes each video first; what it cannot do there never reaches the process that holds the
model. The model is then given a file, as everywhere else, so that a touch over HTTP is decoded by the code that decoded
the training's.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import resource
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import av

from pipeline.running.errors import UserError
from pipeline.running.parallel import end_with_parent
from pipeline.videos.decoding import CONTAINERS, SUFFIXES, video_stream

SUFFIX = {b"RIFF": ".avi", b"\x1aE\xdf\xa3": ".mkv"}
PREFIX = "octopi-"
PLACE = re.compile(rf"\S*{PREFIX}\w+/video(\d+)\.\w+")
"""A file of `Gate`, in a message."""


class Gate:
    """Where videos come in. One checking process serves all; it is started when needed and again when it died.

    Args:
        seconds: Time that decoding one video may take.
        spare_bytes: Memory that it may take beyond what the interpreter and its libraries have.
    """

    def __init__(self, seconds: int = 20, spare_bytes: int = 1 << 30) -> None:
        self.seconds = seconds
        # A fork would have the model's memory, and its threads' locks.
        fresh = multiprocessing.get_context("spawn")
        self._new = partial(ProcessPoolExecutor, 1, fresh, _restrict, (os.getpid(), spare_bytes))
        self._pool, self._lock = self._new(), threading.Lock()

    @contextmanager
    def files(self, videos: Sequence[bytes]) -> Iterator[list[Path]]:
        """Checked videos as files, which are gone after the block.

        Raises:
            UserError: for the first that is no video, or takes too much to decode.
        """
        with tempfile.TemporaryDirectory(prefix=PREFIX) as folder:
            paths = [Path(folder, f"video{n}{SUFFIX.get(data[:4], '.mov')}") for n, data in enumerate(videos, 1)]
            for path, data in zip(paths, videos, strict=True):
                path.write_bytes(data)
                with self._lock:  # One at a time, since a pool breaks for all that it was given.
                    try:
                        frames = self._pool.submit(count_frames, path, self.seconds).result()
                    except BrokenProcessPool:
                        self._pool.shutdown()
                        self._pool = self._new()
                        line = f"{path}: takes too long or too much memory to decode; send a shorter or smaller one"
                        raise UserError(line) from None
                if not frames:
                    raise UserError(f"{path}: no frame of it decodes; send one of {', '.join(SUFFIXES)}")
            yield paths

    def close(self) -> None:
        """End the checking process."""
        self._pool.shutdown()


def count_frames(path: Path, seconds: int) -> int:
    """Decode a video whole; end this process where that takes too long, or more memory than there is."""
    # Nothing handles the alarm, so it ends this process, in the middle of a decoder if need be.
    signal.alarm(seconds)
    frames = 0
    try:
        with av.open(str(path), options=CONTAINERS) as container:
            stream = video_stream(container)
            stream.thread_type, stream.codec_context.thread_count = "NONE", 1
            for packet in container.demux(stream):
                try:
                    frames += len(packet.decode())
                except MemoryError:
                    raise
                except (av.FFmpegError, ValueError):
                    continue  # What is damaged is left out, as players do.
    except MemoryError:
        os._exit(1)
    except (av.FFmpegError, ValueError):
        pass
    signal.alarm(0)
    return frames


def _restrict(parent: int, spare_bytes: int) -> None:
    """Limit the checking process to so much more memory than it has, and end it with its parent alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's to handle: answers in flight finish.
    end_with_parent(parent)
    with suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + spare_bytes
        resource.setrlimit(resource.RLIMIT_AS, (most, most))

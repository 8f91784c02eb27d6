"""Extracting frames: against bare decoding, and against what the published code does.

The published code (github.com/clear-nus/octopi, utils/process_dataset.py) decodes each video twice, in one process,
and writes every chosen frame as a JPEG of its own. Bare decoding makes a BGR picture of every frame and does nothing
with it, in as many processes as the extraction uses. All cases take turns within a repeat, so that a busy machine slows
all alike.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import resource
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import get_args

import cv2

from pipeline.benchmarks import BenchRow, bench_videos
from pipeline.videos.decoding import Image, decode
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.selection import changed_pixels
from pipeline.parallel import run_parallel
from pipeline.videos.catalogue import Catalogue
from pipeline.config import FramesConfig, Selection
from pipeline.videos.files import list_videos

REPEATS = 3
SIZE = 64
LARGE = 224
FRACTION = 0.3
BARE = "bare decoding"
PUBLISHED = "published way"


def measure(root: Path) -> list[BenchRow]:
    """Time every selection over the videos of `bench_videos`, and measure memory over a quarter of them and all.

    Raises:
        UserError: where there are no videos.
    """
    folder, catalogue = bench_videos(root)
    count = len(list_videos(folder, catalogue).files)
    cases: dict[str, Callable[[], object]] = {BARE: lambda: _bare(folder, catalogue)}
    cases |= {"bare decoding by OpenCV": lambda: _bare(folder, catalogue, _decode_by_opencv)}
    cases |= {PUBLISHED: lambda: _published(folder, catalogue)}
    for name in get_args(Selection):
        cases[f"{name}, {SIZE} pixels"] = lambda name=name: _extract(folder, catalogue, name, SIZE)  # type: ignore[misc]
    cases[f"salient, {LARGE} pixels"] = lambda: _extract(folder, catalogue, "salient", LARGE)
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(REPEATS):
        for name, run in cases.items():
            started = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - started)
    rows = []
    for baseline in (BARE, PUBLISHED):
        for name, costs in seconds.items():
            # Ratios within a repeat, so that a slow minute does not count for one side only.
            ratios = [cost / other for cost, other in zip(costs, seconds[baseline], strict=True)]
            rows.append(
                BenchRow(
                    case=f"{name}, {count} videos",
                    cost=round(median(costs), 3),
                    unit="s",
                    baseline=baseline,
                    ratio=round(median(ratios), 3),
                    low=round(min(costs), 3),
                    high=round(max(costs), 3),
                )
            )
    return rows + _memory(folder, catalogue, count)


def _memory(folder: Path, catalogue: Catalogue, count: int) -> list[BenchRow]:
    """Peak memory of a fresh process that extracts, and of its largest child, over few and over all videos."""
    few = max(1, count // 4)
    peaks = {n: _in_fresh_process(folder, catalogue, n) for n in (few, count)}
    baseline = f"peak memory, {few} videos"
    return [
        BenchRow(
            case=f"peak memory, {n} videos",
            cost=round(peak, 1),
            unit="MiB",
            baseline=baseline,
            ratio=round(peak / peaks[few], 3),
            low=round(peak, 1),
            high=round(peak, 1),
        )
        for n, peak in peaks.items()
    ]


def _in_fresh_process(folder: Path, catalogue: Catalogue, count: int) -> float:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_peak, args=(sender, folder, catalogue, count))
    process.start()
    peak: float = receiver.recv()
    process.join()
    return peak


def _peak(sender: multiprocessing.connection.Connection, folder: Path, catalogue: Catalogue, count: int) -> None:
    with TemporaryDirectory() as linked:
        for file in list_videos(folder, catalogue).files[:count]:
            (Path(linked) / f"{file.video_id}{file.path.suffix}").symlink_to(file.path.resolve())
        _extract(Path(linked), catalogue, "salient", SIZE)
    unit = 1 if sys.platform == "darwin" else 1024
    own, child = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    sender.send((own + child) * unit / 2**20)


def _extract(folder: Path, catalogue: Catalogue, selection: Selection, size: int) -> None:
    with TemporaryDirectory() as out:
        config = FramesConfig(selection=selection, size=size, fraction=FRACTION)
        extract_frames(folder, catalogue, config, Path(out) / "frames", Path(out) / "partial")


def _bare(folder: Path, catalogue: Catalogue, way: Callable[[Path], int] | None = None) -> None:
    list(run_parallel(way or _decode_all, [f.path for f in list_videos(folder, catalogue).files], "bare", "video"))


def _decode_all(path: Path) -> int:
    return sum(1 for _ in decode(path))


def _decode_by_opencv(path: Path) -> int:
    return sum(1 for _ in _opencv(path))


def _opencv(path: Path) -> Iterator[Image]:
    """The frames by OpenCV's own decoder, as the published code reads them."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    while True:
        found, frame = capture.read()
        if not found:
            return
        yield frame


def _published(folder: Path, catalogue: Catalogue) -> None:
    with TemporaryDirectory() as out:
        for file in list_videos(folder, catalogue).files:
            _publish_one(file.path, Path(out) / file.video_id)


def _publish_one(path: Path, out: Path) -> None:
    """Score in a first decode, write JPEGs in a second."""
    scores, before, count = [], None, 0
    for index, frame in enumerate(_opencv(path)):
        grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        if before is not None:
            scores.append((-changed_pixels(grey, before), index))
        before, count = grey, index + 1
    chosen = {index for _, index in sorted(scores)[: int(FRACTION * count)]}
    out.mkdir(parents=True)
    for index, frame in enumerate(_opencv(path), 1):
        if index in chosen:
            cv2.imwrite(str(out / f"{index:010d}.jpg"), frame)

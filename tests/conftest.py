"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
import random
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Before any library reads it: make test runs a process a core, and small sums lose by a second thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import av
import cv2
import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, settings

from pipeline.core.records import Part
from pipeline.encoder.records import Classification
from pipeline.running.errors import UserError
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Video

if TYPE_CHECKING:
    import torch

ROOT = Path(__file__).parents[1]
PHYSICLEAR = ROOT / "pipeline" / "physiclear"
CATALOGUE = load_catalogue(PHYSICLEAR)
DATA_VARIABLE = "OCTOPI_DATA_DIR"

HUNG = 600.0
"""Seconds after which a test may take something for hung, however busy the machine is; nothing is measured by them."""

# A loaded machine is no reason to fail, and a test that passes today passes tomorrow.
SAME = {"deadline": None, "derandomize": True, "database": None}
settings.register_profile("house", **SAME, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("house")


def wait_for(condition: Callable[[], object]) -> None:
    """Until it is true; fails where it never is."""
    end = time.monotonic() + HUNG
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def wait_until_ended(processes: Iterable[psutil.Process]) -> None:
    """A zombie has ended, even where nobody fetches it; a process of the same number is another."""
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            wait_for(lambda process=process: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE)


def not_utf8(folder: Path, name: str) -> Path:
    """A place with a byte that begins no character; skips where the file system takes none."""
    path = folder / name.replace("?", "\udcff")
    try:
        path.touch()
    except OSError:
        pytest.skip("needs a file system that takes any bytes for a name")
    path.unlink()
    return path


def refused(words: str) -> Any:
    """A context in which bad input is refused: by one line, in which these words (a regular expression) are found."""
    return pytest.raises(UserError, match=words, check=lambda error: "\n" not in str(error))


def octopi(*words: object, status: int = 0) -> str:
    """What `octopi WORDS...` prints; what it refuses is raised."""
    from typer.testing import CliRunner

    from pipeline.cli import app

    done = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    assert done.exit_code == status, done.output
    return done.output


def pytest_collection_modifyitems(items: list[pytest.Function]) -> None:
    """Mark what `make test-fast` leaves out: the chain, benchmarks, files that start processes, the large model."""
    for item in items:
        starts = {"subprocess", "multiprocessing", "copy_project"} & vars(item.module).keys()
        if starts or item.path.parent.name in ("chain", "benchmarks") or "smollm2_folder" in item.fixturenames:
            item.add_marker("slow")


def pytest_runtest_setup(item: pytest.Item) -> None:
    # What a test draws without a seed of its own must not hang on the tests before it in this process.
    random.seed(0)
    np.random.seed(0)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(67_280_421_310_721)  # As where it is imported later.
    if item.get_closest_marker("real") and not os.environ.get(DATA_VARIABLE):
        pytest.skip(f"needs real videos: set {DATA_VARIABLE} to a folder of the PhysiCLeAR videos")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of the real videos, for tests marked `real`."""
    return Path(os.environ[DATA_VARIABLE])


@pytest.fixture(scope="session")
def catalogue() -> Catalogue:
    return CATALOGUE


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.encoders import write_tower

    return write_tower(tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="session")
def smollm2_folder() -> Path:
    """SmolLM2-135M-Instruct in transformers' format; leave it as it is."""
    from tests.checkpoints import model_folder

    return model_folder("smollm2")


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints go to a folder of the working directory."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, where the scale smoke is chosen and nothing else lies."""
    from pipeline.scales import compose, write_params

    # Kernels are chosen before NumPy is imported, which it is here.
    write_params(compose("smoke", ["kernels=machine"], conf=ROOT / "conf"), tmp_path / "params.yaml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def versions(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Changes a byte of a file of the code, as unfinished work knows it; the code that runs stays as it is."""
    copy = tmp_path_factory.mktemp("version")
    for part in ("pipeline", "stages"):
        shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__", ".*.part"))
    shutil.copy(ROOT / "dvc.yaml", copy)
    monkeypatch.setattr("pipeline.core.io.ROOT", copy)

    def change(path: str) -> None:
        content = (copy / path).read_bytes()
        (copy / path).write_bytes(content[:-1] + b"#")

    return change


Begun = Callable[[Callable[[], object]], str]


@pytest.fixture
def begun_in(monkeypatch: pytest.MonkeyPatch) -> Begun:
    """Where a training looks for checkpoints when it begins; it goes no further."""
    from transformers import Trainer

    def begin(run: Callable[[], object]) -> str:
        asked: list[str] = []

        def stop(trainer: Trainer, **_: object) -> None:
            asked.append(str(trainer.args.output_dir))
            raise KeyboardInterrupt

        monkeypatch.setattr(Trainer, "train", stop)
        with pytest.raises(KeyboardInterrupt):
            run()
        return asked[0]

    return begin


@pytest.fixture
def frames() -> torch.Tensor:
    """Four clips of three frames for the tiny CLIP."""
    import torch

    return torch.from_numpy(np.random.default_rng(0).integers(0, 256, (4, 3, 32, 32, 3), dtype=np.uint8))


def write_video(path: Path, frames: Iterable[np.ndarray]) -> Path:
    """Write BGR uint8 frames as Motion JPEG (lossy: compare with what decodes, not with what went in)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = None
    for frame in frames:
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, size)
            assert writer.isOpened(), path
        writer.write(frame)
    if writer is not None:
        writer.release()
    return path


def encode(
    path: Path,
    frames: Iterable[np.ndarray],
    codec: str = "ffv1",
    pixels: str = "yuv444p",
    given: str = "bgr24",
    milliseconds: Sequence[int] = (),
    bits: int = 0,
    transfer: int = 0,
    aspect: Fraction = Fraction(1),
) -> Path:
    """Write frames (in PyAV's format `given`) by any codec, at any time stamps; FFV1 gives back what went in.

    `transfer` is ITU-T H.273's number of how light follows from values; 0 leaves it unsaid.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.pix_fmt, stream.codec_context.sample_aspect_ratio = pixels, aspect
        if bits:
            stream.bit_rate = bits
        if transfer:
            stream.codec_context.color_trc = transfer
        for index, frame in enumerate(frames):
            video_frame = av.VideoFrame.from_ndarray(frame, format=given)
            if index == 0:
                stream.width, stream.height = video_frame.width, video_frame.height
                if milliseconds:
                    stream.codec_context.time_base = Fraction(1, 1000)
            if milliseconds:
                video_frame.pts, video_frame.time_base = milliseconds[index], Fraction(1, 1000)
            container.mux(stream.encode(video_frame))
        container.mux(stream.encode(None))
    return path


def moving_square(count: int, seed: int = 0, width: int = 48, height: int = 36) -> list[np.ndarray]:
    """Frames in which a bright square jumps about on a grey ground."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(count):
        frame = np.full((height, width, 3), 90, np.uint8)
        x, y = rng.integers(0, width - 8), rng.integers(0, height - 8)
        frame[y : y + 8, x : x + 8] = rng.integers(0, 256, 3)
        frames.append(frame)
    return frames


@pytest.fixture(scope="session")
def tiny_videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with seven small videos of three objects, one of them in a subfolder with a space in its name."""
    folder = tmp_path_factory.mktemp("tiny videos")
    for seed, (name, count) in enumerate(
        [("baseball_0", 12), ("baseball_1", 1), ("baseball_10", 3), ("potato_0", 20), ("potato_2", 9), ("rug_0", 31)]
    ):
        write_video(folder / f"{name}.avi", moving_square(count, seed))
    write_video(folder / "sub folder é" / "rug_1.AVI", moving_square(7, 99))
    return folder


@pytest.fixture
def few_permutations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.videos.audit.leakage.PERMUTATIONS", 50)


def classified(
    video_id: str, name: str, expected: int, predicted: int, shares: Sequence[float] = (1.0,), part: Part = Part.TEST
) -> Classification:
    """What a head said of a video, which is called after its object."""
    whose = {"video_id": video_id, "object_id": video_id.rpartition("_")[0], "part": part, "property": name}
    return Classification(**whose, expected=expected, predicted=predicted, probabilities=tuple(shares))


def fake_videos(objects: Iterable[str], per_object: int = 3) -> list[Video]:
    """Records of videos that do not exist, each with its own content."""
    shape = {"frames": 10, "fps": 25, "width": 32, "height": 24}
    names = [(o, f"{o}_{i}") for o in objects for i in range(per_object)]
    return [Video(video_id=v, object_id=o, path=f"{v}.avi", sha256=f"sha of {v}", **shape) for o, v in names]

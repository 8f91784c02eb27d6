"""Files as the real videos are coded."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from pipeline.videos.decoding import Decoder, decode
from pipeline.videos.film import KEY_EVERY, write_film
from tests.conftest import refused


def frames(count: int) -> list[np.ndarray]:
    y, x = np.mgrid[:48, :64]
    return [np.stack([x + 50, y + 60, x + y + 2 * n], axis=-1).astype(np.uint8) for n in range(count)]


@pytest.mark.parametrize(("count", "fps"), [(2, 25.0), (30, 10.0), (13, 12.5)])
def test_what_is_written_is_read(tmp_path: Path, count: int, fps: float) -> None:
    path = tmp_path / "a b.avi"
    write_film(path, frames(count), fps)
    with Decoder(path) as decoder:
        kinds = [frame.key_frame for frame in decoder.frames()]
        assert (decoder.header.frames, decoder.header.fps) == (count, fps)
    assert kinds == [n % KEY_EVERY == 0 for n in range(count)]
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
    error = np.stack(list(decode(path))).astype(int) - np.stack(frames(count))
    assert np.abs(error).mean() < 3, "colour is coded at half the resolution"


def test_an_unwritable_place_is_one_line(tmp_path: Path) -> None:
    with refused("cannot be written"):
        write_film(tmp_path / "none" / "a.avi", frames(2), 25.0)

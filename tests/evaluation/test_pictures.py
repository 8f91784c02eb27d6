"""Pictures in place of tactile videos: the kept frames bit by bit, or photos of the object that was touched."""

import base64
import io
import re
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from pipeline.evaluation.pictures import frames, photos
from pipeline.videos.frames.store import FrameStore
from tests.conftest import refused
from tests.encoders import write_frames

DRAWN = {7: [0, 1, 2, 4, 5], 3: [0, 1, 2], 1: [0]}
"""Of so many, five at uniform intervals from the first, each once."""


def decoded(urls: Sequence[str]) -> list[Image.Image]:
    parts = [re.fullmatch(r"data:image/(png|jpeg);base64,(.*)", url) for url in urls]
    return [Image.open(io.BytesIO(base64.b64decode(part[2])), formats=[part[1]]) for part in parts]


def test_frames_are_shown_as_they_were_kept(tmp_path: Path) -> None:
    show = frames(write_frames(tmp_path, {f"rug_{count}": count for count in DRAWN}), [], 5)
    for count, places in DRAWN.items():
        found = [np.asarray(picture) for picture in decoded(show(f"rug_{count}"))]
        np.testing.assert_array_equal(found, FrameStore(tmp_path).pictures(f"rug_{count}", places))
    with refused("no frame of rug_9"):
        show("rug_9")


def test_photos_are_a_file_or_a_folder_named_as_the_object(tmp_path: Path) -> None:
    (tmp_path / "mug").mkdir()
    for i in range(7):
        Image.new("RGB", (8, 8 + i)).save(tmp_path / "mug" / f"{i}.png")
    (tmp_path / "mug" / ".hidden.png").write_bytes(b"")
    (tmp_path / "mug" / "notes.txt").write_text("no picture")
    exif, colour = Image.Exif(), (200, 40, 90)
    exif[0x0112], exif[0x010F] = 6, "A camera's maker"
    Image.new("RGB", (2000, 1000), colour).save(rug := tmp_path / "rug.JPG", format="JPEG", exif=exif)
    question: Any = SimpleNamespace(videos=("mug_0", "rug_0"), objects=("mug", "rug"))
    show = photos(tmp_path, [question], 5)
    assert [picture.size for picture in decoded(show("mug_0"))] == [(8, 8 + i) for i in DRAWN[7]]
    (large,) = decoded(show("rug_0"))
    assert large.size == (512, 1024), "upright, no larger than need be"
    np.testing.assert_allclose(np.asarray(large).mean((0, 1)), colour, atol=3)
    assert not large.getexif()
    rug.write_bytes(b"no picture")
    with refused("rug.JPG: not a picture"):
        show("rug_0")
    rug.unlink()
    with refused("no photo of rug;"):
        photos(tmp_path, [question], 5)

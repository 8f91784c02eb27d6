"""`octopi live`: a running camera is watched, and each press is described, or asked about, when it ends."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import cv2
import numpy as np

from pipeline.running.errors import UserError
from pipeline.use.model import with_marks
from pipeline.videos.audit.files import FOUND
from pipeline.videos.decoding import Image
from pipeline.videos.frames.reference import LONGEST, contact_strength, mean, starts_touching
from pipeline.videos.importing.presses import SHORTEST, Contact, Shot, begins_at, film

if TYPE_CHECKING:
    from pipeline.use.model import Octopi

QUIET = 100
"""Untouched pictures, the last ones, whose median strength is the quiet level."""
MOST = 750
"""Pictures of a press, at most: half a minute at 25 a second. What lasts longer is taken for a change of the light."""
GONE = 100
"""Reads in a row that bring no picture, `PAUSE` seconds apart, after which a camera is given up."""
PAUSE = 0.02


class Seen(NamedTuple):
    """One picture as the detector takes it."""

    shot: Shot
    thumb: Image
    strength: float
    """Contact strength, in 8-bit steps."""
    threshold: float
    """The strength that a press begins at."""
    state: Literal["untouched", "pressed", "press", "short", "light"]
    """`pressed` within a press. What ends with this picture is a `press`, too `short` for one, or a change of the
    `light`; only a press is yielded."""


def watch(camera: str, opened: Callable[[float], object] = lambda _: None) -> Iterator[Shot]:
    """The pictures of a file, or of a camera by its index or address, as they come.

    A camera's are `recorded` in ns since 1970, and `stamped` by a clock that nobody sets.

    Args:
        opened: Is given the rate that a camera says it has, in pictures a second; 0 where it says none.

    Raises:
        UserError: for a camera that OpenCV cannot open, or a file that is no video.
    """
    if Path(camera).is_dir():
        raise UserError(f"{camera}: is a folder; name a camera or a video, or use `octopi import video`")
    if Path(camera).is_file() and not camera.isdecimal():  # A device may be named by its path, too.
        yield from film(Path(camera))
        return
    capture = cv2.VideoCapture(int(camera) if camera.isdecimal() else camera)
    if not capture.isOpened():
        raise UserError(f"{camera}: no camera that opens; name an index (0 is the first), a file or an address")
    opened(capture.get(cv2.CAP_PROP_FPS))
    came, missed = False, 0
    try:
        while missed < GONE:  # A camera may drop a frame and deliver the next one.
            good, picture = capture.read()
            recorded, stamped = time.time_ns(), time.monotonic_ns()
            came, missed = came or good, 0 if good else missed + 1
            if good:
                yield Shot(np.asarray(picture, dtype=np.uint8), recorded, stamped)
            else:
                time.sleep(PAUSE)
    finally:
        capture.release()
    if not came:  # As with AV1, which OpenCV opens and does not decode.
        raise UserError(f"{camera}: opens, but OpenCV reads no picture of it; send H.264 or MJPEG, or name a file")
    raise UserError(f"{camera}: brings no picture any more; is it connected?")


def presses(
    shots: Iterable[Shot], times: float = FOUND, see: Callable[[Seen], object] = lambda _: None
) -> Iterator[list[Shot]]:
    """Each press as soon as it ends, with up to `LONGEST` untouched pictures in front, which the model compares it to.

    A press begins where the contact strength is more than `times` the quiet level (the median of untouched pictures),
    and ends as in a recording (`Contact`). A recording's quiet level and reference are of all its pictures; here the
    reference is the mean of pictures a little older than the latest ones: it follows slow changes of the light, and
    does not yet contain a press that begins. A press that deepens over seconds is also taken for a change of the light,
    and its release then looks like a press. `starts_touching` recognises such a release by its loss of detail, and it
    is dropped. `see` is given each picture whose strength is known.

    Raises:
        UserError: as `shots` raises it, after the press that had begun.
    """
    before = deque[tuple[Shot, np.ndarray]](maxlen=2 * LONGEST)
    quiet = deque[float](maxlen=QUIET)
    press, contact = list[Shot](), Contact()
    first, recent = np.zeros((1, 1, 3), np.uint8), deque[np.ndarray](maxlen=LONGEST)
    gone: UserError | None = None
    try:
        for shot in shots:
            thumb = shot.thumb()
            if len(before) < LONGEST:
                before.append((shot, thumb))
                continue
            strength = contact_strength(thumb, mean([old for _, old in list(before)[:LONGEST]]))
            threshold = begins_at(float(np.median(quiet or [0])), times)
            if not press and (strength <= threshold or len(quiet) < LONGEST):
                before.append((shot, thumb))
                quiet.append(strength)
                see(Seen(shot, thumb, strength, threshold, "untouched"))
                continue
            if not press:
                press = [old for old, _ in list(before)[-LONGEST:]]
                first = mean([old for _, old in list(before)[:LONGEST]])
            press.append(shot)
            recent.append(thumb)
            over = contact.over(strength, threshold)
            released = contact.touched == LONGEST and starts_touching(first, mean(recent))
            if not (over or len(press) == MOST or released):
                see(Seen(shot, thumb, strength, threshold, "pressed"))
                continue
            if released or len(press) == MOST:
                see(Seen(shot, thumb, strength, threshold, "light"))
                before.clear()
                quiet.clear()
            elif contact.touched >= SHORTEST:
                see(Seen(shot, thumb, strength, threshold, "press"))
                yield press
            else:
                see(Seen(shot, thumb, strength, threshold, "short"))
            press, contact = [], Contact()
    except UserError as error:  # A press that the camera's failure cut off is still yielded.
        gone = error
    if contact.touched >= SHORTEST:
        yield press
    if gone:
        raise gone


def run(model: Octopi, camera: str, question: str, say: Callable[[str], object], times: float = FOUND) -> int:
    """Describe each press, or answer the question about it, with the true frame rate, until the file ends or Ctrl-C.

    Args:
        question: Asked of each press; empty for a description.
        say: Shows a line.

    Returns:
        How many presses there were.
    """
    if question:
        with_marks(question, 1)
    number = 0
    for number, press in enumerate(presses(watch(camera), times), 1):
        video = np.stack([cv2.cvtColor(shot.picture, cv2.COLOR_BGR2RGB) for shot in press])
        seconds = (press[-1].stamped - press[0].stamped) / 1e9
        rate = f"{(len(press) - 1) / seconds:.1f} a second" if seconds > 0 else "at once"
        try:
            if question:
                said, heads = model.ask(question, [video]), model.verdict(question, [video])
                notes = (*model.apart(said, heads), *model.notes([video], question))
                said += f" (property heads: {heads.shown})" if heads else ""
            else:
                found, told = model.describe(video), list[str]()
                for name, level in found.levels.items():
                    share = found.probabilities.get(name, {}).get(level)
                    told.append(f"{name} {level}" + ("" if share is None else f" ({model.config.share(share)})"))
                said, notes = "; ".join(filter(None, (*told, found.sentence))), found.notes
        except UserError as error:
            said, notes = str(error), ()
        say(f"press {number}, {len(press)} frames, {rate}: {said}")
        for note in notes:
            say(f"  note: {note}")
    return number

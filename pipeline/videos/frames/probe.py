"""What is measured of a video for the audit, from its scan and its file's bytes; nothing is decoded again."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from pipeline.core.io import sha256
from pipeline.videos.decoding import Image
from pipeline.videos.files import VideoFile
from pipeline.videos.frames.reference import contact_strength
from pipeline.videos.frames.scan import Scan
from pipeline.videos.records import Probe

SIGNATURE_FRAMES = 64
"""Number of frames that a video's signature is computed from; signatures are compared to find copies."""
THUMBNAIL_SIZE = (8, 6)
SIGNATURE_SIZE = (24, 18)


def probe(file: VideoFile, found: Scan) -> Probe:
    """The measurements of a scanned video."""
    thumbs, plan, header = found.look.thumbs, found.plan, found.look.header
    shown = thumbs[max(found.strengths, key=found.strengths.__getitem__, default=-1)]
    ((height, width),) = found.look.sizes
    # Seconds per frame between probed frames; `irregular` is 0 (unknown) where time stamps do not rise.
    times = [(i, time) for i in found.probed if (time := found.look.times[i]) is not None]
    steps = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(times)]
    rising = bool(steps) and min(steps) > 0
    brightness = [cv2.mean(thumbs[i])[0] for i in found.probed]
    often = max(1, plan.count // SIGNATURE_FRAMES)
    return Probe(
        video_id=file.video_id,
        object_id=file.object_id,
        path=file.relative,
        sha256=sha256(file.path),
        frames=found.frames,
        fps=header.fps,
        width=width,
        height=height,
        session=file.session,
        header_frames=header.frames,
        hdr=header.hdr,
        rotation=found.look.rotation,
        irregular=max(steps) / min(steps) if rising else 0.0,
        kept=len(found.kept),
        brightness=float(found.ground[:, :, 0].mean()),
        brightness_step=max((abs(b - a) for a, b in itertools.pairwise(brightness)), default=0.0),
        saturated=float(np.mean((shown[:, :, 0] == 0) | (shown[:, :, 0] == 255))),
        contact=found.contact,
        quiet=found.quiet,
        contact_end=contact_strength(thumbs[-1], found.ground),
        starts_touching=found.touching,
        unsteady=found.unsteady,
        untouched=plan.untouched,
        thumbnail=_flat(cv2.resize(found.ground, THUMBNAIL_SIZE, interpolation=cv2.INTER_AREA)),
        signature=_signature(
            [thumbs[i][:, :, 0].copy() for i in range(plan.start, found.frames) if i % often == 0], found.ground
        ),
    )


def _signature(pictures: list[Image], reference: Image) -> tuple[float, ...]:
    """A signature of the contact, for finding copies: the mean of the third with most contact, less that of the rest.

    Such means change little when a copy is shortened or encoded again, though each picture and the reference do.
    """
    untouched = np.ascontiguousarray(reference[:, :, 0])
    ranked = [*sorted(pictures, key=lambda p: contact_strength(p, untouched), reverse=True), untouched]
    # Rounded up, so that one picture is enough for the part with most contact.
    third = -(-len(ranked) // 3)
    most, rest = (np.mean(part or [untouched], axis=0, dtype=np.float32) for part in (ranked[:third], ranked[third:]))
    change = most - rest
    small = cv2.resize(change, SIGNATURE_SIZE, interpolation=cv2.INTER_AREA)
    small -= small.mean()
    norm = float(np.linalg.norm(small))
    return _flat(small / norm if norm > 0 else small)


def _flat(array: np.ndarray) -> tuple[float, ...]:
    return tuple(array.astype(np.float64).round(4).ravel().tolist())

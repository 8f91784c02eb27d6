"""Pressing the surface into the gel with a force: a bed of springs (Winkler), then the gel's own skin.

Johnson, Contact Mechanics, 4.3: an elastic layer of thickness t and modulus E answers each point by itself with the
pressure p = (E / t) c, where c is how far the two undeformed surfaces would overlap there. Object and gel are springs
in series, 1/E* = 1/E_gel + 1/E_object, and the camera sees the gel's share of the overlap, (E* / E_gel) c.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.scenes.geometry import Heights

GEL_MODULUS_MPA = 0.25
"""Reduced modulus of the gel."""
GEL_THICKNESS_MM = 2.5
MEMBRANE_MM = 0.9
"""How far the gel's skin follows beyond a contact, as the standard deviation of a Gaussian (a third of the gel)."""
MEMBRANE_SHARE = 0.75
"""How much of the averaged indentation the skin takes up where nothing touches it."""
TOLERANCE = 1e-4
"""Relative error of the contact force."""
STEPS = 100


@dataclass(frozen=True)
class Contact:
    """A contact in equilibrium."""

    approach: float
    """How far the bodies come together after first touch, in mm."""
    overlap: Heights
    """Shared out between gel and object, in mm; 0 outside the contact."""
    force: float
    """In N, from the pressure over the grid."""


def series(first: float, second: float) -> float:
    """The modulus of two springs in series, in the unit of both."""
    return first * second / (first + second)


def press(gap: Heights, force: float, modulus: float, pitch: float) -> Contact:
    """Press an object into the gel until the pressure adds up to `force`.

    The force grows steadily with the approach, which is found by bisection between none and what would hold if the
    whole grid were in contact at once.

    Args:
        gap: Distance of the undeformed surfaces at first touch, in mm; not negative, and 0 somewhere.
        force: In N, not negative.
        modulus: The object's reduced modulus, in MPa.
        pitch: In mm a pixel.
    """
    if force <= 0:
        return Contact(0.0, np.zeros_like(gap), 0.0)
    # Force a millimetre of overlap and pixel: (E* / t) dA.
    stiffness = series(GEL_MODULUS_MPA, modulus) / GEL_THICKNESS_MM * pitch * pitch
    low, high = 0.0, float(gap.max()) + force / (stiffness * gap.size)
    for _ in range(STEPS):
        approach = (low + high) / 2
        overlap = np.maximum(np.float32(approach) - gap, 0)
        reached = stiffness * cv2.sumElems(overlap)[0]
        if abs(reached - force) <= TOLERANCE * force:
            break
        low, high = (approach, high) if reached < force else (low, approach)
    return Contact(approach, overlap, reached)


def indentation(contact: Contact, modulus: float, pitch: float) -> Heights:
    """How far the gel's skin is pushed in, in mm, as the camera sees it.

    Inside the contact the gel's share of the overlap; around it the skin hangs between the points that hold it,
    for which a Gaussian average stands ("clip and blur").
    """
    share = series(GEL_MODULUS_MPA, modulus) / GEL_MODULUS_MPA
    held = contact.overlap * np.float32(share)
    if contact.approach == 0:
        return held
    skin = np.maximum(held, np.float32(MEMBRANE_SHARE) * _blur(held, MEMBRANE_MM / pitch))
    smooth: Heights = cv2.GaussianBlur(skin, (3, 3), 0)
    return smooth


def _blur(image: Heights, sigma: float) -> Heights:
    """A wide Gaussian, taken on a coarser grid where it is much wider than a pixel."""
    step = max(1, int(sigma / 2))
    height, width = image.shape
    coarse = cv2.resize(image, (max(1, width // step), max(1, height // step)), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coarse, (0, 0), sigma / step, borderType=cv2.BORDER_REPLICATE)
    fine: Heights = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR)
    return fine

"""Pressing into a bed of springs (Winkler), the cheapest contact there is, and a blur for the gel's skin.

Johnson, Contact Mechanics, 4.3: an elastic layer of thickness t and modulus E answers each point by itself with the
pressure p = (E / t) c, where c is how far the two undeformed surfaces would overlap there. Object and gel are springs
in series, and the camera sees the gel's share of the overlap, (E* / E_gel) c.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipeline.scenes.elastic.kernels import Gel
from pipeline.scenes.grid import Heights

MEMBRANE_SHARE = 0.75
"""How much of the averaged indentation the skin takes up where nothing touches it."""
MEMBRANE = 0.36
"""How far the skin follows beyond a contact: the standard deviation of the Gaussian over the gel's thickness."""
TOLERANCE = 1e-4
"""Relative error of the force."""
STEPS = 100


def series(first: float, second: float) -> float:
    """The modulus of two springs in series, in the unit of both."""
    return first * (second / (first + second))


def press_springs(gap: Heights, force: float, modulus: float, pitch: float, gel: Gel) -> Heights:
    """Press an object into the gel until the pressure adds up to `force`, by bisection of the approach.

    The gap is the distance of the undeformed surfaces at first touch in mm, 0 somewhere; the force is in N, the
    object's reduced modulus in MPa, the pitch in mm a pixel. Returns how far both overlap, shared out between them, in
    mm: 0 outside the contact, at most the approach.
    """
    if force <= 0:
        return np.zeros_like(gap)
    # Force a millimetre of overlap and pixel: (E* / t) dA.
    stiffness = series(gel.modulus, modulus) / gel.thickness * pitch * pitch
    low, high = 0.0, float(gap.max()) + force / (stiffness * gap.size)
    for _ in range(STEPS):
        approach = (low + high) / 2
        overlap: Heights = np.maximum(np.float32(approach) - gap, 0)
        reached = stiffness * cv2.sumElems(overlap)[0]
        if abs(reached - force) <= TOLERANCE * force:
            break
        low, high = (approach, high) if reached < force else (low, approach)
    return overlap


def hang_skin(overlap: Heights, modulus: float, pitch: float, gel: Gel) -> Heights:
    """How far the gel's skin is pushed in, in mm: the gel's share of the overlap, and around it a Gaussian average."""
    held = overlap * np.float32(series(gel.modulus, modulus) / gel.modulus)
    # The Gaussian is taken on a coarser grid where it is much wider than a pixel.
    sigma = MEMBRANE * gel.thickness / pitch
    step, (height, width) = max(1, int(sigma / 2)), held.shape
    coarse = cv2.resize(held, (max(1, width // step), max(1, height // step)), interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(coarse, (0, 0), sigma / step, borderType=cv2.BORDER_REPLICATE)
    around = cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR)
    skin: Heights = np.maximum(held, np.float32(MEMBRANE_SHARE) * around)
    return skin

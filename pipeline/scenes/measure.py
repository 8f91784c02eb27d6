"""An object's classes measured from its scene: what a person would call it by the paper's guidelines.

Paper, "Dataset Collection": hardness by the force under which an object yields; roughness by what a sliding finger
meets; bumpiness by how large what sticks out is against a quarter of the tactile image. Here hardness is read from the
object's modulus, roughness from the heights of the surface, bumpiness from the skin of the pressed gel. Texture and
bumps are told apart by wavelength, so that neither counts as the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.scenes.grid import Heights

SOFT_BELOW_MPA = 0.12
"""Reduced modulus under which an object yields with little force: half the gel's, so that it is the object that gives
way, as a fingertip's flesh does (Serina et al., J. Biomech. 31 (1998) 639)."""
HARD_ABOVE_MPA = 3.0
"""Over twelve times the gel's modulus over 90 % of the yielding is the gel's: a pressing hand feels no give."""
TEXTURE_MM = 1.0
"""Shorter wavelengths are texture, longer ones shape: what a fingertip resolves (gratings and gaps of .84 to 1 mm,
Johnson and Phillips, J. Neurophysiol. 46 (1981) 1177)."""
ROUGH_MM = (0.003, 0.013)
"""Root mean square height of the texture from which a surface is slightly rough, and rough."""
VISIBLE_MM = 0.03
"""Least prominence of a protrusion in the skin: over a flank of 1 mm it changes the light by some four 8-bit steps, a
few times the camera's noise."""
BIG_SHARE = 1 / 4
"""The paper's border between small and big bumps, 1/4 of the tactile image, taken as a share of its height."""
HALF, CAP = 0.5, math.sqrt(2)
"""Sections are taken at half height, where neighbours do not run into each other; a paraboloid's foot is CAP
as wide."""
WIDEST_SHARE = 0.6
"""What is wider is the body's shape, as a share of the image's height."""
FITTED = 0.3
"""Where the skin is pressed in by this share of its deepest place, the body's shape is fitted."""
REACH_MM = 4.0
"""Length over which a fingertip averages what it rests on; valleys below that are not reached."""
ROWS = 120
"""A finer skin is averaged to this many rows, to save time."""
CUTOFF = 0.1873
"""Standard deviation over cutoff wavelength of the Gaussian filter that halves it (ISO 16610-21)."""


@dataclass(frozen=True)
class Measured:
    """What a scene shows of one object."""

    modulus: float
    """Reduced, in MPa."""
    texture: float
    """Root mean square height below `TEXTURE_MM`, in mm."""
    bump: float
    """Typical width of visible protrusions over the image's height; 0 where there is none."""

    @property
    def hardness(self) -> int:
        """0 soft, 1 moderately hard, 2 hard."""
        return (self.modulus >= SOFT_BELOW_MPA) + (self.modulus >= HARD_ABOVE_MPA)

    @property
    def roughness(self) -> int:
        """0 smooth, 1 slightly rough, 2 rough."""
        return (self.texture >= ROUGH_MM[0]) + (self.texture >= ROUGH_MM[1])

    @property
    def bumpiness(self) -> int:
        """0 no bumps, 1 small, 2 big."""
        return (self.bump > 0) + (self.bump > BIG_SHARE)


def texture(surface: Heights, pitch: float) -> float:
    """Root mean square height in mm of wavelengths below `TEXTURE_MM` where the surface stands out.

    The shorter waves are what a Gaussian filter (ISO 16610-21) leaves; applied twice, nothing remains of curvature. A
    finger meets what stands above its surroundings; valleys between cylinders are out of its reach and do not count.
    NaN where nothing does, as in a surface with gaps.
    """
    rest = surface - _smooth(surface, TEXTURE_MM, pitch)
    rest = rest - _smooth(rest, TEXTURE_MM, pitch)
    upper = surface >= _smooth(surface, REACH_MM, pitch)
    inner = round(TEXTURE_MM / pitch)  # Nearer to the border the filter lacks neighbours.
    inside = (slice(inner, -inner), slice(inner, -inner))
    proud = rest[inside][upper[inside]]
    return float(proud.std()) if proud.size else math.nan


def bump_share(skin: Heights, pitch: float) -> float:
    """Typical width of the protrusions over the image's height; 0 where none is visible.

    A protrusion rises over what a wide disc can reach from below (white top hat). The body itself may do so too, so a
    protrusion must also rise in what is left of the skin after a fitted paraboloid is taken off. It counts where it
    rises over `VISIBLE_MM`. Its width follows from the largest circle at half its height. The typical width is the
    median over protrusions, weighted by their areas.
    """
    rows, columns = skin.shape
    height = min(rows, ROWS)
    coarse: Heights = cv2.resize(skin, (round(columns * height / rows), height), interpolation=cv2.INTER_AREA)
    touched = np.asarray(coarse > FITTED * float(coarse.max()))
    if not touched.any():
        return 0.0
    smooth = _smooth(coarse, TEXTURE_MM, pitch * rows / height)
    # The least-squares paraboloid through the skin where it is touched; around the contact it means nothing.
    x, y = np.meshgrid(np.linspace(-1, 1, smooth.shape[1]), np.linspace(-1, 1, height))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    body = (terms @ np.linalg.lstsq(terms[touched], smooth[touched], rcond=None)[0]).astype(np.float32)
    rest = np.where(touched, smooth - body, np.minimum(smooth - body, 0))
    proud = np.minimum(_top_hat(smooth), _top_hat(rest))
    widths, areas = _widths(proud)
    if not widths:
        return 0.0
    order = np.argsort(widths)
    half = np.searchsorted(np.cumsum(np.asarray(areas)[order]), sum(areas) / 2)
    typical = float(np.asarray(widths)[order][half])
    return typical / float(height)


def _top_hat(image: Heights) -> Heights:
    """How far it rises over its opening by a disc of `WIDEST_SHARE`."""
    size = round(WIDEST_SHARE * image.shape[0]) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    proud: Heights = cv2.morphologyEx(image, cv2.MORPH_TOPHAT, disc)
    return proud


def _widths(proud: Heights) -> tuple[list[float], list[float]]:
    """Widths and areas in pixels of the protrusions that can be seen."""
    disc = round(2 * BIG_SHARE * proud.shape[0]) | 1
    around = cv2.dilate(proud, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (disc, disc)))
    section = ((proud > HALF * around) & (around > VISIBLE_MM)).astype(np.uint8)
    count, pieces, facts, _ = cv2.connectedComponentsWithStats(section, connectivity=4)
    inside = cv2.distanceTransform(section, cv2.DIST_L2, 5)
    peak, radius = np.zeros(count, np.float32), np.zeros(count, np.float32)
    np.maximum.at(peak, pieces, proud)
    np.maximum.at(radius, pieces, inside)
    seen = [i for i in range(1, count) if peak[i] > VISIBLE_MM]
    return [2 * CAP * float(radius[i]) for i in seen], [float(facts[i, cv2.CC_STAT_AREA]) for i in seen]


def _smooth(image: Heights, cutoff: float, pitch: float) -> Heights:
    """The waves longer than `cutoff` mm."""
    smooth: Heights = cv2.GaussianBlur(image, (0, 0), CUTOFF * cutoff / pitch, borderType=cv2.BORDER_REFLECT)
    return smooth

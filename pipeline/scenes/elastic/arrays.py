"""One code for NumPy and torch: the solver is written against the array API standard; only transforms differ."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.fft
from array_api_compat import array_namespace

Array = Any
"""A NumPy array, or a torch tensor on any device."""

__all__ = ["Array", "array_namespace", "back", "forward", "inverse", "like", "on"]


def forward(field: Array, shape: tuple[int, int]) -> Array:
    """The real transform over the last two axes, padded with zeros to `shape`."""
    # SciPy's transforms take float32 as it is and are several times faster at that than NumPy's.
    if isinstance(field, np.ndarray):
        return scipy.fft.rfft2(field, s=shape)
    return array_namespace(field).fft.rfft2(field, s=shape)


def inverse(spectrum: Array, shape: tuple[int, int]) -> Array:
    """The inverse of `forward`, of the full `shape`."""
    if isinstance(spectrum, np.ndarray):
        return scipy.fft.irfft2(spectrum, s=shape)
    return array_namespace(spectrum).fft.irfft2(spectrum, s=shape)


def like(values: Array, field: Array) -> Array:
    """Values in the number format and on the device of a field."""
    xp = array_namespace(field)
    place = {} if isinstance(field, np.ndarray) else {"device": field.device}
    return xp.asarray(values, dtype=field.dtype, **place)


def on(field: np.ndarray, device: str | None) -> Array:
    """A NumPy array on a torch device, or as it is where that is None."""
    if device is None:
        return field
    import torch

    return torch.from_numpy(field).to(device)


def back(values: Array) -> np.ndarray:
    """As a NumPy array, on the CPU."""
    return values if isinstance(values, np.ndarray) else np.asarray(values.detach().cpu())

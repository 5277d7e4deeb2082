"""Display-referred (sRGB) and scene-linear colour."""

from __future__ import annotations

import numpy as np

BAND_0 = 0.28209479177387814
"""Spherical harmonic of degree 0: colour = 0.5 + BAND_0 * first coefficient."""


def linear_from_display(display: np.ndarray) -> np.ndarray:
    """Decode sRGB values; any shape, unclamped above 1, negative values become 0. Source: IEC 61966-2-1."""
    display = np.maximum(display, 0.0)
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def display_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB; the inverse of `linear_from_display`."""
    linear = np.maximum(linear, 0.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)

"""Mitsuba beside the renderer: scenes described once, and how well images of the two can agree."""

import numpy as np

import warp_psdr as psdr

#: Weight sums of Mitsuba's film, float32, relative.
MITSUBA_ROUNDING = 1e-3


def for_mitsuba(mi, value):
    """Return a scene with Mitsuba's transformations, bitmaps, and grids (Z, Y, X, C)."""
    if isinstance(value, dict):
        return {key: for_mitsuba(mi, item) for key, item in value.items()}
    if isinstance(value, psdr.Transform):
        return mi.ScalarTransform4f(value.matrix)
    if isinstance(value, np.ndarray) and value.ndim == 4:
        return mi.TensorXf(value)
    return mi.Bitmap(value) if isinstance(value, np.ndarray) else value

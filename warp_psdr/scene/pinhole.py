"""The common part of pinhole cameras and projectors: a rigid pose and a field of view."""

from __future__ import annotations

import math

import numpy as np

from warp_psdr.scene.errors import error
from warp_psdr.scene.plugins import Properties

_FOV_AXES = ("x", "y", "diagonal", "smaller", "larger")
#: Diagonal of 35 mm film, in mm: what focal lengths refer to.
_FILM_DIAGONAL = math.hypot(36.0, 24.0)
#: Largest difference of the axes' lengths, relative, that rounding in a scene file may leave.
_RIGID = 1e-3


def rigid_pose(props: Properties) -> np.ndarray:
    """Return the rigid to-world matrix, (4, 4) float64; a uniform scale is divided out with a note."""
    matrix = props.transform("to_world")
    place = props.place("to_world")
    lengths = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if lengths[0] - lengths[-1] > _RIGID * lengths[0]:
        raise error(
            place,
            f"the matrix stretches or shears (singular values {np.round(lengths, 4).tolist()})",
            "build it from rotations and translations, for example with look_at",
        )
    scale = float(np.cbrt(np.abs(np.linalg.det(matrix[:3, :3]))))
    if abs(scale - 1.0) > _RIGID:
        props.context.note(f"{place}: the scale {scale:g} of the {_noun(props)} was removed")
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        props.context.note(f"{place}: the matrix mirrors the image")
    matrix[:3, :3] /= scale
    return matrix


def x_fov(props: Properties, aspect: float) -> float:
    """Return the horizontal field of view in degrees from ``fov`` and ``fov_axis``, or ``focal_length``.

    Args:
        props: The plugin.
        aspect: Width over height of its film or image, as it is seen: times that of a pixel.
    """
    if props.has("fov") and props.has("focal_length"):
        raise error(props.where, "got both 'fov' and 'focal_length'", "give one of them")
    axis = props.string("fov_axis", "x", _FOV_AXES)
    if props.has("fov"):
        fov = props.number("fov", None, minimum=0.0, maximum=180.0, exclusive=True)
        props.take("focal_length")
    else:
        props.take("fov")
        fov, axis = _fov_of_focal_length(props), "diagonal"
    if axis in ("smaller", "larger"):
        axis = "x" if (axis == "larger") == (aspect > 1.0) else "y"
    tangent = math.tan(0.5 * math.radians(fov))
    if axis == "y":
        tangent *= aspect
    elif axis == "diagonal":
        tangent /= math.sqrt(1.0 + 1.0 / aspect**2)
    return math.degrees(2.0 * math.atan(tangent))


def _fov_of_focal_length(props: Properties) -> float:
    text = str(props.take("focal_length", "50mm")).strip()
    try:
        length = float(text.removesuffix("mm"))
    except ValueError:
        length = -1.0
    if not 0.0 < length < math.inf:
        raise error(props.place("focal_length"), f"got '{text}'", "give a positive length such as '50mm'")
    return math.degrees(2.0 * math.atan(0.5 * _FILM_DIAGONAL / length))


def _noun(props: Properties) -> str:
    return "projector" if props.type == "projector" else "camera"

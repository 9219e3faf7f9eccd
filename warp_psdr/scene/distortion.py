"""Lens distortion on the host, in double precision: what sensors take, where a lens folds, and what a film sees.

``kernels/sensor/distortion.py`` has the conventions; a point of the pinhole's image is (p, q), to the left and up.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

from warp_psdr.kernels.constants import DISTORTED_CAMERAS, FISHEYES, RFILTER_GAUSSIAN
from warp_psdr.kernels.sensor.distortion import NUMBERS, STEPS
from warp_psdr.kernels.sensor.film import GAUSSIAN_CUT
from warp_psdr.scene.errors import error

if TYPE_CHECKING:
    import warp as wp

    from warp_psdr.kernels.structs import Camera
    from warp_psdr.scene.description import FilmDescription
    from warp_psdr.scene.plugins import Properties

#: Properties of the film's pixels: fy / fx, and OpenCV's K[0, 1] / fx.
AFFINE = ("pixel_aspect", "skew")
#: Coefficients of each model, in OpenCV's order.
MODELS = {"opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), "fisheye": ("k1", "k2", "k3", "k4")}
#: Points along each side of the film at which a lens is looked at, and points from the axis to each.
_POINTS, _STEPS = 48, 32
#: By how much the box of what the film sees is larger than that of those points, relative to its size.
_ROOM = 0.02
#: Largest step of Newton's method behind which there is no other.
_ROUNDING = 1e-12
#: Largest distance of a film position that is found from the one looked for, relative to 1 + that from the axis.
_MISSED = 1e-6
#: Largest angle that a fisheye's film may see, radians: rays are found by the tangent of the angle.
_WIDEST = np.radians(85.0)


@dataclass(frozen=True)
class FilmPlane:
    """Positions on a film, as F: ``at(s, t) = (1 - 2 (s + cx)) k, (1 - 2 (t + cy)) k / aspect``.

    Attributes:
        k: tan(x_fov / 2).
        offset: (2,) principal point offset.
        aspect: width / height of the film.
        low: (2,) least film position (s, t) that counts for a pixel.
        high: (2,) largest.
    """

    k: float
    offset: tuple[float, ...]
    aspect: float
    low: tuple[float, float]
    high: tuple[float, float]

    @staticmethod
    def of(film: FilmDescription, x_fov: float, offset: tuple[float, float]) -> FilmPlane:
        """Return the plane of a description."""
        gaussian = film.filter == "gaussian"
        reach = GAUSSIAN_CUT * film.filter_stddev if gaussian else film.filter_radius
        border = film.sample_border * max(reach - 0.5, 0.0)
        crop = ((film.crop_offset_x, film.crop_width, film.width), (film.crop_offset_y, film.crop_height, film.height))
        low, high = ([(a - border) / n for a, _w, n in crop], [(a + w + border) / n for a, w, n in crop])
        k = float(np.tan(np.radians(x_fov) / 2.0))
        return FilmPlane(k, offset, film.width / film.height, (low[0], low[1]), (high[0], high[1]))

    def border(self) -> np.ndarray:
        """Return (N, 2) points of F along the border of what counts, corners included."""
        u = np.linspace(0.0, 1.0, _POINTS + 1)
        zero, one = np.zeros_like(u), np.ones_like(u)
        across, down = np.concatenate([u, u, zero, one]), np.concatenate([zero, one, u, u])
        unit = np.stack([across, down], axis=1)
        film = np.array(self.low) + unit * (np.array(self.high) - np.array(self.low))
        return (1.0 - 2.0 * (film + self.offset)) * self.k / [1.0, self.aspect]


def take_distortion(props: Properties) -> tuple[Literal["", "opencv", "fisheye"], tuple[float, ...]]:
    """Return the model of a camera's distortion, "" without one, and its numbers.

    Raises:
        ValueError: a coefficient is not of that model.
    """
    every = sorted({name for names in MODELS.values() for name in names})
    given = [name for name in every if props.has(name)]
    if not given and not props.has("distortion", *AFFINE):
        return "", ()
    model = props.string("distortion", "opencv", tuple(MODELS))
    foreign = [name for name in given if name not in MODELS[model]]
    for name in foreign:
        other = "leave it out, or take distortion 'opencv'"
        raise error(props.place(name), f"distortion '{model}' has the coefficients {', '.join(MODELS[model])}", other)
    numbers = [props.number("pixel_aspect", 1.0, minimum=0.0, exclusive=True), props.number("skew", 0.0)]
    numbers += [props.number(name, 0.0) for name in MODELS[model]]
    for name in every:
        props.take(name)
    numbers += [0.0] * (NUMBERS - len(numbers))
    return cast(Any, model), tuple(numbers)


def _factor(model: str, c: np.ndarray, r2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return D and its derivative by r^2."""
    if model == "opencv":
        above, below = np.polyval([c[6], c[3], c[2], 1.0], r2), np.polyval([c[9], c[8], c[7], 1.0], r2)
        slope = np.polyval([3.0 * c[6], 2.0 * c[3], c[2]], r2)
        return above / below, (slope - above / below * np.polyval([3.0 * c[9], 2.0 * c[8], c[7]], r2)) / below
    safe = np.maximum(r2, 1e-6)
    r = np.sqrt(safe)
    angle = np.arctan(r)
    factor = np.polyval([c[5], c[4], c[3], c[2], 1.0], angle**2) * angle / r
    rate = np.polyval([9.0 * c[5], 7.0 * c[4], 5.0 * c[3], 3.0 * c[2], 1.0], angle**2) / (1.0 + safe)
    slope = 0.5 * (rate - factor) / safe
    return factor + slope * (r2 - safe), slope


def distort(model: str, c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return F at points (..., 2) of the pinhole's image."""
    p, q = np.moveaxis(np.asarray(x, np.float64), -1, 0)
    r2 = p * p + q * q
    factor = _factor(model, c, r2)[0]
    across, up = p * factor, q * factor
    if model == "opencv":
        across = across - 2.0 * c[4] * p * q - c[5] * (r2 + 2.0 * p * p)
        up = up - 2.0 * c[5] * p * q - c[4] * (r2 + 2.0 * q * q)
    return np.stack([across + c[1] * up, c[0] * up], axis=-1)


def jacobian(model: str, c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the Jacobian (..., 2, 2) of F."""
    p, q = np.moveaxis(np.asarray(x, np.float64), -1, 0)
    factor, slope = _factor(model, c, p * p + q * q)
    xx, xy, yy = factor + 2.0 * p * p * slope, 2.0 * p * q * slope, factor + 2.0 * q * q * slope
    if model == "opencv":
        xx = xx - 2.0 * c[4] * q - 6.0 * c[5] * p
        xy = xy - 2.0 * c[4] * p - 2.0 * c[5] * q
        yy = yy - 6.0 * c[4] * q - 2.0 * c[5] * p
    rows = [xx + c[1] * xy, xy + c[1] * yy], [c[0] * xy, c[0] * yy]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _step(model: str, c: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a step of Newton's method from x towards F^-1(y)."""
    j, rest = jacobian(model, c, x), y - distort(model, c, x)
    a, b, d, e = j[:, 0, 0], j[:, 0, 1], j[:, 1, 0], j[:, 1, 1]
    turned = np.stack([e * rest[:, 0] - b * rest[:, 1], a * rest[:, 1] - d * rest[:, 0]], axis=1)
    return turned / (a * e - b * d)[:, None]


def undistort(model: str, c: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return F^-1 at points (N, 2), as camera rays find it; where it is not found, F there is not y."""
    y = np.asarray(y, np.float64)
    up = y[:, 1] / c[0]
    x = np.stack([y[:, 0] - c[1] * up, up], axis=1)
    with np.errstate(all="ignore"):
        if model == "opencv":
            for _ in range(STEPS):
                step = _step(model, c, x, y)
                x = x + step
                if np.abs(step).max() < _ROUNDING:
                    break
            return x
        radius = np.maximum(np.linalg.norm(x, axis=1), 1e-12)
        angle = radius
        for _ in range(STEPS):
            image = angle * np.polyval([c[5], c[4], c[3], c[2], 1.0], angle**2)
            rate = np.polyval([9.0 * c[5], 7.0 * c[4], 5.0 * c[3], 3.0 * c[2], 1.0], angle**2)
            angle = angle + (radius - image) / rate
        # From a quarter turn on there is no point in front of the camera.
        return np.where(np.abs(angle) < 0.5 * np.pi, np.tan(angle) / radius, np.nan)[:, None] * x


@functools.lru_cache(maxsize=64)  # each render asks several times
def fault(model: str, numbers: tuple[float, ...], plane: FilmPlane) -> tuple[str, str] | None:
    """Say why a lens cannot be looked through at some point of a film, and what to do; None: it can.

    What the film sees is inside of the curve that its border sees. All of it lies on lines from the axis to that curve;
    where the Jacobian has no positive determinant on one of them, the lens folds.
    """
    c, ends = np.array(numbers), plane.border()
    x = undistort(model, c, ends)
    with np.errstate(all="ignore"):
        off = np.linalg.norm(distort(model, c, x) - ends, axis=1)
        bad = ~(off < _MISSED * (1.0 + np.linalg.norm(ends, axis=1)))
        lines = np.linspace(0.0, 1.0, _STEPS)[:, None, None] * x
        bad |= ~(np.linalg.det(jacobian(model, c, lines)) > 0.0).all(axis=0)
    if bad.any():
        near = np.linalg.norm(ends[bad], axis=1).min()
        return (
            f"the '{model}' distortion folds, or has no ray, inside the film, {near:.3g} focal lengths from its axis",
            "check the order and the signs of the coefficients, fit fewer of them, or crop the film",
        )
    if model == "fisheye" and np.arctan(np.linalg.norm(x, axis=1)).max() > _WIDEST:
        return (
            f"the film sees more than {np.degrees(_WIDEST):.0f} degrees beside the axis",
            "crop the film to less, for cameras see half a space at most",
        )
    return None


def filter_reach(camera: Camera) -> float:
    """Return by how many pixels a camera's film sees beyond its crop window."""
    gaussian = camera.filter == RFILTER_GAUSSIAN
    reach = GAUSSIAN_CUT * camera.filter_stddev if gaussian else camera.filter_radius
    return camera.sample_border * max(reach - 0.5, 0.0)


def _plane_of(camera: Camera, values: wp.array) -> tuple[str, tuple[float, ...], FilmPlane]:
    """Return the model, the numbers and the film of a camera with distortion, at the scene's flat ``values``."""

    def read(offset: int, count: int) -> tuple[float, ...]:
        return tuple(values[offset : offset + count].numpy().tolist())

    border = filter_reach(camera)
    film = ((camera.crop_x, camera.crop_width, camera.width), (camera.crop_y, camera.crop_height, camera.height))
    low, high = ([(a - border) / n for a, _w, n in film], [(a + w + border) / n for a, w, n in film])
    k = math.tan(math.radians(read(camera.x_fov, 1)[0]) / 2.0)
    plane = FilmPlane(k, read(camera.principal, 2), camera.width / camera.height, (low[0], low[1]), (high[0], high[1]))
    return "fisheye" if camera.kind in FISHEYES else "opencv", read(camera.distortion, NUMBERS), plane


def bounds_of(camera: Camera, values: wp.array) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest (p, q), (2,) each, that a film with distortion sees, and a little more.

    It has to be clear (``require_clear``).
    """
    model, numbers, plane = _plane_of(camera, values)
    x = undistort(model, np.array(numbers), plane.border())
    low, high = x.min(axis=0), x.max(axis=0)
    # The axis may lie outside of a crop window: extremes are on the border all the same, for F is one to one.
    room = _ROOM * (high - low)
    return low - room, high + room


def require_clear(camera: Camera, values: wp.array, path: str) -> Camera:
    """Return a camera, unless its film cannot be looked through at the present values.

    Raises:
        ValueError: the distortion folds inside the film.
    """
    problem = fault(*_plane_of(camera, values)) if camera.kind in DISTORTED_CAMERAS else None
    if problem:
        raise ValueError(
            f"{path!r}: with the values of its parameters {problem[0]}; restore others "
            "(an optimiser that got here took too long a step: lower its learning rate)"
        )
    return camera

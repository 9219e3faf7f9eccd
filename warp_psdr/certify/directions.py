"""Directions along which derivatives are compared, and the length of steps along them.

A direction's largest entry is a *unit*: the longest step of a difference. For what moves, the unit is two pixels at
the scene's distance, or a fifth of the shape's size where that is less; for all else a tenth of the values.
Directions are fixed before the batches that are tested, so that they may follow a pilot's gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from warp_psdr.scene.layout import CAMERA, LIGHT_POSE, POSITIONS, SHAPE_POSE, Parameter

#: Unit of values over the largest of them, and over the width of their range where all are zero.
OF_VALUES = 0.1
#: Unit of what moves: pixels, and share of the size of what moves.
PIXELS, OF_SIZE = 2.0, 0.2
#: By about so much faces turn as points move by themselves, or in waves [radians]. As faces of coarse meshes turn away,
#: quotients settle slowly.
TURNING = 0.2
#: An entry that stands out by more standard errors than these is told well enough.
ENOUGH = 10.0
#: Unit of a turn where nothing says how far away things are [radians].
TURN = 0.2
#: Waves of a random field, and their most radians across it.
WAVES, RADIANS = 4, 4.0
#: A pilot's pull on a whole shape is followed if it is so many of its deviations long; the share of a random vector
#: that is added, since a gradient that is wrong may be right along itself.
CLEAR, BESIDE = 1.5, 0.5
#: Smooth fields of which the one is taken that the pilot's gradient sees most of.
FIELDS = 8
#: Axes along which points and poses move: all, or two where moves along the third part shapes that touch.
PLANES = ((1, 1, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1))
#: Derivatives by values at the end of their range have one side only: differences of second order, (step, weight).
CENTRAL = ((1.0, 0.5), (-1.0, -0.5))
ONE_SIDED = ((0.0, -1.5), (1.0, 2.0), (2.0, -0.5))


@dataclass(frozen=True)
class Direction:
    """A direction of one parameter.

    Attributes:
        parameter: its name.
        what: what the direction is, for tables.
        tangent: in the parameter's shape; the longest step is 1.
        stencil: (step, weight) of the difference.
    """

    parameter: str
    what: str
    tangent: np.ndarray
    stencil: tuple[tuple[float, float], ...] = CENTRAL

    def along(self, gradient: np.ndarray) -> np.ndarray:
        """Return (K,): derivatives along the direction of gradients (K, *shape)."""
        return (gradient * self.tangent).reshape(len(gradient), -1).sum(axis=1)


def directions_of(
    p: Parameter, values: np.ndarray, gradient: np.ndarray, deviation: np.ndarray, reach: float, pixels: int, seed: int
) -> list[Direction]:
    """Return the directions of a parameter, the most telling first.

    Args:
        p: the parameter.
        values: its values, float64.
        gradient: of a pilot, in its shape.
        deviation: standard deviation of ``gradient``.
        reach: how far away is what the parameter moves, or moves against, world units.
        pixels: on the longer side of the image.
        seed: of random directions.
    """
    random = np.random.default_rng((seed, 2, *map(ord, p.name)))
    found = list(_tangents(p, values, gradient, deviation, reach, pixels, random))
    return [_inside(Direction(p.name, what, t), values, p.bounds) for what, t in found if np.any(t)]


def directions_of_numbers(
    name: str,
    values: np.ndarray,
    gradient: np.ndarray,
    deviation: np.ndarray,
    bounds: tuple[float, float],
    unit: float | None,
    seed: int,
) -> list[Direction]:
    """Return the directions of values of which nothing but a range is known, and a unit; None: by their size."""
    random = np.random.default_rng((seed, 2, *map(ord, name)))
    unit = _of_values(values, bounds) if unit is None else unit
    found = _of_numbers(values, gradient, deviation, unit, random)
    return [_inside(Direction(name, what, t), values, bounds) for what, t in found]


def _tangents(p: Parameter, values, gradient, deviation, reach, pixels, random) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and tangents; of equal names the later ones stand in where the first has no derivative."""
    moves = bool(p.uses & {POSITIONS, SHAPE_POSE, CAMERA, LIGHT_POSE})
    if values.shape == (4, 4):
        yield from _of_pose(p, values, gradient, deviation, reach, pixels, random)
    elif moves and values.shape[-1:] == (3,):
        yield from _of_points(p, values, gradient, deviation, _length(p, values, reach, pixels), random)
    else:
        yield from _of_numbers(values, gradient, deviation, _of_values(values, p.bounds), random)


def _of_points(p: Parameter, values, gradient, deviation, unit, random) -> Iterator[tuple[str, np.ndarray]]:
    pull = gradient.reshape(-1, 3).sum(axis=0)
    clear = np.linalg.norm(pull) > CLEAR * np.linalg.norm(deviation)
    for axes in PLANES:
        yield "shift", np.broadcast_to(unit * _towards(pull * clear, random, axes), values.shape).copy()
    if values.size == 3:
        return
    single = min(unit, TURNING * _spacing(values))
    wave = min(unit, TURNING * float(np.ptp(values, axis=0).max()) / RADIANS)
    welded = _welded(gradient, values)
    for axes in PLANES if np.any(welded) else ():
        yield "gradient", single * _scaled(welded * np.array(axes, float))
    for axes in PLANES:
        fields = [_scaled(_field(values, True, random) * np.array(axes, float)) for _ in range(FIELDS)]
        yield "smooth field", wave * max(fields, key=lambda field: abs(float((field * gradient).sum())))
    yield "one entry", single * _scaled(_welded(_one(gradient, deviation), values))


def _of_numbers(values, gradient, deviation, unit, random) -> Iterator[tuple[str, np.ndarray]]:
    if values.size == 1:
        yield "value", np.full(values.shape, unit)
        return
    yield "all alike", np.full(values.shape, unit)
    if values.size <= 3:
        yield "random", unit * _field(values, False, random)
        return
    if np.any(gradient):
        yield "gradient", unit * _scaled(gradient)
    yield "smooth field", unit * _field(values, False, random)
    yield "one entry", unit * _one(gradient, deviation)


def _of_pose(p: Parameter, values, gradient, deviation, reach, pixels, random) -> Iterator[tuple[str, np.ndarray]]:
    """Yield shifts, and turns about the pose's origin."""
    length = _length(p, values, reach, pixels)
    pull = gradient[:3, 3]
    clear = np.linalg.norm(pull) > CLEAR * np.linalg.norm(deviation[:3, 3])
    for axes in PLANES:
        shift = np.zeros((4, 4))
        shift[:3, 3] = length * _towards(pull * clear, random, axes)
        yield "shift", shift
    size = float(np.linalg.norm(values[:3, :3], axis=0).max()) if SHAPE_POSE in p.uses else reach
    angle = min(length / size, TURN) if size > 0.0 else TURN
    turns = [np.cross(np.eye(3), axis) @ values[:3, :3] for axis in np.eye(3)]
    torque = np.array([float((gradient[:3, :3] * turn).sum()) for turn in turns])
    clear = np.linalg.norm(torque) > CLEAR * size * np.linalg.norm(deviation[:3, :3])
    for axis in (_towards(torque * clear, random), *np.eye(3)):
        turn = np.zeros((4, 4))
        turn[:3, :3] = angle * np.einsum("a,aij->ij", axis, turns)
        yield "turn", turn


def _one(gradient: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Return 1 at an entry whose derivative is large and stands out of the noise, and 0 elsewhere."""
    stands_out = np.abs(gradient) / np.maximum(deviation, 1e-6 * np.abs(gradient).max() + 1e-300)
    one = np.zeros(gradient.size)
    one[int(np.argmax(np.abs(gradient) * np.minimum(stands_out, ENOUGH)))] = 1.0
    return one.reshape(gradient.shape)


def _scaled(field: np.ndarray) -> np.ndarray:
    """Return a field with the largest entry 1; zeros stay."""
    return field / max(float(np.abs(field).max()), 1e-300)


def _length(p: Parameter, values: np.ndarray, reach: float, pixels: int) -> float:
    """Return the unit of what moves, world units."""
    size = np.inf
    if POSITIONS in p.uses and values.ndim == 2:
        size = float(np.ptp(values, axis=0).max())
    elif SHAPE_POSE in p.uses and values.shape == (4, 4):
        size = 2.0 * float(np.linalg.norm(values[:3, :3], axis=0).max())
    return min(PIXELS * reach / pixels, OF_SIZE * size)


def _welded(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return a field (N, 3) with its mean at all points of one position: split vertices move together."""
    _places, which, count = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, which.reshape(-1), field)
    return (total / count[:, None])[which.reshape(-1)]


def _spacing(points: np.ndarray) -> float:
    """Return the median distance of points (N, 3) from their nearest neighbours at other places."""
    places = np.unique(points, axis=0)
    if len(places) < 2:
        return np.inf
    return float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))


def _of_values(values: np.ndarray, bounds: tuple[float, float]) -> float:
    largest = float(np.abs(values).max(initial=0.0))
    width = bounds[1] - bounds[0] if np.isfinite(bounds).all() else 1.0
    return OF_VALUES * (largest if largest > 0.0 else width)


def _towards(pull: np.ndarray, random: np.random.Generator, axes: tuple[int, ...] = (1, 1, 1)) -> np.ndarray:
    """Return a random unit vector with some of its axes, nearer to a pull if that is not zero."""
    d = random.normal(size=3) * np.array(axes, float)
    d /= np.linalg.norm(d)
    pull = pull * np.array(axes, float)
    if np.any(pull):
        d = pull / np.linalg.norm(pull) + BESIDE * d
    return d / np.linalg.norm(d)


def _field(values: np.ndarray, points: bool, random: np.random.Generator) -> np.ndarray:
    """Return a random field with the largest entry 1: smooth over points, or over the axes of a picture."""
    if points:
        places, channels = values, 3
    elif values.ndim > 1:
        axes = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in values.shape[:-1]), indexing="ij")
        places, channels = np.stack([a.reshape(-1) for a in axes], axis=1), values.shape[-1]
    else:
        drawn = random.normal(size=values.shape)
        return _scaled(drawn)
    extent = max(float(np.ptp(places, axis=0).max(initial=0.0)), 1e-30)
    waves = random.normal(size=(WAVES, places.shape[1])) * RADIANS / extent
    heights = random.normal(size=(WAVES, channels))
    field = np.cos((places - places.mean(axis=0)) @ waves.T + random.uniform(0.0, 2.0 * np.pi, WAVES)) @ heights
    return _scaled(field).reshape(values.shape)


def _inside(d: Direction, values: np.ndarray, bounds: tuple[float, float]) -> Direction:
    """Return the direction with differences that stay within the parameter's range."""
    low, high = bounds
    t = d.tangent
    near_low, near_high = values - np.abs(t) < low, values + np.abs(t) > high
    if not (near_low | near_high).any():
        return d
    inward = np.where(near_low, np.abs(t), np.where(near_high, -np.abs(t), t))
    room = np.where(inward > 0.0, high - values, values - low)
    used = np.abs(inward) > 0.0
    share = float(np.min(room[used] / (2.0 * np.abs(inward[used])), initial=1.0))
    return Direction(d.parameter, f"{d.what}, inwards", share * inward, ONE_SIDED)

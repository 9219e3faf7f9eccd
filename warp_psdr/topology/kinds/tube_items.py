"""Where segments can touch curves with a radius: the items of ``tube_points.py`` of the kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.silhouette.tube_points import TubeItems
from warp_psdr.scene.kinds.bsplinecurve import coefficients
from warp_psdr.scene.kinds.curve import Curves, world_points
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Parts of a segment (``PART_*`` of the kernels).
SIDE, START, END, CREASE = range(4)
#: Points of a segment by which its length is measured.
POINTS = 5
#: Sine of the turn at a joint below which its cones meet in no crease.
STRAIGHT = 1.0e-5


def curve_shapes(scene: Scene) -> list[int]:
    """Return the numbers of the shapes that are curves."""
    return [i for i in scene.builder.primitives if isinstance(scene.geometry(i), Curves)]


def on_curves(scene: Scene, carriers: frozenset[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return those of some (shape, texture) that are on curves."""
    curves = set(curve_shapes(scene))
    return frozenset(carrier for carrier in carriers if carrier[0] in curves)


def curves_at(scene: Scene, shape: int) -> Curves:
    """Return the curves of a shape that is some."""
    curves = scene.geometry(shape)
    assert isinstance(curves, Curves)
    return curves


def points_at(scene: Scene, shape: int) -> np.ndarray:
    """Return the control points (P, 4) of curves in the device's coordinates."""
    return world_points(scene, shape)


def follows(firsts: np.ndarray) -> np.ndarray:
    """Return a mask (S,) of the segments on which the next one of their curve follows."""
    found = np.zeros(len(firsts), bool)
    found[:-1] = np.diff(firsts) == 1
    return found


def items_of(points: np.ndarray, firsts: np.ndarray, cubic: bool, creases: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers (N,) of the items of curves, and their lengths.

    Args:
        points: (P, 4) control points in the world.
        firsts: (S,) first control point of each segment.
        cubic: B-splines; else straight segments.
        creases: with those at joints.
    """
    segments = np.arange(len(firsts))
    v = np.linspace(0.0, 1.0, POINTS if cubic else 2)
    if cubic:
        a = coefficients(points, firsts)
        places = a[0] + v[:, None, None] * (a[1] + v[:, None, None] * (a[2] + v[:, None, None] * a[3]))
    else:
        places = np.stack([points[firsts], points[firsts + 1]])
    length = np.linalg.norm(np.diff(places[..., :3], axis=0), axis=2).sum(axis=0)
    around = 2.0 * np.pi * np.abs(places[[0, -1], :, 3])
    goes_on = follows(firsts)
    numbers, sizes = [4 * segments + SIDE], [2.0 * length * (around.max(axis=0) > 0.0)]
    # Tubes end where a curve does; of the spheres between straight segments each is the start of one.
    starts = ~np.roll(goes_on, 1) if cubic else np.ones(len(firsts), bool)
    for part, mask, size in ((START, starts, around[0]), (END, ~goes_on, around[1])):
        numbers.append(4 * segments[mask] + part)
        sizes.append(size[mask])
    if creases and not cubic:
        along = np.diff(places[..., :3], axis=0)[0]
        bent = goes_on.copy()
        crossed = np.linalg.norm(np.cross(along[:-1], along[1:]), axis=1)
        turned = crossed > STRAIGHT * length[:-1] * length[1:]
        bent[:-1] &= turned | ((along[:-1] * along[1:]).sum(axis=1) < 0.0)
        numbers.append(4 * segments[bent] + CREASE)
        sizes.append(around[1][bent])
    return np.concatenate(numbers), np.concatenate(sizes)


def tube_items(scene: Scene, shapes: list[int], creases: bool) -> TubeItems | None:
    """Return the items of some curves; None: there are none, since all radii are 0.

    Args:
        scene: the scene.
        shapes: their numbers.
        creases: with the creases at joints of straight segments.
    """
    found = kept(scene, ("tube items", tuple(shapes), creases), lambda: _tube_items(scene, shapes, creases))
    if found is None:
        return None
    own = TubeItems()
    own.items, own.cdf, own.share = found.items, found.cdf, found.share
    return own


def _tube_items(scene: Scene, shapes: list[int], creases: bool) -> TubeItems | None:
    pairs, sizes = [], []
    for shape in shapes:
        curves = scene.geometry(shape)
        assert isinstance(curves, Curves)
        numbers, lengths = items_of(world_points(scene, shape), curves.firsts, curves.cubic, creases)
        record = scene.face_count + scene.builder.primitives.index(shape)
        pairs.append(np.stack([np.full(len(numbers), record), numbers], axis=1))
        sizes.append(lengths)
    items, size = np.concatenate(pairs).astype(np.int32), np.concatenate(sizes)
    items, size = items[size > 0.0], size[size > 0.0]
    if not len(items):
        return None
    found = TubeItems()
    found.items = wp.array(items, dtype=wp.vec2i, device=scene.device)
    cdf = np.concatenate([[0.0], np.cumsum(size) / size.sum()])
    cdf[-1] = 1.0
    found.cdf = wp.array(cdf, dtype=wp.float64, device=scene.device)
    found.share = 1.0
    return found

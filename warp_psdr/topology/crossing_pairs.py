"""Curves of intersection between two exact shapes: chords, as those of ``crossing_curves.py``.

Small triangles whose corners lie on one shape, and which are projected onto it, take the place of those of a mesh.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.shapes.primitives import sphere
from warp_psdr.topology.crossing_curves import LEAST, RIM_POINTS, Chords, cut, cut_grid
from warp_psdr.topology.crossing_fields import FINE, Field, across_axis, exact_field
from warp_psdr.topology.kinds.exact_shapes import (
    TOUCHING,
    crossable_shapes,
    crossed_faces,
    pose,
    rim_points,
    runs_through,
)
from warp_psdr.topology.kinds.grid_silhouettes import grid_shapes
from warp_psdr.topology.kinds.joined_rims import joined_rims
from warp_psdr.topology.kinds.tube_items import curve_shapes
from warp_psdr.topology.tube_crossings import cut_tubes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Segments around and along the cylinder, and around the sphere, that are projected.
AROUND, ALONG, SPHERE = 96, 16, 64


def _on_sphere(q: np.ndarray) -> np.ndarray:
    return q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-300)


def _on_cylinder(q: np.ndarray) -> np.ndarray:
    r = np.maximum(across_axis(q), 1e-300)[..., None]
    return np.concatenate([q[..., :2] / r, q[..., 2:]], axis=-1)


def _on_disk(q: np.ndarray) -> np.ndarray:
    return q * [1.0, 1.0, 0.0]


def _grid(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return triangles (M, 3, 2) that cover a grid of two coordinates."""
    p, q, r, s = (
        np.stack(np.broadcast_arrays(x[:, None], y[None]), axis=-1).reshape(-1, 2)
        for x, y in ((a[:-1], b[:-1]), (a[1:], b[:-1]), (a[1:], b[1:]), (a[:-1], b[1:]))
    )
    return np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)])


def _covering(kind: str) -> np.ndarray:
    """Return triangles (M, 3, 3) whose corners lie on a kind, and which cover it once projected."""
    if kind == "sphere":
        made = sphere(SPHERE)
        return made.vertices[made.faces]
    if kind == "disk":
        square = _grid(np.array([-1.0, 1.0]), np.array([-1.0, 1.0]))
        return np.concatenate([square, np.zeros((len(square), 3, 1))], axis=2)
    t = _grid(np.linspace(0.0, 2.0 * np.pi, AROUND + 1), np.linspace(0.0, 1.0, ALONG + 1))
    return np.stack([np.cos(t[..., 0]), np.sin(t[..., 0]), t[..., 1]], axis=2)


PROJECTED = {"sphere": _on_sphere, "cylinder": _on_cylinder, "disk": _on_disk}


def exact_pairs(scene: Scene, shapes: frozenset[int] | None) -> Iterator[tuple[int, int]]:
    """Yield pairs of exact shapes that run through each other or may touch, one of them in ``shapes`` (None: any).

    Of a cylinder that stands on a disk the disk is the first, since the other one ends there. What closes a cylinder,
    and what that disk lies on, is left out.
    """
    exact, joined = crossable_shapes(scene), joined_rims(scene)
    closes = {frozenset(pair) for pair in (*(cap[:2] for cap in joined.caps), *joined.buried)}
    stands = {(i, j) for i, _end, j in joined.stands}
    for n, i in enumerate(exact):
        for j in exact[n + 1 :]:
            if (shapes is None or i in shapes or j in shapes) and {i, j} not in closes and runs_through(scene, i, j):
                yield (j, i) if (i, j) in stands else (i, j)


def cut_pair(scene: Scene, i: int, j: int) -> Chords:
    """Return the chords of the curves of two exact shapes; ``faces`` holds the number of the first one's record."""
    field, other = exact_field(scene, j), exact_field(scene, i)
    kind = scene.geometry(i).name
    inverse, theirs = np.linalg.inv(other.linear), np.linalg.inv(field.linear)
    stretch = float(np.linalg.norm(theirs, 2))

    def local(p: np.ndarray) -> np.ndarray:
        return (p - field.origin) @ theirs.T

    def own(p: np.ndarray) -> np.ndarray:
        return (p - other.origin) @ inverse.T

    def project(p: np.ndarray) -> np.ndarray:
        return PROJECTED[kind](own(p)) @ other.linear.T + other.origin

    def ends(p: np.ndarray, _rows: np.ndarray) -> np.ndarray:
        found = [f.ends(q) for f, q in ((field, local(p)), (other, own(p))) if f.ends is not None]
        return np.min(found, axis=0) if found else np.ones(p.shape[:-1])

    # In the world, and short for the radii of both.
    finest = FINE * min(_least_radius(scene, k) for k in (i, j))
    made = Field(
        phi=lambda p, _rows: field.phi(local(p)),
        near=lambda p, r, _rows: field.near(local(p), stretch * r),
        ends=ends,
        sides=lambda t: np.full(len(t), finest),
        linear=np.eye(3),
        origin=np.zeros(3),
    )
    corners = _covering(kind) @ other.linear.T + other.origin
    record = scene.face_count + scene.builder.primitives.index(i)
    return cut(made, corners, np.full(len(corners), record), project)


def _least_radius(scene: Scene, shape: int) -> float:
    linear, _origin = pose(scene, shape)
    bent = linear if scene.geometry(shape).name == "sphere" else linear[:, :2]
    return float(np.linalg.svd(bent, compute_uv=False).min())


def touching_pair(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return two exact shapes that touch along a line, one of them among ``shapes`` (None: any)."""
    for i, j in exact_pairs(scene, shapes):
        chords = cut_pair(scene, i, j)
        if not len(chords.faces) or _rim_runs_along(scene, i, j) or _rim_runs_along(scene, j, i):
            return i, j
        a, b = (_slopes(exact_field(scene, k), chords.points.mean(axis=1)) for k in (i, j))
        if np.linalg.norm(np.cross(a, b), axis=1).min() < LEAST:
            return i, j
    return None


def _slopes(field: Field, points: np.ndarray) -> np.ndarray:
    """Return unit normals (N, 3), in the world, at points (N, 3) of a surface."""
    inverse, step = np.linalg.inv(field.linear), 1.0e-6
    q = (points - field.origin) @ inverse.T
    n = np.stack([field.phi(q + step * e) - field.phi(q - step * e) for e in np.eye(3)], axis=1) @ inverse
    return n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]


def _rim_runs_along(scene: Scene, i: int, j: int) -> bool:
    """Whether a rim of an exact shape runs along another one, on which it does not stand."""
    kinds = [scene.geometry(k).name for k in (i, j)]
    if kinds[0] == "sphere":
        return False
    ends = {0} if kinds[0] == "disk" else {0, 1} - joined_rims(scene).standing(i, j)
    (linear, origin), (other, place) = pose(scene, i), pose(scene, j)
    for end in ends:
        q = (rim_points(end, RIM_POINTS) @ linear.T + origin - place) @ np.linalg.inv(other).T
        if kinds[1] == "sphere":
            on = np.abs(np.linalg.norm(q, axis=1) - 1.0) < TOUCHING
        elif kinds[1] == "disk":
            on = (np.abs(q[:, 2]) < TOUCHING) & (across_axis(q) < 1.0 + TOUCHING)
        else:
            on = (np.abs(across_axis(q) - 1.0) < TOUCHING) & (np.abs(q[:, 2] - 0.5) < 0.5 + TOUCHING)
        if (on & np.roll(on, 1)).any():
            return True
    return False


def crossed_light(scene: Scene) -> tuple[int, int] | None:
    """Return a shape without triangles and another shape that run through each other and one of which shines."""
    shines = [shape.emitter is not None for shape in scene.description.shapes]
    for i, j in [*exact_pairs(scene, None), *(cap[:2] for cap in joined_rims(scene).caps)]:
        if shines[i] or shines[j]:
            return (j, i) if shines[i] else (i, j)
    hit = [(i, crossed_faces(scene, i, None)) for i in crossable_shapes(scene)]
    hit += [(i, cut_grid(scene, i, None).faces) for i in grid_shapes(scene)]
    hit += [(i, cut_tubes(scene, i, None)[0].faces) for i in curve_shapes(scene)]
    for i, faces in hit:
        for j in np.unique(scene.builder.face_shape[faces]):
            if shines[i] or shines[j]:
                return (int(j), i) if shines[i] else (i, int(j))
    return None

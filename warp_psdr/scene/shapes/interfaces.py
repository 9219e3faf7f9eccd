"""Surfaces of glass, or that are not there (``null``), that lie on others: the bottom of a cube of smoke on a floor.

Rounding chooses which of two surfaces in one place a ray meets first, and behind the one that lets light pass it starts
beyond the other: light comes through the floor. So the vertices of that surface move off the other one, to its
inner side and by little more than the ray offset; then the order is that of the sides.

Derivation: ``docs/theory/numerics.md#interfaces-on-surfaces``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from warp_psdr.kernels.constants import LOBE_BEHIND, LOBE_DELTA_TRANSMISSION
from warp_psdr.kernels.step import LEAVE
from warp_psdr.scene.materials.bsdfs import model_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from warp_psdr.scene.description import ShapeDescription
    from warp_psdr.scene.scene import Scene

#: Lobes of light that goes on behind a surface in another direction.
BEHIND = {LOBE_BEHIND, LOBE_DELTA_TRANSMISSION}
#: Ray offsets within which two parallel surfaces are one place, and by how many they lie apart afterwards.
COINCIDENT, APART = 2.0, 3.0
#: Rounds that look for what a surface was moved onto: interfaces in interfaces, all of which stand on one floor.
ROUNDS = 8
#: Distance, over a shape's size, by which its vertices move at most.
LARGEST = 1.0e-2
#: Triangles times triangles whose boxes are compared at a time.
PART = 1 << 20


class Overlaps(NamedTuple):
    """Triangles of a shape that lie on others.

    Attributes:
        own, others: (K,) numbers of the triangles.
        normals: (K, 3) unit, of its own.
        steps: (K,) ray offsets at the two, the larger one.
    """

    own: np.ndarray
    others: np.ndarray
    normals: np.ndarray
    steps: np.ndarray


def let_through(scene: Scene) -> list[int]:
    """Return the numbers of the meshes of glass, and of those that are not there."""
    shapes = scene.description.shapes
    return [i for i, s in enumerate(shapes) if (_absent(s) or _glass(s)) and s.geometry is None and len(s.faces)]


def _absent(shape: ShapeDescription) -> bool:
    return shape.bsdf.model == "null"


def _glass(shape: ShapeDescription) -> bool:
    """Whether both sides send light on behind the surface, turned."""
    models = [model_of(side) for side in shape.bsdf.sides]
    return all(BEHIND.intersection(model.lobes) and not model.has_null for model in models)


def part(scene: Scene, passed: list[int], moved: set[int] | None = None) -> dict[int, set[int]]:
    """Move the vertices of surfaces that let light pass off those that they lie on.

    What is not there moves off everything, glass off what no light passes: where two glasses touch, no order is meant.

    Args:
        scene: whose values change.
        passed: ``let_through``.
        moved: numbers of the shapes that have moved since the last call; None: all.

    Returns:
        Numbers of the shapes whose vertices were moved, and of those that they lay on.
    """
    found: dict[int, set[int]] = {}
    solid = ~np.isin(np.arange(len(scene.description.shapes)), passed)
    # What lies in another one ends up further inside.
    for shape in sorted(passed, key=lambda i: -scene.boxes.size[i]):
        met = np.ones_like(solid) if _absent(scene.description.shapes[shape]) else solid
        for _round in range(ROUNDS):
            points = scene.points.astype(np.float64)
            overlaps = _overlaps(scene, points, shape, met, moved)
            steps = APART * overlaps.steps
            if not len(steps) or steps.max() > LARGEST * scene.boxes.size[shape]:
                break
            found.setdefault(shape, set()).update(scene.builder.face_shape[overlaps.others].tolist())
            _move(scene, points, shape, overlaps)
    return found


def notes(scene: Scene, parted: dict[int, set[int]]) -> list[str]:
    """Return what to tell of shapes that ``part`` has moved."""
    named = scene.description.shapes
    return [
        f"'{named[i].path}' is {'not there' if _absent(named[i]) else 'of glass'} ('{named[i].bsdf.model}') and lies "
        f"exactly on {', '.join(repr(named[k].path) for k in sorted(on))}; its vertices there are moved inwards, by "
        f"{APART * scene.ray_epsilon:.1g} or less, so that rays meet one before the other"
        for i, on in parted.items()
    ]


def _ray_offsets(scene: Scene, corners: np.ndarray) -> np.ndarray:
    """Return ``step_off_triangle`` of triangles (N, 3, 3)."""
    if scene.steps.scene <= 0.0:
        return np.full(len(corners), scene.ray_epsilon)
    return LEAVE * np.abs(corners).max(axis=(1, 2), initial=0.0)


def _overlaps(scene: Scene, points: np.ndarray, shape: int, met: np.ndarray, moved: set[int] | None) -> Overlaps:
    """Return where a shape's triangles lie on those of ``met`` ones; ``moved``: where either has moved."""
    indices, of_face = scene.builder.indices, scene.builder.face_shape
    record = scene.builder.shapes[shape]
    own = np.arange(record.first_face, record.first_face + record.face_count)
    others = met[of_face] & (of_face != shape)
    if moved is not None and shape not in moved:
        others &= np.isin(of_face, sorted(moved))
    # Shapes whose boxes do not meet need no look at their triangles.
    low, high, _size = scene.boxes
    reach = COINCIDENT * max(scene.ray_epsilon, float(LEAVE * np.abs(points).max(initial=0.0)))
    near = (low <= high[shape] + reach).all(axis=1) & (high >= low[shape] - reach).all(axis=1)
    numbers = np.flatnonzero(others & near[of_face])
    own, numbers = _within(points, indices, own, numbers, reach)
    a, b = points[indices[own]], points[indices[numbers]]
    steps_a, steps_b = _ray_offsets(scene, a), _ray_offsets(scene, b)
    pairs = np.concatenate([np.zeros((0, 2), np.int64), *_meeting(a, b, steps_a, steps_b)])
    i, j = pairs.T
    steps = np.maximum(steps_a[i], steps_b[j])
    parallel = _lies_in(b[j], a[i], COINCIDENT * steps) | _lies_in(a[i], b[j], COINCIDENT * steps)
    i, j, steps = i[parallel], j[parallel], steps[parallel]
    covers = _cover(a[i], b[j], COINCIDENT * steps)
    i, j, steps = i[covers], j[covers], steps[covers]
    return Overlaps(own[i], numbers[j], record.orientation * _normals(a[i]), steps)


def _within(
    points: np.ndarray, indices: np.ndarray, a: np.ndarray, b: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return those of two sets of triangles that come within reach of the box around the other set."""
    for _both in range(2):
        if len(a) and len(b):
            around, corners = points[indices[a]].reshape(-1, 3), points[indices[b]]
            low, high = around.min(axis=0) - reach, around.max(axis=0) + reach
            b = b[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)]
        a, b = b, a
    return a, b


def _meeting(a: np.ndarray, b: np.ndarray, steps_a: np.ndarray, steps_b: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pairs (N, 2) of triangles whose boxes come within the offset at either of each other."""
    reach_a, reach_b = COINCIDENT * steps_a[:, None], COINCIDENT * steps_b[:, None]
    low_a, high_a = a.min(axis=1) - reach_a, a.max(axis=1) + reach_a
    low_b, high_b = b.min(axis=1) - reach_b, b.max(axis=1) + reach_b
    rows = max(PART // max(len(b), 1), 1)
    for first in range(0, len(a), rows):
        some = slice(first, first + rows)
        meets = np.ones((len(a[some]), len(b)), bool)
        for axis in range(3):
            meets &= low_a[some, None, axis] <= high_b[None, :, axis]
            meets &= high_a[some, None, axis] >= low_b[None, :, axis]
        yield np.argwhere(meets) + np.array([first, 0])


def _normals(corners: np.ndarray) -> np.ndarray:
    """Return the unit normals of triangles (N, 3, 3); zero where there is none."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)


def _lies_in(corners: np.ndarray, others: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Return which triangles lie in the planes of others, one each."""
    n = _normals(others)
    height = np.einsum("ijk,ik->ij", corners - others[:, :1], n)
    some = np.linalg.norm(n, axis=1) > 0.0
    some[some] = np.abs(height[some]).max(axis=1) <= tolerance[some]
    return some


def _cover(a: np.ndarray, b: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Return which triangles overlap by more than the tolerance, seen along the normals of ``a``."""
    n = _normals(a)
    overlap = np.linalg.norm(n, axis=1) > 0.0
    for corners in (a, b):
        for k in range(3):
            across = np.cross(n, corners[:, (k + 1) % 3] - corners[:, k])
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
            s, t = (np.einsum("ijk,ik->ij", c, across) for c in (a, b))
            common = np.minimum(s.max(axis=1), t.max(axis=1)) - np.maximum(s.min(axis=1), t.min(axis=1))
            overlap &= common > tolerance
    return overlap


def _move(scene: Scene, points: np.ndarray, shape: int, overlaps: Overlaps) -> None:
    """Move the corners of overlapping triangles inwards, along all of their normals; one place stays one place."""
    record = scene.builder.shapes[shape]
    first, count = record.first_vertex, record.vertex_count
    _places, place = np.unique(points[first : first + count], axis=0, return_inverse=True)
    place = place.reshape(-1)
    corners = place[scene.builder.indices[overlaps.own] - first]
    square, wanted = np.zeros((place.max() + 1, 3, 3)), np.zeros((place.max() + 1, 3))
    for k in range(3):
        np.add.at(square, corners[:, k], np.einsum("ij,ik->ijk", overlaps.normals, overlaps.normals))
        np.add.at(wanted, corners[:, k], -APART * overlaps.steps[:, None] * overlaps.normals)
    shift = np.einsum("ijk,ik->ij", np.linalg.pinv(square, rcond=1e-3, hermitian=True), wanted)
    stretch = scene.positions + 3 * first
    values = (points[first : first + count] + shift[place]).astype(np.float32)
    scene.values[stretch : stretch + 3 * count].assign(values.reshape(-1))

"""Surfaces that touch, and which of their motions have a derivative.

Where shapes touch, two kinds of motion have a derivative: motions along the contact, and motions that keep together
what touches. Along the contact means n . v = 0 where an edge lies inside of a face, and v parallel to t where it lies
on another edge. Other motions have two one-sided derivatives.

Derivation: ``docs/theory/boundary.md#motions-at-contacts``.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.boundary.pairs import make_pair_kernels
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.faces import face_edges
from warp_psdr.topology.kinds.joined_rims import joined_rims
from warp_psdr.topology.kinds.joined_rims import warn as warn_of_rims
from warp_psdr.topology.shared_edges import goes_on

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Largest sine of the angle between an edge and a face that it touches along more than a point.
STEEPEST = 1.0e-3
#: Height in ray epsilons above a face that still lies in it: rounding of float32 vertices.
ROUNDING_EPSILONS = 0.2
#: Relative velocity across a contact, as a fraction of the largest velocity, that counts as zero: rounding of tangents.
RESTING = 1.0e-4
#: Names of pairs of shapes that a message lists.
LISTED = 3


@dataclass(frozen=True, eq=False)
class Contacts:
    """Pieces of edges that lie on triangles of other shapes, K of them.

    Attributes:
        sides: (K, 2) the triangle and the corner where its side, the edge, starts.
        faces: (K,) the triangle that it lies on.
        spans: (K, 2) the part of the edge, as fractions of the way along it.
        shapes: (K, 2) numbers of the shapes of edge and triangle.
    """

    sides: np.ndarray
    faces: np.ndarray
    spans: np.ndarray
    shapes: np.ndarray


def contacts(scene: Scene) -> Contacts:
    """Return where different shapes of a scene touch along more than a point; kept until a vertex moves."""
    adjacency = scene_adjacency(scene)
    kept = getattr(scene, "_contacts", None)
    if kept is not None and kept[0] is adjacency:
        return kept[1]
    points = scene.points
    triangles = scene.builder.indices
    tolerance = _gap(scene)
    numbers = _near_others(scene, tolerance)
    pairs, spans = _touching(scene, points[triangles[numbers]], scene.builder.face_shape[numbers], tolerance)
    face, corner, other = numbers[pairs[:, 0]], pairs[:, 1], numbers[pairs[:, 2]]
    shapes = np.stack([scene.builder.face_shape[face], scene.builder.face_shape[other]], axis=1)
    found = Contacts(np.stack([face, corner], axis=1), other, spans, shapes)
    scene._contacts = (adjacency, found)  # type: ignore[attr-defined]
    return found


def _gap(scene: Scene) -> float:
    """Distance, world units, up to which shapes touch: where scales are mixed, of the smallest of them."""
    return float(scene.steps.behind.min(initial=np.inf))


def touching(scene: Scene, shapes: frozenset[int]) -> str:
    """Name the shapes that touch one that moves; empty: there are none."""
    found = np.concatenate([contacts(scene).shapes, np.array(joined_rims(scene).pairs, np.int64).reshape(-1, 2)])
    found = np.unique(np.sort(found[np.isin(found, sorted(shapes)).any(axis=1)], axis=1), axis=0)
    return _names(scene, found) if len(found) else ""


def describe(scene: Scene, shapes: frozenset[int]) -> list[tuple[str, str, str]]:
    """Return the plan's line on the shapes that touch one that moves; none where nothing does."""
    names = touching(scene, shapes)
    reason = f"{names} touch; moving them apart or into each other has one-sided derivatives only"
    return [("contacts", "derivatives along them", reason)] if names else []


def warn(scene: Scene, tangents: np.ndarray) -> None:
    """Warn (RuntimeWarning) about motions across contacts.

    No error, since reverse mode returns the same numbers without knowing the motion, and a set of vertices often moves
    both along and across.

    Args:
        scene: the scene.
        tangents: flat, laid out like the scene's values: velocities of all vertices.
    """
    velocity = tangents[scene.positions : scene.positions + 3 * scene.vertex_count].reshape(-1, 3).astype(np.float64)
    warn_of_rims(scene, tangents)
    rest = RESTING * float(np.linalg.norm(velocity, axis=1).max(initial=0.0))
    if rest == 0.0:
        return
    pairs = _crossed(scene, velocity, rest)
    neither = "the image has two one-sided derivatives there, and what is returned at the contact is neither of them"
    if len(pairs):
        gap = _gap(scene)
        warnings.warn(
            f"{_names(scene, pairs)} touch, and the tangent moves them apart or into each other: {neither}. Move them "
            f"together or along the contact, or leave a gap, or let one reach into the other, by more than {gap:.2g}",
            RuntimeWarning,
            stacklevel=4,
        )
    torn = _torn(scene, velocity, rest)
    if torn >= 0:
        warnings.warn(
            f"the tangent tears the mesh {scene.description.shapes[torn].path!r} apart at vertices of one position: "
            f"{neither}. Give them the same velocity, or merge them",
            RuntimeWarning,
            stacklevel=4,
        )


def _names(scene: Scene, pairs: np.ndarray) -> str:
    names = [" and ".join(repr(scene.description.shapes[i].path) for i in pair) for pair in pairs[:LISTED]]
    return ", ".join(names) + (f" and {len(pairs) - LISTED} more pairs of shapes" if len(pairs) > LISTED else "")


def _near_others(scene: Scene, tolerance: float) -> np.ndarray:
    """Return the numbers of the triangles whose box meets the box of another shape."""
    if not scene.face_count:
        return np.zeros(0, np.int64)
    box, size = scene.boxes, 2.0 * tolerance
    meets = np.all(box.low[:, None] <= box.high[None] + size, axis=2)
    use = np.zeros(scene.face_count, bool)
    x = np.ascontiguousarray(scene.points.T)
    for a, b in np.argwhere(meets & meets.T):
        if a == b:
            continue
        record = scene.builder.shapes[a]
        own = np.arange(record.first_face, record.first_face + record.face_count)
        # First along the axis that tells most triangles apart.
        shared = np.minimum(box.high[a], box.high[b]) - np.maximum(box.low[a], box.low[b])
        for axis in np.argsort(shared / np.maximum(box.high[a] - box.low[a], 1e-300)):
            corners = [x[axis].take(corner) for corner in scene.builder.indices.take(own, axis=0).T]
            near = np.minimum.reduce(corners) <= box.high[b, axis] + size
            own = own[near & (np.maximum.reduce(corners) >= box.low[b, axis] - size)]
        use[own] = True
    return np.flatnonzero(use)


def _touching(scene: Scene, corners: np.ndarray, shape: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (triangle, corner, other triangle) and the part of the edge behind that corner, in ascending order."""
    if not len(corners):
        return np.zeros((0, 3), np.int64), np.zeros((0, 2))
    device = str(scene.device)
    bvh = wp.Bvh(
        wp.array(corners.min(axis=1), dtype=wp.vec3, device=device),
        wp.array(corners.max(axis=1), dtype=wp.vec3, device=device),
    )
    inputs = [
        bvh.id,
        wp.array(np.ascontiguousarray(corners), dtype=wp.vec3, device=device, ndim=2),
        wp.array(shape.astype(np.int32), dtype=wp.int32, device=device),
        tolerance,
        scene.steps.scene or ROUNDING_EPSILONS * scene.ray_epsilon,
        STEEPEST,
    ]
    _crossing, touching = make_pair_kernels(scene.accelerator.width)
    room = 1024
    while True:
        count = wp.zeros(1, dtype=wp.int32, device=device)
        pairs = wp.zeros(room, dtype=wp.vec3i, device=device)
        spans = wp.zeros(room, dtype=wp.vec2, device=device)
        launch(touching, dim=3 * len(corners), inputs=inputs, outputs=[count, pairs, spans], device=device)
        n = int(count.numpy()[0])
        if n <= room:
            break
        room = n
    found = pairs.numpy()[:n].astype(np.int64)
    order = np.lexsort(found.T[::-1])
    return found[order], spans.numpy()[:n][order].astype(np.float64)


def _crossed(scene: Scene, velocity: np.ndarray, rest: float) -> np.ndarray:
    """Return the pairs of shapes that move across a contact, (P, 2)."""
    found = contacts(scene)
    if not len(found.faces):
        return found.shapes
    corners, x = _pieces(scene, found)
    of_face = velocity[scene.builder.indices[found.faces]]
    ends, of_edge = (a[_ends(scene, found)] for a in (scene.points.astype(np.float64), velocity))
    tangent = ends[:, 1] - ends[:, 0]
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    square = (normal**2).sum(axis=1)
    v = (1.0 - found.spans)[..., None] * of_edge[:, :1] + found.spans[..., None] * of_edge[:, 1:]
    for k in range(3):
        a, b = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        weight = (np.cross(b - a, (x - a[:, None]).transpose(1, 0, 2)).transpose(1, 0, 2) * normal[:, None]).sum(axis=2)
        v = v - (weight / square[:, None])[..., None] * of_face[:, None, k]
    across = np.abs((v * normal[:, None]).sum(axis=2)) / np.sqrt(square)[:, None]
    sideways = np.linalg.norm(v - (v * tangent[:, None]).sum(axis=2)[..., None] * tangent[:, None], axis=2)
    across, sideways = across.max(axis=1), sideways.max(axis=1)
    if max(across.max(), sideways.max()) <= rest:  # nothing that touches moves
        return found.shapes[:0]
    adjacency = scene_adjacency(scene)
    own = face_edges(scene, adjacency)[found.sides[:, 0], (found.sides[:, 1] + 2) % 3]
    # A side inside of a plane is no edge; where something stands on that plane, it is the other's sides that touch.
    inside = goes_on(scene, adjacency, own, found.sides[:, 0])
    moved = np.where(inside, 0.0, np.where(_on_rim(scene, corners, found.faces, x), sideways, across))
    return np.unique(np.sort(found.shapes[moved > rest], axis=1), axis=0)


def along_sides(scene: Scene) -> np.ndarray:
    """Return pairs (P, 2) of sides of triangles of different shapes that run along each other: 3 triangle + corner."""
    found = contacts(scene)
    if not len(found.faces):
        return np.zeros((0, 2), np.int64)
    piece, opposite = np.nonzero(_along(scene, *_pieces(scene, found)))
    own = 3 * found.sides[piece, 0] + found.sides[piece, 1]
    return np.stack([own, 3 * found.faces[piece] + (opposite + 1) % 3], axis=1)


def _ends(scene: Scene, found: Contacts) -> np.ndarray:
    """Return the global vertices of contacts' edges, (K, 2)."""
    face, corner = found.sides.T
    return np.stack([scene.builder.indices[face, corner], scene.builder.indices[face, (corner + 1) % 3]], axis=1)


def _pieces(scene: Scene, found: Contacts) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of contacts' triangles, (K, 3, 3), and where the pieces on them start and end, (K, 2, 3)."""
    points = scene.points.astype(np.float64)
    ends = points[_ends(scene, found)]
    x = (1.0 - found.spans)[..., None] * ends[:, :1] + found.spans[..., None] * ends[:, 1:]
    return points[scene.builder.indices[found.faces]], x


def _along(scene: Scene, corners: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Whether pieces of triangles' planes lie on the triangle's side opposite of each corner, (K, 3)."""
    result = np.zeros((len(x), 3), bool)
    for k in range(3):
        a, b = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-300)[:, None]
        distance = np.linalg.norm(np.cross(x - a[:, None], along[:, None]), axis=2).max(axis=1)
        result[:, k] = distance <= 2.0 * _gap(scene)
    return result


def _on_rim(scene: Scene, corners: np.ndarray, faces: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Whether pieces (K, 2, 3) of triangles' planes lie on an edge of the triangle where its surface ends or turns."""
    adjacency = scene_adjacency(scene)
    edges = face_edges(scene, adjacency)[faces]
    of = scene.builder.face_shape[adjacency.faces]
    other = np.minimum(adjacency.first[:-1] + 1, len(of) - 1)
    ends = (adjacency.wedge > 0.0) | ((adjacency.count == 2) & (of[adjacency.first[:-1]] != of[other]))
    turns = (edges >= 0) & ends[edges] & ~goes_on(scene, adjacency, edges, faces[:, None])
    return (turns & _along(scene, corners, x)).any(axis=1)


def _torn(scene: Scene, velocity: np.ndarray, rest: float) -> int:
    """Return a shape whose vertices of one position move apart at an edge, -1: there is none."""
    edges = scene_adjacency(scene)
    split = np.flatnonzero((edges.ends != edges.twins).any(axis=1) & (edges.count == 2))
    apart = velocity[edges.ends[split]] - velocity[edges.twins[split]]
    tangent = edges.points[split, 1] - edges.points[split, 0]
    tangent = tangent / np.maximum(edges.length[split], 1e-300)[:, None]
    sideways = np.linalg.norm(apart - (apart * tangent[:, None]).sum(axis=2)[..., None] * tangent[:, None], axis=2)
    torn = split[sideways.max(axis=1, initial=0.0) > rest]
    return int(scene.builder.face_shape[edges.faces[edges.first[torn[0]]]]) if len(torn) else -1

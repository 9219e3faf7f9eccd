"""Edges of a scene's meshes: adjacency on position-welded vertices, and its records on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC, DELTA_LIGHTS
from warp_psdr.scene.light_sampling import cumulative
from warp_psdr.topology.t_junctions import cut_sides
from warp_psdr.topology.welding import components, still_welded, weld, weld_shapes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Vertices closer than this fraction of the scene's extent are one: absorbs float32 rounding of posed vertices. Less
#: than the distance at which the estimators look past an edge, or they would miss it.
WELD = 1.0e-6
#: Largest angle (radians) between two faces of an edge that counts as flat: float32 noise of the normals of triangles
#: a thousandth of the scene's size.
COPLANAR = 1.0e-4
#: A triangle whose height over an edge is below this fraction of the edge is a needle: rounding tilts it.
NEEDLE = 1.0e-2
#: Tilt of a needle times its height, in the scene's extent: a few roundings of its corners.
TILT = 2.5e-7


@dataclass(frozen=True, eq=False)
class Adjacency:
    """All edges of a scene, E of them.

    Attributes:
        ends: (E, 2) global vertices of the first face's side of the edge.
        twins: (E, 2) of the second face's side, at the same positions; equal to ``ends`` where shared or open.
        faces: adjacent triangles of all edges, flat.
        first: (E + 1,) where an edge's triangles start.
        wedge: (E,) angle (radians) of the directions, modulo pi, in which the edge is a silhouette; 0: flat.
        length: (E,) world units.
        points: (E, 2, 3) where the edges start and end.
        group: (N,) number of every vertex's position: equal where vertices are welded.
    """

    ends: np.ndarray
    twins: np.ndarray
    faces: np.ndarray
    first: np.ndarray
    wedge: np.ndarray
    length: np.ndarray
    points: np.ndarray
    group: np.ndarray

    @property
    def count(self) -> np.ndarray:
        """Number of triangles at each edge."""
        return np.diff(self.first)


@dataclass(frozen=True, eq=False)
class Topology:
    """What of the edges depends on which vertices coincide, and not on where they are (see ``Adjacency``).

    Attributes:
        ends, twins, faces, first, group: as in ``Adjacency``.
        solid: (M,) the triangles with an area.
        cut: whether sides are cut at T-junctions, which a motion may open.
    """

    ends: np.ndarray
    twins: np.ndarray
    faces: np.ndarray
    first: np.ndarray
    group: np.ndarray
    solid: np.ndarray
    cut: bool


def adjacency(points: np.ndarray, triangles: np.ndarray, shape: np.ndarray | None = None) -> Adjacency:
    """Find the edges of triangles whose vertices are welded by position; triangles without area are left out.

    Args:
        points: (N, 3) vertex positions.
        triangles: (M, 3) vertex numbers.
        shape: (N,) shape of every vertex, whose T-junctions are closed (``t_junctions``); None: one shape.

    Returns:
        Edges with one (open), two, or more (non-manifold) triangles.
    """
    points = np.asarray(points, np.float64)
    shape = np.zeros(len(points), int) if shape is None else shape
    far = np.full(len(points), _extent(points))
    return _measured(points, triangles, _topology(points, triangles, shape, far, _ranks(points)), far)


def _extent(points: np.ndarray) -> float:
    return float(np.abs(points).max()) if len(points) else 1.0


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of (N, 3) vectors, in a third of the time of ``numpy.cross``."""
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)


def area_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (M, 3): the normals of triangles, as long as twice their areas."""
    p = points[triangles]
    return cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def _solid(points: np.ndarray, triangles: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return a mask of the triangles with three positions and an area."""
    corner = group[triangles]
    doubled = area_normals(points, triangles)
    return (corner != corner[:, [1, 2, 0]]).all(axis=1) & (np.abs(doubled).max(axis=1, initial=0.0) > 0.0)


def _ranks(points: np.ndarray) -> np.ndarray:
    """Return the place of every point in the order of their coordinates."""
    ranks = np.empty(len(points), np.int64)
    ranks[np.lexsort(points.T[::-1])] = np.arange(len(points))
    return ranks


def _scene_ranks(scene: Scene) -> np.ndarray:
    """Return the places of a scene's vertices in the order in which they lay when it was loaded.

    Edges come in that order. Samples are stratified over them, so neighbours should be near each other; and it must not
    depend on how the vertices got where they are: equal scenes draw equal samples.
    """
    kept = getattr(scene, "_vertex_ranks", None)
    if kept is None:
        kept = _ranks(np.concatenate([np.zeros((0, 3)), *(s.vertices for s in scene.description.shapes)]))
        scene._vertex_ranks = kept  # type: ignore[attr-defined]
    return kept


def _numbered(group: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """Return groups of points numbered in the order of their first ones."""
    _numbers, first = np.unique(group[np.argsort(ranks)], return_index=True)
    return np.argsort(np.argsort(first))[group]


def _topology(
    points: np.ndarray, triangles: np.ndarray, shape: np.ndarray, far: np.ndarray, ranks: np.ndarray
) -> Topology:
    """Return what is welded.

    Args:
        points: as of ``adjacency``.
        triangles: as of ``adjacency``.
        shape: as of ``adjacency``.
        far: (N,) the largest coordinate by which a vertex may have been rounded.
        ranks: (N,) places of the vertices in the order in which edges come.
    """
    if len(far) and far.min() < far.max():
        of_shape = np.zeros(int(shape.max()) + 1)
        of_shape[shape] = far
        group = weld_shapes(points, shape, WELD * of_shape)
    else:
        group = weld(points, WELD * _extent(points))
    group = _numbered(group, ranks)
    solid = _solid(points, triangles, group)
    numbers = np.flatnonzero(solid)
    sides = np.stack([triangles[numbers][:, [a, (a + 1) % 3]] for a in range(3)], axis=1).reshape(-1, 2)
    face = np.repeat(numbers, 3)
    whole = len(sides)
    sides, face = cut_sides(points, group, shape, sides, face, WELD * far[sides[:, 0]])
    cut = len(sides) > whole
    key = group[sides]
    swap = key[:, 0] > key[:, 1]
    sides[swap], key[swap] = sides[swap][:, ::-1], key[swap][:, ::-1]
    order = np.lexsort((face, key[:, 1], key[:, 0]))
    sides, face, key = sides[order], face[order], key[order]
    new = np.ones(len(key), bool)
    new[1:] = (key[1:] != key[:-1]).any(axis=1)
    start = np.flatnonzero(new)
    first = np.append(start, len(key)).astype(np.int32)
    second = np.where(np.diff(first) == 2, start + 1, start)
    ends, twins = sides[start].astype(np.int32), sides[second].astype(np.int32)
    return Topology(ends, twins, face.astype(np.int32), first, group, solid, cut)


def _measured(points: np.ndarray, triangles: np.ndarray, t: Topology, far: np.ndarray) -> Adjacency:
    """Return the edges with what depends on where the vertices are."""
    start, count = t.first[:-1], np.diff(t.first)
    ends = points[t.ends]
    along = ends[:, 1] - ends[:, 0]
    length = np.sqrt((along * along).sum(axis=1))
    along /= np.maximum(length, 1e-300)[:, None]
    doubled = area_normals(points, triangles)
    doubled = np.sqrt((doubled * doubled).sum(axis=1))  # twice the triangles' areas
    middle = points[triangles[:, 0]] + points[triangles[:, 1]] + points[triangles[:, 2]]
    middle /= 3.0

    def across(face: np.ndarray) -> np.ndarray:
        """Direction from an edge into a face, perpendicular to the edge."""
        into = middle[face] - ends[:, 0]
        return into - (into * along).sum(axis=1)[:, None] * along

    second = np.where(count == 2, start + 1, start)
    a, b = across(t.faces[start]), across(t.faces[second])
    sine = cross(a, b)
    angle = np.arctan2(np.sqrt((sine * sine).sum(axis=1)), (a * b).sum(axis=1))
    wedge = np.where(count == 2, np.pi - angle, np.pi)
    tall = np.minimum(*(doubled[t.faces[i]] for i in (start, second))) / np.maximum(length, 1e-300)
    tilt = np.where(tall < NEEDLE * length, TILT * far[t.ends[:, 0]] / np.maximum(tall, 1e-300), 0.0)
    wedge[wedge < np.maximum(COPLANAR, tilt)] = 0.0
    return Adjacency(t.ends, t.twins, t.faces, t.first, wedge, length, ends, t.group)


def join(a: Adjacency, b: Adjacency) -> Adjacency:
    """Return the edges of both, with the vertices of the first."""
    parts = {
        name: np.concatenate([getattr(a, name), getattr(b, name)])
        for name in ("ends", "twins", "faces", "wedge", "length", "points")
    }
    return Adjacency(first=np.append(a.first, a.first[-1] + b.first[1:]).astype(np.int32), group=a.group, **parts)


def select(edges: Adjacency, keep: np.ndarray) -> Adjacency:
    """Return some of the edges, by number."""
    count = edges.count[keep]
    first = np.append(0, np.cumsum(count)).astype(np.int32)
    faces = edges.faces[np.repeat(edges.first[:-1][keep] - first[:-1], count) + np.arange(first[-1])]
    parts = {n: getattr(edges, n)[keep] for n in ("ends", "twins", "wedge", "length", "points")}
    return Adjacency(first=first, faces=faces, group=edges.group, **parts)


def without(edges: Adjacency, gone: np.ndarray) -> Adjacency:
    """Return the edges that are left without some of the triangles, a mask; where one is left, the edge is open."""
    left = ~gone[edges.faces]
    count = np.add.reduceat(left, edges.first[:-1], dtype=np.int32)
    side = np.where(left[edges.first[:-1]][:, None], edges.ends, edges.twins)
    opened = (count == 1) & (edges.count > 1)
    rest = replace(
        edges,
        ends=np.where(opened[:, None], side, edges.ends),
        twins=np.where(opened[:, None], side, edges.twins),
        wedge=np.where(opened, np.pi, edges.wedge),
        faces=edges.faces[left],
        first=np.append(0, np.cumsum(count)).astype(np.int32),
    )
    return select(rest, np.flatnonzero(count > 0))


def scene_adjacency(scene: Scene) -> Adjacency:
    """Return the edges of a scene; kept until a vertex moves.

    What is welded, and hence which edges there are, is kept as long as the same vertices coincide.
    """
    points = scene.points
    triangles = scene.builder.indices
    kept = getattr(scene, "_edges", None)
    if kept is not None and np.array_equal(kept[0], points):
        return kept[1]
    exact = points.astype(np.float64)
    topology = kept[2] if kept is not None else None
    far = scene.steps.far[shape_of_vertex(scene)]
    if topology is None or not (
        not topology.cut
        and not scene.steps.scene
        and still_welded(exact, topology.group, WELD * _extent(exact))
        and np.array_equal(_solid(exact, triangles, topology.group), topology.solid)
    ):
        topology = _topology(exact, triangles, shape_of_vertex(scene), far, _scene_ranks(scene))
    found = _measured(exact, triangles, topology, far)
    scene._edges = (points.copy(), found, topology)  # type: ignore[attr-defined]
    return found


def sides_of(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return which side of its triangle, ``edges.faces``, an edge is: from corner a to a + 1.

    A triangle's corner opposite to the edge is the one that is farthest from the edge's line; welded triangles share
    positions, not vertex numbers. Kept for the edges of the whole scene.
    """
    kept = getattr(scene, "_sides", None)
    if kept is not None and kept[0] is edges:
        return kept[1]
    points = scene.points.astype(np.float64)
    edge = np.repeat(np.arange(len(edges.length)), edges.count)
    ends = points[edges.ends[edge]]
    along = (ends[:, 1] - ends[:, 0]) / np.maximum(edges.length[edge], 1e-300)[:, None]
    corners = points[scene.builder.indices[edges.faces]] - ends[:, :1]
    across = corners - (corners * along[:, None]).sum(axis=2, keepdims=True) * along[:, None]
    sides = (np.argmax((across * across).sum(axis=2), axis=1) + 1) % 3
    if edges is scene_adjacency(scene):
        scene._sides = (edges, sides)  # type: ignore[attr-defined]
    return sides


def joined_faces(faces: int, edges: Adjacency, joins: np.ndarray) -> np.ndarray:
    """Return the number of every triangle's group, (faces,): equal where edges of two triangles join them.

    Args:
        faces: number of triangles.
        edges: of the scene.
        joins: (E,) mask of edges, each of two triangles.
    """
    start = edges.first[:-1][joins]
    return components(faces, edges.faces[start], edges.faces[start + 1])


def mesh_parts(scene: Scene) -> np.ndarray:
    """Return the number of every triangle's part of its mesh, (faces,): parts of a mesh share no edge.

    Kept as long as the same vertices coincide.
    """
    edges = scene_adjacency(scene)
    kept = getattr(scene, "_mesh_parts", None)
    if kept is None or kept[0] is not scene._edges[2]:  # type: ignore[attr-defined]
        shape = scene.builder.face_shape[edges.faces]
        edge = np.repeat(np.arange(len(edges.length)), edges.count)
        joined = np.flatnonzero((edge[1:] == edge[:-1]) & (shape[1:] == shape[:-1]))
        parts = components(scene.face_count, edges.faces[joined], edges.faces[joined + 1])
        kept = (scene._edges[2], parts.astype(np.int32))  # type: ignore[attr-defined]
        scene._mesh_parts = kept  # type: ignore[attr-defined]
    return kept[1]


def shape_of_vertex(scene: Scene) -> np.ndarray:
    """Return the shape number of every vertex."""
    return np.repeat(np.arange(len(scene.builder.shapes)), [s.vertex_count for s in scene.builder.shapes])


def moving_edges(scene: Scene, edges: Adjacency, shapes: set[int]) -> np.ndarray:
    """Return a mask of the edges of which an end belongs to one of the shapes."""
    moves = np.isin(shape_of_vertex(scene), sorted(shapes))
    (a, b), (c, d) = edges.ends.T, edges.twins.T
    return moves[a] | moves[b] | moves[c] | moves[d]


def curve_edges(scene: Scene, curves: Adjacency) -> Edges | None:
    """Return curves of intersection, drawn by their length; None: there are none."""
    n = len(curves.length)
    return upload(scene, curves, np.arange(n), curves.length, np.zeros(n), np.ones(n)) if n else None


def every_edge(scene: Scene, edges: Adjacency) -> Edges:
    """Return all edges in their order, unweighted."""
    n = len(edges.length)
    return upload(scene, edges, np.arange(n), np.ones(n), np.zeros(n), np.ones(n))


def upload(scene: Scene, edges: Adjacency, keep: np.ndarray, weight: np.ndarray, low, high) -> Edges:
    """Return some of the edges, by number, with their weights and the stretches that are sampled, on the device."""

    def array(values, dtype=wp.float32) -> wp.array:
        kind = np.int32 if dtype is wp.int32 else np.float32
        return wp.array(np.ascontiguousarray(values, dtype=kind), dtype=dtype, device=scene.device)

    edges = select(edges, keep)
    record = Edges()
    record.cdf = array(cumulative(weight))
    record.points = wp.array(np.ascontiguousarray(edges.points, np.float32), dtype=wp.vec3, device=scene.device, ndim=2)
    record.ends = array(edges.ends, wp.int32)
    record.twins = array(edges.twins, wp.int32)
    record.faces = array(edges.faces, wp.int32)
    record.first = array(edges.first, wp.int32)
    record.low, record.high = array(low), array(high)
    # Only lights of no area, and parallel rays of a camera, have edges one behind the other (``coincident.py``).
    parallel = {camera.kind for camera in scene.builder.cameras} & {CAMERA_ORTHOGRAPHIC}
    aligned = parallel or {e.kind for e in scene.builder.emitters} & DELTA_LIGHTS
    record.parts = array(mesh_parts(scene) if aligned else [0], wp.int32)
    record.sides, record.beside, record.beside_first = (array([0], wp.int32) for _ in range(3))
    return record

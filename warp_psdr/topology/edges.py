"""Edges of a scene's meshes: adjacency on position-welded vertices, and its records on the device."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import warp as wp

from warp_psdr import columns
from warp_psdr.device import launch_on_host
from warp_psdr.kernels.boundary.edge_lists import take_edges
from warp_psdr.kernels.boundary.edge_wedges import edge_wedges, face_normals
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC, DELTA_LIGHTS
from warp_psdr.progress import say
from warp_psdr.scene.lights.light_sampling import cumulative
from warp_psdr.topology.shared_edges import put_first
from warp_psdr.topology.t_junctions import cut_sides
from warp_psdr.topology.welding import components, stable_order, still_welded, weld, weld_shapes

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

T = TypeVar("T")

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
#: Seconds that the lists of the edges of a triangle take before its scene's first gradient, all of them together.
SECONDS_A_TRIANGLE = 4.0e-6


@dataclass(frozen=True, eq=False)
class Adjacency:
    """All edges of a scene, E of them, in the order of the groups of their ends, the lower one first.

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
    normals = normal_columns(points, triangles)
    return _measured(points, triangles, _topology(points, triangles, normals, shape, far, _ranks(points)), far)


def _extent(points: np.ndarray) -> float:
    return float(np.abs(points).max()) if len(points) else 1.0


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of (N, 3) vectors, in a third of the time of ``numpy.cross``."""
    return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)


def area_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (M, 3): the normals of triangles, as long as twice their areas."""
    return np.ascontiguousarray(normal_columns(points, triangles).T)


def normal_columns(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return (3, M): the normals of triangles, as long as twice their areas, by component."""
    inputs = [np.asarray(points, np.float64), triangles.astype(np.int32, copy=False)]
    (normals,) = launch_on_host(face_normals, len(triangles), inputs, [wp.vec3d])
    return columns.of(normals)


def _solid(normals: np.ndarray, triangles: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return a mask of the triangles with three positions and an area."""

    def solid(rows: slice) -> tuple[np.ndarray]:
        a, b, c = (group.take(corner) for corner in triangles[rows].T)
        x, y, z = np.abs(normals[:, rows])
        return ((a != b) & (b != c) & (c != a) & (np.maximum(np.maximum(x, y), z) > 0.0),)

    return columns.in_chunks(solid, len(triangles))[0]


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
    first = np.full(int(group.max(initial=-1)) + 1, len(group))
    np.minimum.at(first, group, ranks)
    starts = np.zeros(len(group) + 1, bool)
    starts[first] = True
    return (np.cumsum(starts) - 1)[first][group]


def _topology(
    points: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray,
    shape: np.ndarray,
    far: np.ndarray,
    ranks: np.ndarray,
) -> Topology:
    """Return what is welded.

    Args:
        points: as of ``adjacency``.
        triangles: as of ``adjacency``.
        normals: as of ``normal_columns``.
        shape: as of ``adjacency``.
        far: (N,) the largest coordinate by which a vertex may have been rounded.
        ranks: (N,) places of the vertices in the order in which edges come.
    """
    if len(far) and far.min() < far.max():
        of_shape = np.zeros(int(shape.max()) + 1)
        of_shape[shape] = far
        group = weld_shapes(points, shape, WELD * of_shape)
    else:
        order = np.empty_like(ranks)
        order[ranks] = np.arange(len(ranks))
        group = weld(points, WELD * _extent(points), order)
    group = _numbered(group, ranks)
    solid = _solid(normals, triangles, group)
    numbers = np.flatnonzero(solid)
    corners = triangles.take(numbers, axis=0)
    start, end = corners.reshape(-1), corners[:, [1, 2, 0]].reshape(-1)
    face = np.repeat(numbers, 3)
    order, first = _edges(group.take(start), group.take(end))
    # Only open sides are cut.
    lone = np.sort(order[first[:-1][np.diff(first) == 1]])
    sides = np.stack([start[lone], end[lone]], axis=1)
    pieces, of = cut_sides(points, group, shape, sides, face[lone], WELD * far[start[lone]])
    cut = len(pieces) > len(lone)
    if cut:
        start, end, face = (
            np.append(np.delete(x, lone), more) for x, more in ((start, pieces[:, 0]), (end, pieces[:, 1]), (face, of))
        )
        by_face = np.argsort(face, kind="stable")
        start, end, face = start[by_face], end[by_face], face[by_face]
        order, first = _edges(group[start], group[end])

    def ends(rows: np.ndarray) -> np.ndarray:
        """Return the vertices of sides, (E, 2) in the order of their groups."""
        a, b = start.take(rows), end.take(rows)
        turned = group.take(a) > group.take(b)
        return np.stack([np.where(turned, b, a), np.where(turned, a, b)], axis=1).astype(np.int32)

    order, shared = put_first(order, first, face, shape[triangles[:, 0]], normals)
    second = np.where(shared | (np.diff(first) == 2), first[:-1] + 1, first[:-1])
    return Topology(
        ends=ends(order[first[:-1]]),
        twins=ends(order[second]),
        faces=face.take(order).astype(np.int32),
        first=first.astype(np.int32),
        group=group,
        solid=solid,
        cut=cut,
    )


def _edges(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put sides in the order of the edges that they belong to.

    Args:
        a: (S,) groups of the vertices where they start.
        b: (S,) groups of those where they end.

    Returns:
        (S,) numbers of the sides, by the lower group, the higher one, and number; (E + 1,) where an edge's sides start.
    """
    low, high = np.minimum(a, b), np.maximum(a, b)
    count = int(high.max(initial=-1)) + 1
    order = stable_order(high, count)
    order = order[stable_order(low[order], count)]
    low, high = low[order], high[order]
    new = np.ones(len(order), bool)
    new[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return order, np.append(np.flatnonzero(new), len(order))


def _measured(points: np.ndarray, triangles: np.ndarray, t: Topology, far: np.ndarray) -> Adjacency:
    """Return the edges with what depends on where the vertices are."""
    ends = points.take(t.ends, axis=0)
    inputs = [points, triangles.astype(np.int32, copy=False), t.ends, t.faces, t.first, far, NEEDLE, TILT]
    size, turn, tilt = launch_on_host(edge_wedges, len(t.ends), inputs, [wp.float64, wp.vec2d, wp.float64])
    wedge = np.where(np.diff(t.first) == 2, np.pi - np.arctan2(turn[:, 0], turn[:, 1]), np.pi)
    wedge[wedge < np.maximum(COPLANAR, tilt)] = 0.0
    return Adjacency(t.ends, t.twins, t.faces, t.first, wedge, size, ends, t.group)


def join(a: Adjacency, b: Adjacency) -> Adjacency:
    """Return the edges of both, with the vertices of the first."""
    if not len(b.length):
        return a
    parts = {
        name: np.concatenate([getattr(a, name), getattr(b, name)])
        for name in ("ends", "twins", "faces", "wedge", "length", "points")
    }
    return Adjacency(first=np.append(a.first, a.first[-1] + b.first[1:]).astype(np.int32), group=a.group, **parts)


def _firsts(count: np.ndarray) -> np.ndarray:
    """Return where lists of these lengths start in one, and where the last one ends."""
    first = np.zeros(len(count) + 1, np.int32)
    np.cumsum(count, out=first[1:])
    return first


def select(edges: Adjacency, keep: np.ndarray) -> Adjacency:
    """Return some of the edges, by number."""
    start, count = edges.first.take(keep), edges.count.take(keep)
    first = _firsts(count)
    faces = edges.faces.take(np.repeat(start - first[:-1], count) + np.arange(first[-1], dtype=np.int32))
    parts = {n: getattr(edges, n).take(keep, axis=0) for n in ("ends", "twins", "wedge", "length", "points")}
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
    if kept is None:
        count = len(triangles)
        say(f"listing the edges of {count:,} triangles (first use; kept until they move)", SECONDS_A_TRIANGLE * count)
    exact = points.astype(np.float64)
    normals = normal_columns(exact, triangles)
    topology = kept[2] if kept is not None else None
    far = scene.steps.far[shape_of_vertex(scene)]
    if topology is None or not (
        not topology.cut
        and not scene.steps.scene
        and still_welded(exact, topology.group, WELD * _extent(exact))
        and np.array_equal(_solid(normals, triangles, topology.group), topology.solid)
    ):
        topology = _topology(exact, triangles, normals, shape_of_vertex(scene), far, _scene_ranks(scene))
    found = _measured(exact, triangles, topology, far)
    scene._edges = (points.copy(), found, topology, normals)  # type: ignore[attr-defined]
    return found


def scene_normals(scene: Scene) -> np.ndarray:
    """Return ``normal_columns`` of a scene's triangles; kept until a vertex moves."""
    scene_adjacency(scene)
    return scene._edges[3]  # type: ignore[attr-defined]


def while_welded(scene: Scene, edges: Adjacency, key: Hashable, find: Callable[[], T]) -> T:
    """Return what ``find()`` returns, kept as long as the same vertices coincide.

    Args:
        scene: the scene.
        edges: of the scene, all of them; for others it is found anew.
        key: names what is found, and all that it depends on beside the topology.
        find: what finds it.
    """
    kept = getattr(scene, "_edges", None)
    if kept is None or edges.faces is not kept[2].faces:
        return find()
    held: tuple[Topology, dict[Hashable, Any]] | None = getattr(scene, "_welded", None)
    if held is None or held[0] is not kept[2]:
        held = scene._welded = (kept[2], {})  # type: ignore[attr-defined]
    if key not in held[1]:
        held[1][key] = find()
    return held[1][key]


def edge_of_side(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return the number of the edge of every entry of ``edges.faces``."""
    return while_welded(scene, edges, "edge of side", lambda: np.repeat(np.arange(len(edges.length)), edges.count))


def sides_of(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return which side of its triangle, ``edges.faces``, an edge is: from corner a to a + 1.

    A triangle's corner opposite to the edge is the one that is farthest from the edge's line; welded triangles share
    positions, not vertex numbers. Kept for the edges of the whole scene.
    """
    kept = getattr(scene, "_sides", None)
    if kept is not None and kept[0] is edges:
        return kept[1]
    p, triangles = columns.of(scene.points), scene.builder.indices
    edge = edge_of_side(scene, edges)

    def farthest(rows: slice) -> tuple[np.ndarray]:
        begin, end = (columns.take(p, edges.ends[:, i].take(edge[rows])) for i in (0, 1))
        along = (end - begin) / np.maximum(edges.length.take(edge[rows]), 1e-300)
        corners = [columns.take(p, corner) - begin for corner in triangles.take(edges.faces[rows], axis=0).T]
        across = [x - columns.dot(x, along) * along for x in corners]
        return (np.argmax([columns.dot(x, x) for x in across], axis=0),)

    sides = (columns.in_chunks(farthest, len(edge))[0] + 1) % 3
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

    def find() -> np.ndarray:
        shape = scene.builder.face_shape[edges.faces]
        edge = edge_of_side(scene, edges)
        joined = np.flatnonzero((edge[1:] == edge[:-1]) & (shape[1:] == shape[:-1]))
        return components(scene.face_count, edges.faces[joined], edges.faces[joined + 1]).astype(np.int32)

    return while_welded(scene, edges, "mesh parts", find)


def shape_of_vertex(scene: Scene) -> np.ndarray:
    """Return the shape number of every vertex."""
    return np.repeat(np.arange(len(scene.builder.shapes)), [s.vertex_count for s in scene.builder.shapes])


def moving_edges(scene: Scene, edges: Adjacency, shapes: set[int]) -> np.ndarray:
    """Return a mask of the edges of which an end belongs to one of the shapes."""

    def find() -> np.ndarray:
        moves = np.isin(shape_of_vertex(scene), sorted(shapes))
        (a, b), (c, d) = edges.ends.T, edges.twins.T
        return moves[a] | moves[b] | moves[c] | moves[d]

    return while_welded(scene, edges, ("moving", frozenset(shapes)), find)


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

    n, first = len(keep), _firsts(edges.count.take(keep))
    points = wp.empty((n, 2), dtype=wp.vec3, device="cpu")
    ends, twins = (wp.empty((n, 2), dtype=wp.int32, device="cpu") for _ in range(2))
    faces = wp.empty(int(first[-1]), dtype=wp.int32, device="cpu")
    inputs = [keep.astype(np.int32), first, edges.points, edges.ends, edges.twins, edges.faces, edges.first]
    launch_on_host(take_edges, n, inputs, [points, ends, twins, faces])
    record = Edges()
    record.cdf = array(cumulative(weight))
    record.points, record.ends, record.twins, record.faces = (x.to(scene.device) for x in (points, ends, twins, faces))
    record.first = array(first, wp.int32)
    record.low, record.high = array(low), array(high)
    # Only lights of no area, and parallel rays of a camera, have edges one behind the other (``coincident.py``).
    parallel = {camera.kind for camera in scene.builder.cameras} & {CAMERA_ORTHOGRAPHIC}
    aligned = parallel or {e.kind for e in scene.builder.emitters} & DELTA_LIGHTS
    record.parts = array(mesh_parts(scene) if aligned else [0], wp.int32)
    record.sides, record.beside, record.beside_first = (array([0], wp.int32) for _ in range(3))
    return record

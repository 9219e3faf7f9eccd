"""Which edges the film can see, and which of them jump: the candidate sets of the primary boundary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr import columns
from warp_psdr.device import launch_on_host
from warp_psdr.kernels.boundary.film_clip import faces_apart
from warp_psdr.kernels.constants import (
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NULL,
    LOBE_SMOOTH,
    READ_TEXCOORDS,
    TEXTURE_FACE,
)
from warp_psdr.topology.absent import absent_faces
from warp_psdr.topology.camera_view import CameraView, camera_view
from warp_psdr.topology.edges import (
    COPLANAR,
    Adjacency,
    cross,
    join,
    moving_edges,
    scene_adjacency,
    scene_normals,
    select,
    sides_of,
    upload,
    while_welded,
    without,
)
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene

#: Largest angle (radians) between the normals of a crease for which one path serves both faces. Measured (diffuse
#: balls over a floor, sky and panel, depth 2 and 4): below, its variance is lower than that of two paths, in the end
#: in proportion to the angle; above, two paths whose directions turn with the normals tell less of even light.
SHALLOW = 0.15
#: Least width in which its faces are seen, in ray epsilons: twenty times the distance at which rays pass beside it.
WIDE = 2.0
#: Share of its weight that a crease keeps if a closed shape hides it.
HIDDEN = 0.05
#: Largest turn of dp/du (radians) across an edge that counts as none.
TURN = 1.0e-3
#: Least share of the samples that creases between flat faces get, and that is left for all others.
LEAST_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Seen:
    """Edges that the film can see.

    Attributes:
        keep: (K,) their numbers.
        low, high: (K,) the stretch of each that is seen, in [0, 1].
        length: (K,) of its image, pixels.
    """

    keep: np.ndarray
    low: np.ndarray
    high: np.ndarray
    length: np.ndarray


@dataclass(frozen=True, eq=False)
class FilmEdges:
    """The edges of a scene that jump on the film.

    Attributes:
        key: what they depend on.
        every: all edges.
        edges: those of shapes that the camera sees.
        others: those drawn by the length of their image.
        facets: the creases between flat faces that the camera sees side by side.
        weight: (K,) of the facets: length times the sine between the two faces, to which the jump is proportional;
            less where a closed shape turns its back to the camera.
        share: of the samples that the facets get, in proportion to the sum of the weights.
        creases: the edges inside of interpolated normals that are no silhouettes.
        sides: ``Edges.sides`` of ``others``, in scenes of several shapes.
    """

    key: tuple
    every: Adjacency
    edges: Adjacency
    others: Seen
    flat_creases: Seen
    weight: np.ndarray
    share: float
    creases: Seen
    sides: wp.array | None


def film_edges(
    scene: Scene,
    sensor: int,
    shapes: set[int],
    *,
    camera_moves: bool,
    hide_emitters: bool = False,
    of_radiance: bool = True,
) -> FilmEdges:
    """Return the edges that jump on the film and move; kept until the scene or the camera moves.

    Left out, but for the creases, is what provably does not jump or move: flat or smoothly shaded edges inside a shape
    that are never a silhouette from the camera, and edges that rest before a camera at rest.

    Args:
        scene: the scene.
        sensor: which camera.
        shapes: the shapes that move.
        camera_moves: a parameter of the camera is differentiated.
        hide_emitters: the camera sees through area lights.
        of_radiance: creases between flat faces are apart from other edges, by the light that they receive, and surfaces
            that are not there have none; else those of an image of properties.
    """
    every = scene_adjacency(scene)
    view = camera_view(scene, sensor)
    key = (
        sensor,
        frozenset(shapes),
        camera_moves,
        hide_emitters,
        of_radiance,
        *_brushed_texcoords(scene),
        *view.numbers(),
    )
    before: FilmEdges | None = getattr(scene, "_film_edges", None)
    if before is not None and before.every is every and before.key == key:
        return before
    edges = without(every, scene.luminous) if hide_emitters else every
    if scene.builder.media and of_radiance:
        edges = without(edges, absent_faces(scene))
    asked = np.ones(len(edges.length), bool) if camera_moves else moving_edges(scene, edges, shapes)
    jumps = _jumps(scene, view, edges, asked)
    usable = asked & ~jumps & (edges.wedge > 0.0) & np.any(scatters(scene), axis=1)[_shape(scene, edges)]
    creases = _seen(view, edges, usable)
    lit = _facets(scene, view, edges, jumps) & (of_radiance and not scene.builder.media)
    others, flat_creases = _seen(view, edges, jumps & ~lit), _seen(view, edges, lit)
    weight = flat_creases.length * _sine(edges, flat_creases.keep)
    weight = np.where(_hidden(scene, view, edges, flat_creases.keep), HIDDEN * weight, weight)
    share = 0.0
    if len(weight):
        share = float(np.clip(weight.sum() / (weight.sum() + others.length.sum()), LEAST_SHARE, 1.0 - LEAST_SHARE))
    sides = None
    if len(scene.builder.shapes) > 1:
        sides = wp.array(_sides(scene, select(edges, others.keep)), dtype=wp.int32, device=scene.device)
    found = FilmEdges(key, every, edges, others, flat_creases, weight, share, creases, sides)
    scene._film_edges = found  # type: ignore[attr-defined]
    return found


def primary_edges(scene: Scene, found: FilmEdges, curves: Adjacency | None = None) -> Edges | None:
    """Return the edges drawn by the clipped length of their image, ``curves`` of intersection with them; None: none."""
    seen, edges = found.others, found.edges
    if curves is not None:
        view = camera_view(scene, found.key[0])
        more = _seen(view, curves, np.ones(len(curves.length), bool))
        parts = {n: np.append(getattr(seen, n), getattr(more, n)) for n in ("low", "high", "length")}
        seen = Seen(np.append(seen.keep, more.keep + len(edges.length)), **parts)
        edges = join(edges, curves)
    if not len(seen.keep):
        return None
    record = upload(scene, edges, seen.keep, seen.length, seen.low, seen.high)
    if found.sides is not None:
        record.sides = found.sides
    return record


def _sides(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return ``Edges.sides``."""
    found = np.zeros(scene.face_count, np.int32)
    np.bitwise_or.at(found, edges.faces, (1 << sides_of(scene, edges)).astype(np.int32))
    return found


def flat_crease_edges(scene: Scene, found: FilmEdges) -> Edges | None:
    """Return the creases between flat faces (``boundary/path_space/flat_creases.py``), drawn by weight; None: none."""
    seen = found.flat_creases
    if not len(seen.keep):
        return None
    key = ("flat creases", found.key)
    return kept(scene, key, lambda: upload(scene, found.edges, seen.keep, found.weight, seen.low, seen.high))


def crease_edges(scene: Scene, found: FilmEdges) -> tuple[Edges, float] | None:
    """Return the creases inside of interpolated normals; None: there are none.

    The scattering function is continuous there, but light may reach one of the two triangles only, the other having
    turned away from it (``kernels/boundary/shading_normals/geometric_horizon.py``). They are drawn by the clipped
    length of their image times the sine between their triangles, to which the jump is proportional; its mean is the
    second result.
    """
    seen = found.creases
    if not len(seen.keep):
        return None

    def find() -> tuple[Edges, float]:
        weight = seen.length * _sine(found.edges, seen.keep)
        mean = float(weight.sum() / seen.length.sum())
        return upload(scene, found.edges, seen.keep, weight, seen.low, seen.high), mean

    return kept(scene, ("creases", found.key), find)


def smooth_edges(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return a mask of the edges inside of one shape across which neither normal nor texture nor dp/du jumps."""
    interpolated = np.array([s.smooth == 1 for s in scene.builder.shapes])
    return _within(scene, edges) & (interpolated[_shape(scene, edges)] | (edges.wedge == 0.0))


def _shape(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return the shape of every edge's first triangle."""
    shape = scene.builder.face_shape
    return while_welded(scene, edges, "shapes", lambda: shape.take(edges.faces.take(edges.first[:-1])))


def _inner(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return a mask of the edges of two triangles that share both vertices."""

    def find() -> np.ndarray:
        (a, b), (c, d) = edges.ends.T, edges.twins.T
        return (edges.count == 2) & (a == c) & (b == d)

    return while_welded(scene, edges, "inner", find)


def _within(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return a mask of the edges between two triangles of one shape across which no texture, nor dp/du, jumps."""
    stepped = np.array([_stepped(scene, s) for s in scene.builder.shapes])
    within = _inner(scene, edges) & ~stepped[_shape(scene, edges)]
    if not scene.builder.anisotropic:
        return within
    brushed = np.array([_brushed(scene, s) for s in scene.builder.shapes])
    some = np.flatnonzero(within & brushed[_shape(scene, edges)])
    within[some] = ~_turned(scene, edges, some)
    return within


def _stepped(scene: Scene, shape: Any) -> bool:
    """Return whether a texture of a shape may jump at its edges."""
    # A face attribute jumps at every edge; on a shape without texture coordinates barycentrics are read instead.
    return any(
        t.kind == TEXTURE_FACE or (t.kind in READ_TEXCOORDS and shape.has_uv == 0)
        for t in scene.builder.textures_of(shape)
    )


def _brushed(scene: Scene, shape: Any) -> bool:
    """Return whether a side of a shape is anisotropic, so that its look depends on dp/du."""
    b = scene.builder
    return not b.anisotropic.isdisjoint({shape.bsdf, b.bsdfs[shape.bsdf].back})


def _brushed_texcoords(scene: Scene) -> list[bytes]:
    """Return what dp/du depends on beside positions."""
    if not scene.builder.anisotropic:
        return []
    flat = scene.values.numpy()
    found = [s for s in scene.builder.shapes if s.has_uv == 1 and _brushed(scene, s)]
    first = [s.uv_offset + 2 * s.first_vertex for s in found]
    return [flat[a : a + 2 * s.vertex_count].tobytes() for a, s in zip(first, found, strict=True)]


def _turned(scene: Scene, edges: Adjacency, some: np.ndarray) -> np.ndarray:
    """Return across which of some edges of two faces dp/du turns, either way up (``kernels/surface.uv_tangent``)."""
    start = edges.first[:-1][some]
    along = edges.points[some, 1] - edges.points[some, 0]
    found = []
    for face in (edges.faces[start], edges.faces[start + 1]):
        p = scene.points[scene.builder.indices[face]].astype(np.float64)
        d1, d2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        t1, t2 = _texture_edges(scene, face)
        determinant = t1[:, 0] * t2[:, 1] - t1[:, 1] * t2[:, 0]
        turned = np.sign(determinant)[:, None] * (t2[:, 1:] * d1 - t1[:, 1:] * d2)
        tangent = np.where(np.abs(determinant)[:, None] < 1.0e-20, d1, turned)
        # Across the edge, out of the first face and into the second, however the two are wound.
        beside = cross(cross(d1, d2), along)
        beside *= (np.linalg.norm(along, axis=1) / np.maximum(np.linalg.norm(beside, axis=1), 1e-300))[:, None]
        inward = ((p.mean(axis=1) - edges.points[some, 0]) * beside).sum(axis=1) > 0.0
        beside[inward == (len(found) == 0)] *= -1.0
        found.append(np.stack([(tangent * along).sum(axis=1), (tangent * beside).sum(axis=1)], axis=1))
    a, b = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300) for x in found)
    return np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > TURN


def _texture_edges(scene: Scene, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how texture coordinates change along two sides of triangles, 0 without any."""
    flat, shapes = scene.values.numpy(), scene.builder.shapes
    shape = scene.builder.face_shape[faces]
    offset = np.array([s.uv_offset if s.has_uv == 1 else -1 for s in shapes])[shape]
    at = np.maximum(offset, 0)[:, None] + 2 * scene.builder.indices[faces]
    t = np.stack([flat[at], flat[at + 1]], axis=2).astype(np.float64)
    t[offset < 0] = 0.0
    return t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]


def _jumps(scene: Scene, view: CameraView, edges: Adjacency, asked: np.ndarray) -> np.ndarray:
    """Return a mask of the asked edges at which the radiance may jump as the camera sees them."""
    smooth = asked & smooth_edges(scene, edges)
    jumps = asked & ~smooth
    # Where neither normal nor texture jumps, only a silhouette does.
    rest = np.flatnonzero(smooth & (edges.wedge > 0.0))
    jumps[rest] = ~_apart(scene, view, edges, rest, np.zeros(len(rest)))
    return jumps


def _facets(scene: Scene, view: CameraView, edges: Adjacency, asked: np.ndarray) -> np.ndarray:
    """Return a mask of the asked edges across which only a flat normal jumps, and that are never a silhouette.

    Their faces scatter smoothly, and are wide enough for rays beside the edge.
    """
    shapes = scene.builder.shapes
    usable = np.array([s.smooth == 0 for s in shapes]) & scatters(scene).all(axis=1) & ~_mirrors(scene).any(axis=1)
    shape = _shape(scene, edges)
    flat_creases = asked & _within(scene, edges) & usable[shape] & (edges.wedge > 0.0) & (edges.wedge < SHALLOW)
    some = np.flatnonzero(flat_creases)
    steps = scene.steps.shapes if scene.steps.scene > 0.0 else np.full(len(shapes), scene.ray_epsilon)
    flat_creases[some] = _apart(scene, view, edges, some, WIDE * steps[shape[some]]) & _alike(scene, edges, some)
    return flat_creases


def scatters(scene: Scene) -> np.ndarray:
    """Return which shapes are more than a mirror or glass in front and on the back, (S, 2)."""
    return _lobes(scene) & (1 << LOBE_SMOOTH) != 0


def _mirrors(scene: Scene) -> np.ndarray:
    """Return which shapes show mirror images, or let them through, in front and on the back, (S, 2)."""
    return _lobes(scene) & (1 << LOBE_DELTA_REFLECTION | 1 << LOBE_DELTA_TRANSMISSION | 1 << LOBE_NULL) != 0


def _lobes(scene: Scene) -> np.ndarray:
    bsdfs = scene.builder.bsdfs
    sides = [(bsdfs[s.bsdf].lobes, bsdfs[bsdfs[s.bsdf].back].lobes) for s in scene.builder.shapes]
    return np.array(sides, dtype=np.int64).reshape(-1, 2)


def _alike(scene: Scene, edges: Adjacency, some: np.ndarray) -> np.ndarray:
    """Return which of some edges have faces that turn the same side to the camera: they run along them either way."""
    start, (begin, end) = edges.first[some], edges.ends.take(some, axis=0).T

    def forward(face: np.ndarray) -> np.ndarray:
        a, b, c = scene.builder.indices.take(face, axis=0).T
        return ((a == begin) & (b == end)) | ((b == begin) & (c == end)) | ((c == begin) & (a == end))

    return forward(edges.faces.take(start)) != forward(edges.faces.take(start + 1))


def _apart(scene: Scene, view: CameraView, edges: Adjacency, some: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return which of some edges have a face on either side, as the camera sees them, at least ``width`` wide."""
    inputs = [view.record(), scene.points, scene.builder.indices, some.astype(np.int32), width, edges.points]
    inputs += [edges.length, edges.faces, edges.first, COPLANAR]
    return launch_on_host(faces_apart, len(some), inputs, [wp.bool])[0]


def _hidden(scene: Scene, view: CameraView, edges: Adjacency, some: np.ndarray) -> np.ndarray:
    """Return which of some edges belong to a face of a closed shape that turns its back to the camera."""
    shapes, points, triangles = scene.builder.shapes, columns.of(scene.points), scene.builder.indices
    shape = _shape(scene, edges)
    closed = np.bincount(shape, edges.count != 2, len(shapes)) == 0
    outside = np.zeros(len(shapes))
    for i in np.unique(shape[some]):
        # Positive if the triangles' normals point out of the shape.
        outside[i] = closed[i] * np.sign(_volume(points, triangles[scene.builder.face_shape == i]))
    face = edges.faces[edges.first[some]]
    corner = scene.points.take(triangles[:, 0].take(face), axis=0)
    facing = columns.dot(columns.take(scene_normals(scene), face), columns.of(view.towards(corner.astype(np.float64))))
    return outside[shape[some]] * facing < 0.0


def _volume(points: np.ndarray, triangles: np.ndarray) -> float:
    """Return six times the volume that triangles enclose.

    Args:
        points: (3, N) vertices.
        triangles: (F, 3) their numbers.
    """
    origin = points[:, triangles[0, :1]]

    def parts(rows: slice) -> tuple[np.ndarray]:
        a, b, c = (columns.take(points, corner) - origin for corner in triangles[rows].T)
        return (a * columns.cross(b, c),)

    return float(np.ascontiguousarray(columns.in_chunks(parts, len(triangles))[0].T).sum())


def _seen(view: CameraView, edges: Adjacency, use: np.ndarray) -> Seen:
    """Return what the film can see of some edges, a mask."""
    keep = np.flatnonzero(use)
    low, high, visible = view.clip(edges.points, keep)
    seen = visible > 0.0
    return Seen(keep[seen], low[seen], high[seen], visible[seen])


def _sine(edges: Adjacency, keep: np.ndarray) -> np.ndarray:
    return np.sin(np.minimum(edges.wedge[keep], 0.5 * np.pi))

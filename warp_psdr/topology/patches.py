"""The lengths over which light between surfaces varies: the width of their smooth patches, and their curvature."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import columns
from warp_psdr.topology.edges import edge_of_side, joined_faces, scene_adjacency, scene_normals
from warp_psdr.topology.kinds.exact_shapes import exact_shapes, pose
from warp_psdr.topology.unchanged import kept as kept_for

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Angle (radians) between two triangles from which their edge ends a patch. Coarse spheres and cylinders have less.
CREASE = 0.8
#: Radius of curvature over area / (length of the edge * angle) of the triangles or quadrilaterals of spheres.
BEND = 1.2
#: The same of exact shapes over half their least width: the least that triangles of spheres have.
BALL = 1.5
#: Radius of a patch over its width: half the diagonal of a cube of side 2.
RADIUS = np.sqrt(3.0)


def patch_radii(scene: Scene) -> wp.array:
    """Return the radius at every triangle, (F,) world units (a 0 if there is none), kept until a vertex moves.

    In media those of shapes without triangles follow.
    """
    if scene.builder.media and scene.builder.primitives:
        return kept_for(scene, "patch radii", lambda: _with_exact_shapes(scene))
    edges = scene_adjacency(scene)
    kept = getattr(scene, "_patch_radii", None)
    if kept is None or kept[0] is not edges:
        found = radii(scene)
        if not len(found):
            found = np.zeros(1)
        kept = (edges, wp.array(found, dtype=wp.float32, device=scene.device))
        scene._patch_radii = kept  # type: ignore[attr-defined]
    return kept[1]


def _with_exact_shapes(scene: Scene) -> wp.array:
    """Return the radii of triangles, and of shapes without them; 0 of those that are not exact."""
    found = radii(scene)
    exact = set(exact_shapes(scene))
    own = [_exact_radius(scene, i) if i in exact else 0.0 for i in scene.builder.primitives]
    return wp.array(np.concatenate([found, own]), dtype=wp.float32, device=scene.device)


def _exact_radius(scene: Scene, shape: int) -> float:
    """Return the radius of an exact shape: by half its least width, which of a sphere is its own."""
    linear, _center = pose(scene, shape)
    box = scene.geometry(shape).corners(np.eye(4)).astype(np.float64)
    half = 0.5 * (box.max(axis=0) - box.min(axis=0))
    return BALL * float((half * np.linalg.norm(linear, axis=0))[half > 0.0].min())


def radii(scene: Scene) -> np.ndarray:
    """Return the radius at every triangle: of its patch, or of the surface's curvature if that is less.

    A patch is as wide as twice its area over its circumference, and half the root of its area at most: a square of
    side 2 a is a wide, a strip or a frame as wide as its bars. Its radius is sqrt(3) times that. Curvature is the angle
    at an edge within the patch over the distance across it of the smaller of the two flat polygons: spheres and
    cylinders of radius r have 1.5 to 2.1 r. But a flat polygon has no less than by its own width: its rounded or
    bevelled edges count for themselves.

    Returns:
        (F,) float64, world units; 0: without area.
    """
    edges = scene_adjacency(scene)
    area = 0.5 * columns.length(scene_normals(scene))

    def widths(name: str, joins: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the groups that edges join the triangles to, and how wide each is."""
        group = _joined(scene, edges, name, joins)
        sides = np.flatnonzero(~joins[edge_of_side(scene, edges)])
        around = edges.length.take(edge_of_side(scene, edges).take(sides))
        around = np.bincount(group.take(edges.faces.take(sides)), around, group.max(initial=-1) + 1)
        whole = np.bincount(group, area)
        half = 0.5 * np.sqrt(whole)
        return group, np.minimum(half, 2.0 * whole / np.maximum(around, np.maximum(half, 1e-300)))

    two = edges.count == 2
    patch, wide = widths("patches", two & (edges.wedge < CREASE))
    polygon, narrow = widths("polygons", two & (edges.wedge == 0.0))
    curved = np.flatnonzero(two & (edges.wedge > 0.0) & (edges.wedge < CREASE))
    first, second = (polygon.take(edges.faces.take(edges.first.take(curved) + i)) for i in (0, 1))
    whole, wedge = np.bincount(polygon, area), edges.wedge.take(curved)
    across = np.minimum(whole.take(first), whole.take(second)) / edges.length.take(curved)
    bend = np.full(len(narrow), np.inf)
    for own in (first, second):
        np.minimum.at(bend, own, np.maximum(BEND * across / wedge, narrow.take(own)))
    return RADIUS * np.minimum(wide.take(patch), bend.take(polygon))


def _joined(scene: Scene, edges: Adjacency, name: str, joins: np.ndarray) -> np.ndarray:
    """Return ``joined_faces``, kept by name as long as the same edges join the same triangles."""
    held = scene.__dict__.setdefault("_joined_faces", {})
    kept = held.get(name)
    if kept is None or kept[0] is not edges.faces or not np.array_equal(kept[1], joins):
        kept = held[name] = (edges.faces, joins, joined_faces(scene.face_count, edges, joins))
    return kept[2]

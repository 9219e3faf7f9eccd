"""The faces as the line search sees them: which of them are one surface, and which edges they have."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables
from warp_psdr.kernels.constants import READ_TEXCOORDS
from warp_psdr.kernels.texture.steps import StepTextures
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.scene.shapes.shading import ROUNDED, normals_at_vertices
from warp_psdr.topology.absent import absent_faces, absent_shapes
from warp_psdr.topology.edges import every_edge, joined_faces, scene_adjacency, without
from warp_psdr.topology.film_edges import smooth_edges
from warp_psdr.topology.interpolated_normals import interpolated_faces
from warp_psdr.topology.outlook import has_in_front

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene
    from warp_psdr.topology.edges import Adjacency

#: Most triangles of a lens, whose vertices are all compared with all of its triangles at every gradient.
MOST_LENS = 4096
#: Boxes around mirrors that rays are tested against one by one; more are joined.
MOST_BOXES = 16
#: By how many ray epsilons they are larger than what they hold: rays start off the surface, and are rounded.
PAD = 4.0


def face_tables(scene: Scene) -> tuple[Edges, Tables]:
    """Return every edge of a scene and, of every face, its edges, its group of coplanar neighbours, and its normals.

    Behind the triangles are the records of shapes without any, each a group of its own, without edges.
    """
    found = scene_adjacency(scene)
    if scene.builder.media:
        found = without(found, absent_faces(scene))
    edges = every_edge(scene, found)
    smooth = smooth_edges(scene, found)
    tables = Tables()
    records = len(scene.builder.primitives)
    group = joined_faces(scene.face_count, found, smooth & (found.wedge == 0.0))
    for faces in lenses(scene, found, smooth):
        group[faces] = group[faces[0]]
    own = scene.face_count + np.arange(records)  # no group of triangles has such a number
    for name, values in (
        ("group", np.concatenate([group, own])),
        ("interpolated", np.concatenate([interpolated_faces(scene), np.zeros(records, bool)])),
        ("face_edges", np.concatenate([face_edges(scene, found).reshape(-1), np.full(3 * records, -1)])),
        ("smooth_edge", smooth),
    ):
        setattr(tables, name, wp.array(values.astype(np.int32), dtype=wp.int32, device=scene.device))
    tables.steps = _step_textures(scene)
    tables.mirrors = wp.array(mirror_boxes(scene), dtype=wp.vec3, device=scene.device)
    return edges, tables


def _step_textures(scene: Scene) -> StepTextures:
    """Return the textures with steps of every shape."""
    stepped = scene.builder.stepped
    lists = [stepped.get(i, ()) for i in range(len(scene.builder.shapes))]
    tables = StepTextures()
    first = np.append(0, np.cumsum([len(numbers) for numbers in lists], dtype=np.int64)).astype(np.int32)
    tables.first = wp.array(first, dtype=wp.int32, device=scene.device)
    flat = [number for numbers in lists for number in numbers] or [-1]
    tables.textures = wp.array(np.array(flat, np.int32), dtype=wp.int32, device=scene.device)
    return tables


def lenses(scene: Scene, edges: Adjacency, smooth: np.ndarray) -> list[np.ndarray]:
    """Return the triangles of each shape that is one surface to the rays that meet it, however many triangles it has.

    Smooth, closed, convex, and a mirror or glass alone: a ray meets it once from without and once from within, and what
    it sends is continuous across its edges.
    """
    b, found = scene.builder, []
    beside = b.face_shape[edges.faces[~np.repeat(smooth | seams(scene, edges), edges.count)]]
    rough = np.bincount(beside, minlength=len(b.shapes))
    for i, (shape, record) in enumerate(zip(scene.description.shapes, b.shapes, strict=True)):
        models = [model_of(side) for side in shape.bsdf.sides]
        faces = np.flatnonzero(b.face_shape == i)
        alone = all(m.has_delta and not m.has_smooth for m in models)
        if not (alone and record.smooth and 0 < len(faces) <= MOST_LENS) or rough[i]:
            continue
        triangles = b.indices[faces]
        own = triangles.min(), triangles.max() + 1
        points = scene.points[slice(*own)].astype(np.float64)
        # Convex, whichever way its triangles are turned.
        if not all(has_in_front(points, triangles - own[0], turned, False) for turned in (1.0, -1.0)):
            found.append(faces)
    return found


def seams(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return a mask of the edges along which only texture coordinates jump, which no texture of the shape reads.

    Tessellated spheres have one, whose vertices are there twice, with equal normals.
    """
    b, normals = scene.builder, normals_at_vertices(scene)
    reads = [bool(READ_TEXCOORDS & {t.kind for t in b.textures_of(s)}) for s in b.shapes]
    plain = np.array([s.smooth == 1 for s in b.shapes]) & ~np.array(reads)
    first, last = edges.first[:-1], edges.first[1:] - 1
    one, other = (b.face_shape[edges.faces[i]] for i in (first, last))
    equal = (np.abs(normals[edges.ends] - normals[edges.twins]) <= ROUNDED).all(axis=(1, 2))
    return (edges.count == 2) & (one == other) & plain[one] & equal


def mirror_boxes(scene: Scene) -> np.ndarray:
    """Return (2 N, 3) float32: lower and upper corners of boxes around the shapes that are mirrors, glass or masks."""
    points, boxes = scene.points, []
    absent = absent_shapes(scene) & bool(scene.builder.media)
    for shape, record, passed in zip(scene.description.shapes, scene.builder.shapes, absent, strict=True):
        if not passed and any(model_of(side).has_delta for side in shape.bsdf.sides):
            own = points[record.first_vertex : record.first_vertex + record.vertex_count]
            boxes.append([own.min(axis=0) - PAD * scene.ray_epsilon, own.max(axis=0) + PAD * scene.ray_epsilon])
    found = np.array(boxes, np.float32).reshape(-1, 2, 3)
    if len(found) > MOST_BOXES:
        found = np.stack([found[:, 0].min(axis=0), found[:, 1].max(axis=0)])[None]
    return found.reshape(-1, 3)


def face_edges(scene: Scene, edges: Adjacency) -> np.ndarray:
    """Return (faces, 3): the edge opposite of each corner, which is farthest from it; -1: a face of no area."""
    points = scene.points
    edge = np.repeat(np.arange(len(edges.length)), edges.count)
    corners = points[scene.builder.indices[edges.faces]].astype(np.float64)
    ends = points[edges.ends[edge]].astype(np.float64)
    along = ends[:, 1] - ends[:, 0]
    opposite = np.linalg.norm(np.cross(corners - ends[:, :1], along[:, None]), axis=2).argmax(axis=1)
    found = np.full((scene.face_count, 3), -1, np.int32)
    found[edges.faces, opposite] = edge
    return found

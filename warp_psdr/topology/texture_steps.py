"""Lines along which textures jump inside of triangles: the borders of a checkerboard's fields, and of nearest texels.

A texture's *place* is its coordinate in units of its cells (``kernels/texture/steps.py``), linear over a triangle; each
whole number that a coordinate takes there is a line, from one side of the triangle to another. One that runs along a
side is listed once, on the triangle above it, where nothing but the texture jumps across that side. Along a seam of
texture coordinates the side is an edge of its own, which moves; there a line is listed for what slides.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.local_form import STEP
from warp_psdr.topology.camera_view import camera_view
from warp_psdr.topology.edges import Adjacency, scene_adjacency, upload
from warp_psdr.topology.faces import face_edges
from warp_psdr.topology.film_edges import smooth_edges

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.kernels.structs import Shape, Texture
    from warp_psdr.scene.scene import Scene

#: Pairs of a shape and a texture of it.
Carriers = frozenset[tuple[int, int]]
#: Edges of a scene, and the lines that were listed for them with what they were read from.
Held = tuple[Adjacency, dict[tuple[Carriers, bool], tuple[list[bytes], Adjacency]]]
#: Distance of two lines, in texture coordinates, and of their directions, up to which they are one.
SAME = 1.0e-8
#: Most lines of a scene: half a gigabyte.
MOST = 1 << 21


def film_lines(scene: Scene, sensor: int, carriers: Carriers, seams: bool) -> tuple[Edges, float] | None:
    """Return the lines that a camera may see, drawn by the clipped length of their image; None: none.

    Second is that length, in pixels. ``seams``: with those along seams of texture coordinates.
    """
    lines = _lines(scene, carriers, seams)
    low, high, length = camera_view(scene, sensor).clip(lines.points)
    keep = np.flatnonzero(length > 0.0)
    if not len(keep):
        return None
    return upload(scene, lines, keep, length[keep], low[keep], high[keep]), float(length[keep].sum())


def world_lines(scene: Scene, carriers: Carriers) -> Edges | None:
    """Return all lines, drawn by their length; None: there are none."""
    lines = _lines(scene, carriers, True)
    n = len(lines.length)
    return upload(scene, lines, np.arange(n), lines.length, np.zeros(n), np.ones(n)) if n else None


def too_many(scene: Scene, carriers: Carriers) -> str:
    """Say which texture has more lines than can be listed; empty: none. The plan asks before any are listed."""
    total = 0
    for carrier in sorted(carriers):
        _faces, place = _places(scene, carrier)
        spans = np.floor(place.max(axis=1)) - np.floor(place.min(axis=1))
        total += int(spans.sum())
        if total > MOST:
            path = scene.description.shapes[carrier[0]].path
            return f"the textures with steps of {path!r} and others have more than {MOST:,} lines on their triangles"
    return ""


def on_seams(scene: Scene, carriers: Carriers) -> bool:
    """Whether some lines run along seams of texture coordinates."""
    return len(_lines(scene, carriers, True).length) > len(_lines(scene, carriers, False).length)


def _lines(scene: Scene, carriers: Carriers, seams: bool) -> Adjacency:
    """Return the lines of some textures on some shapes as edges of one face; kept until they change."""
    edges = scene_adjacency(scene)
    held: Held | None = scene.__dict__.get("_texture_lines")
    if held is None or held[0] is not edges:
        held = scene.__dict__["_texture_lines"] = (edges, {})
    read = _read(scene, carriers)
    found = held[1].get((carriers, seams))
    if found is None or found[0] != read:
        found = held[1][carriers, seams] = (read, _listed(scene, carriers, seams))
    return found[1]


def _listed(scene: Scene, carriers: Carriers, seams: bool) -> Adjacency:
    """Return the lines of some textures on some shapes as edges of one face."""
    parts = [_lines_of(scene, carrier, seams) for carrier in sorted(carriers)]
    faces, ends, twins, points, where = (np.concatenate([part[k] for part in parts]) for k in range(5))
    if len({shape for shape, _texture in carriers}) < len(carriers):
        # What jumps at a line is what the surface sends, whichever of its textures jump there.
        alone = one_of_each(np.column_stack([faces, where]))
        faces, ends, twins, points = faces[alone], ends[alone], twins[alone], points[alone]
    n = len(faces)
    return Adjacency(
        ends=ends,
        twins=twins,
        faces=faces,
        first=np.arange(n + 1, dtype=np.int32),
        wedge=np.zeros(n),
        length=np.linalg.norm(points[:, 1] - points[:, 0], axis=1),
        points=points,
        group=scene_adjacency(scene).group,
    )


def one_of_each(names: np.ndarray) -> np.ndarray:
    """Return the numbers of rows, (N, K), that no row before is equal to, but for roundings."""
    return np.sort(np.unique(np.round(names / SAME).astype(np.int64), axis=0, return_index=True)[1])


def coincide(scene: Scene, carriers: Carriers) -> int:
    """Return a shape on which a line of one of some textures lies on one of another texture; -1: there is none."""
    for shape, texture in sorted(carriers):
        every = frozenset((shape, other) for other in scene.builder.stepped.get(shape, ()))
        alone = frozenset({(shape, texture)})
        if every - alone and shape not in scene.builder.primitives:
            all_of_them, single, others = (
                len(_lines(scene, c, True).length) for c in (every | alone, alone, every - alone)
            )
            if all_of_them < single + others:
                return shape
    return -1


def _read(scene: Scene, carriers: Carriers) -> list[bytes]:
    """Return what lines depend on besides positions."""
    b, flat = scene.builder, scene.values.numpy()
    found = []
    for carrier in sorted(carriers):
        shape, at = b.shapes[carrier[0]], b.textures[carrier[1]].to_uv
        found.append(flat[at : at + 9].tobytes())
        if shape.has_uv == 1:
            first = shape.uv_offset + 2 * shape.first_vertex
            found.append(flat[first : first + 2 * shape.vertex_count].tobytes())
    return found


def _places(scene: Scene, carrier: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of a shape, (F,), and the texture's place at their corners, (F, 3, 2)."""
    b, flat = scene.builder, scene.values.numpy()
    shape, texture = b.shapes[carrier[0]], b.textures[carrier[1]]
    faces = np.flatnonzero(b.face_shape == carrier[0])
    uv = _texcoords(flat, shape, b.indices[faces])
    matrix, cells = place_of(scene, texture)
    return faces, (uv @ matrix[:, :2].T + matrix[:, 2]) * cells


def place_of(scene: Scene, texture: Texture) -> tuple[np.ndarray, np.ndarray]:
    """Return the first two rows (2, 3) of a texture's transformation, and its cells in a unit of coordinates (2,)."""
    rows = scene.values.numpy()[texture.to_uv : texture.to_uv + 6].astype(np.float64).reshape(2, 3)
    cells = (2.0, 2.0) if texture.kind == c.TEXTURE_CHECKERBOARD else (texture.width, texture.height)
    return rows, np.asarray(cells, np.float64)


def _texcoords(flat: np.ndarray, shape: Shape, corners: np.ndarray) -> np.ndarray:
    """Return the texture coordinates of triangles' corners, (F, 3, 2); barycentrics where a shape has none."""
    if shape.has_uv == 0:
        return np.broadcast_to(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (len(corners), 3, 2))
    at = shape.uv_offset + 2 * corners
    return np.stack([flat[at], flat[at + 1]], axis=2).astype(np.float64)


def _lines_of(scene: Scene, carrier: tuple[int, int], seams: bool) -> tuple[np.ndarray, ...]:
    """Return the lines of a texture on a shape: faces, ends, twins, points (``kernels/boundary/local_form.Edges``).

    The last ones, (N, 3), are where they lie in texture coordinates: a unit vector across, and the distance from 0.
    """
    faces, place = _places(scene, carrier)
    matrix, cells = place_of(scene, scene.builder.textures[carrier[1]])
    corners = scene.points[scene.builder.indices[faces]].astype(np.float64)
    found = []

    def add(axis: int, own: np.ndarray, ends: np.ndarray, level: np.ndarray) -> None:
        marks = [np.tile(np.array([int(STEP), value], np.int32), (len(own), 1)) for value in (carrier[1], axis)]
        across, shift = matrix[axis, :2], matrix[axis, 2]
        turned = -1.0 if across[np.argmax(across != 0.0)] < 0.0 else 1.0
        size = turned * max(float(np.hypot(*across)), 1e-300)
        distance = (level / cells[axis] - shift) / size
        where = np.column_stack([np.tile(across / size, (len(own), 1)), distance])
        found.append((faces[own].astype(np.int32), *marks, ends, where))

    for axis in range(2):
        s = place[:, :, axis]
        first, last = np.floor(s.min(axis=1)) + 1.0, np.ceil(s.max(axis=1)) - 1.0
        count = np.maximum(last - first + 1.0, 0.0).astype(np.int64)
        face = np.repeat(np.arange(len(faces)), count)
        level = first[face] + np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
        own, p = s[face], corners[face]
        ends = np.zeros((len(face), 2, 3))
        met = np.zeros(len(face), np.int64)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            crossed = ((own[:, a] < level) != (own[:, b] < level)) & (met < 2)
            rows = np.flatnonzero(crossed)
            at = ((level - own[:, a])[rows] / (own[:, b] - own[:, a])[rows])[:, None]
            ends[rows, met[rows]] = (1.0 - at) * p[rows, a] + at * p[rows, b]
            met[rows] += 1
        keep = (met == 2) & (np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 0.0)
        add(axis, face[keep], ends[keep], level[keep])
        beside, alone = _along_sides(scene, faces, s, seams)
        sides = np.stack([corners[beside, (alone + 1) % 3], corners[beside, (alone + 2) % 3]], axis=1)
        add(axis, beside, sides, s[beside].min(axis=1))
    return tuple(np.concatenate([part[k] for part in found]) for k in range(5))


def _along_sides(scene: Scene, faces: np.ndarray, s: np.ndarray, seams: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return which faces have a line along a side below them, and the corner opposite of it.

    Across the side nothing but the texture may jump, or (``seams``) it is a seam with a line along either side.
    """
    low = s.min(axis=1)
    on = s == low[:, None]
    own = np.flatnonzero((on.sum(axis=1) == 2) & (low == np.floor(low)))
    alone = (~on[own]).argmax(axis=1)
    if not len(own):
        return own, alone
    edges = scene_adjacency(scene)
    side = face_edges(scene, edges)[faces[own], alone]
    keep = (side >= 0) & smooth_edges(scene, edges)[side]
    if seams:
        high = s.max(axis=1)
        ends_above = ((s == high[:, None]).sum(axis=1) == 2) & (high == np.floor(high))
        above = np.zeros(scene.face_count, bool)
        above[faces] = ends_above
        first = edges.first[:-1][side]
        other = edges.faces[first] + edges.faces[np.minimum(first + 1, len(edges.faces) - 1)] - faces[own]
        seam = (edges.count[side] == 2) & (edges.ends[side] != edges.twins[side]).any(axis=1)
        keep |= (side >= 0) & seam & above[np.where(seam, other, 0)]
    return own[keep], alone[keep]

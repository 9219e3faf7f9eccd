"""Tessellations of the analytic shapes, in object space.

Vertices lie *on* the surface, so that a sphere, disk or cylinder of ``n`` segments is inscribed: its area and volume
are smaller, by a relative error of about (pi / n)^2 (0.24 % at the default 64 segments) or less. Lights are widened
until they have the area of the shape (``kinds/affine.py``). Normals are analytic.
Vertices are shared between triangles except along seams of the texture coordinates, where both copies have the same
position, bit for bit; closed shapes therefore are watertight. Texture coordinates follow Mitsuba:

* rectangle: ((x + 1) / 2, (y + 1) / 2);
* cube: the unit square on each face;
* sphere: (azimuth / 2 pi, inclination from +z / pi);
* disk: (distance from the centre, azimuth / 2 pi);
* cylinder: (azimuth / 2 pi, height).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

#: Segments of a full turn.
DEFAULT_RESOLUTION = 64
MIN_RESOLUTION = 3
#: A sphere of so many has 4 million triangles, and its error is below that of float32.
MAX_RESOLUTION = 2048


@dataclass(eq=False)
class Tessellation:
    """An object-space mesh, counter-clockwise seen from where the normals point."""

    vertices: np.ndarray  #: (N, 3) float64
    faces: np.ndarray  #: (M, 3) int32
    normals: np.ndarray  #: (N, 3) float64, unit
    texcoords: np.ndarray  #: (N, 2) float64


def rectangle(resolution: int = DEFAULT_RESOLUTION) -> Tessellation:
    """Return the square [-1, 1]^2 in the plane z = 0, normal +z, two triangles."""
    xy = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    vertices = np.pad(xy, ((0, 0), (0, 1)))
    return Tessellation(vertices, _int([[0, 1, 2], [2, 3, 0]]), np.tile([0.0, 0.0, 1.0], (4, 1)), 0.5 * (xy + 1.0))


def cube(resolution: int = DEFAULT_RESOLUTION) -> Tessellation:
    """Return the cube [-1, 1]^3: 24 vertices with the faces' normals, in Mitsuba's order."""
    corners = (
        "+-- +-+ --+ --- ++- -+- -++ +++ +-- ++- +++ +-+ +-+ +++ -++ --+ --+ -++ -+- --- ++- +-- --- -+-"
    ).split()
    vertices = np.array([[1.0 if sign == "+" else -1.0 for sign in corner] for corner in corners])
    sides = np.array([[0, -1, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1]], dtype=np.float64)
    faces = np.concatenate([np.array([[0, 1, 2], [3, 0, 2]]) + 4 * side for side in range(6)])
    texcoords = np.tile([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]], (6, 1))
    return Tessellation(vertices, _int(faces), np.repeat(sides, 4, axis=0), texcoords)


def sphere(resolution: int = DEFAULT_RESOLUTION) -> Tessellation:
    """Return the unit sphere: ``resolution`` meridians and half as many bands, one vertex a segment at the poles."""
    bands = max(2, resolution // 2)
    circle = _circle(resolution)
    inclination = np.pi * np.arange(1, bands) / bands
    u = np.arange(resolution + 1) / resolution
    rings = np.empty((bands - 1, resolution + 1, 3))
    rings[..., :2] = np.sin(inclination)[:, None, None] * circle
    rings[..., 2] = np.cos(inclination)[:, None]
    pole_u = u[:-1] + 0.5 / resolution
    pole = np.array([0.0, 0.0, 1.0])
    vertices = np.concatenate([np.tile(pole, (resolution, 1)), rings.reshape(-1, 3), np.tile(-pole, (resolution, 1))])
    texcoords = np.concatenate(
        [
            np.stack([pole_u, np.zeros(resolution)], axis=1),
            np.stack(np.broadcast_arrays(u, (np.arange(1, bands) / bands)[:, None]), axis=-1).reshape(-1, 2),
            np.stack([pole_u, np.ones(resolution)], axis=1),
        ]
    )
    segment, columns = np.arange(resolution), resolution + 1
    starts = resolution + columns * np.arange(bands - 1)
    last = starts[-1]
    top = np.stack([segment, resolution + segment, resolution + segment + 1], axis=1)
    bottom = np.stack([last + segment, last + columns + segment, last + segment + 1], axis=1)
    middle = [_band(upper, lower, segment) for upper, lower in itertools.pairwise(starts.tolist())]
    return Tessellation(vertices, _int(np.concatenate([top, *middle, bottom])), vertices.copy(), texcoords)


def disk(resolution: int = DEFAULT_RESOLUTION) -> Tessellation:
    """Return the unit disk in the plane z = 0, normal +z: a fan with one copy of the centre a segment."""
    rim = np.pad(_circle(resolution), ((0, 0), (0, 1)))
    turn, segment = np.arange(resolution + 1) / resolution, np.arange(resolution)
    vertices = np.concatenate([rim, np.zeros((resolution, 3))])
    texcoords = np.concatenate(
        [
            np.stack([np.ones(resolution + 1), turn], axis=1),
            np.stack([np.zeros(resolution), turn[:-1] + 0.5 / resolution], axis=1),
        ]
    )
    faces = np.stack([resolution + 1 + segment, segment, segment + 1], axis=1)
    return Tessellation(vertices, _int(faces), np.tile([0.0, 0.0, 1.0], (len(vertices), 1)), texcoords)


def cylinder(resolution: int = DEFAULT_RESOLUTION) -> Tessellation:
    """Return the open cylinder of radius 1 about z from z = 0 to z = 1, normals outwards."""
    circle, columns = _circle(resolution), resolution + 1
    normals = np.pad(circle, ((0, 0), (0, 1)))
    turn = np.arange(columns) / resolution
    vertices = np.concatenate([normals, normals + np.array([0.0, 0.0, 1.0])])
    texcoords = np.concatenate([np.stack([turn, np.full(columns, v)], axis=1) for v in (0.0, 1.0)])
    faces = _band(columns, 0, np.arange(resolution))
    return Tessellation(vertices, _int(faces), np.concatenate([normals, normals]), texcoords)


def surface_area(vertices: np.ndarray, faces: np.ndarray, to_world: np.ndarray) -> float:
    """Return the area of triangles (M, 3) of vertices (N, 3) under ``to_world`` (4, 4)."""
    corners = (vertices @ to_world[:3, :3].T)[faces]
    return 0.5 * float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )


def _circle(resolution: int) -> np.ndarray:
    """Return points on the unit circle, the last a bit-exact copy of the first, shape (resolution + 1, 2)."""
    angle = 2.0 * np.pi * np.arange(resolution) / resolution
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([points, points[:1]])


def _band(upper: int, lower: int, segment: np.ndarray) -> np.ndarray:
    """Return two triangles a segment between two rows of vertices that start at ``upper`` and ``lower``."""
    quads = np.stack([upper + segment, lower + segment, lower + segment + 1, upper + segment + 1], axis=1)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _int(faces: object) -> np.ndarray:
    return np.asarray(faces, dtype=np.int32)

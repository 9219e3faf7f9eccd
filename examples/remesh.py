"""Makes even triangles of an uneven mesh, and measures the distance between two surfaces.

A mesh that was pulled far has long triangles where it grew and tiny ones where it shrank. ``remesh`` samples its signed
distance on a grid, puts one vertex into every cell that the surface crosses [Gib98], and slides the vertices along the
old surface until they are evenly spread. Where the old surface ran into itself, the new one is the outer hull.

[Gib98] S. Gibson: Constrained Elastic Surface Nets. MICCAI 1998.
"""

from __future__ import annotations

import numpy as np
import warp as wp

#: Further than any point of a mesh; the queries want a limit.
FAR = 1.0e6
#: Cells of empty space around a mesh in the grid, and rounds of smoothing.
MARGIN, ROUNDS = 2.5, 8


@wp.kernel(enable_backward=False)
def signed_distance(
    # In:
    mesh: wp.uint64,
    low: wp.vec3,
    spacing: wp.float32,
    # Out:
    distance_out: wp.array3d(dtype=wp.float32),
):
    """Distance of grid points, negative inside, which the winding number decides."""
    i, j, k = wp.tid()
    point = low + spacing * wp.vec3(wp.float32(i), wp.float32(j), wp.float32(k))
    query = wp.mesh_query_point_sign_winding_number(mesh, point, FAR)
    distance_out[i, j, k] = query.sign * wp.length(point - wp.mesh_eval_position(mesh, query.face, query.u, query.v))


@wp.kernel(enable_backward=False)
def closest_point(
    # In:
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    # Out:
    closest_out: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], FAR)
    closest_out[i] = wp.mesh_eval_position(mesh, query.face, query.u, query.v)


def as_mesh(vertices: np.ndarray, faces: np.ndarray) -> wp.Mesh:
    indices = wp.array(np.asarray(faces).reshape(-1), dtype=wp.int32, device="cpu")
    return wp.Mesh(wp.array(vertices, dtype=wp.vec3, device="cpu"), indices, support_winding_number=True)


def project(points: np.ndarray, mesh: wp.Mesh) -> np.ndarray:
    """Return the points of a mesh that are closest to points (N, 3)."""
    closest = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    inputs = [mesh.id, wp.array(points, dtype=wp.vec3, device="cpu")]
    wp.launch(closest_point, dim=len(points), inputs=inputs, outputs=[closest], device="cpu")
    return closest.numpy().astype(np.float64)


def surface_distance(first: tuple, second: tuple, count: int = 20000) -> float:
    """Return the mean distance between two meshes (vertices, faces).

    From ``count`` random points of each surface to the nearest point of the other; the mean of both directions.
    """
    import trimesh

    means = []
    for one, other in ((first, second), (second, first)):
        points = trimesh.sample.sample_surface(trimesh.Trimesh(*one, process=False), count, seed=1)[0]
        means.append(np.linalg.norm(points - project(points, as_mesh(*other)), axis=1).mean())
    return float(np.mean(means))


def remesh(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (N, 3) and triangles (M, 3) of the same surface, with edges of about ``spacing``."""
    mesh = as_mesh(vertices, faces)
    low = vertices.min(axis=0) - MARGIN * spacing
    shape = tuple(np.ceil((vertices.max(axis=0) - low) / spacing + MARGIN).astype(int) + 1)
    grid = wp.zeros(shape, dtype=wp.float32, device="cpu")
    wp.launch(signed_distance, shape, [mesh.id, wp.vec3(*low), float(spacing)], [grid], device="cpu")
    cells, quads = surface_net(grid.numpy().astype(np.float64))
    points = low + spacing * cells
    sides = np.concatenate([quads[:, [a, (a + 1) % 4]] for a in range(4)])
    sides = np.unique(np.sort(sides, axis=1), axis=0)
    degree = np.bincount(sides.reshape(-1), minlength=len(points))
    for _ in range(ROUNDS):
        total = np.zeros_like(points)
        np.add.at(total, sides[:, 0], points[sides[:, 1]])
        np.add.at(total, sides[:, 1], points[sides[:, 0]])
        points = project(0.5 * points + 0.5 * total / degree[:, None], mesh)
    # Two triangles a quad, cut along the shorter diagonal.
    p = points[quads]
    cut = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) > np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    quads = np.where(cut[:, None], np.roll(quads, -1, axis=1), quads)
    return points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def surface_net(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (N, 3) in grid units and quads (M, 4), fronts outside, of the zero level of values on a grid."""
    cells = np.array(distance.shape) - 1
    total, count = np.zeros((*cells, 3)), np.zeros(cells)
    corner = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).astype(np.float64)
    for axis in range(3):
        b, c = (a for a in range(3) if a != axis)
        for at_b, at_c in np.ndindex(2, 2):  # the four edges of a cell along this axis
            offset = np.zeros(3, int)
            offset[[b, c]] = at_b, at_c
            start = distance[tuple(slice(o, o + n) for o, n in zip(offset, cells, strict=True))]
            offset[axis] = 1
            end = distance[tuple(slice(o, o + n) for o, n in zip(offset, cells, strict=True))]
            crossed = (start < 0.0) != (end < 0.0)
            point = corner + np.where(np.arange(3) == axis, 0, offset)
            point[..., axis] += np.where(crossed, start, 0.0) / np.where(crossed, start - end, 1.0)
            total += point * crossed[..., None]
            count += crossed
    number = np.where(count > 0, np.cumsum(count.reshape(-1) > 0).reshape(count.shape) - 1, -1)
    vertices = total[count > 0] / count[count > 0][:, None]
    quads = []
    for axis in range(3):  # a quad for every grid edge that the surface crosses, of the four cells around it
        b, c = (axis + 1) % 3, (axis + 2) % 3
        start = [slice(1, n) for n in cells]
        start[axis] = slice(0, cells[axis])
        end = list(start)
        end[axis] = slice(1, cells[axis] + 1)
        inside, outside = distance[tuple(start)] < 0.0, distance[tuple(end)] < 0.0
        where = np.argwhere(inside != outside)
        around = []
        for at_b, at_c in ((0, 0), (1, 0), (1, 1), (0, 1)):
            cell = where.copy()
            cell[:, b] += at_b
            cell[:, c] += at_c
            around.append(number[tuple(cell.T)])
        quad = np.stack(around, axis=1)
        leaves = inside[inside != outside]
        quads.append(np.where(leaves[:, None], quad, quad[:, ::-1]))
    return vertices, np.concatenate(quads)

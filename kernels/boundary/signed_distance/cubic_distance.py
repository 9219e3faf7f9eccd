"""The signed distance of a cubic grid (``sdfgrid_cubic.py``), in units of its box and known inside of it.

Derivation: ``docs/theory/signed_distances.md#the-motion-of-rays``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.box import inside_box, known_in_box
from warp_psdr.kernels.boundary.signed_distance.distance import Distance, Field, similar_scale
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, make_pose_sink
from warp_psdr.kernels.primitive.sdfgrid import Grid, grid_of, voxel_corner
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_field, spline_hessian, spline_row
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import make_spline_sink
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def spline_weights_d(x: wp.float64) -> wp.vec4d:
    """``spline_weights`` in double precision."""
    y = wp.float64(1.0) - x
    three = wp.float64(3.0)
    four = wp.float64(4.0)
    six = wp.float64(6.0)
    return wp.vec4d(
        y * y * y / six, (four + x * x * (three * x - six)) / six, (four + y * y * (three * y - six)) / six,
        x * x * x / six,
    )  # fmt: skip


@wp.func
def spline_value(scene: Scene, g: Grid, i: wp.int32, j: wp.int32, k: wp.int32, x: wp.vec3d) -> wp.float32:
    """Phi at the place x in a voxel, [0, 1]^3: the rounding of float32 is that of the result."""
    wx = spline_weights_d(x[0])
    wy = spline_weights_d(x[1])
    wz = spline_weights_d(x[2])
    total = wp.float64(0.0)
    row = wp.int32(0)
    while row < 16:
        b = row & 3
        c = row >> 2
        total += wy[b] * wz[c] * wp.dot(wx, wp.vec4d(spline_row(scene, g, i, j + b - 1, k + c - 1)))
        row += 1
    return wp.float32(total)


@wp.func
def cubic_distance(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3, t: wp.float64) -> Distance:
    r = Distance()
    g = grid_of(scene, tri)
    start = from_axes(tri, o - tri.normal)
    way = from_axes(tri, w)
    q = wp.vec3d(start) + t * wp.vec3d(way)
    p = wp.cw_mul(wp.vec3d(g.cells), q)
    i = wp.clamp(wp.int32(wp.floor(p[0])), 0, g.nx - 2)
    j = wp.clamp(wp.int32(wp.floor(p[1])), 0, g.ny - 2)
    k = wp.clamp(wp.int32(wp.floor(p[2])), 0, g.nz - 2)
    x = p - wp.vec3d(voxel_corner(i, j, k))
    scale = similar_scale(tri)
    r.phi = scale * spline_value(scene, g, i, j, k, x)
    inside_voxel = wp.vec3(x)
    found = spline_field(scene, g, i, j, k, inside_voxel)
    inverse = scale / determinant(tri)
    r.gradient = inverse * cofactor(tri, wp.cw_mul(g.cells, wp.vec3(found[0], found[1], found[2])))
    sign = wp.where(r.phi < 0.0, -1.0, 1.0)
    r.step = sign * r.phi
    r.step_gradient = sign * r.gradient
    # The Hessian is s A^-T C H C A^-1, A^-T = A / s^2.
    h = wp.diag(g.cells) * spline_hessian(scene, g, i, j, k, inside_voxel) * wp.diag(g.cells)
    turn = wp.matrix_from_cols(tri.p0, tri.p1, tri.p2) * (1.0 / (scale * scale))
    r.hessian = scale * (turn * h * wp.transpose(turn))
    share = inside_box(tri, wp.vec3(q))
    r.inside = share[3]
    r.inside_gradient = wp.vec3(share[0], share[1], share[2])
    return r


@functools.cache
def make_cubic_distance_pull(role: str):
    """Return ``pull``: phi_pi = s phi_pi(q) - grad phi . (A' q + b'), q = A^-1 (x - b)."""
    accumulate_pose = make_pose_sink(role)
    accumulate_spline = make_spline_sink(role)

    @wp.func
    def pull_cubic_distance(
        scene: Scene, target: wp.array(dtype=wp.float32), tri: Triangle, x: wp.vec3, a_phi: wp.float32, a_g: wp.vec3
    ) -> wp.float32:
        g = grid_of(scene, tri)
        at = cubic_distance(scene, tri, x, x, wp.float64(0.0))
        scale = similar_scale(tri)
        q = from_axes(tri, x - tri.normal)
        p = from_axes(tri, a_g)
        place = wp.cw_mul(g.cells, q)
        i = wp.clamp(wp.int32(wp.floor(place[0])), 0, g.nx - 2)
        j = wp.clamp(wp.int32(wp.floor(place[1])), 0, g.ny - 2)
        k = wp.clamp(wp.int32(wp.floor(place[2])), 0, g.nz - 2)
        local = place - voxel_corner(i, j, k)
        total = accumulate_spline(target, g, i, j, k, local, scale * a_phi, scale * wp.cw_mul(g.cells, p))
        pulled = -(a_phi * at.gradient + at.hessian * a_g)
        n = at.gradient
        total += accumulate_pose(
            target, tri, q[0] * pulled - p[0] * n, q[1] * pulled - p[1] * n, q[2] * pulled - p[2] * n, pulled
        )
        return total

    return pull_cubic_distance


CUBIC = Field(similar_scale, known_in_box, cubic_distance, make_cubic_distance_pull, convex=False)

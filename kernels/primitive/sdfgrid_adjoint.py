"""The sinks for the adjoint of a point on a grid of signed distances: the values around it, and the pose.

A grid has no material points. A vertex slides along the ray o + t d that found it (form S),

    t' = -(Phi' + grad Phi . (o' + t d')) / (grad Phi . d),        x' = o' + t d' + t' d,

and the start of a ray that leaves a grid moves with the pose and across the surface,

    c' = A' q + b' - phi' grad Phi / |grad Phi|^2,

which stays on the surface and depends on the position alone. Phi' is the derivative of phi at a position at rest, by
values and pose, and phi' the one by the values. The normal turns with the position and with the values; a value adds
the gradient of its weight to the gradient of phi.

Derivation: ``docs/theory/implicit.md#form-s``.
"""

import functools

import warp as wp

from warp_psdr.kernels.primitive.affine import cofactor, determinant, make_pose_sink, to_axes
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.network_surface import make_cell_sink, network_bend, network_point
from warp_psdr.kernels.primitive.normal_flow import make_flow_pull
from warp_psdr.kernels.primitive.sdfgrid import Grid, Voxel, grid_of
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_hessian
from warp_psdr.kernels.primitive.sdfgrid_cubic_surface import make_spline_sink, spline_point
from warp_psdr.kernels.primitive.sdfgrid_surface import (
    blend,
    held_point,
    slope_along,
    slope_of_slab,
    smooth_gradient,
    voxel_corner,
)
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import RayAdjoint, VertexAdjoint, normalize_vjp


@wp.func
def mixed_differences(c: Voxel, x: wp.vec3) -> wp.vec3:
    """Second derivatives of phi by y and z, z and x, x and y at the place x in a voxel; the other ones are 0."""
    x0 = (c.v011 - c.v001) - (c.v010 - c.v000)
    x1 = (c.v111 - c.v101) - (c.v110 - c.v100)
    y0 = (c.v101 - c.v001) - (c.v100 - c.v000)
    y1 = (c.v111 - c.v011) - (c.v110 - c.v010)
    z0 = (c.v110 - c.v010) - (c.v100 - c.v000)
    z1 = (c.v111 - c.v011) - (c.v101 - c.v001)
    return wp.vec3(wp.lerp(x0, x1, x[0]), wp.lerp(y0, y1, x[1]), wp.lerp(z0, z1, x[2]))


@wp.func
def bend_of(h: wp.vec3, w: wp.vec3) -> wp.vec3:
    """H w, H the Hessian with the mixed derivatives h."""
    return wp.vec3(h[2] * w[1] + h[1] * w[2], h[2] * w[0] + h[0] * w[2], h[1] * w[0] + h[0] * w[1])


@wp.func
def still_share(at: wp.int32, nodes: wp.int32) -> wp.float32:
    """Derivative of ``blend`` by the place."""
    return wp.where(at < 0 or at > nodes - 3, 0.0, 1.0)


@wp.func
def slab_rates(
    scene: Scene,
    at: wp.int32,
    stride: wp.int32,
    nodes: wp.int32,
    first: wp.int32,
    stride_a: wp.int32,
    stride_b: wp.int32,
    a: wp.float32,
    b: wp.float32,
) -> wp.vec2:
    """Derivatives of ``slope_of_slab`` by a and b."""
    s00 = slope_along(scene, first, stride, at, nodes)
    s10 = slope_along(scene, first + stride_a, stride, at, nodes)
    s01 = slope_along(scene, first + stride_b, stride, at, nodes)
    s11 = slope_along(scene, first + stride_a + stride_b, stride, at, nodes)
    return wp.vec2(wp.lerp(s10 - s00, s11 - s01, b), wp.lerp(s01 - s00, s11 - s10, a))


@functools.cache
def make_voxel_sink(role: str):
    """Return ``accumulate(target, g, i, j, k, x, a_phi, a_gradient) -> float`` at the place x in a voxel, [0, 1]^3.

    ``a_phi`` is the adjoint of phi there, ``a_gradient`` that of its gradient, in voxels.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_voxel(
        target: wp.array(dtype=wp.float32),
        g: Grid,
        i: wp.int32,
        j: wp.int32,
        k: wp.int32,
        x: wp.vec3,
        a_phi: wp.float32,
        a_gradient: wp.vec3,
    ) -> wp.float32:
        first = g.first + (k * g.ny + j) * g.nx + i
        total = wp.float32(0.0)
        corner = wp.int32(0)
        while corner < 8:
            at_x = corner & 1
            at_y = (corner >> 1) & 1
            at_z = corner >> 2
            wx = wp.where(at_x == 1, x[0], 1.0 - x[0])
            wy = wp.where(at_y == 1, x[1], 1.0 - x[1])
            wz = wp.where(at_z == 1, x[2], 1.0 - x[2])
            value = a_phi * wx * wy * wz
            value += wp.where(at_x == 1, a_gradient[0], -a_gradient[0]) * wy * wz
            value += wp.where(at_y == 1, a_gradient[1], -a_gradient[1]) * wx * wz
            value += wp.where(at_z == 1, a_gradient[2], -a_gradient[2]) * wx * wy
            total += sink(target, first + at_x + at_y * g.nx + at_z * g.nx * g.ny, value)
            corner += 1
        return total

    return accumulate_voxel


@functools.cache
def make_smooth_sink(role: str):
    """Return ``accumulate(scene, target, g, p, i, j, k, a) -> (vec3, float)``: the adjoint a of ``smooth_gradient``.

    The vector is the adjoint of p.
    """
    sink = make_sink(role)

    @wp.func
    def accumulate_slab(
        target: wp.array(dtype=wp.float32),
        at: wp.int32,
        stride: wp.int32,
        nodes: wp.int32,
        first: wp.int32,
        stride_a: wp.int32,
        stride_b: wp.int32,
        a: wp.float32,
        b: wp.float32,
        value: wp.float32,
    ) -> wp.float32:
        """The adjoint of ``slope_of_slab``."""
        total = wp.float32(0.0)
        if at < 0 or at >= nodes - 1:
            return total
        row = wp.int32(0)
        while row < 4:
            at_a = row & 1
            at_b = row >> 1
            w = value * wp.where(at_a == 1, a, 1.0 - a) * wp.where(at_b == 1, b, 1.0 - b)
            place = first + at * stride + at_a * stride_a + at_b * stride_b
            total += sink(target, place + stride, w) + sink(target, place, -w)
            row += 1
        return total

    @wp.func
    def accumulate_smooth(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        g: Grid,
        p: wp.vec3,
        i: wp.int32,
        j: wp.int32,
        k: wp.int32,
        a: wp.vec3,
    ) -> tuple[wp.vec3, wp.float32]:
        sy = g.nx
        sz = g.nx * g.ny
        at = p - voxel_corner(i, j, k)
        # ---- As in ``smooth_gradient`` ----
        ci = wp.int32(wp.floor(p[0] + 0.5)) - 1
        cj = wp.int32(wp.floor(p[1] + 0.5)) - 1
        ck = wp.int32(wp.floor(p[2] + 0.5)) - 1
        row_x = g.first + j * sy + k * sz
        row_y = g.first + i + k * sz
        row_z = g.first + i + j * sy
        share = wp.vec3(blend(ci, g.nx, p[0]), blend(cj, g.ny, p[1]), blend(ck, g.nz, p[2]))
        low = wp.cw_mul(
            g.cells,
            wp.vec3(
                slope_of_slab(scene, ci, 1, g.nx, row_x, sy, sz, at[1], at[2]),
                slope_of_slab(scene, cj, sy, g.ny, row_y, 1, sz, at[0], at[2]),
                slope_of_slab(scene, ck, sz, g.nz, row_z, 1, sy, at[0], at[1]),
            ),
        )
        high = wp.cw_mul(
            g.cells,
            wp.vec3(
                slope_of_slab(scene, ci + 1, 1, g.nx, row_x, sy, sz, at[1], at[2]),
                slope_of_slab(scene, cj + 1, sy, g.ny, row_y, 1, sz, at[0], at[2]),
                slope_of_slab(scene, ck + 1, sz, g.nz, row_z, 1, sy, at[0], at[1]),
            ),
        )
        # ---- The eight normals and their shares ----
        a_low = wp.vec3(0.0, 0.0, 0.0)
        a_high = wp.vec3(0.0, 0.0, 0.0)
        a_share = wp.vec3(0.0, 0.0, 0.0)
        corner = wp.int32(0)
        while corner < 8:
            cx = wp.where((corner & 1) == 1, 1.0, 0.0)
            cy = wp.where(((corner >> 1) & 1) == 1, 1.0, 0.0)
            cz = wp.where((corner >> 2) == 1, 1.0, 0.0)
            wx = wp.lerp(1.0 - share[0], share[0], cx)
            wy = wp.lerp(1.0 - share[1], share[1], cy)
            wz = wp.lerp(1.0 - share[2], share[2], cz)
            m = wp.vec3(
                wp.lerp(low[0], high[0], cx),
                wp.lerp(low[1], high[1], cy),
                wp.lerp(low[2], high[2], cz),
            )
            n = wp.normalize(m)
            a_m = (wx * wy * wz) * normalize_vjp(n, wp.length(m), a)
            high_m = wp.cw_mul(wp.vec3(cx, cy, cz), a_m)
            a_high += high_m
            a_low += a_m - high_m
            along = wp.dot(n, a)
            a_share += along * wp.vec3(
                (2.0 * cx - 1.0) * wy * wz,
                (2.0 * cy - 1.0) * wx * wz,
                (2.0 * cz - 1.0) * wx * wy,
            )
            corner += 1
        a_low = wp.cw_mul(g.cells, a_low)
        a_high = wp.cw_mul(g.cells, a_high)
        # ---- The slopes ----
        a_p = wp.cw_mul(a_share, wp.vec3(still_share(ci, g.nx), still_share(cj, g.ny), still_share(ck, g.nz)))
        total = wp.float32(0.0)
        side = wp.int32(0)
        while side < 2:
            a_slope = a_low
            if side == 1:
                a_slope = a_high
            x_rates = slab_rates(scene, ci + side, 1, g.nx, row_x, sy, sz, at[1], at[2])
            y_rates = slab_rates(scene, cj + side, sy, g.ny, row_y, 1, sz, at[0], at[2])
            z_rates = slab_rates(scene, ck + side, sz, g.nz, row_z, 1, sy, at[0], at[1])
            a_p += wp.vec3(
                a_slope[1] * y_rates[0] + a_slope[2] * z_rates[0],
                a_slope[0] * x_rates[0] + a_slope[2] * z_rates[1],
                a_slope[0] * x_rates[1] + a_slope[1] * y_rates[1],
            )
            total += accumulate_slab(target, ci + side, 1, g.nx, row_x, sy, sz, at[1], at[2], a_slope[0])
            total += accumulate_slab(target, cj + side, sy, g.ny, row_y, 1, sz, at[0], at[2], a_slope[1])
            total += accumulate_slab(target, ck + side, sz, g.nz, row_z, 1, sy, at[0], at[1], a_slope[2])
            side += 1
        return a_p, total

    return accumulate_smooth


@functools.cache
def make_sdfgrid_sink(
    role: str, cubic: bool = False, network: bool = False, flow: bool = False, geometric: bool = False
):
    """Return ``accumulate(scene, target, tri, u, v, adjoint, by_ray, o, d) -> RayAdjoint``, as ``make_vertex_sink``'s.

    ``by_ray``: of the vertex that the ray (o, d) finds; otherwise the adjoint is that of c, and has a place alone.

    Args:
        role: of the sinks.
        cubic: of a smooth grid, whose normal is the gradient's, and turns with the place by the Hessian.
        network: of a network, whose normal does the same.
        flow: vertices flow along normals, which are continuous: the adjoints of c and of the normal count as well.
        geometric: the adjoint of the normal is that of the surface's own one, whatever is interpolated.
    """
    accumulate_pose = make_pose_sink(role)
    record_of = network_of if network else grid_of
    point_at = network_point if network else spline_point if cubic else held_point
    accumulate_field = make_spline_sink(role) if cubic else make_voxel_sink(role)
    accumulate_smooth = None if cubic or network or geometric else make_smooth_sink(role)
    accumulate_cell = make_cell_sink(role) if network else None
    pull_flow = make_flow_pull(network) if flow else None

    @wp.func
    def sdfgrid_sink(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        adjoint: VertexAdjoint,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
    ) -> RayAdjoint:
        result = RayAdjoint()
        total = wp.float32(0.0)
        g = record_of(scene, tri)
        at = point_at(scene, g, u, v)
        x = at.p - voxel_corner(at.i, at.j, at.k)
        q = wp.cw_div(at.p, g.cells)
        det = determinant(tri)
        slope = wp.cw_mul(g.cells, at.gradient)
        across = (1.0 / det) * cofactor(tri, slope)  # grad Phi
        zero = wp.vec3(0.0, 0.0, 0.0)
        if not by_ray:
            away = wp.dot(adjoint.x, across) / wp.max(wp.dot(across, across), 1.0e-30)
            pull = adjoint.x
            if wp.static(pull_flow is not None):
                turned = pull_flow(scene, tri, g, at, adjoint.c, adjoint.n)
                if wp.static(accumulate_cell is not None):
                    total += accumulate_cell(scene, target, g, at.p, turned.phi - away, turned.gradient)
                else:
                    total += accumulate_field(target, g, at.i, at.j, at.k, x, turned.phi - away, turned.gradient)
                total += accumulate_pose(
                    target, tri, q[0] * pull + turned.g0, q[1] * pull + turned.g1, q[2] * pull + turned.g2, pull
                )
            else:
                if wp.static(accumulate_cell is not None):
                    total += accumulate_cell(scene, target, g, at.p, -away, zero)
                else:
                    total += accumulate_field(target, g, at.i, at.j, at.k, x, -away, zero)
                total += accumulate_pose(target, tri, q[0] * pull, q[1] * pull, q[2] * pull, pull)
            result.dot = total
            return result
        a_gradient = wp.vec3(0.0, 0.0, 0.0)
        g0 = wp.vec3(0.0, 0.0, 0.0)
        g1 = wp.vec3(0.0, 0.0, 0.0)
        g2 = wp.vec3(0.0, 0.0, 0.0)
        h = wp.vec3(0.0, 0.0, 0.0)
        # ---- The shading normal, cof(A) m over its length ----
        if wp.dot(adjoint.n, adjoint.n) > 0.0:
            m = slope
            is_smooth = wp.bool(False)
            if wp.static(accumulate_smooth is not None):
                if g.smooth == 1:
                    interpolated = smooth_gradient(scene, g, at.p, at.i, at.j, at.k)
                    if wp.dot(interpolated, interpolated) > 0.0:
                        m = interpolated
                        is_smooth = True
            c = cofactor(tri, m)
            length = wp.length(c)
            a_c = normalize_vjp((1.0 / wp.where(length > 0.0, length, 1.0)) * c, length, wp.float32(tri.i2) * adjoint.n)
            g0 = wp.cross(m[2] * tri.p1 - m[1] * tri.p2, a_c)
            g1 = wp.cross(m[0] * tri.p2 - m[2] * tri.p0, a_c)
            g2 = wp.cross(m[1] * tri.p0 - m[0] * tri.p1, a_c)
            a_m = wp.vec3(
                wp.dot(a_c, wp.cross(tri.p1, tri.p2)),
                wp.dot(a_c, wp.cross(tri.p2, tri.p0)),
                wp.dot(a_c, wp.cross(tri.p0, tri.p1)),
            )
            a_p = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(accumulate_smooth is not None):
                if is_smooth:
                    moved, dot = accumulate_smooth(scene, target, g, at.p, at.i, at.j, at.k, a_m)
                    a_p = moved
                    total += dot
            if not is_smooth:
                a_gradient = wp.cw_mul(g.cells, a_m)
                if wp.static(network):
                    a_p = network_bend(scene, g, at.p, a_gradient)
                elif wp.static(cubic):
                    a_p = spline_hessian(scene, g, at.i, at.j, at.k, x) * a_gradient
                else:
                    a_p = bend_of(mixed_differences(at.voxel, x), a_gradient)
            # q = A^-1 (x - b).
            h = (1.0 / det) * cofactor(tri, wp.cw_mul(g.cells, a_p))
        # ---- The place, which slides along the ray ----
        a_x = adjoint.x + h
        facing = wp.dot(across, d)
        share = wp.dot(a_x, d) / wp.where(facing == 0.0, 1.0, facing)
        pulled = share * across - h
        if wp.static(accumulate_cell is not None):
            total += accumulate_cell(scene, target, g, at.p, -share, a_gradient)
        else:
            total += accumulate_field(target, g, at.i, at.j, at.k, x, -share, a_gradient)
        total += accumulate_pose(target, tri, g0 + q[0] * pulled, g1 + q[1] * pulled, g2 + q[2] * pulled, pulled)
        k = a_x - share * across
        t = wp.dot(tri.normal + to_axes(tri, q) - o, d) / wp.dot(d, d)
        result.o = k
        result.d = t * k
        result.dot = total
        return result

    return sdfgrid_sink

"""Outlines of grids of signed distances and networks that a line crosses (``chain_outlines.py``).

Along a ray that nearly touches such a surface, phi comes close to 0 and turns. In a voxel of a linear grid phi is a
cubic polynomial, which turns inside of the voxel, or at its face, a crease. On cubic grids and networks, Newton's steps
find where grad phi . d = 0. Creases that are seen from the front, where the normal jumps, lie between two hits.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools
from collections.abc import Callable

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.silhouette.grid_points import TouchPoint, make_linear_touch_sink
from warp_psdr.kernels.boundary.silhouette.network_points import make_network_touch_sink
from warp_psdr.kernels.boundary.silhouette.spline_points import make_cubic_touch_sink
from warp_psdr.kernels.boundary.specular.chain_touch import (
    APART,
    GRAZED,
    JUMPS,
    SAME,
    SHEET,
    ChainOutline,
    ChainTouch,
)
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.primitive.affine import cofactor, determinant, from_axes, to_axes
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.kernels.primitive.network_surface import network_bend, network_field
from warp_psdr.kernels.primitive.sdfgrid import (
    Grid,
    cubic_along,
    grid_of,
    unpack,
    value_and_gradient,
    voxel_at,
    voxel_corner,
    voxel_of,
)
from warp_psdr.kernels.primitive.sdfgrid_adjoint import bend_of, mixed_differences
from warp_psdr.kernels.primitive.sdfgrid_cubic import spline_field, spline_hessian
from warp_psdr.kernels.structs import Scene, Triangle

#: Most voxels that a ray which meets a linear grid passes up to where phi turns.
VOXELS = 16
#: Newton's steps to where it turns, of smooth grids; the longest of them, in voxels; and what the last may be.
NEWTON, LONGEST, SETTLED = 8, 1.0, 1.0e-3
#: Squared length of a gradient below which it has no direction.
LEVEL = 1.0e-20


@wp.struct
class GridTouch:
    """Where a ray touches a grid, in voxels."""

    valid: wp.int32
    crease: wp.int32  # 1: it touches an edge between two sheets
    p: wp.vec3
    gradient: wp.vec3  # of phi; of a crease: in the face
    along: wp.vec3  # of a crease: its tangent
    off: wp.float32  # distance that was left between ray and surface
    curvature: wp.float32  # in the world


@wp.func
def slope_of(tri: Triangle, g: Grid, gradient: wp.vec3) -> wp.float32:
    """Length of the gradient of phi in the world."""
    return wp.length(cofactor(tri, wp.cw_mul(g.cells, gradient))) / wp.abs(determinant(tri))


@wp.func
def crease_at(scene: Scene, g: Grid, p: wp.vec3, at: wp.vec3i, axis: wp.int32) -> GridTouch:
    """The crease next to a place of the face across an axis of the voxel ``at``."""
    r = GridTouch()
    corner = voxel_corner(at[0], at[1], at[2])
    voxel = voxel_at(scene, g, at[0], at[1], at[2])
    f = value_and_gradient(voxel, p - corner)
    slope = wp.vec3(f[0], f[1], f[2])
    slope[axis] = 0.0
    squared = wp.length_sq(slope)
    if squared < LEVEL:
        return r
    r.crease = 1
    r.p = p - (f[3] / squared) * slope
    r.off = wp.abs(f[3]) / wp.sqrt(squared)
    f = value_and_gradient(voxel, r.p - corner)
    r.gradient = wp.vec3(f[0], f[1], f[2])
    r.gradient[axis] = 0.0
    normal = wp.vec3(0.0, 0.0, 0.0)
    normal[axis] = 1.0
    r.along = wp.cross(normal, r.gradient)
    r.valid = 1
    return r


@wp.func
def crease_between(scene: Scene, g: Grid, low: wp.vec3, high: wp.vec3) -> GridTouch:
    """The crease between two places of the surface, in neighbouring voxels."""
    a = voxel_of(g, low)
    b = voxel_of(g, high)
    axis = wp.where(a[0] != b[0], 0, wp.where(a[1] != b[1], 1, 2))
    at = wp.where(b[axis] > a[axis], b, a)
    p = 0.5 * (low + high)
    p[axis] = wp.float32(at[axis])
    return crease_at(scene, g, p, at, axis)


@wp.func
def linear_graze(scene: Scene, tri: Triangle, g: Grid, hit: wp.vec3, direction: wp.vec3) -> GridTouch:
    """Where phi turns along a ray next to a hit; the direction is in voxels."""
    r = GridTouch()
    p = hit
    at = voxel_of(g, p)
    w = direction
    axis = wp.int32(-1)
    k = wp.int32(0)
    while k < VOXELS:
        corner = voxel_corner(at[0], at[1], at[2])
        voxel = voxel_at(scene, g, at[0], at[1], at[2])
        c = cubic_along(voxel, p - corner, w)
        if k == 0 and c[1] > 0.0:
            # By a rounding the hit is behind where phi turns.
            w = -w
            c = cubic_along(voxel, p - corner, w)
        if k > 0 and c[1] >= 0.0:
            return crease_at(scene, g, p, at, axis)
        # Out of the voxel.
        out = wp.float32(1.0e30)
        for n in range(3):
            if w[n] != 0.0:
                s = (corner[n] + wp.where(w[n] > 0.0, 1.0, 0.0) - p[n]) / w[n]
                if s < out:
                    out = s
                    axis = n
        out = wp.max(out, 0.0)
        # The first root of its derivative.
        third = 3.0 * c[3]
        discriminant = c[2] * c[2] - third * c[1]
        root = wp.float32(1.0e30)
        if discriminant >= 0.0:
            q = -(c[2] + wp.where(c[2] >= 0.0, 1.0, -1.0) * wp.sqrt(discriminant))
            one = q / third
            other = c[1] / q
            if one >= 0.0:
                root = one
            if other >= 0.0 and other < root:
                root = other
        if root <= out:
            p += root * w
            f = value_and_gradient(voxel, p - corner)
            slopes = wp.vec3(f[0], f[1], f[2])
            squared = wp.length_sq(slopes)
            if squared < LEVEL:
                return r
            r.p = p - (f[3] / squared) * slopes
            r.off = wp.abs(f[3]) / wp.sqrt(squared)
            f = value_and_gradient(voxel, r.p - corner)
            r.gradient = wp.vec3(f[0], f[1], f[2])
            h = mixed_differences(voxel, r.p - corner)
            r.curvature = wp.dot(w, bend_of(h, w)) / slope_of(tri, g, r.gradient)
            r.valid = 1
            return r
        p += out * w
        forward = w[axis] > 0.0
        p[axis] = corner[axis] + wp.where(forward, 1.0, 0.0)
        at[axis] = at[axis] + wp.where(forward, 1, -1)
        if at[axis] < 0 or at[axis] > wp.int32(g.cells[axis]) - 1:
            return r
        k += 1
    return r


@functools.cache
def make_smooth_graze(field: wp.Function, bend: wp.Function) -> wp.Function:
    """Return ``graze(scene, tri, g, hit, w) -> GridTouch`` of a smooth surface, from (gradient, phi) and H w."""

    @wp.func
    def smooth_graze(scene: Scene, tri: Triangle, g: Grid, hit: wp.vec3, w: wp.vec3) -> GridTouch:
        r = GridTouch()
        p = hit
        longest = LONGEST / wp.length(w)
        last = wp.float32(1.0)
        for _k in range(wp.static(NEWTON)):
            f = field(scene, g, p)
            rate = wp.dot(w, bend(scene, g, p, w))
            step = -(f[0] * w[0] + f[1] * w[1] + f[2] * w[2]) / wp.where(rate == 0.0, 1.0, rate)
            last = wp.abs(step) / longest
            p += wp.clamp(step, -longest, longest) * w
        f = field(scene, g, p)
        slope = wp.vec3(f[0], f[1], f[2])
        squared = wp.length_sq(slope)
        # False for NaN, too.
        if not (last < SETTLED) or squared < LEVEL:
            return r
        r.p = p - (f[3] / squared) * slope
        r.off = wp.abs(f[3]) / wp.sqrt(squared)
        f = field(scene, g, r.p)
        r.gradient = wp.vec3(f[0], f[1], f[2])
        r.curvature = wp.dot(w, bend(scene, g, r.p, w)) / slope_of(tri, g, r.gradient)
        r.valid = 1
        return r

    return smooth_graze


@wp.func
def spline_level(scene: Scene, g: Grid, p: wp.vec3) -> wp.vec4:
    """(gradient, phi) of a smooth grid at a place, in voxels."""
    at = voxel_of(g, p)
    return spline_field(scene, g, at[0], at[1], at[2], p - voxel_corner(at[0], at[1], at[2]))


@wp.func
def spline_level_bend(scene: Scene, g: Grid, p: wp.vec3, w: wp.vec3) -> wp.vec3:
    """H w there."""
    at = voxel_of(g, p)
    return spline_hessian(scene, g, at[0], at[1], at[2], p - voxel_corner(at[0], at[1], at[2])) * w


@wp.func
def network_level(scene: Scene, g: Grid, p: wp.vec3) -> wp.vec4:
    """(gradient, phi) of a network at a place, in cells."""
    f = network_field(scene, g, wp.cw_div(p, g.cells))
    return wp.vec4(f[0] / g.cells[0], f[1] / g.cells[1], f[2] / g.cells[2], f[3])


@wp.func
def across_touch(tri: Triangle, cells: wp.vec3, touch: GridTouch, d: wp.vec3) -> wp.vec3:
    """Across the ray and the outline, of any length, in the world."""
    if touch.crease == 1:
        return wp.cross(to_axes(tri, wp.cw_div(touch.along, cells)), d)
    return wp.normalize(cofactor(tri, wp.cw_mul(cells, touch.gradient)))


@wp.func
def no_front(g: Grid, low: wp.vec2, high: wp.vec2) -> wp.bool:
    """On smooth surfaces normals do not jump."""
    return False


@wp.func
def voxels_differ(g: Grid, low: wp.vec2, high: wp.vec2) -> wp.bool:
    """Whether vertices hold points of two voxels of a linear grid."""
    a = voxel_of(g, wp.cw_mul(g.cells, unpack(low[0], low[1])))
    b = voxel_of(g, wp.cw_mul(g.cells, unpack(high[0], high[1])))
    return a[0] != b[0] or a[1] != b[1] or a[2] != b[2]


@functools.cache
def make_grid_outlines(
    record: wp.Function, graze: wp.Function, jumps: wp.Function, make_point_sink: Callable[[str], wp.Function]
) -> ChainTouch:
    """Return the functions of a kind.

    Args:
        record: ``(scene, tri) -> Grid``.
        graze: ``(scene, tri, g, hit, w) -> GridTouch`` of a ray, in voxels.
        jumps: ``(g, low, high) -> bool``: whether the normal jumps between what two vertices hold.
        make_point_sink: role -> the sink of a ``TouchPoint``.
    """

    @wp.func
    def grid_outline(
        scene: Scene,
        tri: Triangle,
        face: wp.int32,
        low: Link,
        high: Link,
        own_low: wp.bool,
        hit: wp.vec3,
        o: wp.vec3,
        d: wp.vec3,
        front: wp.bool,
    ) -> ChainOutline:
        r = ChainOutline()
        r.face = face
        g = record(scene, tri)
        t = GridTouch()
        if front:
            # The voxels that vertices hold: positions may miss them by a rounding.
            if wp.static(jumps is voxels_differ):
                a = wp.cw_mul(g.cells, unpack(low.u, low.v))
                b = wp.cw_mul(g.cells, unpack(high.u, high.v))
                t = crease_between(scene, g, a, b)
        else:
            q = from_axes(tri, hit - tri.normal)
            t = graze(scene, tri, g, wp.cw_mul(g.cells, q), wp.cw_mul(g.cells, from_axes(tri, d)))
        r.rim = t.crease
        r.q = wp.cw_div(t.p, g.cells)
        r.x = tri.normal + to_axes(tri, r.q)
        r.m = across_touch(tri, g.cells, t, wp.normalize(r.x - o))
        r.curvature = t.curvature
        r.gradient = t.gradient
        r.valid = wp.where(t.valid == 1 and t.off < GRAZED and wp.length_sq(r.m) > 0.0, 1, 0)
        return r

    @wp.func
    def grid_sheet(scene: Scene, tri: Triangle, low: Link, high: Link) -> wp.int32:
        g = record(scene, tri)
        size = wp.min(
            wp.min(wp.length(tri.p0) / g.cells[0], wp.length(tri.p1) / g.cells[1]), wp.length(tri.p2) / g.cells[2]
        )
        if wp.length(low.x - high.x) > SHEET * size:
            return APART
        return wp.where(jumps(g, wp.vec2(low.u, low.v), wp.vec2(high.u, high.v)), JUMPS, SAME)

    def make_sink(role: str) -> wp.Function:
        accumulate_point = make_point_sink(role)

        @wp.func
        def accumulate_grid_outline(
            scene: Scene, target: wp.array(dtype=wp.float32), outline: ChainOutline, a: wp.vec3
        ) -> wp.float32:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            g = record(scene, scene.triangles[outline.face])
            point = TouchPoint()
            point.face = outline.face
            point.q = outline.q
            point.gradient = outline.gradient
            point.place = wp.cw_mul(g.cells, outline.q)
            if wp.static(record is grid_of):
                p = point.place
                at = voxel_of(g, p)
                point.i = at[0]
                point.j = at[1]
                point.k = at[2]
                point.place = p - voxel_corner(at[0], at[1], at[2])
            return accumulate_point(scene, target, point, a)

        return accumulate_grid_outline

    return ChainTouch(grid_outline, grid_sheet, make_sink)


def grid_outlines() -> dict[int, ChainTouch]:
    """Return the functions of grids and networks: number of the kind -> its own."""
    cubic, network = make_smooth_graze(spline_level, spline_level_bend), make_smooth_graze(network_level, network_bend)
    return {
        LINEAR_GRID.number: make_grid_outlines(grid_of, linear_graze, voxels_differ, make_linear_touch_sink),
        CUBIC_GRID.number: make_grid_outlines(grid_of, cubic, no_front, make_cubic_touch_sink),
        NETWORK.number: make_grid_outlines(network_of, network, no_front, make_network_touch_sink),
    }

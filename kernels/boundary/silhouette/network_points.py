"""Points at which segments can touch a network: its surface and its silhouettes, cell by cell.

The items are cells, as the voxels of cubic grids are (``spline_points.py``), and all points of a line or a slice count.
The bound of a cell's second derivatives replaces Bezier coefficients: it bounds how far phi is from linear, and how
fast grad phi . (x - eye) changes.

Derivation: ``docs/theory/implicit.md#silhouettes-of-networks``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.silhouette.grid_points import (
    TouchPoint,
    from_voxels,
    make_touch_sink,
    place_point,
    surface_density,
    turn_axes,
    turn_axes_back,
)
from warp_psdr.kernels.boundary.silhouette.spline_points import CUBIC_VOXELS, spline_curve_density, spline_direction
from warp_psdr.kernels.primitive.affine import cofactor, determinant
from warp_psdr.kernels.primitive.network import network_cell, network_of, phi_along
from warp_psdr.kernels.primitive.network_roots import make_network_root
from warp_psdr.kernels.primitive.network_surface import make_cell_sink, network_bend, network_field
from warp_psdr.kernels.primitive.sdfgrid import Grid, voxel_corner
from warp_psdr.kernels.structs import Scene, Triangle

ANY_ROOT = make_network_root(True)
#: Halvings of a slice, after which a square holds one point of a silhouette, as of smooth grids.
FINEST_SQUARE = 5
#: Newton's steps from the middle of such a square, the last one of those that count, and one that is the last. Rounding
#: of phi keeps steps at some 1e-4 cells: points that end there count.
STEPS_MOST, STEP_COUNTS, STEP_LAST = 8, 2.0e-3, 1.0e-6


@wp.func
def network_touch(scene: Scene, tri: Triangle, g: Grid, point: TouchPoint) -> TouchPoint:
    """Fill in what the surface is like at a place of a cell."""
    r = point
    p = voxel_corner(r.i, r.j, r.k) + r.place
    found = network_field(scene, g, wp.cw_div(p, g.cells))
    r.gradient = wp.cw_div(wp.vec3(found[0], found[1], found[2]), g.cells)
    hx = network_bend(scene, g, p, wp.vec3(1.0, 0.0, 0.0))
    hy = network_bend(scene, g, p, wp.vec3(0.0, 1.0, 0.0))
    hz = network_bend(scene, g, p, wp.vec3(0.0, 0.0, 1.0))
    r.pure = wp.vec3(hx[0], hy[1], hz[2])
    r.mixed = wp.vec3(hy[2], hx[2], hx[1])
    r.out = wp.normalize(cofactor(tri, wp.cw_mul(g.cells, r.gradient)))
    if determinant(tri) < 0.0:
        r.out = -r.out
    r.valid = wp.where(wp.length_sq(r.gradient) > 0.0, 1, 0)
    return place_point(tri, g, r)


@wp.func
def network_surface_point(
    scene: Scene, tri: Triangle, g: Grid, at: wp.vec4i, u: wp.float32, v: wp.float32, choice: wp.float32
) -> TouchPoint:
    """Point of the surface in a cell: on a line along one of three axes, one of all roots."""
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
    y = 3.0 * u - wp.float32(axis)
    q = wp.cw_div(voxel_corner(r.i, r.j, r.k) + turn_axes_back(wp.vec3(0.0, y, v), axis), g.cells)
    way = wp.cw_div(turn_axes_back(wp.vec3(1.0, 0.0, 0.0), axis), g.cells)
    bend = -wp.dot(way, way) * network_cell(scene, g, r.i, r.j, r.k)
    inside = phi_along(scene.values, g.first, q, way)[0] < 0.0
    root, count = ANY_ROOT(scene, g.first, q, way, bend, inside, choice)
    if count == 0.0:
        return r
    r.place = turn_axes_back(wp.vec3(root, y, v), axis)
    r = network_touch(scene, tri, g, r)
    r.density = surface_density(r)
    r.roots = count
    return r


@wp.func
def away_from(p: wp.vec3, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
    """The way to a place from an eye, in cells; from a direction that direction."""
    if distant:
        return eye
    return p - eye


@wp.func
def point_in_square(
    scene: Scene,
    g: Grid,
    corner: wp.vec3,
    axis: wp.int32,
    x: wp.float32,
    low: wp.vec2,
    width: wp.float32,
    eye: wp.vec3,
    distant: wp.bool,
) -> tuple[wp.vec2, wp.bool]:
    """Where phi and grad phi . (x - eye) are zero in a square of a slice, and whether there is such a place."""
    y = low[0] + 0.5 * width
    z = low[1] + 0.5 * width
    last = wp.float32(1.0)
    for _k in range(wp.static(STEPS_MOST)):
        p = corner + turn_axes_back(wp.vec3(x, y, z), axis)
        away = away_from(p, eye, distant)
        found = network_field(scene, g, wp.cw_div(p, g.cells))
        gradient = wp.cw_div(wp.vec3(found[0], found[1], found[2]), g.cells)
        rate = network_bend(scene, g, p, away)
        if not distant:
            rate += gradient
        psi = wp.dot(gradient, away)
        f = turn_axes(gradient, axis)
        s = turn_axes(rate, axis)
        det = f[1] * s[2] - f[2] * s[1]
        step_y = (found[3] * s[2] - psi * f[2]) / det
        step_z = (f[1] * psi - s[1] * found[3]) / det
        # A step may leave the slice, but not by far.
        y = wp.clamp(y - step_y, -0.5, 1.5)
        z = wp.clamp(z - step_z, -0.5, 1.5)
        last = wp.abs(step_y) + wp.abs(step_z)
        if last < wp.static(STEP_LAST):
            break
    inside = y >= low[0] and y < low[0] + width and z >= low[1] and z < low[1] + width
    # False for NaN, too.
    return wp.vec2(y, z), inside and last < wp.static(STEP_COUNTS)


@wp.func
def network_curve_point(
    scene: Scene,
    tri: Triangle,
    g: Grid,
    at: wp.vec4i,
    eye: wp.vec3,
    distant: wp.bool,
    u: wp.float32,
    choice: wp.float32,
) -> TouchPoint:
    """Point of the silhouette that an eye, in cells, sees in a cell: in a slice across an axis, one of all.

    Squares of the slice in which phi, or grad phi . (x - eye), has one sign by the bound hold none; the others are cut
    in four, and Newton's steps end in the finest.
    """
    r = TouchPoint()
    r.i = at[0]
    r.j = at[1]
    r.k = at[2]
    corner = voxel_corner(r.i, r.j, r.k)
    axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
    x = 3.0 * u - wp.float32(axis)
    bend = -network_cell(scene, g, r.i, r.j, r.k) / (g.cells[0] * g.cells[0])
    count = wp.float32(0.0)
    root = wp.vec2(0.0, 0.0)
    rest = wp.float32(choice)
    level = wp.int32(0)
    n = wp.int32(0)
    width = wp.float32(1.0)
    while level >= 0:
        # The bits of n say in turn which halves of y and z the square is in.
        cy = wp.int32(0)
        cz = wp.int32(0)
        bit = wp.int32(0)
        while bit < level:
            cy += ((n >> (2 * bit)) & 1) << bit
            cz += ((n >> (2 * bit + 1)) & 1) << bit
            bit += 1
        low = wp.vec2(width * wp.float32(cy), width * wp.float32(cz))
        half = 0.5 * width
        p = corner + turn_axes_back(wp.vec3(x, low[0] + half, low[1] + half), axis)
        found = network_field(scene, g, wp.cw_div(p, g.cells))
        gradient = wp.cw_div(wp.vec3(found[0], found[1], found[2]), g.cells)
        away = away_from(p, eye, distant)
        across = turn_axes(gradient, axis)
        may_hold = wp.abs(found[3]) <= half * (wp.abs(across[1]) + wp.abs(across[2]) + bend * half)
        reach = 1.41422 * half
        steepest = bend * wp.length(away)
        if not distant:
            steepest += wp.length(gradient) + 2.0 * bend * reach
        if wp.abs(wp.dot(gradient, away)) > reach * steepest:
            may_hold = False
        if may_hold and level < wp.static(FINEST_SQUARE):
            level += 1
            n *= 4
            width *= 0.5
        else:
            if may_hold:
                place, is_one = point_in_square(scene, g, corner, axis, x, low, width, eye, distant)
                if is_one:
                    count += 1.0
                    if rest * count < 1.0:
                        root = place
                        rest = rest * count
                    else:
                        rest = (rest - 1.0 / count) / (1.0 - 1.0 / count)
            n += 1
            while level > 0 and (n & 3) == 0:
                n = n >> 2
                level -= 1
                width *= 2.0
            if level == 0:
                level = -1
    if count == 0.0:
        return r
    r.place = turn_axes_back(wp.vec3(x, root[0], root[1]), axis)
    r = network_touch(scene, tri, g, r)
    t = spline_direction(r, eye, distant)
    r.density = spline_curve_density(t)
    r.along = from_voxels(tri, g, t)
    r.roots = count
    r.valid = wp.where(r.density > 0.0, r.valid, 0)
    return r


@functools.cache
def make_network_touch_sink(role: str) -> wp.Function:
    """Return ``make_touch_sink``'s function for networks."""
    accumulate_cell = make_cell_sink(role)

    @wp.func
    def accumulate_network_phi(
        scene: Scene, target: wp.array(dtype=wp.float32), g: Grid, point: TouchPoint, a_phi: wp.float32
    ) -> wp.float32:
        zero = wp.vec3(0.0, 0.0, 0.0)
        return accumulate_cell(scene, target, g, voxel_corner(point.i, point.j, point.k) + point.place, a_phi, zero)

    return make_touch_sink(role, network_of, accumulate_network_phi)


NETWORK_CELLS = CUBIC_VOXELS._replace(
    record=network_of,
    seen=network_curve_point,
    place=network_surface_point,
    make_sink=make_network_touch_sink,
)

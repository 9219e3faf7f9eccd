"""Points of a grid whose interpolated normal is perpendicular to the direction from an eye.

In a slice of a voxel across an axis the surface is a hyperbola with monotone branches. psi = n . (eye - x) is evaluated
at successive positions along them; a change of its sign brackets a point. All points count: one is drawn, each with the
same probability, and is weighted with their number ``roots``. A point at the border of two voxels counts in both, with
shares that add up to one (``spline_points.py``).

Derivation: ``docs/theory/shading_normals.md#terminators-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.silhouette.grid_points import (
    TouchPoint,
    from_voxels,
    spread,
    turn_axes_back,
    turn_voxel,
    with_surface,
)
from warp_psdr.kernels.boundary.silhouette.spline_points import BAND, interval_share
from warp_psdr.kernels.primitive.affine import cofactor
from warp_psdr.kernels.primitive.sdfgrid import Grid, voxel_at, voxel_corner
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_smooth_sink
from warp_psdr.kernels.primitive.sdfgrid_surface import smooth_gradient
from warp_psdr.kernels.structs import Scene, Triangle

#: Parts of a branch of a hyperbola, in each of which psi has one zero at most, and steps that find it.
BRANCH_PARTS, BRANCH_STEPS = 8, 12
#: Ends of a slice, with the bands of points that are shared.
LOW, HIGH = -BAND, 1.0 + BAND


@wp.struct
class TurnedPoint:
    """A point at which psi is zero."""

    touch: TouchPoint  # its tangent is that of the curve
    n: wp.vec3  # unit shading normal
    rise: wp.vec3  # gradient of psi by the place, in the world


@wp.struct
class Branch:
    """A part of the hyperbola (a_0 + a_1 y) + z (a_2 + a_3 y) = 0 between two points of it."""

    a: wp.vec4
    first: wp.vec2  # (y, z)
    last: wp.vec2


@wp.func
def along_branch(b: Branch, t: wp.float32) -> wp.vec2:
    """(y, z) at a fraction of the way along the axis along which the branch is longer."""
    way = b.last - b.first
    y = b.first[0] + t * way[0]
    z = b.first[1] + t * way[1]
    if wp.abs(way[0]) >= wp.abs(way[1]):
        z = wp.clamp(-(b.a[0] + b.a[1] * y) / (b.a[2] + b.a[3] * y), wp.static(LOW), wp.static(HIGH))
    else:
        y = wp.clamp(-(b.a[0] + b.a[2] * z) / (b.a[1] + b.a[3] * z), wp.static(LOW), wp.static(HIGH))
    return wp.vec2(y, z)


@wp.func
def towards_eye(g: Grid, p: wp.vec3, eye: wp.vec3, distant: wp.bool) -> wp.vec3:
    """The way to the eye from a place, both in voxels, in the box of the grid."""
    way = -eye
    if not distant:
        way = eye - p
    return wp.cw_div(way, g.cells)


@wp.func
def facing_at(scene: Scene, g: Grid, at: wp.vec4i, place: wp.vec3, eye: wp.vec3, distant: wp.bool) -> wp.float32:
    """psi, over a positive factor, at a place in a voxel."""
    p = voxel_corner(at[0], at[1], at[2]) + place
    return wp.dot(smooth_gradient(scene, g, p, at[0], at[1], at[2]), towards_eye(g, p, eye, distant))


@functools.cache
def make_turned_point():
    """Return ``turned_point(scene, target, tri, g, at, eye, distant, u, choice) -> TurnedPoint`` in a voxel.

    The interpolated normal turns away there from an eye, in voxels. ``target`` is neither read nor written.
    """
    pull_smooth = make_smooth_sink("samples")  # the derivative by the place is what is asked for

    @wp.func
    def turned_point(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        g: Grid,
        at: wp.vec4i,
        eye: wp.vec3,
        distant: wp.bool,
        u: wp.float32,
        choice: wp.float32,
    ) -> TurnedPoint:
        r = TurnedPoint()
        point = TouchPoint()
        point.i = at[0]
        point.j = at[1]
        point.k = at[2]
        voxel = voxel_at(scene, g, at[0], at[1], at[2])
        axis = wp.clamp(wp.int32(3.0 * u), 0, 2)
        x = 3.0 * u - wp.float32(axis)
        c = turn_voxel(voxel, axis)
        b = Branch()
        b.a[0] = wp.lerp(c.v000, c.v100, x)
        b.a[1] = wp.lerp(c.v010, c.v110, x) - b.a[0]
        b.a[2] = wp.lerp(c.v001, c.v101, x) - b.a[0]
        b.a[3] = wp.lerp(c.v011, c.v111, x) - wp.lerp(c.v001, c.v101, x) - b.a[1]
        low = wp.static(LOW)
        high = wp.static(HIGH)
        # On the sides z = low and high phi is f + y rise; where it is 0 there; low if it is not, or not here.
        f0 = b.a[0] + low * b.a[2]
        f1 = b.a[0] + high * b.a[2]
        rise0 = b.a[1] + low * b.a[3]
        rise1 = b.a[1] + high * b.a[3]
        y0 = -f0 / rise0
        y1 = -f1 / rise1
        y0 = wp.where(y0 > low and y0 < high, y0, low)
        y1 = wp.where(y1 > low and y1 < high, y1, low)
        # Whether one branch leads from side to side, which may run along z.
        across = y0 > low and y1 > low and (f0 + low * rise0 < 0.0) == (f1 + low * rise1 < 0.0)
        count = wp.float32(0.0)
        rest = wp.float32(choice)
        held = Branch()
        start = wp.float32(0.0)
        f_low = wp.float32(0.0)
        f_high = wp.float32(0.0)
        for piece in range(3):
            ya = wp.where(piece == 0, low, wp.where(piece == 1, wp.min(y0, y1), wp.max(y0, y1)))
            yb = wp.where(piece == 0, wp.min(y0, y1), wp.where(piece == 1, wp.max(y0, y1), high))
            middle = 0.5 * (ya + yb)
            z = -(b.a[0] + b.a[1] * middle) / (b.a[2] + b.a[3] * middle)
            is_across = across and piece == 1
            if is_across or (yb > ya and z >= low and z <= high):
                b.first = wp.vec2(ya, wp.clamp(-(b.a[0] + b.a[1] * ya) / (b.a[2] + b.a[3] * ya), low, high))
                b.last = wp.vec2(yb, wp.clamp(-(b.a[0] + b.a[1] * yb) / (b.a[2] + b.a[3] * yb), low, high))
                if is_across:
                    b.first = wp.vec2(y0, low)
                    b.last = wp.vec2(y1, high)
                before = facing_at(scene, g, at, turn_axes_back(wp.vec3(x, b.first[0], b.first[1]), axis), eye, distant)
                n = wp.int32(0)
                while n < wp.static(BRANCH_PARTS):
                    yz = along_branch(b, wp.float32(n + 1) * wp.static(1.0 / BRANCH_PARTS))
                    here = facing_at(scene, g, at, turn_axes_back(wp.vec3(x, yz[0], yz[1]), axis), eye, distant)
                    if (here < 0.0) != (before < 0.0):
                        count += 1.0
                        # The latest of n roots is kept with the probability 1 / n.
                        if rest * count < 1.0:
                            held = b
                            start = wp.float32(n) * wp.static(1.0 / BRANCH_PARTS)
                            f_low = before
                            f_high = here
                            rest = rest * count
                        else:
                            rest = (rest - 1.0 / count) / (1.0 - 1.0 / count)
                    before = here
                    n += 1
        if count == 0.0:
            return r
        end = start + wp.static(1.0 / BRANCH_PARTS)
        yz = along_branch(held, start)
        kept = wp.int32(0)  # the end that the last step has kept: -1, +1
        for _k in range(wp.static(BRANCH_STEPS)):
            # False position; the value at an end that stays twice is halved.
            t = wp.clamp(start + (end - start) * f_low / (f_low - f_high), start, end)
            yz = along_branch(held, t)
            f = facing_at(scene, g, at, turn_axes_back(wp.vec3(x, yz[0], yz[1]), axis), eye, distant)
            if (f < 0.0) == (f_low < 0.0):
                start = t
                f_low = f
                f_high *= wp.where(kept == 1, 0.5, 1.0)
                kept = 1
            else:
                end = t
                f_high = f
                f_low *= wp.where(kept == -1, 0.5, 1.0)
                kept = -1
        point.place = turn_axes_back(wp.vec3(x, yz[0], yz[1]), axis)
        point = with_surface(tri, g, voxel, point)
        p = voxel_corner(at[0], at[1], at[2]) + point.place
        m = smooth_gradient(scene, g, p, at[0], at[1], at[2])
        way = towards_eye(g, p, eye, distant)
        rise, _none = pull_smooth(scene, target, g, p, at[0], at[1], at[2], way)
        if not distant:
            rise -= wp.cw_div(m, g.cells)
        t_curve = wp.normalize(wp.cross(point.gradient, rise))
        normal = cofactor(tri, m)
        length = wp.length(normal)
        point.density = spread(t_curve) / 3.0
        point.along = from_voxels(tri, g, t_curve)
        point.roots = count * interval_share(yz[0], 0.0, 1.0) * interval_share(yz[1], 0.0, 1.0)
        if point.roots == 0.0 or not (point.density > 0.0 and length > 0.0):
            point.valid = 0
        turn = wp.float32(tri.i2)
        r.touch = point
        r.n = (turn / length) * normal
        r.rise = (turn / length) * cofactor(tri, wp.cw_mul(g.cells, rise))
        return r

    return turned_point

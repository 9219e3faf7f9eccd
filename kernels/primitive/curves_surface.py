"""The point of a curve that a vertex holds, and its normal (``curves.py``).

Derivation: ``docs/theory/implicit.md#curves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import PI, TWO_PI
from warp_psdr.kernels.primitive.curves import (
    MOST_SEGMENTS,
    across_axis,
    control_point,
    curves_of,
    first_point,
    place_on,
    slope_on,
    spline_at,
    widest_angle,
    xyz,
)
from warp_psdr.kernels.primitive.sdfgrid import unpack
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import Surface


@wp.func
def held_on(u: wp.float32, v: wp.float32) -> tuple[wp.int32, wp.float32]:
    """The segment that two numbers hold, and the place along it, that of spheres at its ends included."""
    held = unpack(u, v)
    return wp.int32(held[2] * wp.static(float(MOST_SEGMENTS))), held[0]


@wp.func
def on_cone(along: wp.float32) -> tuple[wp.float32, wp.float32]:
    """The place on a cone that a place along it with its spheres is, and 1; at an end, and 0: on the sphere there."""
    return wp.clamp(2.0 * along - 0.5, 0.0, 1.0), wp.where(along < 0.25 or along > 0.75, 0.0, 1.0)


@functools.cache
def make_curve_surface(cubic: bool, tangent: bool):
    """Return ``surface_of(scene, tri, u, v) -> Surface``; ``tangent``: along the circles, dp/du."""

    @wp.func
    def curve_surface(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> Surface:
        g = curves_of(scene, tri)
        held = unpack(u, v)
        segment = wp.int32(held[2] * wp.static(float(MOST_SEGMENTS)))
        turns = wp.static(TWO_PI) * held[1]
        zero = wp.vec3(0.0, 0.0, 0.0)
        along = held[0]
        s = Surface()
        if wp.static(cubic):
            curve = spline_at(scene, g, segment, zero)
            here = place_on(curve, along)
            slope = slope_on(curve, along)
            c = xyz(slope)
            axis = wp.normalize(c)
            up = across_axis(axis)
            right = wp.cross(up, axis)
            e = wp.cos(turns) * right + wp.sin(turns) * up
            q = here[3] * e
            bend = 2.0 * xyz(curve.a2 + (3.0 * along) * curve.a3)
            s.x = xyz(here) + q
            s.ng = wp.normalize((wp.dot(c, c) - wp.dot(q, bend)) * e - slope[3] * c)
        else:
            i = first_point(scene, g, segment)
            p0 = control_point(scene, g, i, zero)
            p1 = control_point(scene, g, i + 1, zero)
            b = xyz(p1 - p0)
            axis = b / wp.max(wp.length(b), 1.0e-30)
            up = across_axis(axis)
            right = wp.cross(up, axis)
            e = wp.cos(turns) * right + wp.sin(turns) * up
            angle = widest_angle(b, p0, p1)
            if along < 0.25:
                angle = wp.static(PI) - (4.0 * along) * (wp.static(PI) - angle)
            if along > 0.75:
                angle = (4.0 - 4.0 * along) * angle
            along = wp.clamp(2.0 * along - 0.5, 0.0, 1.0)
            here = wp.lerp(p0, p1, along)
            s.ng = wp.sin(angle) * e + wp.cos(angle) * axis
            s.x = xyz(here) + here[3] * s.ng
        s.n = s.ng
        s.shape = tri.shape
        s.length = -1.0
        s.uv = wp.vec2(held[1], (along + wp.float32(segment)) / wp.float32(g.segments))
        if wp.static(tangent):
            s.tangent = wp.cos(turns) * up - wp.sin(turns) * right
        return s

    return curve_surface

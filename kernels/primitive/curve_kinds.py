"""Curves with a radius: two kinds of shapes, cones between spheres and tubes about B-splines (``curves.py``)."""

import functools
from collections.abc import Callable

import warp as wp

from warp_psdr.kernels.lanes.curve_lanes import make_curve_lanes
from warp_psdr.kernels.primitive.curves import BSPLINE_CURVE, LINEAR_CURVE, make_curve_hit
from warp_psdr.kernels.primitive.curves_adjoint import make_curve_sink
from warp_psdr.kernels.primitive.curves_frame import frame_at, tube_bend, tube_gradient
from warp_psdr.kernels.primitive.curves_surface import held_on, make_curve_surface, on_cone
from warp_psdr.kernels.primitive.kind import SLIDES, Kind
from warp_psdr.kernels.primitive.sliding import make_sliding_jvp
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.vertex_motion import normalize_jvp


@wp.func
def seen_from_outside(scene: Scene, tri: Triangle, x: wp.vec3) -> wp.vec3:
    """No normal: curves are seen from outside alone."""
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def curve_patch(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.int32:
    """The segment."""
    segment, _along = held_on(u, v)
    return segment


@functools.cache
def make_curve_turn(cubic: bool):
    """Return ``turn(scene, tri, u, v, x_dot) -> vec3``, the rate of the unit normal (``turned_normal.py``)."""
    surface_of = make_curve_surface(cubic, False)

    @wp.func
    def curve_turn(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32, x_dot: wp.vec3) -> wp.vec3:
        surface = surface_of(scene, tri, u, v)
        segment, along = held_on(u, v)
        place = along
        free = wp.float32(1.0)
        if wp.static(not cubic):
            place, free = on_cone(along)
        f = frame_at(scene, tri, segment, place)
        e = wp.normalize(surface.x - f.c)
        return normalize_jvp(surface.ng, wp.length(tube_gradient(f, e)), tube_bend(f, e, free, x_dot))

    return curve_turn


def _curves(number: int, cubic: bool, make_lanes: Callable | None) -> Kind:
    def make_sink(role: str, uv: bool, tangent: bool, _rays: bool, _flow: bool) -> wp.Function:
        return make_curve_sink(role, cubic, uv, tangent)

    def make_velocity(uv: bool, tangent: bool, _flow: bool) -> wp.Function:
        return make_sliding_jvp(make_curve_sink("forward", cubic, uv, tangent), uv, tangent)

    return Kind(
        number=number,
        moves=SLIDES,
        make_hit=functools.partial(make_curve_hit, cubic),
        make_lanes=make_lanes,
        make_surface=lambda _uv, tangent: make_curve_surface(cubic, tangent),
        normal=seen_from_outside,
        make_sink=make_sink,
        make_velocity=make_velocity,
        make_turn=functools.partial(make_curve_turn, cubic),
        outside=True,
        patch=curve_patch,
    )


CONES = _curves(LINEAR_CURVE, False, None)
TUBES = _curves(BSPLINE_CURVE, True, make_curve_lanes)
#: Numbers of both.
CURVES = (CONES.number, TUBES.number)

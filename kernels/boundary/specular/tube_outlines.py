"""Outlines of curves with a radius that a line crosses (``chain_outlines.py``).

A ray touches a tube on the circle through the hit, at the root of ``tube_roots.py`` that is nearest to the hit, or at
its open end. It may also touch a straight segment on its spheres. Where two straight segments meet, a crease lies
between two hits.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    PART_CREASE,
    PART_END,
    PART_SIDE,
    PART_START,
    SMOOTH,
    TubePoint,
    crease_of,
    end_sphere_point,
    lean,
    side_point,
    side_roots,
    tube_axis,
    tube_curvature,
)
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.boundary.specular.chain_touch import (
    APART,
    GRAZED,
    JUMPS,
    SAME,
    SHEET,
    ChainOutline,
    ChainTouch,
    TubeGraze,
)
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.constants import INV_TWO_PI
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.primitive.curve_kinds import CONES
from warp_psdr.kernels.primitive.curves import curves_of, first_point, is_spline
from warp_psdr.kernels.primitive.curves_frame import frame_at
from warp_psdr.kernels.primitive.curves_surface import held_on
from warp_psdr.kernels.structs import Scene, Triangle

#: Distance along a segment from an open end up to which a hit may be at the end.
AT_END = 0.01


@wp.func
def begins_curve(scene: Scene, tri: Triangle, segment: wp.int32) -> wp.bool:
    """Whether no segment of the same curve is before this one."""
    g = curves_of(scene, tri)
    if segment <= 0:
        return True
    if segment >= g.segments:
        return True
    return first_point(scene, g, segment - 1) + 1 != first_point(scene, g, segment)


@wp.func
def tube_point(scene: Scene, tri: Triangle, face: wp.int32, touch: TubeGraze) -> TubePoint:
    """The point itself; ``along`` is a direction along the curve, of rims and creases alone."""
    if touch.part == PART_CREASE:
        return crease_of(scene, tri, face, touch.segment, touch.v)
    f = frame_at(scene, tri, touch.segment, touch.v)
    if touch.part == PART_SIDE:
        return side_point(f, face, touch.segment, touch.v, touch.e)
    if is_spline(tri):
        r = side_point(f, face, touch.segment, touch.v, touch.e)
        r.part = touch.part
        r.rim = 1
        r.along = wp.cross(tube_axis(f), touch.e)
        return r
    return end_sphere_point(f, face, touch.segment, touch.part, touch.e)


@wp.func
def beside_ray(x: wp.vec3, o: wp.vec3, d: wp.vec3) -> wp.float32:
    """Distance of a point from a line."""
    return wp.length(wp.cross(x - o, d))


@wp.func
def side_touch(scene: Scene, tri: Triangle, segment: wp.int32, v: wp.float32, hit: wp.vec3, o: wp.vec3) -> TubeGraze:
    """The silhouette from o on the circle at v that is nearest to a hit."""
    r = TubeGraze()
    f = frame_at(scene, tri, segment, v)
    roots, s, t = side_roots(f, o, False)
    h = lean(f)
    nearest = wp.float32(0.0)
    for k in range(4):
        if k < roots.count:
            e = wp.sqrt(wp.max(1.0 - h * h, 0.0)) * (roots.cosine[k] * s + roots.sine[k] * t)
            if f.cubic == 0:
                e += (h / wp.length(f.c1)) * f.c1
            distance = wp.length(f.c + f.r * e - hit)
            if r.valid == 0 or distance < nearest:
                nearest = distance
                r.valid = 1
                r.e = e
    r.segment = segment
    r.part = PART_SIDE
    r.v = v
    return r


@wp.func
def end_touch(scene: Scene, tri: Triangle, segment: wp.int32, part: wp.int32, hit: wp.vec3) -> TubeGraze:
    """The point of an open end next to a hit."""
    r = TubeGraze()
    r.segment = segment
    r.part = part
    r.v = wp.where(part == PART_END, 1.0, 0.0)
    f = frame_at(scene, tri, segment, r.v)
    axis = tube_axis(f)
    across = hit - f.c
    r.e = wp.normalize(across - wp.dot(across, axis) * axis)
    r.valid = 1
    return r


@wp.func
def sphere_touch(scene: Scene, tri: Triangle, segment: wp.int32, part: wp.int32, o: wp.vec3, d: wp.vec3) -> TubeGraze:
    """Where a ray touches the sphere at the end of a straight segment."""
    r = TubeGraze()
    r.segment = segment
    r.part = part
    r.v = wp.where(part == PART_END, 1.0, 0.0)
    f = frame_at(scene, tri, segment, r.v)
    r.e = wp.normalize(o + wp.dot(f.c - o, d) * d - f.c)
    r.valid = 1
    return r


@wp.func
def joint_touch(scene: Scene, tri: Triangle, segment: wp.int32, hit: wp.vec3) -> TubeGraze:
    """The crease between a straight segment and the next one, at the angle of a hit."""
    r = TubeGraze()
    r.segment = segment
    r.part = PART_CREASE
    f = frame_at(scene, tri, segment, 1.0)
    axis = tube_axis(f)
    s = any_tangent(axis)
    q = hit - f.c
    r.v = wp.atan2(wp.dot(q, wp.cross(axis, s)), wp.dot(q, s)) * INV_TWO_PI
    r.valid = 1
    return r


@wp.func
def tube_touch(
    scene: Scene, tri: Triangle, held: wp.vec2, hit: wp.vec3, other: wp.vec2, o: wp.vec3, d: wp.vec3, front: wp.bool
) -> TubeGraze:
    """Where a ray from o along d touches a tube that it meets at ``hit``, which a vertex holds as ``held``.

    ``front``: a neighbour of the ray meets the next segment, where a vertex holds ``other``.
    """
    segment, along = held_on(held[0], held[1])
    if front:
        next_segment, _along = held_on(other[0], other[1])
        return joint_touch(scene, tri, wp.min(segment, next_segment), hit)
    if not is_spline(tri):
        if along < 0.25:
            return sphere_touch(scene, tri, segment, PART_START, o, d)
        if along > 0.75:
            return sphere_touch(scene, tri, segment, PART_END, o, d)
        return side_touch(scene, tri, segment, wp.clamp(2.0 * along - 0.5, 0.0, 1.0), hit, o)
    side = side_touch(scene, tri, segment, along, hit, o)
    end = TubeGraze()
    if along < AT_END and begins_curve(scene, tri, segment):
        end = end_touch(scene, tri, segment, PART_START, hit)
    if along > 1.0 - AT_END and begins_curve(scene, tri, segment + 1):
        end = end_touch(scene, tri, segment, PART_END, hit)
    if end.valid == 1:
        if side.valid == 0:
            return end
        at_end = tube_point(scene, tri, 0, end)
        at_side = tube_point(scene, tri, 0, side)
        if beside_ray(at_end.x, o, d) < beside_ray(at_side.x, o, d):
            return end
    return side


@functools.cache
def make_tube_outlines(primitives: tuple[int, ...]) -> ChainTouch:
    """Return the functions of the kinds of curves of a scene."""
    straight = CONES.number in primitives

    @wp.func
    def tube_outline_at(
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
        held = wp.where(own_low, wp.vec2(low.u, low.v), wp.vec2(high.u, high.v))
        other = wp.where(own_low, wp.vec2(high.u, high.v), wp.vec2(low.u, low.v))
        r.tube = tube_touch(scene, tri, held, hit, other, o, d, front)
        if r.tube.valid == 0:
            return r
        point = tube_point(scene, tri, face, r.tube)
        r.x = point.x
        w = wp.normalize(r.x - o)
        if point.rim == 1 or point.part == PART_CREASE:
            r.rim = 1
            r.m = wp.cross(point.along, w)
        else:
            r.m = point.out
            r.curvature = tube_curvature(point, w)
        near = beside_ray(r.x, o, d) < GRAZED * point.f.r
        r.valid = wp.where(near and point.valid == 1 and wp.length_sq(r.m) > 0.0, 1, 0)
        return r

    @wp.func
    def tube_sheet(scene: Scene, tri: Triangle, low: Link, high: Link) -> wp.int32:
        first, along = held_on(low.u, low.v)
        second, other = held_on(high.u, high.v)
        place = along
        if not is_spline(tri):
            place = wp.clamp(2.0 * along - 0.5, 0.0, 1.0)
        if wp.length(low.x - high.x) > SHEET * frame_at(scene, tri, first, place).r:
            return APART
        if wp.static(straight):
            if first != second and not is_spline(tri):
                cones = wp.min(along, other) >= 0.25 and wp.max(along, other) <= 0.75
                if cones and wp.length(wp.cross(low.ng, high.ng)) > SMOOTH:
                    return JUMPS
        return SAME

    def make_sink(role: str) -> wp.Function:
        accumulate_tube = make_tube_sink(role, primitives)

        @wp.func
        def accumulate_tube_outline(
            scene: Scene, target: wp.array(dtype=wp.float32), outline: ChainOutline, g: wp.vec3
        ) -> wp.float32:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            point = tube_point(scene, scene.triangles[outline.face], outline.face, outline.tube)
            return accumulate_tube(scene, target, point, g)

        return accumulate_tube_outline

    return ChainTouch(tube_outline_at, tube_sheet, make_sink)

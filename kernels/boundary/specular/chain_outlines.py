"""Outlines of shapes without triangles that a line crosses: where a ray that just misses a shape touches it.

Two neighbouring rays lie on either side: one meets the shape, the other passes it, and a ray between touches it. It
touches at a rim next to the hit, or where the surface is seen edge-on, next to the ray's point that is nearest to the
shape.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.curve import OFF
from warp_psdr.kernels.boundary.crossing.levels import voxel_of
from warp_psdr.kernels.boundary.silhouette.dispatch import make_silhouettes
from warp_psdr.kernels.boundary.silhouette.rim import make_rims
from warp_psdr.kernels.boundary.silhouette.tube_points import PART_CREASE, SMOOTH, tube_curvature
from warp_psdr.kernels.boundary.specular.chain_patches import cells_of
from warp_psdr.kernels.boundary.specular.grid_outlines import across_touch, make_grid_sink, make_grid_touch
from warp_psdr.kernels.boundary.specular.specular_chain import Link
from warp_psdr.kernels.boundary.specular.tube_outlines import (
    TubeGraze,
    beside_ray,
    make_tube_outline_sink,
    tube_point,
    tube_touch,
)
from warp_psdr.kernels.constants import (
    PRIMITIVE_CYLINDER,
    PRIMITIVE_DISK,
    PRIMITIVE_LINEARCURVE,
    PRIMITIVE_SDFGRID,
    PRIMITIVE_SPHERE,
)
from warp_psdr.kernels.primitive.affine import (
    cofactor,
    from_axes,
    is_primitive_at,
    make_pose_sink,
    step_off_primitive,
    to_axes,
)
from warp_psdr.kernels.primitive.curves_frame import frame_at
from warp_psdr.kernels.primitive.curves_surface import held_on
from warp_psdr.kernels.primitive.dispatch import (
    BOXED,
    CURVES,
    is_bspline,
    is_cubic,
    is_linear,
    is_network,
    slides_on,
)
from warp_psdr.kernels.primitive.kinds import affine_kinds, join
from warp_psdr.kernels.primitive.sdfgrid import grid_of, unpack
from warp_psdr.kernels.structs import Scene, Triangle

#: How far from being touched, over the size of the shape, what a ray meets may be. Neighbouring rays are some 1e-6
#: apart, and a thousand times that where what lies between is curved or the shape is small.
GRAZED = 0.05
#: Distance, in voxels or radii, up to which two neighbouring hits are on one sheet.
SHEET = 0.05
#: What numbers that are divided by are at least.
TINY = 1.0e-20


@wp.struct
class Outline:
    """A point at which a ray touches a shape without triangles."""

    valid: wp.int32
    rim: wp.int32  # 1: the surface ends there
    face: wp.int32  # number of the record
    q: wp.vec3  # in the shape's coordinates
    x: wp.vec3
    m: wp.vec3  # across the ray and the outline, of any length and either sign
    curvature: wp.float32  # of the surface along the ray; 0: of a rim
    gradient: wp.vec3  # of grids, see ``GridTouch``
    tube: TubeGraze  # of curves


@wp.struct
class Graze:
    """The same in the shape's coordinates; ``off``: how far the ray is from touching it."""

    q: wp.vec3
    off: wp.float32
    rim: wp.int32
    normal: wp.vec3  # of the surface, not of rims


@wp.func
def sphere_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    m = o - (wp.dot(o, d) / wp.dot(d, d)) * d
    length = wp.length(m)
    r.q = m / wp.max(length, TINY)
    r.normal = r.q
    r.off = wp.abs(1.0 - length)
    return r


@wp.func
def disk_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    length = wp.sqrt(hit[0] * hit[0] + hit[1] * hit[1])
    r.q = wp.vec3(hit[0], hit[1], 0.0) / wp.max(length, TINY)
    r.off = wp.abs(1.0 - length)
    r.rim = 1
    return r


@wp.func
def cylinder_graze(hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
    r = Graze()
    across = d[0] * d[0] + d[1] * d[1]
    m = o - ((o[0] * d[0] + o[1] * d[1]) / wp.max(across, TINY)) * d
    length = wp.sqrt(m[0] * m[0] + m[1] * m[1])
    beside = wp.abs(1.0 - length)
    end = wp.min(wp.abs(hit[2]), wp.abs(1.0 - hit[2]))
    if end < beside:
        around = wp.sqrt(hit[0] * hit[0] + hit[1] * hit[1])
        r.q = wp.vec3(hit[0] / wp.max(around, TINY), hit[1] / wp.max(around, TINY), wp.where(hit[2] < 0.5, 0.0, 1.0))
        r.off = end
        r.rim = 1
    else:
        r.q = wp.vec3(m[0] / wp.max(length, TINY), m[1] / wp.max(length, TINY), wp.clamp(m[2], 0.0, 1.0))
        r.normal = wp.vec3(r.q[0], r.q[1], 0.0)
        r.off = beside
    return r


#: Kind (PRIMITIVE_*) -> ``(hit, o, d) -> Graze`` of a line that is next to touching the shape, which it meets at a hit.
GRAZES: dict[int, wp.Function] = {
    PRIMITIVE_SPHERE: sphere_graze,
    PRIMITIVE_DISK: disk_graze,
    PRIMITIVE_CYLINDER: cylinder_graze,
}


def _make_graze(f: wp.Function) -> wp.Function:
    @wp.func
    def graze_at(tri: Triangle, hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
        return f(from_axes(tri, hit - tri.normal), from_axes(tri, o - tri.normal), from_axes(tri, d))

    return graze_at


def _either_graze(word: int, f: wp.Function, rest: wp.Function) -> wp.Function:
    @wp.func
    def graze_of_kind(tri: Triangle, hit: wp.vec3, o: wp.vec3, d: wp.vec3) -> Graze:
        if tri.i1 == word:
            return f(tri, hit, o, d)
        return rest(tri, hit, o, d)

    return graze_of_kind


@functools.cache
def make_outline(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``outline_at(scene, face, low, high, own_low, o, front) -> Outline`` for a ray from o.

    It meets a shape, ``face`` the number of its record, at the hit ``low`` or (not ``own_low``) ``high``, and is next
    to touching it; or with ``front`` both are on one sheet, and its normal jumps between them. None: there is no such
    shape.
    """
    if not primitives:
        return None
    grid_touch = make_grid_touch(primitives)
    curves = bool(set(CURVES) & set(primitives))
    grazed = join(_either_graze, {kind: _make_graze(GRAZES[kind]) for kind in affine_kinds(primitives)})
    silhouettes = make_silhouettes(primitives)
    rims = make_rims(primitives)

    @wp.func
    def outline_at(
        scene: Scene, face: wp.int32, low: Link, high: Link, own_low: wp.bool, o: wp.vec3, front: wp.bool
    ) -> Outline:
        r = Outline()
        tri = scene.triangles[face]
        hit = wp.where(own_low, low.x, high.x)
        d = wp.normalize(hit - o)
        r.face = face
        if wp.static(curves):
            if is_linear(tri) or is_bspline(tri):
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
                    r.m = wp.cross(point.rate, w)
                else:
                    r.m = point.out
                    r.curvature = tube_curvature(point, w)
                near = beside_ray(r.x, o, d) < GRAZED * point.f.r
                r.valid = wp.where(near and point.valid == 1 and wp.length_sq(r.m) > 0.0, 1, 0)
                return r
        if wp.static(grid_touch is not None):
            if wp.static(grazed is None) or slides_on(tri):
                t = grid_touch(scene, tri, wp.vec2(low.u, low.v), wp.vec2(high.u, high.v), hit, d, front)
                cells = cells_of(scene, tri)
                r.rim = t.crease
                r.q = wp.cw_div(t.p, cells)
                r.x = tri.normal + to_axes(tri, r.q)
                r.m = across_touch(tri, cells, t, wp.normalize(r.x - o))
                r.curvature = t.curvature
                r.gradient = t.gradient
                r.valid = wp.where(t.valid == 1 and t.off < GRAZED and wp.length_sq(r.m) > 0.0, 1, 0)
                return r
        if wp.static(grazed is not None):
            g = grazed(tri, hit, o, d)
            r.rim = g.rim
            r.q = g.q
            r.x = tri.normal + to_axes(tri, g.q)
            w = wp.normalize(r.x - o)
            if wp.static(rims is not None):
                if g.rim == 1:
                    r.m = wp.cross(rims.rate(tri, g.q), w)
            if wp.static(silhouettes is not None):
                if g.rim == 0:
                    r.m = wp.normalize(cofactor(tri, g.normal))
                    r.curvature = silhouettes.curvature(tri, g.q, w)
            r.valid = wp.where(g.off < GRAZED and wp.length_sq(r.m) > 0.0, 1, 0)
        return r

    return outline_at


@functools.cache
def make_one_sheet(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``one_sheet(scene, low, high) -> int`` of two hits on one face; None: there are no such shapes.

    0: the one stands in front of the other; 1: they are neighbours on one sheet; 2: and its normal jumps between them.
    """
    if not primitives:
        return None
    boxed = bool(set(BOXED) & set(primitives))
    curves = bool(set(CURVES) & set(primitives))
    straight = PRIMITIVE_LINEARCURVE in primitives
    linear = PRIMITIVE_SDFGRID in primitives

    @wp.func
    def one_sheet(scene: Scene, low: Link, high: Link) -> wp.int32:
        if not is_primitive_at(scene, low.face):
            return 1
        tri = scene.triangles[low.face]
        if wp.static(curves):
            if is_linear(tri) or is_bspline(tri):
                first, along = held_on(low.u, low.v)
                second, other = held_on(high.u, high.v)
                place = along
                if is_linear(tri):
                    place = wp.clamp(2.0 * along - 0.5, 0.0, 1.0)
                if wp.length(low.x - high.x) > SHEET * frame_at(scene, tri, first, place).r:
                    return 0
                if wp.static(straight):
                    if first != second and is_linear(tri):
                        cones = wp.min(along, other) >= 0.25 and wp.max(along, other) <= 0.75
                        if cones and wp.length(wp.cross(low.ng, high.ng)) > SMOOTH:
                            return 2
                return 1
        if wp.static(boxed):
            if slides_on(tri):
                cells = cells_of(scene, tri)
                size = wp.min(
                    wp.min(wp.length(tri.p0) / cells[0], wp.length(tri.p1) / cells[1]), wp.length(tri.p2) / cells[2]
                )
                if wp.length(low.x - high.x) > SHEET * size:
                    return 0
                if wp.static(linear):
                    if not is_cubic(tri) and not is_network(tri):
                        g = grid_of(scene, tri)
                        a = voxel_of(g, wp.cw_mul(g.cells, unpack(low.u, low.v)))
                        b = voxel_of(g, wp.cw_mul(g.cells, unpack(high.u, high.v)))
                        if a[0] != b[0] or a[1] != b[1] or a[2] != b[2]:
                            return 2
                return 1
        return wp.where(low.facing == high.facing, 1, 0)

    return one_sheet


@wp.func
def begins_beside(scene: Scene, outline: Outline, face: wp.int32, t1: wp.float32) -> wp.bool:
    """Whether a ray that begins on a face touches a shape closer than where the terms of their common curve look.

    ``docs/theory/implicit.md#curves-of-intersection``; t1 is the way to the touched point.
    """
    tri = scene.triangles[outline.face]
    if outline.rim == 1 or scene.triangles[face].shape == tri.shape:
        return False
    return 0.5 * outline.curvature * t1 * t1 < OFF * step_off_primitive(scene, tri)


@functools.cache
def make_outline_sink(role: str, primitives: tuple[int, ...]):
    """Return ``accumulate(scene, target, outline, g) -> float``: the adjoint g of a point of an outline."""
    accumulate_pose = make_pose_sink(role)
    accumulate_grid = make_grid_sink(role, primitives) if set(BOXED) & set(primitives) else None
    accumulate_tube = make_tube_outline_sink(role, primitives) if set(CURVES) & set(primitives) else None

    @wp.func
    def accumulate_outline(
        scene: Scene, target: wp.array(dtype=wp.float32), outline: Outline, g: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[outline.face]
        if wp.static(accumulate_tube is not None):
            if is_linear(tri) or is_bspline(tri):
                return accumulate_tube(scene, target, outline.face, outline.tube, g)
        if wp.static(accumulate_grid is not None):
            if slides_on(tri):
                return accumulate_grid(scene, target, outline.face, outline.q, outline.gradient, g)
        return accumulate_pose(target, tri, outline.q[0] * g, outline.q[1] * g, outline.q[2] * g, g)

    return accumulate_outline

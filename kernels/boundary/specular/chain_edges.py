"""Edges that a line crosses where the identity of a chain changes, as the adjoint of phi = 0 (``discontinuity.py``).

The candidates are edges of the surfaces that the two rays beside the crossing meet, curves of intersection, and edges
that end the light of a point, spot or directional light.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.concave_edge import (
    concave_distance,
    facing,
    is_ridge,
    let_through,
    refracts,
    sharp_glass,
)
from warp_psdr.kernels.boundary.crossing.curve import MOST, OFF
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, barycentrics_at, split_between
from warp_psdr.kernels.boundary.specular.chain_outlines import begins_beside, make_chain_outline, make_one_sheet
from warp_psdr.kernels.boundary.specular.chain_touch import JUMPS, ChainOutline
from warp_psdr.kernels.boundary.specular.ray_differential import PointDifferential, RayDifferential
from warp_psdr.kernels.boundary.specular.sheet_crossing import make_sheet_end
from warp_psdr.kernels.boundary.specular.specular_chain import Block, Link, make_lit
from warp_psdr.kernels.boundary.specular.triangle_borders import (
    RIM_EPSILONS,
    Tables,
    TriangleBorder,
    border_of,
    of_edge,
    point_on_edge,
    smooth_between,
)
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.emitter.dispatch import make_delta_sample
from warp_psdr.kernels.primitive.affine import determinant, is_primitive_at
from warp_psdr.kernels.primitive.dispatch import make_clear, slides_on
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.texture.steps import Step
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Where two surfaces meet, an edge within this many ray epsilons is what is crossed: they touch there.
TOUCHING = 2.0
#: Distance in steps from a corner at which rays pass it in any case: closer, roundings decide which of its surfaces
#: a ray that leaves the other one starts behind.
CORNER = 1.0
#: The part of a line at which its two sides are looked at at most, in a notch.
ASIDE_MOST = 0.01
#: Squared sine of the angle between two planes below which they have no line in common.
PARALLEL = 1.0e-10
#: What numbers that are divided by are at least.
TINY = 1.0e-20
#: Distance of two such planes, in ray epsilons, within which they are one.
ONE_PLANE = 0.5


@wp.struct
class Crossing:
    """A curve in the domain of q, as the adjoint of phi."""

    valid: wp.int32
    side: wp.int32  # 0: the integrand jumps; +1, -1: it counts on that side of the line only
    phi_a: wp.float32  # derivatives of phi along the line and across it
    phi_b: wp.float32
    aside: wp.float32  # part of the line at which its two sides are looked at; 0: where they differ
    low_lies: wp.int32  # where its lower side lies: 1: up the line, -1: down it, 0: as at its crossing
    both: wp.int32  # 1: the other side of the line is a crossing of its own
    # 1: ``point`` and ``segment`` hold the edge, 2: ``segment`` holds material points, 3: ``outline``, 4: ``step``,
    # 5: a side of an image, with the place (u2, v2) of ``segment`` on it
    edge: wp.int32
    point: EdgePoint
    outline: ChainOutline
    segment: Segment  # of the points, face1 (-1: none) is moved along ``boundary_normal1``, face2 along ``sweep``
    boundary_normal1: wp.vec3
    last: wp.int32  # where the pull-back starts (``chain_pullback.py``)
    start: VertexAdjoint
    o_before: wp.vec3
    a_o: wp.vec3
    a_d: wp.vec3
    tied: wp.vec3  # adjoint of what rays from the block's vertex are tied to (form S)
    step: Step  # phi is a coordinate of the texture's place at ``last``


@wp.func
def inside(tri: Triangle, x: wp.vec3) -> wp.bool:
    uv = barycentrics_at(tri, x)
    return uv[0] > 0.0 and uv[1] > 0.0 and uv[0] + uv[1] < 1.0


@wp.func
def laid_over(scene: Scene, low: Link, high: Link) -> wp.bool:
    """Whether two triangles lie over one another in one plane at both hits: which is met there is up to rounding."""
    if is_primitive_at(scene, low.face) or is_primitive_at(scene, high.face):
        return False
    tri_low = scene.triangles[low.face]
    tri_high = scene.triangles[high.face]
    if wp.length_sq(wp.cross(tri_low.normal, tri_high.normal)) >= PARALLEL:
        return False
    if wp.abs(wp.dot(tri_low.normal, high.x - low.x)) > ONE_PLANE * scene.ray_epsilon:
        return False
    return inside(tri_low, high.x) and inside(tri_high, low.x)


@wp.func
def aside(scene: Scene, block: Block, m: wp.vec3, room: wp.float32, phi_a: wp.float32) -> wp.float32:
    """``Crossing.aside`` for a room in steps; phi is m times a distance in the plane across the ray."""
    along = wp.max(wp.abs(phi_a) * block.ell, TINY)
    return wp.min(room * scene.ray_epsilon * wp.length(m) / along, ASIDE_MOST)


@wp.func
def off_curve(scene: Scene, low: Link, high: Link, along: wp.vec3, m: wp.vec3) -> wp.float32:
    """Distance across the ray, in steps, at which surfaces are seen beside their common curve; 0: two triangles.

    It is that of the other terms of such curves (``crossing/curve.py``) on the surface that is the flat one.
    """
    round_low = is_primitive_at(scene, low.face)
    round_high = is_primitive_at(scene, high.face)
    if not round_low and not round_high:
        return 0.0
    sine = wp.length(along)
    unit = wp.normalize(m)
    distance = wp.min(OFF / sine, MOST) / sine
    by_low = distance * wp.abs(wp.dot(unit, wp.cross(low.ng, along)))
    by_high = distance * wp.abs(wp.dot(unit, wp.cross(high.ng, along)))
    if not round_low:
        return by_low
    if not round_high:
        return by_high
    return wp.max(by_low, by_high)


@wp.func
def curve_crossing(
    scene: Scene,
    block: Block,
    low: Link,
    high: Link,
    x: wp.vec3,
    a: RayDifferential,
    b: RayDifferential,
    i: wp.int32,
    count: wp.int32,
    which: wp.int32,
    hidden: wp.bool,
) -> Crossing:
    """Where the surfaces that two neighbouring rays meet run through each other."""
    r = Crossing()
    n_low = low.ng
    n_high = high.ng
    along = wp.cross(n_low, n_high)
    squared = wp.length_sq(along)
    first = block.film == 0 and i == 0
    if squared < PARALLEL or (first and block.first == 0):
        return r
    x_b = 0.5 * (low.x + high.x)
    t1 = wp.length(x_b - x)
    d = (x_b - x) / t1
    m = wp.cross(along / wp.sqrt(squared), d)
    by_low, by_high = split_between(m, n_low, n_high, squared)
    r.edge = 2
    r.segment.x = x_b
    r.segment.w = d
    r.segment.face1 = low.face
    r.segment.u1 = low.u
    r.segment.v1 = low.v
    r.segment.face2 = high.face
    r.segment.u2 = high.u
    r.segment.v2 = high.v
    r.boundary_normal1 = by_low
    r.segment.boundary_normal = by_high
    r.last = count + i - 1
    if first:
        # c on the lower side's surface, and then on the upper one's.
        r.both = 1
        r.side = 2 * which - 1
        if which == 0:
            if slides_on(scene.triangles[low.face]):
                r.tied = -m
            else:
                r.boundary_normal1 = -by_high
        else:
            if slides_on(scene.triangles[high.face]):
                r.tied = -m
            else:
                r.segment.boundary_normal = -by_low
    else:
        r.a_o = -m
        r.a_d = -t1 * m
    r.phi_a = -wp.dot(m, a.o + t1 * a.d)
    r.phi_b = -wp.dot(m, b.o + t1 * b.d)
    through = let_through(scene, low.face, high.face, hidden)
    apart_by = wp.max(concave_distance(facing(n_low, d), facing(n_high, d), through), CORNER)
    r.aside = aside(scene, block, m, wp.max(apart_by, off_curve(scene, low, high, along, m)), r.phi_a)
    r.valid = 1
    return r


@functools.cache
def make_edge_crossing(hidden: bool, primitives: tuple[int, ...]):
    """Return ``edge_crossing(scene, edges, tables, block, low, high, x, a, b, i, count, which, begin) -> Crossing``.

    The edge between what two neighbouring rays from x meet at the i-th vertex of the chain, ``low`` and ``high``; x is
    on the face ``begin`` where the block begins on a surface and i is 0.
    ``hidden``: there are lights that the camera does not see. ``primitives``: kinds of shapes without triangles.
    """
    outline_at = make_chain_outline(primitives)
    one_sheet = make_one_sheet(primitives)
    clear_of = make_clear(primitives)

    @wp.func
    def edge_crossing(
        scene: Scene,
        edges: Edges,
        tables: Tables,
        block: Block,
        low: Link,
        high: Link,
        x: wp.vec3,
        a: RayDifferential,
        b: RayDifferential,
        i: wp.int32,
        count: wp.int32,
        which: wp.int32,
        begin: wp.int32,
    ) -> Crossing:
        r = Crossing()
        t_low = wp.float32(FAR)
        t_high = wp.float32(FAR)
        rim_low = TriangleBorder()
        rim_low.near = FAR
        rim_high = TriangleBorder()
        rim_high.near = FAR
        if low.face >= 0:
            t_low = wp.length(low.x - x)
            rim_low = border_of(scene, tables, low.face, low.u, low.v)
        if high.face >= 0:
            t_high = wp.length(high.x - x)
            rim_high = border_of(scene, tables, high.face, high.u, high.v)
        room = RIM_EPSILONS * scene.ray_epsilon
        tie = wp.abs(t_low - t_high) <= room
        if low.face >= 0 and high.face >= 0:
            if laid_over(scene, low, high):
                return r
            apart = wp.min(rim_low.distance, rim_high.distance) > TOUCHING * scene.ray_epsilon
            neighbours = rim_low.edge >= 0 and of_edge(edges, rim_low.edge, high.face)
            if apart and not neighbours and low.face != high.face and wp.length(low.x - high.x) <= room:
                return curve_crossing(scene, block, low, high, x, a, b, i, count, which, wp.static(hidden))
        own_low = wp.where(tie, rim_low.distance <= rim_high.distance, t_low <= t_high)
        if wp.static(outline_at is not None):
            if is_primitive_at(scene, low.face) or is_primitive_at(scene, high.face):
                own_low = t_low <= t_high
        own = wp.where(own_low, rim_low.edge, rim_high.edge)
        near = wp.where(own_low, rim_low.near, rim_high.near)
        hit = wp.where(own_low, low.x, high.x)
        x_b = hit
        front = wp.bool(False)
        own_face = wp.where(own_low, low.face, high.face)
        if wp.static(outline_at is not None):
            if is_primitive_at(scene, own_face):
                if low.face == high.face:
                    front = one_sheet(scene, low, high) == JUMPS
                r.outline = outline_at(scene, own_face, low, high, own_low, x, front)
                if r.outline.valid == 0:
                    return r
                r.edge = 3
                x_b = r.outline.x
        if r.edge == 0:
            if near > 1.0 or own < 0:
                return r
            r.edge = 1
            r.point = point_on_edge(scene, edges, own, hit)
            x_b = r.point.x
        t1 = wp.length(x_b - x)
        # A vertex on the edge itself, up to its last bit: of measure zero, without a direction.
        if t1 <= 0.0:
            return r
        d = (x_b - x) / t1
        m = wp.cross(r.point.p1 - r.point.p0, d)
        if r.edge == 3:
            m = r.outline.m
        r.segment.x = x_b
        r.segment.w = d
        r.segment.boundary_normal = m
        r.segment.t1 = t1
        r.segment.face2 = -1
        r.segment.light = -1
        r.last = count + i - 1
        tau = wp.float32(0.0)
        if block.film == 0 and i == 0:
            # The local form: the background is a material point.
            face = wp.where(own_low, high.face, low.face)
            t2 = wp.where(own_low, t_high, t_low)
            r.side = wp.where(own_low, 1, -1)
            if block.first == 0:
                return r
            if wp.static(outline_at is not None):
                if r.edge == 3 and slides_on(scene.triangles[r.outline.face]):
                    # What slides along rays counts as well, on either side of a crease, or past its silhouette.
                    if front:
                        r.side = 0
                    else:
                        r.both = 1
                        if which == 1:
                            r.side = -r.side
                    if front or which == 1:
                        r.tied = -m
                        face = wp.int32(-1)
            if wp.static(outline_at is not None):
                if r.edge == 3 and begins_beside(scene, r.outline, begin, t1):
                    return r
            shared = wp.bool(False)
            if face >= 0 and r.edge == 1:
                shared = edges.ends[own, 0] == edges.twins[own, 0] and edges.ends[own, 1] == edges.twins[own, 1]
                shared = shared and of_edge(edges, own, face)
            if shared:
                return r
            if face >= 0:
                # An edge inside of what it touches lies behind the background.
                tau = wp.min(t1 / t2, 1.0)
                r.segment.face2 = face
                r.segment.u2 = wp.where(own_low, high.u, low.u)
                r.segment.v2 = wp.where(own_low, high.v, low.v)
                r.segment.tau = tau
            if wp.length_sq(r.tied) == 0.0:
                r.a_o = -(1.0 - tau) * m
        else:
            r.a_o = -m
            r.a_d = -t1 * m
        r.phi_a = -wp.dot(m, a.o + t1 * a.d)
        r.phi_b = -wp.dot(m, b.o + t1 * b.d)
        apart_by = wp.float32(0.0)
        if r.edge == 1:
            apart_by = sharp_glass(scene, edges, own)
            if refracts(scene, own_face):
                apart_by = wp.max(apart_by, CORNER)
        if r.edge == 1 and wp.length(low.x - high.x) <= room and low.face >= 0 and high.face >= 0:
            n_low = facing(low.ng, d)
            n_high = facing(high.ng, d)
            if not is_ridge(n_low, n_high, wp.sign(r.phi_a) * m, d):
                apart_by = wp.max(apart_by, wp.max(concave_distance(n_low, n_high, False), CORNER))
        if wp.static(clear_of is not None):
            if r.edge == 3:
                tri = scene.triangles[r.outline.face]
                clear = clear_of(scene, tri)
                if clear > 0.0:
                    # Closer to its outline, hits lie in front of the touched point or behind it, as phi is rounded.
                    apart_by = clear / scene.ray_epsilon
                    # Along a normal that faces outwards phi falls.
                    falls = (r.phi_a < 0.0) == (determinant(tri) > 0.0)
                    r.low_lies = wp.where(falls == own_low, -1, 1)
        r.aside = aside(scene, block, m, apart_by, r.phi_a)
        r.valid = 1
        return r

    return edge_crossing


@functools.cache
def make_shadow_crossing(config: PathConfig):
    """Return ``shadow_crossing(scene, edges, tables, p, q, a_x, b_x, light, last) -> Crossing``.

    The edge whose shadow from a point, spot or directional light ends between the points p and q, whose differentials
    are ``a_x`` along the line and ``b_x`` across it. None: the scene has no such light.
    """
    lit = make_lit(config)
    if lit is None:
        return None
    sheet_end = make_sheet_end(config) if config.points_pass else None
    outline_at = make_chain_outline(config.surfaces.primitives)
    sample = make_delta_sample(config.lights.others)
    visibility = visibility_of(config.rays, config.surfaces.primitives)

    @wp.func
    def shadow_crossing(
        scene: Scene,
        edges: Edges,
        tables: Tables,
        p: Link,
        q: Link,
        a_x: PointDifferential,
        b_x: PointDifferential,
        light: wp.int32,
        last: wp.int32,
    ) -> Crossing:
        r = Crossing()
        if wp.static(sheet_end is None):
            lit_low = lit(scene, p.x, p.ng, light)
            if lit_low == lit(scene, q.x, q.ng, light):
                return r
        # Where light meets the back of one of two faces: at a crease, see above.
        if p.face != q.face and smooth_between(edges, tables, p.face, q.face) >= 0:
            return r
        if wp.static(sheet_end is None):
            dark_x = wp.where(lit_low, q.x, p.x)
            dark_ng = wp.where(lit_low, q.ng, p.ng)
            ls = sample(scene, scene.emitters[light], dark_x, wp.vec2(0.5, 0.5))
            o = step_beside(dark_x, dark_ng, ls.wi, scene.ray_epsilon)
            hit = visibility.closest(scene, o, ls.wi, ls.distance)
        else:
            end = sheet_end(scene, edges, tables, p, q, light)
            if end.found == 0:
                return r
            dark_x = end.x
            ls = end.ls
            o = end.o
            hit = end.hit
        # What is met at once is what the surface runs through.
        if hit.face < 0 or hit.t <= scene.ray_epsilon:
            return r
        x_b = dark_x
        if wp.static(outline_at is not None):
            if is_primitive_at(scene, hit.face):
                met = Link()
                met.x = o + hit.t * ls.wi
                met.u = hit.u
                met.v = hit.v
                r.outline = outline_at(scene, hit.face, met, met, True, dark_x, False)
                if r.outline.valid == 0:
                    return r
                r.edge = 3
                x_b = r.outline.x
                if begins_beside(scene, r.outline, p.face, wp.length(x_b - p.x)):
                    return r
        if r.edge == 0:
            rim = border_of(scene, tables, hit.face, hit.u, hit.v)
            if rim.near > 1.0 or rim.edge < 0:
                return r
            r.edge = 1
            r.point = point_on_edge(scene, edges, rim.edge, point_on(scene.triangles[hit.face], hit.u, hit.v))
            x_b = r.point.x
        t1 = wp.length(x_b - p.x)
        w = (x_b - p.x) / t1
        m = wp.cross(r.point.p1 - r.point.p0, w)
        if r.edge == 3:
            m = r.outline.m
        r.segment.x = x_b
        r.segment.w = w
        r.segment.boundary_normal = m
        r.segment.t1 = t1
        r.segment.face2 = -1
        r.segment.light = light
        if ls.distance < 0.5 * FAR:
            r.segment.tau = t1 / ls.distance
        r.last = last
        r.start.x = -(1.0 - r.segment.tau) * m
        r.phi_a = wp.dot(r.start.x, a_x.x)
        r.phi_b = wp.dot(r.start.x, b_x.x)
        r.valid = 1
        return r

    return shadow_crossing

"""What a line crosses where the identity of the chain changes, and the implicit equation phi = 0 of that curve.

Two rays on either side of the crossing are followed in step until they differ at the i-th vertex x of the chain:

* an edge: phi = m . (x_b - o - t d), m = tangent x d, for the ray (o, d) that passes the edge at x_b. In a block that
  starts at a smooth vertex y the first vertex behind it is a material point c (or at infinity), and on the first
  segment only the background counts:  phi = m . (x_b - (1 - tau) y - tau c), the local form;
* a curve along which two surfaces run through each other: an edge whose velocity follows from those of both planes,
  m . x_b' = a n_A . v_A + b n_B . v_B with m = a n_A + b n_B. On the first segment behind a smooth vertex, where
  ``curve.py`` says what jumps, once for the material point c of either surface:  phi = m . (x_b - c);
* a crease of interpolated normals: an edge beside which light may reach one of the two triangles only;
* the horizon of a vertex y with such normals (``horizon.py``): phi = n_g . (c - y) / |c - y|, once for either side,
  where c is another point;
* a shadow's edge: the same for the segment from x to a point, spot or directional light;
* the terminator of interpolated normals, where the ray arrives edge-on: phi = n . (o - x);
* the horizon of a mirror or glass with such normals, where its lobe leaves along the surface: phi = n_g . d.

Each is a linear form in the velocities of the edge, the vertex, the ray and the light, so phi' is that form pulled back
along the path, and its gradient in q that form applied to the ray differentials.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.chain import (
    MEETS_DELTA,
    MEETS_SMOOTH,
    Block,
    Link,
    make_lit,
    make_meet,
    make_start,
    transmits,
)
from warp_psdr.kernels.boundary.chain_pullback import Visit
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, barycentrics_at, split_between
from warp_psdr.kernels.boundary.notch import facing, is_ridge, let_through, notch, sharp_glass
from warp_psdr.kernels.boundary.ray_differential import (
    RayDifferential,
    make_point_differential,
    scattered_differential,
)
from warp_psdr.kernels.boundary.rims import (
    RIM_EPSILONS,
    Rim,
    Tables,
    joined,
    of_edge,
    point_on_edge,
    rim_of,
    smooth_between,
)
from warp_psdr.kernels.boundary.transport import Segment
from warp_psdr.kernels.bvh.wide import make_intersect
from warp_psdr.kernels.constants import FAR, LOBE_NONE
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.path import PathConfig
from warp_psdr.kernels.structs import Camera, Scene, Triangle
from warp_psdr.kernels.surface import VertexAdjoint, normalize_vjp, point_on

#: Where two surfaces meet, an edge within this many ray epsilons is what is crossed: they touch there.
TOUCHING = 2.0
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
    aside: wp.float32  # part of the line at which its two sides are looked at (``notch.py``)
    both: wp.int32  # 1: the other side of the line is a crossing of its own
    edge: wp.int32  # 1: ``point`` and ``segment`` hold the edge, 2: ``segment`` holds material points
    point: EdgePoint
    segment: Segment  # of the points, face1 (-1: none) is moved along ``sweep1``, face2 along ``sweep``
    sweep1: wp.vec3
    last: wp.int32  # where the pull-back starts (``chain_pullback.py``)
    start: VertexAdjoint
    o_before: wp.vec3
    a_o: wp.vec3
    a_d: wp.vec3


@wp.func
def inside(tri: Triangle, x: wp.vec3) -> wp.bool:
    uv = barycentrics_at(tri, x)
    return uv[0] > 0.0 and uv[1] > 0.0 and uv[0] + uv[1] < 1.0


@wp.func
def laid_over(scene: Scene, low: Link, high: Link) -> wp.bool:
    """Whether two faces lie over one another in one plane at both hits: which is met there is up to rounding."""
    tri_low = scene.triangles[low.face]
    tri_high = scene.triangles[high.face]
    if wp.length_sq(wp.cross(tri_low.normal, tri_high.normal)) >= PARALLEL:
        return False
    if wp.abs(wp.dot(tri_low.normal, high.x - low.x)) > ONE_PLANE * scene.ray_epsilon:
        return False
    return inside(tri_low, high.x) and inside(tri_high, low.x)


@wp.func
def at_once(scene: Scene, hit: Link, o: wp.vec3) -> wp.bool:
    """Whether a ray meets something where it starts."""
    return hit.face >= 0 and wp.length(hit.x - o) <= scene.ray_epsilon


@wp.func
def aside(scene: Scene, block: Block, m: wp.vec3, room: wp.float32, phi_a: wp.float32) -> wp.float32:
    """``Crossing.aside`` for a room in steps; phi is m times a distance in the plane across the ray."""
    along = wp.max(wp.abs(phi_a) * block.ell, TINY)
    return wp.min(room * scene.ray_epsilon * wp.length(m) / along, ASIDE_MOST)


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
    """Where the triangles that two neighbouring rays meet run through each other."""
    r = Crossing()
    n_low = scene.triangles[low.face].normal
    n_high = scene.triangles[high.face].normal
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
    r.sweep1 = by_low
    r.segment.sweep = by_high
    r.last = count + i - 1
    if first:
        # c on the lower side's surface, and then on the upper one's.
        r.both = 1
        r.side = 2 * which - 1
        if which == 0:
            r.sweep1 = -by_high
        else:
            r.segment.sweep = -by_low
    else:
        r.a_o = -m
        r.a_d = -t1 * m
    r.phi_a = -wp.dot(m, a.o + t1 * a.d)
    r.phi_b = -wp.dot(m, b.o + t1 * b.d)
    through = let_through(scene, low.face, high.face, hidden)
    r.aside = aside(scene, block, m, notch(facing(n_low, d), facing(n_high, d), through), r.phi_a)
    r.valid = 1
    return r


@functools.cache
def make_crossing(config: PathConfig):
    """Return ``crossing(scene, camera, edges, tables, block, low, high, which, a, b, visits, ...) -> Crossing``.

    ``a`` and ``b`` are the differentials of the first ray along the line and across it; ``visits[:count]`` is the path
    up to the block, to which the chain's vertices are added. ``which``: where the two sides are crossings of their own
    (``both``), 0 for the lower and 1 for the upper one.
    """
    start_at = make_start(config.camera)
    meet = make_meet(config)
    lit = make_lit(config)
    point_differential = make_point_differential(config.smooth, config.flat)
    closest_hit, _any_hit = make_intersect(config.ray_backend, config.ray_width)
    sample_light = make_delta_sample(config.lights)

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
    ) -> Crossing:
        r = Crossing()
        t_low = wp.float32(FAR)
        t_high = wp.float32(FAR)
        rim_low = Rim()
        rim_low.near = FAR
        rim_high = Rim()
        rim_high.near = FAR
        if low.face >= 0:
            t_low = wp.length(low.x - x)
            rim_low = rim_of(scene, tables, low.face, low.u, low.v)
        if high.face >= 0:
            t_high = wp.length(high.x - x)
            rim_high = rim_of(scene, tables, high.face, high.u, high.v)
        room = RIM_EPSILONS * scene.ray_epsilon
        tie = wp.abs(t_low - t_high) <= room
        if low.face >= 0 and high.face >= 0:
            if laid_over(scene, low, high):
                return r
            apart = wp.min(rim_low.distance, rim_high.distance) > TOUCHING * scene.ray_epsilon
            neighbours = rim_low.edge >= 0 and of_edge(edges, rim_low.edge, high.face)
            if apart and not neighbours and wp.length(low.x - high.x) <= room:
                return curve_crossing(scene, block, low, high, x, a, b, i, count, which, wp.static(config.hidden))
        own_low = wp.where(tie, rim_low.distance <= rim_high.distance, t_low <= t_high)
        own = wp.where(own_low, rim_low.edge, rim_high.edge)
        near = wp.where(own_low, rim_low.near, rim_high.near)
        if near > 1.0 or own < 0:
            return r
        hit = wp.where(own_low, low.x, high.x)
        r.edge = 1
        r.point = point_on_edge(scene, edges, own, hit)
        t1 = wp.length(r.point.x - x)
        # A vertex on the edge itself, up to its last bit: of measure zero, without a direction.
        if t1 <= 0.0:
            return r
        d = (r.point.x - x) / t1
        m = wp.cross(r.point.p1 - r.point.p0, d)
        r.segment.x = r.point.x
        r.segment.w = d
        r.segment.sweep = m
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
            if face >= 0:
                shared = edges.ends[own, 0] == edges.twins[own, 0] and edges.ends[own, 1] == edges.twins[own, 1]
                if shared and of_edge(edges, own, face):
                    return r
                # An edge inside of what it touches lies behind the background.
                tau = wp.min(t1 / t2, 1.0)
                r.segment.face2 = face
                r.segment.u2 = wp.where(own_low, high.u, low.u)
                r.segment.v2 = wp.where(own_low, high.v, low.v)
                r.segment.tau = tau
            r.a_o = -(1.0 - tau) * m
        else:
            r.a_o = -m
            r.a_d = -t1 * m
        r.phi_a = -wp.dot(m, a.o + t1 * a.d)
        r.phi_b = -wp.dot(m, b.o + t1 * b.d)
        apart_by = sharp_glass(scene, edges, own)
        if wp.length(low.x - high.x) <= room and low.face >= 0 and high.face >= 0:
            n_low = facing(scene.triangles[low.face].normal, d)
            n_high = facing(scene.triangles[high.face].normal, d)
            if not is_ridge(n_low, n_high, wp.sign(r.phi_a) * m, d):
                apart_by = wp.max(apart_by, notch(n_low, n_high, False))
        r.aside = aside(scene, block, m, apart_by, r.phi_a)
        r.valid = 1
        return r

    @wp.func
    def own_horizon(
        scene: Scene,
        block: Block,
        face: wp.int32,
        hit: Link,
        d: wp.vec3,
        a: RayDifferential,
        b: RayDifferential,
        last: wp.int32,
        side: wp.int32,
    ) -> Crossing:
        r = Crossing()
        r.both = 1
        r.side = side
        r.last = last
        tri = scene.triangles[face]
        area = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
        r.start.c = normalize_vjp(block.n, area, scene.shapes[tri.shape].orientation * d)
        r.phi_a = wp.dot(block.n, a.d)
        r.phi_b = wp.dot(block.n, b.d)
        r.segment.x = block.x
        r.segment.w = d
        r.segment.face1 = -1
        if hit.face >= 0:
            r.edge = 2
            r.segment.face2 = hit.face
            r.segment.u2 = hit.u
            r.segment.v2 = hit.v
            r.segment.sweep = block.n / wp.length(hit.x - block.x)
            r.a_o = -r.segment.sweep
        r.valid = 1
        return r

    @wp.func
    def crossing(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        block: Block,
        low: wp.float32,
        high: wp.float32,
        which: wp.int32,
        first_a: RayDifferential,
        first_b: RayDifferential,
        visits: wp.array(dtype=Visit),
        count: wp.int32,
        max_depth: wp.int32,
    ) -> Crossing:
        r = Crossing()
        ray = start_at(scene, camera, block, low)
        other = start_at(scene, camera, block, high)
        x = ray.x
        o = ray.o
        d = ray.d
        o_high = other.o
        d_high = other.d
        t_max = ray.t_max
        a = first_a
        b = first_b
        i = wp.int32(0)
        more = wp.bool(True)
        while more:
            depth = block.depth + i
            transmit = transmits(block, i)
            p = meet(scene, o, d, t_max, depth, transmit, max_depth)
            q = meet(scene, o_high, d_high, t_max, depth, transmit, max_depth)
            more = False
            if block.film == 0 and i == 0 and block.first == 1:
                face = visits[count - 1].face
                if tables.bent[face] == 1 and (wp.dot(block.n, d) >= 0.0) != (wp.dot(block.n, d_high) >= 0.0):
                    if which == 0:
                        return own_horizon(scene, block, face, p, d, a, b, count - 1, -1)
                    return own_horizon(scene, block, face, q, d, a, b, count - 1, 1)
            if p.face < 0 and q.face < 0:
                return r
            same = p.face >= 0 and q.face >= 0
            if same:
                same = joined(scene, edges, tables, p, q)
            if not same:
                if block.film == 1 and i == 0:
                    return r
                # Where something runs through a mirror, the curve is a discontinuity of the segment before.
                if i > 0 and (at_once(scene, p, o) or at_once(scene, q, o_high)):
                    return r
                return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which)
            is_bent = tables.bent[p.face] == 1 and tables.bent[q.face] == 1
            crease = is_bent and p.face != q.face
            if crease:
                crease = smooth_between(edges, tables, p.face, q.face) >= 0
            delta = p.kind == MEETS_DELTA and q.kind == MEETS_DELTA
            crosses = is_bent and p.leaving != q.leaving
            if crosses and not delta and p.kind != MEETS_SMOOTH and q.kind != MEETS_SMOOTH:
                # Of a face seen edge-on: what lies between its horizon and its terminator is as narrow as a cell.
                delta = p.kind == MEETS_DELTA or q.kind == MEETS_DELTA
                if p.kind != MEETS_DELTA and not crease:
                    p = q
                    o = o_high
                    d = d_high
            visit = Visit()
            visit.face = p.face
            visit.u = p.u
            visit.v = p.v
            visit.o = wp.where(i == 0 and block.film == 1, x, o)
            visit.d = d
            visit.lobe = wp.where(p.kind == MEETS_DELTA, p.lobe, LOBE_NONE)
            visit.attached = wp.where(i > 0 or block.film == 1, 1, 0)
            visits[count + i] = visit
            a_x = point_differential(scene, p, x, d, a)
            b_x = point_differential(scene, p, x, d, b)
            if is_bent and p.facing != q.facing and not (crosses and delta):
                if i == 0 and block.first == 0:
                    return r
                to = x - p.x
                r.last = count + i
                r.start.x = -p.n
                r.start.n = to
                r.o_before = p.n
                r.phi_a = wp.dot(p.n, a.o - a_x.x) + wp.dot(a_x.n, to)
                r.phi_b = wp.dot(p.n, b.o - b_x.x) + wp.dot(b_x.n, to)
                r.valid = 1
                return r
            if p.kind == MEETS_SMOOTH and q.kind == MEETS_SMOOTH:
                if crease and i > 0:
                    return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which)
                if wp.static(lit is not None):
                    if (i > 0 or block.first == 1) and depth + 1 < max_depth:
                        shared = smooth_between(edges, tables, p.face, q.face)
                        for k in range(scene.emitters.shape[0]):
                            if r.valid == 0 and is_delta_light(scene.emitters[k].kind):
                                lit_low = lit(scene, p.x, p.ng, k)
                                lit_high = lit(scene, q.x, q.ng, k)
                                if lit_low != lit_high:
                                    # Where light meets the back of one of two faces: at a crease, see above.
                                    if p.face == q.face or shared < 0:
                                        dark_x = wp.where(lit_low, q.x, p.x)
                                        dark_ng = wp.where(lit_low, q.ng, p.ng)
                                        ls = sample_light(scene, scene.emitters[k], dark_x, wp.vec2(0.5, 0.5))
                                        turn = wp.where(
                                            wp.dot(dark_ng, ls.wi) >= 0.0, scene.ray_epsilon, -scene.ray_epsilon
                                        )
                                        hit = closest_hit(scene.accel, dark_x + turn * dark_ng, ls.wi, ls.distance)
                                        # What is met at once is what the surface runs through.
                                        if hit.face >= 0 and hit.t > scene.ray_epsilon:
                                            rim = rim_of(scene, tables, hit.face, hit.u, hit.v)
                                            if rim.near <= 1.0 and rim.edge >= 0:
                                                tri = scene.triangles[hit.face]
                                                met = point_on(tri, hit.u, hit.v)
                                                r.edge = 1
                                                r.point = point_on_edge(scene, edges, rim.edge, met)
                                                t1 = wp.length(r.point.x - p.x)
                                                w = (r.point.x - p.x) / t1
                                                m = wp.cross(r.point.p1 - r.point.p0, w)
                                                r.segment.x = r.point.x
                                                r.segment.w = w
                                                r.segment.sweep = m
                                                r.segment.t1 = t1
                                                r.segment.face2 = -1
                                                r.segment.light = k
                                                if ls.distance < 0.5 * FAR:
                                                    r.segment.tau = t1 / ls.distance
                                                r.last = count + i
                                                r.start.x = -(1.0 - r.segment.tau) * m
                                                r.phi_a = wp.dot(r.start.x, a_x.x)
                                                r.phi_b = wp.dot(r.start.x, b_x.x)
                                                r.valid = 1
                return r
            if delta:
                if crosses and crease:
                    if i == 0 and block.film == 0:
                        return r
                    return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which)
                a = scattered_differential(p, d, a, a_x)
                b = scattered_differential(p, d, b, b_x)
                if crosses:
                    tri = scene.triangles[p.face]
                    area = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
                    r.last = count + i
                    r.start.c = normalize_vjp(p.ng, area, scene.shapes[tri.shape].orientation * p.d)
                    r.a_d = p.ng
                    r.phi_a = wp.dot(p.ng, a.d)
                    r.phi_b = wp.dot(p.ng, b.d)
                    r.valid = 1
                    return r
                x = p.x
                o = p.o
                d = p.d
                o_high = q.o
                d_high = q.d
                t_max = FAR
                i += 1
                more = True
        return r

    return crossing

"""The discontinuity that a line crosses where the identity of a chain changes, and its implicit equation phi = 0.

Two rays on either side of the crossing are followed in step until they differ at the i-th vertex of the chain. The
difference (an edge, a curve of intersection, a crease, a horizon, a shadow's edge, a terminator, a texture's step)
decides phi, a linear form in the velocities.

Derivation: ``docs/theory/specular.md#what-a-line-crosses``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.specular.chain_edges import Crossing, aside, make_edge_crossing, make_shadow_crossing
from warp_psdr.kernels.boundary.specular.chain_outlines import make_one_sheet
from warp_psdr.kernels.boundary.specular.chain_pullback import Visit
from warp_psdr.kernels.boundary.specular.chain_touch import SAME
from warp_psdr.kernels.boundary.specular.frame_crossing import frame_crossing
from warp_psdr.kernels.boundary.specular.ray_differential import (
    RayDifferential,
    make_point_differential,
    scattered_differential,
)
from warp_psdr.kernels.boundary.specular.specular_chain import (
    MEETS_DELTA,
    MEETS_SMOOTH,
    Block,
    Link,
    goes_on,
    make_chain_depth,
    make_intersect_link,
    make_start,
)
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables, joined, smooth_between
from warp_psdr.kernels.constants import EMITTER_PROJECTOR, FAR, LOBE_NONE
from warp_psdr.kernels.emitter.dispatch import is_delta_light
from warp_psdr.kernels.primitive.affine import is_primitive_at
from warp_psdr.kernels.primitive.dispatch import slides_on
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import normalize_vjp
from warp_psdr.kernels.texture.steps import line_beside, place_gradient
from warp_psdr.kernels.vertex import PathConfig

#: Cosine of the normal of a shape without triangles below which a ray only touches it: where it does has no derivative.
TANGENT = 1.0e-5
#: Up to how far from a crossing, in ray epsilons, a step of a texture lies, and its two sides are looked at: the two
#: ends of a line's finest cell are up to roundings one point.
STEP_REACH = 3.0


@wp.func
def at_once(scene: Scene, hit: Link, o: wp.vec3) -> wp.bool:
    """Whether a ray meets something where it starts."""
    return hit.face >= 0 and wp.length(hit.x - o) <= scene.ray_epsilon


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
    """The horizon of the vertex at which a block starts, on one side, seen past the point c that ``hit`` is."""
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
        r.segment.boundary_normal = block.n / wp.length(hit.x - block.x)
        r.a_o = -r.segment.boundary_normal
        if slides_on(scene.triangles[hit.face]):
            # It moves as what it is tied to, the vertex of the block (form S).
            r.segment.face2 = face
            r.edge = 0
            r.a_o = wp.vec3(0.0, 0.0, 0.0)
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
    intersect_link = make_intersect_link(config)
    chain_depth, behind = make_chain_depth(config.media is not None)
    point_differential = make_point_differential(
        config.surfaces.smooth, config.surfaces.flat, config.surfaces.primitives
    )
    edge_crossing = make_edge_crossing(config.rays.hidden, config.surfaces.primitives)
    shadow_crossing = make_shadow_crossing(config)
    one_sheet = make_one_sheet(config.surfaces.primitives)
    projects = EMITTER_PROJECTOR in config.lights.others

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
        depth = block.depth
        begin = wp.int32(-1)
        if block.film == 0:
            begin = visits[count - 1].face
            if wp.static(config.media is not None):
                begin = wp.where(block.shape < 0, -1, begin)
        more = wp.bool(True)
        while more:
            most = chain_depth(block, i, max_depth)
            on = goes_on(block, i)
            p = intersect_link(scene, o, d, t_max, depth, on, most)
            q = intersect_link(scene, o_high, d_high, t_max, depth, on, most)
            more = False
            if block.film == 0 and i == 0 and block.first == 1:
                face = begin
                sides = (wp.dot(block.n, d) >= 0.0) != (wp.dot(block.n, d_high) >= 0.0)
                if sides:
                    if tables.interpolated[face] == 1:
                        if which == 0:
                            return own_horizon(scene, block, face, p, d, a, b, count - 1, -1)
                        return own_horizon(scene, block, face, q, d, a, b, count - 1, 1)
            if p.face < 0 and q.face < 0:
                return r
            same = p.face >= 0 and q.face >= 0
            if same:
                same = joined(scene, edges, tables, p, q)
                if wp.static(one_sheet is not None):
                    if same and p.face == q.face:
                        same = one_sheet(scene, p, q) == SAME
            if not same:
                if block.film == 1 and i == 0:
                    return r
                # Where something runs through a mirror, the curve is a discontinuity of the segment before.
                if i > 0 and (at_once(scene, p, o) or at_once(scene, q, o_high)):
                    return r
                return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which, begin)
            is_interpolated = tables.interpolated[p.face] == 1 and tables.interpolated[q.face] == 1
            crease = is_interpolated and p.face != q.face
            if crease:
                crease = smooth_between(edges, tables, p.face, q.face) >= 0
            delta = p.kind == MEETS_DELTA and q.kind == MEETS_DELTA
            crosses = is_interpolated and p.leaving != q.leaving
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
            if wp.static(bool(config.surfaces.primitives)):
                if is_primitive_at(scene, p.face) and wp.abs(wp.dot(p.ng, d)) < TANGENT:
                    return r
            a_x = point_differential(scene, p, x, d, a)
            b_x = point_differential(scene, p, x, d, b)
            if wp.static(config.surfaces.steps):
                meshes = not is_primitive_at(scene, p.face) and not is_primitive_at(scene, q.face)
                if meshes and (i > 0 or block.first == 1):
                    step = line_beside(scene, tables.steps, p.face, p.u, p.v, STEP_REACH * scene.ray_epsilon)
                    if step.texture >= 0:
                        r.edge = 4
                        r.step = step
                        r.last = count + i
                        r.start.u = step.slopes[0]
                        r.start.v = step.slopes[1]
                        gradient = place_gradient(scene.triangles[p.face], step.slopes)
                        r.phi_a = wp.dot(gradient, a_x.x)
                        r.phi_b = wp.dot(gradient, b_x.x)
                        r.aside = aside(scene, block, gradient, STEP_REACH, r.phi_a)
                        r.valid = 1
                        return r
            if is_interpolated and p.facing != q.facing and not (crosses and delta):
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
                    return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which, begin)
                if wp.static(shadow_crossing is not None):
                    if (i > 0 or block.first == 1) and depth + 1 < max_depth:
                        for k in range(scene.emitters.shape[0]):
                            if wp.static(projects):
                                if r.valid == 0:
                                    r = frame_crossing(scene, p.x, q.x, a_x, b_x, k, count + i)
                            if r.valid == 0 and is_delta_light(scene.emitters[k].kind):
                                r = shadow_crossing(scene, edges, tables, p, q, a_x, b_x, k, count + i)
                return r
            if delta:
                if crosses and crease:
                    if i == 0 and block.film == 0:
                        return r
                    return edge_crossing(scene, edges, tables, block, p, q, x, a, b, i, count, which, begin)
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
                depth = behind(depth, p.lobe)
                more = True
        return r

    return crossing

"""Curves of intersection as path vertices meet them: two surfaces A and B that run through each other.

The camera sees such a curve as it sees a crease (``primary.py``). For deeper vertices no segment grazes it, since both
surfaces go on behind it; what jumps is the visibility of a path vertex c *on* A, towards both of its neighbours, where
c passes through B. Let s be the side of B on which the neighbours lie: both on the same, for otherwise one of them is
hidden from c on either side of the curve. c contributes where it lies on that side, and in material form

    dI = integral over the curve and the direction omega of  W(c, omega) L(c, omega) |n_A . omega| beta dl dsigma,

beta the speed in A's plane, away from the part of A on side s, of the curve x_b relative to the material point c. Since
x_b' - c' lies in A's plane and n_B . (x_b' - c') = n_B . (v_B - v_A), and since |n_A . omega| is the part of t x omega
across the curve in that plane, this is the local form with x_1 = c, t_1 = 0, tau = 0 and

    sweep = +- t x omega,  turned away from the visible part of A.

Two cases, of which one is drawn, and likewise which of the two surfaces carries c:

* c scatters: omega leads to the vertex behind it, and the walk towards the sensor begins on the same side of B. A c
  that the camera sees belongs to the film's parametrisation and is left to ``primary.py``, like a contact
  (``local_form.py``).
* c emits: it is the last vertex, x_2 = c and tau = 1; x_1 is what it lights, at any depth, and does not enter.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.direction import SAME_POINT, Wedge, make_direction, pdf_wedge
from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, barycentrics_at, edge_point
from warp_psdr.kernels.boundary.secondary import make_segment_sink
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.bvh.wide import make_intersect
from warp_psdr.kernels.constants import FAR, PI
from warp_psdr.kernels.emitter.area import make_area
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.path import PathConfig
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import Camera, Scene

#: Sample slots of a point on the curve; those of the walk follow.
SLOT_POINT, SLOT_DIRECTION, SLOT_LIGHT = 0, 1, 2
#: A ray starts a ray epsilon off both surfaces, and this many at most along A where they meet at a small angle.
MAX_SHIFT = 50.0


@wp.struct
class Vertex:
    """A point c of the curve as a point of one of its surfaces."""

    face: wp.int32
    u: wp.float32
    v: wp.float32
    n: wp.vec3  # normal of its surface
    side: wp.vec3  # normal of the other, on the side where c is visible
    t: wp.vec3  # along the curve
    out: wp.vec3  # unit, in the plane of its surface, towards the visible part
    shift: wp.vec3  # off the other surface


@wp.func
def sweep_at(c: Vertex, w: wp.vec3) -> wp.vec3:
    """Return t x w, turned away from the visible part of the surface."""
    m = wp.cross(c.t, w)
    return wp.where(wp.dot(m, c.out) > 0.0, -m, m)


@wp.func
def vertex_at(scene: Scene, edges: Edges, point: EdgePoint, which: wp.int32, w: wp.vec3) -> Vertex:
    """The curve's point on its first or second face, visible from the direction w."""
    c = Vertex()
    first = edges.first[point.edge]
    c.face = edges.faces[first + which]
    tri = scene.triangles[c.face]
    other = scene.triangles[edges.faces[first + 1 - which]].normal
    uv = barycentrics_at(tri, point.x)
    c.u = uv[0]
    c.v = uv[1]
    c.n = tri.normal
    c.side = wp.where(wp.dot(other, w) < 0.0, -other, other)
    c.t = wp.normalize(point.p1 - point.p0)
    c.out = wp.normalize(wp.cross(c.n, c.t))
    if wp.dot(c.out, c.side) < 0.0:
        c.out = -c.out
    # The start is moved off c's own surface too, by one epsilon, which may lead towards the other: make up for it.
    sine = wp.max(wp.dot(c.out, c.side), 1.0e-6)
    c.shift = (scene.ray_epsilon * wp.min((1.0 + wp.abs(wp.dot(c.n, c.side))) / sine, MAX_SHIFT)) * c.out
    return c


@functools.cache
def make_scattering(config: PathConfig):
    """Return ``scattering(scene, edges, point, which, u4, v4, share) -> Segment``: c scatters."""
    closest_hit, any_hit = make_intersect(config.ray_backend, config.ray_width)
    sample_direction, pdf_light = make_direction(config)

    @wp.func
    def scattering(
        scene: Scene,
        edges: Edges,
        point: EdgePoint,
        which: wp.int32,
        u4: wp.vec4,
        v4: wp.vec4,
        share: wp.float32,
    ) -> Segment:
        r = Segment()
        r.face2 = -1
        r.light = -1
        wedge = Wedge()  # all directions
        wedge.t = wp.normalize(point.p1 - point.p0)
        wedge.a = any_tangent(wedge.t)
        wedge.b = wp.cross(wedge.t, wedge.a)
        wedge.width = PI
        direction = sample_direction(scene, wedge, point.x, share, u4, v4)
        if direction.valid == 0:
            return r
        r.w = direction.w
        c = vertex_at(scene, edges, point, which, r.w)
        r.sweep = sweep_at(c, r.w)
        r.contact = 1
        r.face1 = c.face
        r.u1 = c.u
        r.v1 = c.v
        r.shift = c.shift
        r.side = c.side
        turn = wp.where(wp.dot(c.n, r.w) >= 0.0, scene.ray_epsilon, -scene.ray_epsilon)
        start = point.x + c.shift + turn * c.n
        # ``source`` goes on one epsilon before it starts.
        r.x = start - scene.ray_epsilon * r.w
        pdf = pdf_wedge(wedge)
        if direction.light >= 0:
            if any_hit(scene.accel, start, r.w, direction.distance):
                return r
            r.known = 1
            r.radiance = direction.irradiance
            pdf = 1.0 - share
        else:
            hit = closest_hit(scene.accel, start, r.w, FAR)
            if direction.aimed == 1:
                if direction.distance > 0.5 * FAR:
                    if hit.face >= 0:
                        return r
                elif wp.abs(hit.t - direction.distance) > SAME_POINT * direction.distance or hit.face < 0:
                    return r
            pdf = share * pdf + (1.0 - share) * pdf_light(scene, hit.face, r.w, hit.t)
        r.scale = wp.length(point.p1 - point.p0) / (point.pdf * pdf)
        r.valid = 1
        return r

    return scattering


@functools.cache
def make_emission(config: PathConfig):
    """Return ``emission(scene, edges, point, which, u) -> Segment``: c emits, by the cosine of its direction."""
    closest_hit, _any_hit = make_intersect(config.ray_backend, config.ray_width)
    emitted = make_area(config.area)[0]

    @wp.func
    def emission(scene: Scene, edges: Edges, point: EdgePoint, which: wp.int32, u: wp.vec2) -> Segment:
        r = Segment()
        r.light = -1
        n = scene.triangles[edges.faces[edges.first[point.edge] + which]].normal
        local = square_to_cosine_hemisphere(u)
        s = any_tangent(n)
        out = to_world(s, wp.cross(n, s), n, local)
        c = vertex_at(scene, edges, point, which, out)
        start = point.x + c.shift + scene.ray_epsilon * n
        hit = closest_hit(scene.accel, start, out, FAR)
        if hit.face < 0 or local[2] <= 0.0:
            return r
        r.x = start
        r.w = -out
        r.sweep = sweep_at(c, out)
        r.t1 = hit.t
        r.tau = 1.0
        r.face1 = hit.face
        r.u1 = hit.u
        r.v1 = hit.v
        r.face2 = c.face
        r.u2 = c.u
        r.v2 = c.v
        r.known = 1
        r.radiance = emitted(
            scene, scene.emitters[scene.shapes[scene.triangles[c.face].shape].emitter], c.face, c.u, c.v, r.w
        )
        r.scale = wp.length(point.p1 - point.p0) * PI / (point.pdf * local[2])
        r.valid = 1
        return r

    return emission


@functools.cache
def make_curve_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``)."""
    scattering = make_scattering(config)
    emission = make_emission(config) if config.area else None
    push_segment = make_segment_sink(role, False)
    transport = make_transport(config, role, camera_moves, make_source(config))
    draw = make_sampler(config.sampler)
    sample_4d = draw.sample_4d

    @wp.kernel(module="unique", enable_backward=False)
    def curve(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        first: wp.int32,
        samples: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        share: wp.float32,
        adjoint: wp.array2d(dtype=wp.vec3),
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = first + wp.tid()
        sampler = Sampler()
        sampler.pixel = wp.uint32(number)
        sampler.seed = seed
        u4 = sample_4d(sampler, SLOT_POINT)
        point = edge_point(scene, edges, number, samples, u4[0])
        which = wp.where(u4[1] < 0.5, 0, 1)
        face = edges.faces[edges.first[point.edge] + which]
        # Behind a scattering c there are two more vertices, in front of an emitting one a single one.
        emits = wp.float32(0.0)
        if wp.static(bool(config.area)):
            if scene.shapes[scene.triangles[face].shape].emitter >= 0:
                emits = 0.5
        if max_depth == 2 and emits > 0.0:
            emits = 1.0
        s = Segment()
        if u4[2] < emits:
            if wp.static(bool(config.area)):
                s = emission(scene, edges, point, which, wp.vec2(u4[3], (u4[1] * 2.0) % 1.0))
                s.scale /= emits
        else:
            if max_depth == 2:
                return
            s = scattering(
                scene,
                edges,
                point,
                which,
                sample_4d(sampler, SLOT_DIRECTION),
                sample_4d(sampler, SLOT_LIGHT),
                share,
            )
            s.scale /= 1.0 - emits
        if s.valid == 0:
            return
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = push_segment(scene, target, edges, point, s, 1.0)
        scale = 2.0 * s.scale / wp.float32(samples)
        weight = transport(scene, camera, sampler, s, scale, rest, max_depth, rr_depth, adjoint, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                push_segment(scene, target, edges, point, s, weight)

    return curve

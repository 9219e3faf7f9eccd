"""Secondary boundary at curves of intersection: two surfaces A and B that run through each other.

Where a path vertex c on A passes through B, it loses sight of the vertex before it and of everything behind it. The
jump is the local form with tau = 1 and the normal +- t x w, turned away from the visible part of A.

Derivation: ``docs/theory/boundary.md#curves-of-intersection``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.local_form import (
    EdgePoint,
    Edges,
    barycentrics_at,
    edge_behind,
    edge_point,
    edge_step,
)
from warp_psdr.kernels.boundary.path_space.secondary import make_segment_sink
from warp_psdr.kernels.boundary.transport import Segment, make_source, make_transport
from warp_psdr.kernels.constants import FAR, TWO_PI
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, RayConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of a point on the curve; those of the walk follow (``transport.py``).
SLOT_POINT, SLOT_DIRECTION = 0, 1
#: c lies this many ray epsilons off B, and where the surfaces meet at a small angle this many at most off the curve.
OFF, MAX_SHIFT = 3.0, 100.0


@functools.cache
def make_curve_draw():
    """Return ``draw(scene, edges, point, which, u4) -> Segment``: c on the first or second face of the curve.

    The direction to x_1, -w, is known, and nothing else of x_1; ``source`` is where the ray to x_1 starts.
    """

    @wp.func
    def draw(scene: Scene, edges: Edges, point: EdgePoint, which: wp.int32, u4: wp.vec4) -> Segment:
        r = Segment()
        r.light = -1
        first = edges.first[point.edge]
        r.face2 = edges.faces[first + which]
        tri = scene.triangles[r.face2]
        uv = barycentrics_at(tri, point.x)
        r.u2 = uv[0]
        r.v2 = uv[1]
        r.tau = 1.0
        # On either face of A's triangle.
        n = wp.where(u4[2] < 0.5, tri.normal, -tri.normal)
        local = square_to_cosine_hemisphere(wp.vec2(u4[0], u4[1]))
        if local[2] <= 0.0:
            return r
        s = any_tangent(n)
        back = to_world(s, wp.cross(n, s), n, local)
        r.w = -back
        other = scene.triangles[edges.faces[first + 1 - which]].normal
        other = wp.where(wp.dot(other, back) < 0.0, -other, other)
        t = wp.normalize(point.p1 - point.p0)
        # In A's plane, towards its visible part.
        out = wp.normalize(wp.cross(n, t))
        if wp.dot(out, other) < 0.0:
            out = -out
        m = wp.cross(t, r.w)
        r.boundary_normal = wp.where(wp.dot(m, out) > 0.0, -m, m)
        step = edge_step(scene, edges, point.edge)
        r.x = point.x + (step * wp.min(OFF / wp.dot(out, other), MAX_SHIFT)) * out
        r.source = r.x + edge_behind(scene, step) * back
        # pdf_l is a density of the fraction s, dl = |p1 - p0| ds; pdf_sigma = cosine / (2 pi), and A or B.
        r.scale = 2.0 * wp.length(point.p1 - point.p0) * TWO_PI / (point.pdf * local[2])
        r.valid = 1
        return r

    return draw


@functools.cache
def make_curve_segment(rays: RayConfig, primitives: tuple[int, ...]):
    """Return ``segment(scene, edges, point, which, u4) -> Segment``: as drawn, with x_1."""
    visibility = visibility_of(rays, primitives)
    sees = make_sees(rays, primitives)
    curve_draw = make_curve_draw()

    @wp.func
    def segment(scene: Scene, edges: Edges, point: EdgePoint, which: wp.int32, u4: wp.vec4) -> Segment:
        r = curve_draw(scene, edges, point, which, u4)
        if r.valid == 0:
            return r
        r.valid = 0
        back = -r.w
        hit = visibility.closest(scene, r.source, back, FAR)
        if hit.face < 0 or not sees(scene, r.source, r.w, hit.t):
            return r
        r.t1 = hit.t
        r.face1 = hit.face
        r.u1 = hit.u
        r.v1 = hit.v
        r.valid = 1
        return r

    return segment


@functools.cache
def make_intersection_curve_kernel(config: PathConfig, role: str, camera_moves: bool, indirect: bool = False):
    """Return the kernel: one thread a sample (arguments as in ``secondary.py``)."""
    segment_at = make_curve_segment(config.rays, config.surfaces.primitives)
    accumulate_segment = make_segment_sink(role, False, config.surfaces.primitives)
    source = make_source(config)
    source = make_indirect(source) if indirect else source
    transport = make_transport(config, role, camera_moves, source)
    sample_4d = make_sampler(config.sampler).sample_4d
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def intersection_curve(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u4 = sample_4d(sampler, SLOT_POINT)
        point = edge_point(scene, edges, number, job.samples, u4[0])
        s = segment_at(scene, edges, point, wp.where(u4[1] < 0.5, 0, 1), sample_4d(sampler, SLOT_DIRECTION))
        if s.valid == 0:
            return
        note_place(scene, NOTE_EDGE, point.edge, point.s, 0.0, point.x, s.w, wp.vec3(s.scale))
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_segment(scene, target, edges, point, s, 1.0)
        scale = s.scale / wp.float32(job.samples)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_segment(scene, target, edges, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return intersection_curve

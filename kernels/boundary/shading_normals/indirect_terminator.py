"""The terminator of interpolated normals as seen from path vertices other than the camera.

The light that x scatters towards the vertex y before it jumps where phi = n(x) . (y - x) = 0. The direction is drawn in
the plane perpendicular to n.

Derivation: ``docs/theory/shading_normals.md#the-terminator-beyond-the-camera``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.distribution import stratified_entry
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_triangle
from warp_psdr.kernels.step import leaving_step, passing_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink
from warp_psdr.kernels.vertex import PathConfig, SurfaceConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sine of the angle by which the two directions of the jump lie above and below the horizon of n.
TILT = 1.0e-4
#: Distance from x at which the rays of the jump start, in ray epsilons: far enough for float32 to find x again, near
#: enough for nothing to be in between.
AHEAD = 50.0
#: sin(alpha) below which a point counts as flat.
FLAT = 1.0e-5


@functools.cache
def make_jump(config: PathConfig):
    """Return ``jump(scene, sampler, segment, k, max_depth, rr_depth) -> Incident``: [L] with common random numbers."""
    incident = make_incident(config)

    @wp.func
    def jump(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        n = -s.t1 * s.boundary_normal
        ahead = wp.min(AHEAD * passing_step(scene, s.face2), 0.5 * s.t1)
        d = wp.normalize(s.w - TILT * n)
        here = incident(scene, sampler, s.x - ahead * d, d, FAR, k, max_depth, rr_depth)
        d = wp.normalize(s.w + TILT * n)
        there = incident(scene, sampler, s.x - ahead * d, d, FAR, k, max_depth, rr_depth)
        return difference(here, there)

    return jump


@functools.cache
def make_turned_sink(surfaces: SurfaceConfig, role: str):
    """Return ``accumulate_terminator(scene, target, segment, w) -> float``, for x_2 and its normal."""
    accumulate_vertex = make_vertex_sink(role, True, surfaces.flat, False, False, False, True)

    @wp.func
    def accumulate_terminator(
        scene: Scene, target: wp.array(dtype=wp.float32), s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        vertex = VertexAdjoint()
        vertex.x = w * s.boundary_normal
        vertex.n = -w * s.w
        accumulated = accumulate_vertex(scene, target, s.face2, s.u2, s.v2, vertex, False, s.x, s.w)
        return accumulated.dot

    return accumulate_terminator


@functools.cache
def make_turned_segment(config: PathConfig):
    """Return ``turned_segment(scene, face_cdf, faces, number, samples, sampler) -> (Segment, vec3, float32)``.

    A point x = x_2 of the triangles ``faces`` and a direction w in the plane perpendicular to its normal; where the ray
    to x_1, along -w, starts; and the sample's weight. The boundary normal is not yet divided by the distance of x_1.
    """
    surface_at = make_interaction(config.surfaces, config.lights).surface
    sample_4d = make_sampler(config.sampler).sample_4d

    @wp.func
    def turned_segment(
        scene: Scene,
        face_cdf: wp.array(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        number: wp.int32,
        samples: wp.int32,
        sampler: Sampler,
    ) -> tuple[Segment, wp.vec3, wp.float32]:
        u4 = sample_4d(sampler, 0)
        face, probability = stratified_entry(face_cdf, faces, number, samples, u4[0])
        s = Segment()
        s.light = -1
        s.face2 = face
        uv = square_to_triangle(wp.vec2(u4[1], u4[2]))
        s.u2 = uv[0]
        s.v2 = uv[1]
        surface = surface_at(scene, s.face2, s.u2, s.v2)
        across = surface.ng - wp.dot(surface.ng, surface.n) * surface.n
        sine = wp.length(across)
        if sine < FLAT:
            return s, s.x, 0.0
        across = across / sine
        # theta: its sine is uniform, its cosine has either sign.
        half = wp.where(u4[3] < 0.5, 0.0, 1.0)
        b = 4.0 * u4[3] - 2.0 * half - 1.0
        a = (1.0 - 2.0 * half) * wp.sqrt(1.0 - b * b)
        out = a * across + b * wp.cross(surface.n, across)
        s.x = surface.x
        s.w = -out
        away = leaving_step(scene, s.face2)
        turn = (1.0 - 2.0 * half) * away
        s.boundary_normal = -1.0 * surface.n
        s.valid = 1
        tri = scene.triangles[s.face2]
        area = 0.5 * wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
        # |n_g . w| / pdf_theta = 4 sin(alpha)
        return s, s.x + turn * surface.ng, 4.0 * sine * area / (probability * wp.float32(samples))

    return turned_segment


@functools.cache
def make_indirect_terminator_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``).

    ``faces`` are the triangles whose normals bend, ``face_cdf`` their cumulative probabilities.
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    turned_segment = make_turned_segment(config)
    accumulate_terminator = make_turned_sink(config.surfaces, role)
    transport = make_transport(config, role, camera_moves, make_jump(config), 2)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def indirect_terminator(
        # Scene:
        scene: Scene,
        camera: Camera,
        face_cdf: wp.array(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        s, start, scale = turned_segment(scene, face_cdf, faces, number, job.samples, sampler)
        if s.valid == 0:
            return
        out = -s.w
        hit = visibility.closest(scene, start, out, FAR)
        if hit.face < 0 or hit.t <= leaving_step(scene, s.face2):
            return
        s.t1 = hit.t
        s.boundary_normal = (1.0 / s.t1) * s.boundary_normal
        s.face1 = hit.face
        s.u1 = hit.u
        s.v1 = hit.v
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_terminator(scene, target, s, 1.0)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_terminator(scene, target, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return indirect_terminator

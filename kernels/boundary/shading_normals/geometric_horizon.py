"""The horizon of a path vertex's own triangle, where interpolated normals differ from the triangle's normal.

The incident light at x jumps where phi = n_g . (x_2 - x) = 0. Under interpolated normals the scattering function does
not vanish there. Directions are sampled in the plane of the triangle, tilted to either side.

Derivation: ``docs/theory/shading_normals.md#the-horizon-of-a-triangle``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.depth import make_indirect
from warp_psdr.kernels.boundary.detector import Incident, make_incident, scaled
from warp_psdr.kernels.boundary.shading_normals.indirect_terminator import FLAT, TILT
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.bsdf.dispatch import passing
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.distribution import stratified_entry
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.dispatch import has_slides, make_adjoint_sink, slides_on
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_triangle
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, normalize_vjp
from warp_psdr.kernels.vertex import PathConfig, SurfaceConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of x and theta, and of the side; those of the walk follow (``transport.py``).
SLOT_POINT, SLOT_SIDE = 0, 1


@functools.cache
def make_horizon_source(config: PathConfig):
    """Return ``side(scene, sampler, segment, k, max_depth, rr_depth) -> Incident``: L, negative below the triangle."""
    incident = make_incident(config)

    @wp.func
    def side(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        radiance_behind = incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)
        return scaled(radiance_behind, wp.vec3(0.0, 0.0, 0.0), s.radiance[0])

    return side


@functools.cache
def make_horizon_sink(surfaces: SurfaceConfig, role: str):
    """Return ``accumulate_geometric_horizon(scene, target, segment, w) -> float``, for the triangle of x_1 and x_2."""
    accumulate_vertex = make_adjoint_sink(role, False, False, False, False, False, True, surfaces.primitives)

    @wp.func
    def accumulate_geometric_horizon(
        scene: Scene, target: wp.array(dtype=wp.float32), s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        tri = scene.triangles[s.face1]
        own = VertexAdjoint()
        twice_area = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
        own.c = normalize_vjp(tri.normal, twice_area, (w * scene.shapes[tri.shape].orientation) * s.w)
        accumulated = accumulate_vertex(scene, target, s.face1, s.u1, s.v1, own, False, s.x, s.w)
        total = accumulated.dot
        if s.face2 >= 0 and wp.length_sq(s.boundary_normal) > 0.0:
            other = VertexAdjoint()
            other.x = w * s.boundary_normal
            met = accumulate_vertex(scene, target, s.face2, s.u2, s.v2, other, False, s.x, s.w)
            total += met.dot
        return total

    return accumulate_geometric_horizon


@functools.cache
def make_horizon_segment(config: PathConfig):
    """Return ``horizon_segment(scene, face_cdf, faces, number, samples, sampler) -> (Segment, vec3, float32)``.

    A point x_1 of the triangles ``faces``, a direction beside its horizon, with the sign of its side for a radiance,
    its triangle's normal, and the sample's weight.
    """
    surface_at = make_interaction(config.surfaces, config.lights).surface
    both = config.surfaces.two_sided or bool(passing(config.surfaces.bsdfs))
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.func
    def horizon_segment(
        scene: Scene,
        face_cdf: wp.array(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        number: wp.int32,
        samples: wp.int32,
        sampler: Sampler,
    ) -> tuple[Segment, wp.vec3, wp.float32]:
        u4 = sample_4d(sampler, SLOT_POINT)
        face, probability = stratified_entry(face_cdf, faces, number, samples, u4[0])
        s = Segment()
        s.light = -1
        s.face1 = face
        uv = square_to_triangle(wp.vec2(u4[1], u4[2]))
        s.u1 = uv[0]
        s.v1 = uv[1]
        surface = surface_at(scene, s.face1, s.u1, s.v1)
        across = surface.n - wp.dot(surface.n, surface.ng) * surface.ng
        sine = wp.length(across)
        if sine < FLAT:
            return s, s.x, 0.0
        across = across / sine
        # theta: its sine is uniform. Where n . w < 0, only materials with two sides, or a lobe behind, scatter.
        half = wp.float32(0.0)
        b = 2.0 * u4[3] - 1.0
        chance = wp.float32(1.0)
        if wp.static(both):
            half = wp.where(u4[3] < 0.5, 0.0, 1.0)
            b = 4.0 * u4[3] - 2.0 * half - 1.0
            chance = wp.float32(0.5)
        cosine = wp.sqrt(1.0 - b * b)
        if cosine <= 0.0:
            return s, s.x, 0.0
        flat = (1.0 - 2.0 * half) * cosine * across + b * wp.cross(surface.ng, across)
        sign = wp.where(sample_1d(sampler, SLOT_SIDE) < 0.5, 1.0, -1.0)
        s.radiance = wp.vec3(sign, 0.0, 0.0)
        s.w = wp.normalize(flat + (sign * TILT) * surface.ng)
        s.x = surface.x
        s.source = s.x + (sign * leaving_step(scene, s.face1)) * surface.ng
        s.valid = 1
        tri = scene.triangles[s.face1]
        area = 0.5 * wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
        # One of two sides; pdf_theta = chance |cos(theta)| / 2.
        density = chance * cosine * probability * wp.float32(samples)
        return s, surface.ng, 4.0 * area * wp.abs(wp.dot(surface.ng, s.w)) / density

    return horizon_segment


@functools.cache
def make_geometric_horizon_kernel(config: PathConfig, role: str, camera_moves: bool, indirect: bool = False):
    """Return the kernel: one thread a sample; arguments as those of ``make_secondary_kernel``."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    horizon_segment = make_horizon_segment(config)
    accumulate_geometric_horizon = make_horizon_sink(config.surfaces, role)
    source = make_indirect(make_horizon_source(config)) if indirect else make_horizon_source(config)
    transport = make_transport(config, role, camera_moves, source)
    has_sliding = has_slides(config.surfaces.primitives)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def geometric_horizon(
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
        s, normal, scale = horizon_segment(scene, face_cdf, faces, number, job.samples, sampler)
        if s.valid == 0:
            return
        hit = visibility.closest(scene, s.source, s.w, FAR)
        s.face2 = hit.face
        if hit.face >= 0:
            if hit.t <= leaving_step(scene, s.face1):
                return
            s.u2 = hit.u
            s.v2 = hit.v
            s.boundary_normal = normal / hit.t
            if wp.static(has_sliding):
                # What slides along w moves across n_g as x does, which is nothing.
                if slides_on(scene.triangles[hit.face]):
                    s.boundary_normal = wp.vec3(0.0, 0.0, 0.0)
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_geometric_horizon(scene, target, s, 1.0)
        weight = transport(scene, camera, sampler, s, scale, rest, job, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_geometric_horizon(scene, target, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return geometric_horizon

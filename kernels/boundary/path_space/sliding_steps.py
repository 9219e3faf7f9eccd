"""Steps of textures that slide over a surface, at vertices of paths that the camera does not see.

Where ``to_uv`` or texture coordinates change, the lines along which a texture jumps slide over their triangles
(``texture/steps.py``), and what a path's vertex scatters or emits there jumps: a boundary of the integrand, while
visibility does not change. dI = W_1 . (L_+ - L_-) s' / |grad s| |n . w| dl dsigma, s the coordinate of the place.

Derivation: ``docs/theory/boundary.md#steps-of-textures``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE_STEP, MARGIN
from warp_psdr.kernels.boundary.local_form import Edges, barycentrics_at, edge_point, edge_step
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR, TWO_PI
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.math import any_tangent
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.texture.steps import make_slide_sink, place_gradient, place_slopes
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_step_jump(config: PathConfig):
    """Return ``jump(scene, sampler, segment, k, max_depth, rr_depth) -> Incident``: L_+ - L_-, of common numbers.

    ``segment.boundary_normal`` is the unit vector across the line, ``segment.step`` how far either ray passes from it.
    """
    incident = make_incident(config)

    @wp.func
    def jump(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        o = s.source
        above = incident(scene, sampler, o + s.step * s.boundary_normal, s.w, FAR, k, max_depth, rr_depth)
        below = incident(scene, sampler, o - s.step * s.boundary_normal, s.w, FAR, k, max_depth, rr_depth)
        return difference(above, below)

    return jump


@functools.cache
def make_slide_draw(kind: str):
    """Return ``draw_slide(scene, edges, sampler, number, samples) -> (Segment, edge, start)``; ``kind``: of sampler.

    The Segment ends in a point of a line and lacks x_1, in the direction -w from ``start``; its ``t1`` is the cosine
    there, its ``scale`` one over the density. What moves against x_1 is nothing: its ``tau`` is 1.
    """
    draw = make_sampler(kind)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.func
    def draw_slide(
        scene: Scene, edges: Edges, sampler: Sampler, number: wp.int32, samples: wp.int32
    ) -> tuple[Segment, wp.int32, wp.vec3]:
        point = edge_point(scene, edges, number, samples, sample_1d(sampler, 0))
        face = edges.faces[edges.first[point.edge]]
        tri = scene.triangles[face]
        texture = edges.ends[point.edge, 1]
        slope = place_gradient(tri, place_slopes(scene, scene.textures[texture], tri, edges.twins[point.edge, 1]))
        steepness = wp.length(slope)
        # Towards x_1: on either side of the triangle, in proportion to the cosine.
        u4 = sample_4d(sampler, 1)
        local = square_to_cosine_hemisphere(wp.vec2(u4[1], u4[2]))
        n = wp.where(u4[0] < 0.5, -1.0, 1.0) * tri.normal
        side = any_tangent(n)
        out = local[0] * side + local[1] * wp.cross(n, side) + local[2] * n
        uv = barycentrics_at(tri, point.x)
        s = Segment()
        s.light = -1
        s.face1 = -1
        s.face2 = face
        s.u2 = uv[0]
        s.v2 = uv[1]
        s.x = point.x
        s.w = -out
        s.t1 = local[2]
        s.step = BESIDE_STEP * edge_step(scene, edges, point.edge)
        s.boundary_normal = slope / steepness
        s.tau = 1.0
        # |n . w| / pdf = 2 pi: half of the directions go to either side.
        s.scale = TWO_PI * wp.length(point.p1 - point.p0) / (point.pdf * steepness * wp.float32(samples))
        return s, point.edge, point.x + leaving_step(scene, face) * n

    return draw_slide


@wp.func
def beside_step(scene: Scene, edges: Edges, edge: wp.int32, s: Segment, cosine: wp.float32) -> wp.vec3:
    """Where the two rays to the sides of a line start, between its point and x_1."""
    ahead = wp.max(AHEAD * edge_step(scene, edges, edge), MARGIN * s.step / cosine)
    return s.x - wp.min(ahead, 0.5 * s.t1) * s.w


@functools.cache
def make_sliding_steps_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    transport = make_transport(config, role, camera_moves, make_step_jump(config))
    accumulate_slide = make_slide_sink(role)
    draw_slide = make_slide_draw(config.sampler)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def sliding_steps(
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
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        s, edge, start = draw_slide(scene, edges, sampler, number, job.samples)
        cosine = s.t1
        hit = visibility.closest(scene, start, -s.w, FAR)
        if hit.face < 0 or cosine <= 0.0:
            return
        s.t1 = hit.t
        s.source = beside_step(scene, edges, edge, s, cosine)
        s.face1 = hit.face
        s.u1 = hit.u
        s.v1 = hit.v
        tri = scene.triangles[s.face2]
        texture = edges.ends[edge, 1]
        axis = edges.twins[edge, 1]
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate_slide(scene, target, texture, axis, tri, s.u2, s.v2, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role == "reverse"):
            if weight != 0.0:
                if accumulate_slide(scene, target, texture, axis, tri, s.u2, s.v2, weight) != 0.0:
                    count_invalid(scene, sampler)

    return sliding_steps

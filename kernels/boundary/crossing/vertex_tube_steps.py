"""Steps of textures on tubes, at vertices of paths that the camera does not see.

Such a vertex slides along the ray that finds it, and a line of a texture does not. Seen from x_1 along w, the border of
a colour moves over the directions from there: dI = W_1 . (L_+ - L_-) out . (x_b' - c_1') sin(phi) dl dsigma, c_1' the
velocity of what x_1's rays are tied to (form S), out the normal of the plane of line and w, away from where S grows.

Derivation: ``docs/theory/boundary.md#steps-on-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.tube_steps import (
    TubeStep,
    TubeSteps,
    make_tube_step,
    make_tube_step_sink,
)
from warp_psdr.kernels.boundary.detector import Incident, difference, make_incident
from warp_psdr.kernels.boundary.film_edge import AHEAD, MARGIN
from warp_psdr.kernels.boundary.forwards import make_sees
from warp_psdr.kernels.boundary.path_space.secondary import make_source_sink
from warp_psdr.kernels.boundary.silhouette.ends import make_sensor_end
from warp_psdr.kernels.boundary.silhouette.touch import FRONT
from warp_psdr.kernels.boundary.transport import Segment, make_transport
from warp_psdr.kernels.constants import FAR, TWO_PI
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sampling import square_to_sphere
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_beside_line(config: PathConfig):
    """Return the source of radiance L_+ - L_-, of common numbers: from ``segment.source`` less from ``segment.x``."""
    incident = make_incident(config)

    @wp.func
    def beside_line(
        scene: Scene, sampler: Sampler, s: Segment, k: wp.int32, max_depth: wp.int32, rr_depth: wp.int32
    ) -> Incident:
        above = incident(scene, sampler, s.source, s.w, FAR, k, max_depth, rr_depth)
        return difference(above, incident(scene, sampler, s.x, s.w, FAR, k, max_depth, rr_depth))

    return beside_line


@functools.cache
def make_vertex_tube_steps_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    tube_step = make_tube_step(config.surfaces.primitives)
    accumulate_step = make_tube_step_sink(role, config.surfaces.primitives)
    accumulate_source = make_source_sink(role, False, config.surfaces.primitives)
    sees = make_sees(config.rays, config.surfaces.primitives)
    sensor_end = make_sensor_end(config.rays, config.surfaces.primitives)
    transport = make_transport(config, role, camera_moves, make_beside_line(config))
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d

    @wp.func
    def accumulate(
        scene: Scene, target: wp.array(dtype=wp.float32), point: TubeStep, s: Segment, w: wp.float32
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = accumulate_step(scene, target, point, w * s.boundary_normal)
        return accumulate_source(scene, target, s, w, total)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def vertex_tube_steps(
        # Scene:
        scene: Scene,
        camera: Camera,
        steps: TubeSteps,
        moving: wp.array(dtype=wp.int32),
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, 0))) / wp.float64(job.samples)
        point = tube_step(scene, steps, u)
        if point.valid == 0:
            return
        s = Segment()
        s.light = -1
        s.tau = 1.0
        s.step = point.step
        # Uniform on the outer side.
        s.w = square_to_sphere(sample_2d(sampler, 1))
        if wp.dot(point.n, s.w) > 0.0:
            s.w = -s.w
        facing = -wp.dot(point.n, s.w)
        if facing <= 0.0:
            return
        s.boundary_normal = wp.cross(point.along, s.w)
        if wp.dot(s.boundary_normal, point.across) > 0.0:
            s.boundary_normal = -s.boundary_normal
        s.x = point.x - (FRONT * s.step) * s.w
        s = sensor_end(scene, moving, s, 1)
        if s.valid == 0 or not sees(scene, s.x, s.w, s.t1):
            return
        ahead = wp.min(wp.max(AHEAD * s.step, MARGIN * point.beside / facing), 0.5 * s.t1)
        s.source = point.x + point.beside * point.across - ahead * s.w
        s.x = point.x - point.beside * point.across - ahead * s.w
        s.face2 = point.face
        s.scale = TWO_PI / (point.density * wp.float32(job.samples))
        rest = wp.float32(0.0)
        if wp.static(role == "forward"):
            rest = accumulate(scene, target, point, s, 1.0)
        weight = transport(scene, camera, sampler, s, s.scale, rest, job, target, image_out)
        if wp.static(role != "forward"):
            if weight != 0.0:
                if accumulate(scene, target, point, s, weight) != 0.0:
                    count_invalid(scene, sampler)

    return vertex_tube_steps

"""Primary boundary at steps of textures on tubes: the camera sees another colour on each side of a line.

As at edges (``path_space/primary.py``), dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds, along a line that moves
with the tube, and over it.

Derivation: ``docs/theory/boundary.md#steps-on-tubes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.tube_steps import TubeSteps, make_tube_step, make_tube_step_sink
from warp_psdr.kernels.boundary.detector import make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, MARGIN
from warp_psdr.kernels.boundary.forwards import make_hidden
from warp_psdr.kernels.boundary.silhouette.touch import FRONT
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_EDGE, make_note
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig

#: How far from a point of a line its two sides may be met, over the distance at which rays start in front of it.
NEAR = 4.0


@functools.cache
def make_film_tube_steps_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    tube_step = make_tube_step(config.surfaces.primitives)
    accumulate_step = make_tube_step_sink(role, config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    incident_radiance = make_incident_radiance(config)
    hidden = make_hidden(config.rays, config.surfaces.primitives)
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def film_tube_steps(
        # Scene:
        scene: Scene,
        camera: Camera,
        steps: TubeSteps,
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
        lens = lens_point(sample_2d(sampler, 1))
        point = tube_step(scene, steps, u)
        if point.valid == 0:
            return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        facing = -wp.dot(point.n, d)
        if facing <= 0.0 or hidden(scene, point.x - (FRONT * point.step) * d, at.origin, at.near):
            return
        # ---- The motion of the image ----
        out = wp.cross(point.along, d)
        if wp.dot(out, point.across) > 0.0:
            out = -out
        rate = film_velocity(scene, camera, at, point.along)
        a = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(a, out) < 0.0:
            a = -a
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        note_place(scene, NOTE_EDGE, point.face, 0.0, 0.0, point.x, d, weight)
        # ---- The jump: where S is larger less where it is smaller ----
        ahead = wp.max(AHEAD * point.step, MARGIN * point.beside / facing)
        ahead = wp.min(ahead, distance - at.near)
        t_max = at.far - distance + ahead
        sampler.index = wp.uint32(1)
        o = point.x + point.beside * point.across - ahead * d
        above = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
        sampler.index = wp.uint32(1)
        o = point.x - point.beside * point.across - ahead * d
        below = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
        if above.face != point.face or below.face != point.face:
            return
        if wp.max(wp.length(above.x - point.x), wp.length(below.x - point.x)) > NEAR * ahead:
            return
        jump = above.radiance - below.radiance
        # ---- Accumulation ----
        scale = 1.0 / (point.density * wp.float32(job.samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a = scale * a
        speed = accumulate_step(scene, target, point, a)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -a, -distance * a)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return film_tube_steps

"""Primary boundary at curves of intersection: the camera sees a different surface on each side of the curve.

As at edges (``path_space/primary.py``), dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds, along a curve that moves
with both surfaces.

Derivation: ``docs/theory/implicit.md#curves-of-intersection``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.curve import (
    CrossingCurves,
    make_crossing_point,
    make_crossing_sink,
    make_shows,
    place_beside,
    sheet_in_front,
)
from warp_psdr.kernels.boundary.film_edge import AHEAD
from warp_psdr.kernels.boundary.film_sight import make_film_sight
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


@wp.func
def same_shape(scene: Scene, face: wp.int32, other: wp.int32) -> wp.bool:
    """Whether a face (-1: none) belongs to the shape of another."""
    return face >= 0 and scene.triangles[wp.max(face, 0)].shape == scene.triangles[other].shape


@functools.cache
def make_film_crossing_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    crossing_point = make_crossing_point(config.surfaces.primitives)
    accumulate_crossing = make_crossing_sink(role, config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    hidden, before_of, radiance_of = make_film_sight(config)
    shows = make_shows(config.surfaces.primitives)
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def film_crossing(
        # Scene:
        scene: Scene,
        camera: Camera,
        curves: CrossingCurves,
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
        point = crossing_point(scene, curves, u)
        if point.valid == 0:
            return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        start = point.x - (FRONT * point.step) * d
        if not shows(scene, point, d) or hidden(scene, camera, sampler, start, at):
            return
        # ---- The motion of the image ----
        sheet_a = sheet_in_front(point.n_a, point.n_b, point.along, d)
        sheet_b = sheet_in_front(point.n_b, point.n_a, point.along, d)
        out = wp.cross(point.along, d)
        if wp.dot(out, sheet_b) < 0.0:
            out = -out
        # Both on one side: an edge-on surface, up to roundings.
        if wp.dot(out, sheet_a) >= 0.0:
            return
        rate = film_velocity(scene, camera, at, point.along)
        a = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(a, out) < 0.0:
            a = -a
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        note_place(scene, NOTE_EDGE, point.face_a, 0.0, 0.0, point.x, d, weight)
        # ---- The jump: A less B ----
        ahead = wp.min(AHEAD * point.step, distance - at.near)
        t_max = at.far - distance + ahead
        sampler.index = wp.uint32(1)
        before = before_of(scene, camera, sampler, at, d, distance - ahead - at.near)
        o = place_beside(point, sheet_a) - ahead * d
        of_a = radiance_of(scene, sampler, before.medium, o, d, t_max, job.max_depth, job.rr_depth)
        if not same_shape(scene, of_a.face, point.face_a):
            return
        sampler.index = wp.uint32(1)
        o = place_beside(point, sheet_b) - ahead * d
        of_b = radiance_of(scene, sampler, before.medium, o, d, t_max, job.max_depth, job.rr_depth)
        if not same_shape(scene, of_b.face, point.face_b):
            return
        jump = wp.cw_mul(before.transmittance, of_a.radiance - of_b.radiance)
        # ---- Accumulation ----
        scale = 1.0 / (point.density * wp.float32(job.samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a = scale * a
        speed = accumulate_crossing(scene, target, point, a)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -a, -distance * a)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return film_crossing

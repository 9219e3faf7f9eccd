"""Primary boundary of curves with a radius: silhouettes, open ends, and creases at joints that the camera sees.

The term is that of other silhouettes on the film (``primary.py``), along curves that are found item by item
(``tube_points.py``). At a crease, where the cones of two straight segments meet, the light of the surface jumps.

Derivation: ``docs/theory/implicit.md#silhouettes-of-tubes``, ``#joints``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import IncidentRadiance, make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.forwards import make_hidden
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.primary import FRONT, MARGIN, WIDER, make_camera_eye
from warp_psdr.kernels.boundary.silhouette.tube_points import (
    LOOKS,
    PART_CREASE,
    TubeItems,
    ahead_of_tube,
    beside_tube,
    choose_tube,
    in_front,
    tube_coordinates,
    tube_curvature,
    tube_seen,
)
from warp_psdr.kernels.boundary.silhouette.tube_sink import make_tube_sink
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_primary_tube_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    accumulate_tube = make_tube_sink(role, config.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    incident_radiance = make_incident_radiance(config)
    hidden = make_hidden(config)
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    camera_eye = make_camera_eye(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)
    distant = config.camera == CAMERA_ORTHOGRAPHIC

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primary_tube(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: TubeItems,
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
        u4 = sample_4d(sampler, 1)
        lens = lens_point(wp.vec2(u4[0], u4[1]))
        n, along, chance = choose_tube(found, u)
        face = found.items[n][0]
        tri = scene.triangles[face]
        eye = camera_eye(scene, camera, lens)
        point = tube_seen(scene, tri, face, found.items[n][1], eye, wp.static(distant), along, u4[2])
        if point.valid == 0:
            return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        step = step_off_primitive(scene, tri)
        crease = point.part == PART_CREASE
        out = point.out
        start = point.x + beside_tube(point, step) * out
        if crease:
            out = wp.normalize(wp.cross(point.rate, d))
            start = point.x - FRONT * step * d
        curvature = tube_curvature(point, d)
        if not in_front(point, d, curvature):
            return
        if hidden(scene, start, at.origin, at.near):
            return
        # ---- The motion of the image ----
        rate = film_velocity(scene, camera, at, point.rate)
        a = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(a, out) < 0.0:
            a = -a
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        uv = tube_coordinates(point)
        note_place(scene, NOTE_POINT, face, uv[0], uv[1], point.x, d, weight)
        # ---- The jump: inside less outside ----
        sampler.index = wp.uint32(1)
        apart = beside_tube(point, BESIDE * step)
        inside = IncidentRadiance()
        met = wp.bool(False)
        k = wp.int32(0)
        ahead = wp.float32(0.0)
        o = point.x
        while k < LOOKS and not met:
            ahead = wp.max(AHEAD * step, MARGIN * ahead_of_tube(point, d, out, apart, curvature))
            ahead = wp.min(ahead, distance - at.near)
            o = point.x - apart * out - ahead * d
            inside = incident_radiance(scene, sampler, o, d, at.far - distance + ahead, 0, job.max_depth, job.rr_depth)
            met = inside.face == face and wp.dot(inside.x - point.x, d) < ahead
            if not met:
                apart = wp.min(WIDER * apart, 0.25 * point.f.r)
            k += 1
        if not met:
            return
        sampler.index = wp.uint32(1)
        o = point.x + apart * out - ahead * d
        outside = incident_radiance(scene, sampler, o, d, at.far - distance + ahead, 0, job.max_depth, job.rr_depth)
        if crease:
            if outside.face != face or wp.dot(outside.x - point.x, d) >= ahead:
                return
        jump = inside.radiance - outside.radiance
        # ---- Accumulation ----
        scale = point.choices / (chance * wp.float32(job.samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a = scale * a
        speed = accumulate_tube(scene, target, point, a)
        if wp.static(role == "samples"):
            speed += record_pull(target, number, point.x, point.rate, a)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -a, -distance * a)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return primary_tube

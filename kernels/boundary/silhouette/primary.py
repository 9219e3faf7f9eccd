"""Primary boundary of shapes without triangles: silhouettes, rims and creases that the camera sees.

As at edges (``path_space/primary.py``), dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds, along the curve that the
camera sees. On smooth surfaces it is the silhouette, and only the normal component of its velocity counts, which is
that of the surface. A rim moves with its shape. At a crease that is seen from the front (``Touch.creases``) the
reflected light jumps. A family of shapes gives the points of its curves, with their measures (``touch.py``).

Derivation: ``docs/theory/implicit.md#primary-silhouettes``, ``#rims``, ``#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import IncidentRadiance
from warp_psdr.kernels.boundary.film_edge import AHEAD
from warp_psdr.kernels.boundary.film_sight import make_film_sight
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.aim import SLOT_SILHOUETTE
from warp_psdr.kernels.boundary.silhouette.table import touch_of
from warp_psdr.kernels.boundary.silhouette.touch import MARGIN, SLOT_LENS, WIDER
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import ClearLine
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.property import make_beside_edge
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_eye, make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_primary_silhouette_kernel(config: PathConfig, role: str, camera_moves: bool, family: str):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``); ``family``: a touch's."""
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, choice_of, draw, seen_from, passing_at = touch.items, touch.choice, touch.draw, touch.seen, touch.passing
    ahead_of, meets, scale_of, held_at = touch.ahead, touch.meets, touch.scale, touch.held
    accumulate_point = touch.make_sink(role)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    own, behind = make_beside_edge(config.shown)
    hidden, before_of, radiance_of = make_film_sight(config, bool(touch.hides))
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    camera_eye = make_camera_eye(config.camera)
    numbers = make_sampler(config.sampler)
    sample_1d = numbers.sample_1d
    sample_2d = numbers.sample_2d
    note_place = make_note(config.noted)
    distant = config.camera == CAMERA_ORTHOGRAPHIC

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: items,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        number = job.first + wp.tid()
        sampler = sampler_at(number, 0, job.seed)
        u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_SILHOUETTE))) / wp.float64(job.samples)
        lens = lens_point(sample_2d(sampler, SLOT_LENS))
        drawn = draw(found, True, u)
        eye = camera_eye(scene, camera, lens)
        point = seen_from(scene, found, drawn, eye, wp.static(distant), choice_of(sampler, True))
        if point.valid == 0:
            return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        step = step_off_primitive(scene, scene.triangles[drawn.face])
        passing = passing_at(scene, point, d, step, distance - at.near)
        if passing.shows == 0 or hidden(scene, camera, sampler, passing.start, at):
            return
        # ---- The motion of the image ----
        rate = film_velocity(scene, camera, at, point.along)
        a = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(a, passing.out) < 0.0:
            a = -a
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        held = held_at(scene, point)
        note_place(scene, NOTE_POINT, point.face, held[0], held[1], point.x, d, weight)
        # ---- The jump: inside less outside ----
        sampler.index = wp.uint32(1)
        apart = passing.apart
        inside = IncidentRadiance()
        before = ClearLine()  # up to where both rays start
        met = wp.bool(False)
        k = wp.int32(0)
        ahead = wp.float32(0.0)
        while k < wp.static(touch.tries) and not met:
            ahead = wp.max(AHEAD * step, MARGIN * ahead_of(point, passing, d, apart))
            ahead = wp.min(ahead, distance - at.near)
            o = point.x - apart * passing.out - ahead * d
            t_max = at.far - distance + ahead
            before = before_of(scene, camera, sampler, at, d, distance - ahead - at.near)
            inside = radiance_of(scene, sampler, before.medium, o, d, t_max, job.max_depth, job.rr_depth)
            met = meets(point, False, inside.face, wp.dot(inside.x - point.x, d), ahead)
            if not met:
                apart = wp.min(WIDER * apart, passing.most)
            k += 1
        if not met:
            return
        o = point.x + apart * passing.out - ahead * d
        t_max = at.far - distance + ahead
        outside = radiance_of(scene, sampler, before.medium, o, d, t_max, job.max_depth, job.rr_depth)
        if passing.crease == 1:
            if not meets(point, True, outside.face, wp.dot(outside.x - point.x, d), ahead):
                return  # it passes another silhouette, which counts that jump
        if wp.static(bool(config.shown)):
            inside.radiance = own(point.x, distance - at.near)
            outside.radiance = behind(outside.radiance, outside.face, distance - ahead - at.near)
        jump = wp.cw_mul(before.transmittance, inside.radiance - outside.radiance)
        # ---- Accumulation ----
        scale = scale_of(point, drawn, wp.float32(job.samples))
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a = scale * a
        speed = accumulate_point(scene, target, point, a)
        if wp.static(role == "samples"):
            speed += record_pull(target, number, point.x, point.along, a)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -a, -distance * a)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return primary_silhouette

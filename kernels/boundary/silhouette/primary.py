"""Primary boundary at smooth silhouettes and rims of shapes without triangles, as the camera sees them.

As at edges (``path_space/primary.py``), dI_j = integral h(u - u_j) (L_- - L_+) (u' . N) ds. The curve is the silhouette
from the camera, and only the normal component of its velocity counts, which is that of the surface. A rim is a curve of
the shape and moves with it. Beside a rim of two surfaces the camera may see either.

Derivation: ``docs/theory/implicit.md#primary-silhouettes``, ``#rims``, ``#rims-that-join``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.crossing.curve import MOST, OFF
from warp_psdr.kernels.boundary.detector import IncidentRadiance, make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.dispatch import (
    OutlineItem,
    choose_outline,
    make_coordinates,
    make_silhouette_sink,
    make_silhouettes,
)
from warp_psdr.kernels.boundary.silhouette.edge_on import EDGEWISE, is_beside
from warp_psdr.kernels.boundary.silhouette.point import SilhouettePoint
from warp_psdr.kernels.boundary.silhouette.rim import is_open_end, make_neighbour, make_rims
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC, CAMERA_THINLENS
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import lens_origin, load_mat44, make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Distances from the silhouette at which a ray inside of it is looked for, each over the one before: float32 may miss
#: the shape at the first.
WIDER, TRIES = 4.0, 4
#: Share by which a ray inside starts farther in front of the silhouette than where it meets the shape.
MARGIN = 3.0
#: How far in front of an edge that is seen from the front rays back to the camera start, in steps off the surface.
FRONT = 20.0


@functools.cache
def make_camera_eye(kind: int):
    """Return ``camera_eye(scene, camera, lens) -> vec3``: where a camera's rays start, or the way they come from."""

    @wp.func
    def camera_eye(scene: Scene, camera: Camera, lens: wp.vec2) -> wp.vec3:
        m = load_mat44(scene.values, camera.to_world)
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            return wp.vec3(m[0, 2], m[1, 2], m[2, 2])
        if wp.static(kind == CAMERA_THINLENS):
            return lens_origin(m, scene.values[camera.aperture_radius], lens)
        return wp.vec3(m[0, 3], m[1, 3], m[2, 3])

    return camera_eye


@functools.cache
def make_primary_silhouette_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    silhouettes = make_silhouettes(config.primitives)
    rims = make_rims(config.primitives)
    neighbour = make_neighbour(config.primitives)
    coordinates = make_coordinates(config.primitives)
    accumulate_silhouette = make_silhouette_sink(role)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    incident_radiance = make_incident_radiance(config)
    visibility = visibility_of(config)
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)
    camera_eye = make_camera_eye(config.camera)
    distant = config.camera == CAMERA_ORTHOGRAPHIC

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primary_silhouette(
        # Scene:
        scene: Scene,
        camera: Camera,
        outlines: wp.array(dtype=OutlineItem),
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
        n, along = choose_outline(outlines, u)
        item = outlines[n]
        rim = item.number < 0
        face = wp.where(rim, -1 - item.number, item.number)
        tri = scene.triangles[face]
        eye = camera_eye(scene, camera, lens)
        point = SilhouettePoint()
        if wp.static(rims is not None):
            if rim:
                point = rims.seen(tri, face, along, eye, wp.static(distant))
        if wp.static(silhouettes is not None):
            if not rim:
                point = silhouettes.seen(tri, face, eye, wp.static(distant), along)
        if point.valid == 0:
            return
        if wp.static(rims is not None):
            if rim and not is_open_end(item, point.q):
                return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        step = step_off_primitive(scene, tri)
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        start = point.x + step * point.out
        joined = wp.bool(False)
        both = wp.bool(False)  # surfaces are seen, one on either side
        if wp.static(neighbour is not None):
            joined = rim and item.neighbours[0] >= 0
            if joined:
                # From outside or from within, the way to the eye does not pass the two surfaces.
                start = point.x - wp.min(FRONT * step, distance - at.near) * d
        back = at.origin - start
        length = wp.length(back)
        if length > at.near and visibility.hidden_from_camera(scene, start, back / length, length - at.near):
            return
        # ---- The motion of the image ----
        turn = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(rims is not None):
            if rim:
                turn = rims.rate(tri, point.q)
        if wp.static(silhouettes is not None):
            if not rim:
                turn = silhouettes.rate(tri, eye, wp.static(distant), point.q)
        rate = film_velocity(scene, camera, at, turn)
        g = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(g, point.out) < 0.0:
            g = -g
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        uv = coordinates(tri, point.q)
        note_place(scene, NOTE_POINT, face, uv[0], uv[1], point.x, d, weight)
        # ---- The jump: inside less outside ----
        sampler.index = wp.uint32(1)
        curvature = wp.float32(0.0)
        slant = wp.float32(0.0)
        if wp.static(rims is not None):
            if rim:
                slant = rims.slant(tri, point.q, d)
        apart = BESIDE * step
        if wp.static(neighbour is not None):
            if joined:
                wall = neighbour.into(scene, item, point.x)
                both = not is_beside(wall, -point.out, d, EDGEWISE)
                from_its_edge = both != is_beside(wall, point.out, d, EDGEWISE)
                if not from_its_edge:
                    slant = wp.min(slant, neighbour.slant(scene, item, point.x, d))
                    sine = neighbour.corner(scene, item, point, d)
                    if sine > 0.0:
                        apart = step * wp.min(OFF / sine, MOST)
        if wp.static(silhouettes is not None):
            if not rim:
                curvature = silhouettes.curvature(tri, point.q, d)
        inside = IncidentRadiance()
        k = wp.int32(0)
        ahead = wp.float32(0.0)
        met = wp.bool(False)
        while k < TRIES and not met:
            # At a depth s below the surface, a ray meets it sqrt(2 s / kappa) in front of the silhouette; beside a rim,
            # s over the slant.
            before = wp.float32(0.0)
            if wp.static(silhouettes is not None):
                if not rim:
                    before = wp.sqrt(2.0 * apart / curvature)
            if wp.static(rims is not None):
                if rim:
                    before = apart / slant
            ahead = wp.max(AHEAD * step, MARGIN * before)
            ahead = wp.min(ahead, distance - at.near)
            o = point.x - apart * point.out - ahead * d
            t_max = at.far - distance + ahead
            inside = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
            met = inside.face == face
            if wp.static(neighbour is not None):
                # In front of a silhouette's end there may be a disk.
                near = inside.face == item.neighbours[0] or inside.face == item.neighbours[1]
                met = met or (near and inside.face >= 0)
            apart *= WIDER
            k += 1
        if not met:
            return
        o = point.x + apart / WIDER * point.out - ahead * d
        t_max = at.far - distance + ahead
        outside = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
        if both and outside.face != item.neighbours[0]:
            return  # it passes the wall's silhouette, which counts that jump
        jump = inside.radiance - outside.radiance
        # ---- Accumulation ----
        scale = wp.float32(outlines.shape[0]) / wp.float32(job.samples)
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        g = scale * g
        speed = accumulate_silhouette(scene, target, point, g)
        if wp.static(role == "samples"):
            speed += record_pull(target, number, point.x, turn, g)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -g, -distance * g)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return primary_silhouette

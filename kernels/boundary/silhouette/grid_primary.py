"""Primary boundary of grids of signed distances [ZCM*24]: creases and smooth silhouettes that the camera sees.

The term is that of edges on the film (``path_space/primary.py``) along the curve that the camera sees, found item by
item (``grid_points.py``): the part of a crease that is a silhouette from the camera, and in a voxel the silhouette of
the smooth surface. The variant ``shading`` is the term of creases that the camera sees from the front, where the normal
and the reflected light jump, as on flat meshes (``path_space/flat_creases.py``).

Derivation: ``docs/theory/implicit.md#silhouettes-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import IncidentRadiance, make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.pull_record import record_pull
from warp_psdr.kernels.boundary.silhouette.grid_points import (
    VOXEL_ITEM,
    GridItems,
    TouchPoint,
    ahead_of_sheet,
    choose_item,
    crease_point,
    crease_side,
    curve_point,
    eye_in_voxels,
    item_parts,
    make_touch_sink,
    shows_both_sheets,
    touch_curvature,
)
from warp_psdr.kernels.boundary.silhouette.network_points import network_curve_point
from warp_psdr.kernels.boundary.silhouette.primary import FRONT, MARGIN, TRIES, WIDER, make_camera_eye
from warp_psdr.kernels.boundary.silhouette.spline_points import SLOT_ROOT, spline_curvature, spline_curve_point
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_primary_grid_kernel(
    config: PathConfig, role: str, camera_moves: bool, shading: bool = False, cubic: bool = False, network: bool = False
):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``); ``cubic``: smooth grids.

    ``network`` beside ``cubic``: networks, whose cells are the voxels of smooth grids.
    """
    accumulate_touch = make_touch_sink(role, cubic, network)
    record_of = network_of if network else grid_of
    smooth_curve_point = network_curve_point if network else spline_curve_point
    curvature_of = spline_curvature if cubic else touch_curvature
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    incident_radiance = make_incident_radiance(config)
    visibility = visibility_of(config)
    splat, gather = make_splat()
    project, film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    camera_eye = make_camera_eye(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)
    distant = config.camera == CAMERA_ORTHOGRAPHIC

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def primary_grid(
        # Scene:
        scene: Scene,
        camera: Camera,
        found: GridItems,
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
        count = found.items.shape[0]
        n, along = choose_item(found, count, u)
        item = found.items[n]
        tri = scene.triangles[item[0]]
        g = record_of(scene, tri)
        parts = item_parts(g, item[1])
        eye = camera_eye(scene, camera, lens)
        point = TouchPoint()
        if wp.static(cubic):
            seen = eye_in_voxels(tri, g, eye, wp.static(distant))
            choice = sample_1d(sampler, wp.static(SLOT_ROOT))
            point = smooth_curve_point(scene, tri, g, parts, seen, wp.static(distant), along, choice)
        elif parts[3] == VOXEL_ITEM:
            if wp.static(not shading):
                seen_from = eye_in_voxels(tri, g, eye, wp.static(distant))
                point = curve_point(scene, tri, g, parts, seen_from, wp.static(distant), along)
        else:
            point = crease_point(scene, tri, g, parts, along)
        if point.valid == 0:
            return
        point.face = item[0]
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        d = (point.x - at.origin) / distance
        out = point.out
        curvature = wp.float32(0.0)
        step = step_off_primitive(scene, tri)
        start = point.x
        if point.crease == 1:
            across = wp.normalize(wp.cross(point.along, d))
            if wp.static(shading):
                if not shows_both_sheets(point, d):
                    return
                out = across
                start -= FRONT * step * d
            else:
                side = crease_side(point, d)
                if side == 0.0:
                    return
                out = -side * across
                start += step * out
        else:
            curvature = curvature_of(tri, g, point, d)
            if curvature <= 0.0:
                return
            start += step * out
        back = at.origin - start
        length = wp.length(back)
        if length > at.near and visibility.hidden_from_camera(scene, start, back / length, length - at.near):
            return
        # ---- The motion of the image ----
        rate = film_velocity(scene, camera, at, point.along)
        a = film_gradient(scene, camera, at, wp.vec2(rate[1], -rate[0]))
        if wp.dot(a, out) < 0.0:
            a = -a
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        uv = pack(point.q)
        note_place(scene, NOTE_POINT, point.face, uv[0], uv[1], point.x, d, weight)
        # ---- The jump: inside less outside ----
        sampler.index = wp.uint32(1)
        apart = BESIDE * step
        inside = IncidentRadiance()
        inside.face = -1
        k = wp.int32(0)
        ahead = wp.float32(0.0)
        while k < TRIES and inside.face != point.face:
            # Where the ray inside meets the surface in front of the silhouette.
            met = wp.sqrt(2.0 * apart / wp.max(curvature, 1.0e-20))
            if point.crease == 1:
                met = apart * ahead_of_sheet(point, d, out)
            ahead = wp.min(wp.max(AHEAD * step, MARGIN * met), distance - at.near)
            o = point.x - apart * out - ahead * d
            t_max = at.far - distance + ahead
            inside = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
            apart *= WIDER
            k += 1
        if inside.face != point.face:
            return
        sampler.index = wp.uint32(1)
        o = point.x + apart / WIDER * out - ahead * d
        t_max = at.far - distance + ahead
        outside = incident_radiance(scene, sampler, o, d, t_max, 0, job.max_depth, job.rr_depth)
        if wp.static(shading):
            if outside.face != point.face:
                return
        jump = inside.radiance - outside.radiance
        # ---- Accumulation ----
        scale = wp.float32(count) / (point.density * wp.float32(job.samples))
        if wp.static(cubic):
            scale *= point.roots
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a = scale * a
        speed = accumulate_touch(scene, target, point, a)
        if wp.static(role == "samples"):
            speed += record_pull(target, number, point.x, point.along, a)
        if wp.static(camera_moves):
            speed += accumulate_camera(scene, target, camera, at.sample, -a, -distance * a)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, speed * jump, image_out)
        else:
            if speed != 0.0:
                count_invalid(scene, sampler)

    return primary_grid

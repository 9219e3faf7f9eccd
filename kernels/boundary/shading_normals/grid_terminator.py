"""The terminator of a grid's interpolated normals as the camera sees it.

As on meshes (``terminator.py``), the light that a surface sends jumps where its shading normal turns away from the
camera while the surface still faces it. On grids with ``normals: smooth`` this happens beside every silhouette.

Derivation: ``docs/theory/shading_normals.md#terminators-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.local_form import on_plane
from warp_psdr.kernels.boundary.shading_normals.turned_points import make_turned_point
from warp_psdr.kernels.boundary.silhouette.grid_points import GridItems, choose_item, eye_in_voxels, item_parts
from warp_psdr.kernels.boundary.silhouette.spline_points import SLOT_ROOT
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC
from warp_psdr.kernels.invalid import count_invalid, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.primitive.affine import step_off_primitive
from warp_psdr.kernels.primitive.sdfgrid import grid_of, pack
from warp_psdr.kernels.primitive.sdfgrid_adjoint import make_sdfgrid_sink
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_eye, make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@functools.cache
def make_grid_terminator_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    turned_point = make_turned_point()
    incident_radiance = make_incident_radiance(config)
    accumulate_vertex = make_sdfgrid_sink(role)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    project, _film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    camera_eye = make_camera_eye(config.camera)
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_2d = draw.sample_2d
    note_place = make_note(config.noted)
    distant = config.camera == CAMERA_ORTHOGRAPHIC

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def grid_terminator(
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
        g = grid_of(scene, tri)
        eye = camera_eye(scene, camera, lens)
        seen_from = eye_in_voxels(tri, g, eye, wp.static(distant))
        choice = sample_1d(sampler, wp.static(SLOT_ROOT))
        turned = turned_point(
            scene, target, tri, g, item_parts(g, item[1]), seen_from, wp.static(distant), along, choice
        )
        point = turned.touch
        if point.valid == 0:
            return
        at = project(scene, camera, point.x, lens)
        if at.valid == 0:
            return
        distance = wp.length(point.x - at.origin)
        view = (at.origin - point.x) / distance
        step = step_off_primitive(scene, tri)
        cosine = wp.dot(point.out, view)
        start = point.x + wp.where(cosine >= 0.0, step, -step) * point.out
        back = at.origin - start
        length = wp.length(back)
        if length > at.near and visibility.hidden_from_camera(scene, start, back / length, length - at.near):
            return
        weight = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(role != "forward"):
            weight = gather(camera, at.pixel, job.image_adjoint)
            if vanishes(weight):
                return
        uv = pack(point.q)
        note_place(scene, NOTE_POINT, item[0], uv[0], uv[1], point.x, -view, weight)
        # ---- The curve on the film ----
        across = wp.cross(point.out, wp.normalize(point.along))
        slope = wp.dot(turned.rise, across)
        by_along = film_velocity(scene, camera, at, point.along)
        by_across = film_velocity(scene, camera, at, across)
        area = wp.abs(by_along[0] * by_across[1] - by_along[1] * by_across[0])
        # ---- The jump: where psi > 0 less where psi < 0 ----
        beside = wp.normalize(wp.cross(point.along, view))
        # What is beside the curve for the camera, on the surface.
        on_surface = beside - (wp.dot(point.out, beside) / wp.where(cosine == 0.0, 1.0, cosine)) * view
        beside = wp.where(wp.dot(turned.rise, on_surface) >= 0.0, BESIDE * step, -BESIDE * step) * beside
        ahead = wp.min(AHEAD * step, distance - at.near)
        branch = sampler
        branch.index = wp.uint32(1)
        jump = wp.vec3(0.0, 0.0, 0.0)
        own = wp.bool(True)
        for side in range(2):
            sign = 1.0 - 2.0 * wp.float32(side)
            o = point.x + sign * beside + ahead * view
            t_max = at.far - distance + ahead
            seen = incident_radiance(scene, branch, o, -view, t_max, 0, job.max_depth, job.rr_depth)
            jump += sign * seen.radiance
            own = own and seen.face == item[0] and on_plane(point.out, seen.x - point.x, step)
        if not own or slope == 0.0:
            return
        # ---- Accumulation ----
        scale = point.roots * wp.float32(count) * area
        scale /= wp.abs(slope) * point.density * wp.float32(job.samples)
        if wp.static(role != "forward"):
            scale *= wp.dot(weight, jump)
        a_eye = scale * turned.n
        vertex = VertexAdjoint()
        if wp.static(distant):
            # psi = -n . d, in place of n . (o - x).
            vertex.n = scale * view
        else:
            vertex.x = -a_eye
            vertex.n = scale * (at.origin - point.x)
        accumulated = accumulate_vertex(scene, target, tri, uv[0], uv[1], vertex, True, at.origin, -view)
        moved = accumulated.dot
        if wp.static(camera_moves):
            a_o = accumulated.o
            a_d = accumulated.d
            if wp.static(distant):
                a_d -= a_eye
            else:
                a_o += a_eye
            moved += accumulate_camera(scene, target, camera, at.sample, a_o, a_d)
        if wp.static(role == "forward"):
            splat(scene, sampler, camera, at.pixel, moved * jump, image_out)
        else:
            if moved != 0.0:
                count_invalid(scene, sampler)

    return grid_terminator

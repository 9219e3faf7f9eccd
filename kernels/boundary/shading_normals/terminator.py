"""The terminator of interpolated normals as the camera sees it: a discontinuity on the film.

The radiance jumps where a shading normal n turns away from the camera while its triangle does not, along phi = n . (o -
x) = 0. On a line of constant barycentric coordinate phi is quadratic, and its roots sample the curve.

Derivation: ``docs/theory/shading_normals.md#the-terminator-that-the-camera-sees``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.detector import make_incident_radiance
from warp_psdr.kernels.boundary.film_edge import AHEAD, BESIDE
from warp_psdr.kernels.boundary.local_form import on_plane
from warp_psdr.kernels.boundary.media_radiance import make_media_radiance
from warp_psdr.kernels.constants import CAMERA_ORTHOGRAPHIC, THIN_LENSES
from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.medium.line import BEFORE, make_line
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.notes import NOTE_POINT, make_note
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import lens_origin, load_mat44, make_camera_sink, make_lens
from warp_psdr.kernels.sensor.projection import make_projection, make_splat
from warp_psdr.kernels.step import leaving_step, passing_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of


@wp.func
def corner(face_normals: wp.mat33, i: wp.int32) -> wp.vec3:
    return wp.vec3(face_normals[i, 0], face_normals[i, 1], face_normals[i, 2])


@wp.func
def phi_at(p: wp.mat33, n: wp.mat33, b: wp.vec3, o: wp.vec3, finite: wp.float32) -> wp.float32:
    """Return n . (o - finite x) at barycentrics b, with the rows of p and n the corners' positions and normals."""
    return wp.dot(wp.transpose(n) * b, o - finite * (wp.transpose(p) * b))


@wp.func
def barycentrics(axis: wp.int32, w: wp.float32, r: wp.float32) -> wp.vec3:
    b = wp.vec3(0.0, 0.0, 0.0)
    b[axis] = w
    b[(axis + 1) % 3] = (1.0 - w) * r
    b[(axis + 2) % 3] = (1.0 - w) * (1.0 - r)
    return b


@functools.cache
def make_terminator_kernel(config: PathConfig, role: str, camera_moves: bool):
    """Return the kernel: one thread a sample (arguments as in ``path_space/secondary.py``)."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    among_media = config.media is not None
    media_radiance = make_media_radiance(config) if among_media else None
    line = make_line(config)[0] if among_media else None
    incident_radiance = None if among_media else make_incident_radiance(config)
    accumulate_vertex = make_vertex_sink(role, True, config.surfaces.flat, False, False, False, True)
    accumulate_camera = make_camera_sink(role, config.camera) if camera_moves else None
    splat, gather = make_splat()
    project, _film_gradient, film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    parallel = config.camera == CAMERA_ORTHOGRAPHIC
    slides = not config.material_first
    draw = make_sampler(config.sampler)
    sample_2d = draw.sample_2d
    sample_4d = draw.sample_4d
    note_place = make_note(config.noted)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def terminator(
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
        u4 = sample_4d(sampler, 0)
        cell = find_interval(face_cdf, 0, faces.shape[0], u4[0])
        probability = face_cdf[cell + 1] - face_cdf[cell]
        face = faces[cell]
        tri = scene.triangles[face]
        shape = scene.shapes[tri.shape]
        p = wp.matrix_from_rows(tri.p0, tri.p1, tri.p2)
        n = wp.matrix_from_rows(
            load_vec3(scene.values, shape.normal_offset + 3 * tri.i0),
            load_vec3(scene.values, shape.normal_offset + 3 * tri.i1),
            load_vec3(scene.values, shape.normal_offset + 3 * tri.i2),
        )
        m = load_mat44(scene.values, camera.to_world)
        lens = lens_point(sample_2d(sampler, 1))
        finite = wp.float32(1.0)
        eye = wp.vec3(m[0, 3], m[1, 3], m[2, 3])
        if wp.static(parallel):
            finite = wp.float32(0.0)
            eye = -wp.normalize(wp.vec3(m[0, 2], m[1, 2], m[2, 2]))
        elif wp.static(config.camera in THIN_LENSES):
            eye = lens_origin(m, scene.values[camera.aperture_radius], lens)
        axis = wp.min(wp.int32(3.0 * u4[1]), 2)
        w = u4[2]
        # phi(r) = a r^2 + b r + c from three of its values.
        c = phi_at(p, n, barycentrics(axis, w, 0.0), eye, finite)
        middle = phi_at(p, n, barycentrics(axis, w, 0.5), eye, finite)
        end = phi_at(p, n, barycentrics(axis, w, 1.0), eye, finite)
        a = 2.0 * (end + c - 2.0 * middle)
        b = end - c - a
        discriminant = b * b - 4.0 * a * c
        if discriminant <= 0.0:
            return
        # At least half of the discriminant's root, so never 0.
        half = -0.5 * (b + wp.where(b >= 0.0, wp.sqrt(discriminant), -wp.sqrt(discriminant)))
        e1 = tri.p1 - tri.p0
        e2 = tri.p2 - tri.p0
        for k in range(2):
            r = wp.float32(-1.0)
            if k == 0:
                r = c / half
            if k == 1 and wp.abs(half) < wp.abs(a):
                r = half / a
            if r > 0.0 and r < 1.0:
                at_b = barycentrics(axis, w, r)
                x = wp.transpose(p) * at_b
                raw = wp.transpose(n) * at_b
                size = wp.length(raw)
                at = project(scene, camera, x, lens)
                if at.valid == 1 and size > 0.0:
                    to = eye - finite * x
                    distance = wp.length(at.origin - x)
                    view = (at.origin - x) / distance
                    phi_u = wp.dot(corner(n, 1) - corner(n, 0), to) - finite * wp.dot(raw, e1)
                    phi_v = wp.dot(corner(n, 2) - corner(n, 0), to) - finite * wp.dot(raw, e2)
                    speed_sum = wp.abs(phi_u) + wp.abs(phi_v) + wp.abs(phi_u - phi_v)
                    q1 = film_velocity(scene, camera, at, e1)
                    q2 = film_velocity(scene, camera, at, e2)
                    area = wp.abs(q1[0] * q2[1] - q1[1] * q2[0])
                    cosine = wp.dot(tri.normal, view)
                    away = leaving_step(scene, face)
                    start = x + wp.where(cosine >= 0.0, away, -away) * tri.normal
                    back = at.origin - start
                    length = wp.length(back)
                    if wp.static(among_media):
                        ray = -back / length
                        way = length - at.near
                        ahead = wp.min(AHEAD * passing_step(scene, face), wp.max(way, 0.0))
                        before = line(
                            scene, sampler, BEFORE, at.origin + at.near * ray, ray, way - ahead, camera.medium, 0
                        )
                        # Up to where both rays start: beyond it the transmittance is theirs.
                        hidden = way <= 0.0 or before.face >= 0 or before.lost
                    else:
                        hidden = visibility.hidden_from_camera(scene, start, back / length, length - at.near)
                    weight = wp.vec3(1.0, 1.0, 1.0)
                    if wp.static(role == "reverse"):
                        weight = gather(camera, at.pixel, job.image_adjoint)
                    if not hidden and speed_sum > 0.0 and wp.length_sq(weight) > 0.0:
                        note_place(scene, NOTE_POINT, face, at_b[1], at_b[2], x, -view, weight)
                        local = passing_step(scene, face)
                        # Up phi across the line of sight, where e1 and e2 look as long as they are wide.
                        step = phi_u * wp.cross(e2, view) - phi_v * wp.cross(e1, view)
                        step = wp.where(shape.orientation * cosine >= 0.0, BESIDE, -BESIDE) * local * wp.normalize(step)
                        ahead = wp.min(AHEAD * local, distance - at.near)
                        branch = sampler
                        branch.index = wp.uint32(1)
                        jump = wp.vec3(0.0, 0.0, 0.0)
                        own = wp.bool(True)
                        for side in range(2):
                            sign = 1.0 - 2.0 * wp.float32(side)
                            near_x = x + sign * step + ahead * view
                            far = at.far - distance
                            if wp.static(among_media):
                                seen = media_radiance(
                                    scene,
                                    branch,
                                    before.medium,
                                    near_x,
                                    -view,
                                    far + ahead,
                                    job.max_depth,
                                    job.rr_depth,
                                )
                            else:
                                seen = incident_radiance(
                                    scene, branch, near_x, -view, far, 0, job.max_depth, job.rr_depth
                                )
                            jump += sign * seen.radiance
                            own = own and seen.face >= 0 and on_plane(tri.normal, seen.x - x, local)
                        if not own:
                            continue
                        if wp.static(among_media):
                            jump = wp.cw_mul(before.transmittance, jump)
                        g = 3.0 * size * area / (speed_sum * probability * wp.float32(job.samples))
                        if wp.static(role == "reverse"):
                            g *= wp.dot(weight, jump)
                        unit = raw / size
                        vertex = VertexAdjoint()
                        vertex.x = -g * finite * unit
                        vertex.n = (shape.orientation * g) * to
                        accumulated = accumulate_vertex(
                            scene, target, face, at_b[1], at_b[2], vertex, wp.static(slides), at.origin, -view
                        )
                        moved = accumulated.dot
                        if wp.static(camera_moves):
                            a_o = accumulated.o + (g * finite) * unit
                            a_d = accumulated.d - (g * (1.0 - finite)) * unit
                            moved += accumulate_camera(scene, target, camera, at.sample, a_o, a_d)
                        if wp.static(role == "forward"):
                            splat(scene, sampler, camera, at.pixel, moved * jump, image_out)
                        elif wp.static(role == "reverse"):
                            if moved != 0.0:
                                count_invalid(scene, sampler)

    return terminator

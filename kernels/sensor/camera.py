"""Cameras: a ray through a film position, and the adjoint of that ray.

The conventions are those of Mitsuba's ``perspective``, ``thinlens`` and ``orthographic``. Film position and lens point
are fixed while the camera moves, so the first vertex of a path slides over the surface. A ``radiancemeter`` is the
orthographic ray of the film's centre. ``meter.py`` has the rays of an ``irradiancemeter``, ``distortion.py`` the lenses
that bend a pinhole's or thin lens's image.

Derivation: ``docs/theory/cameras.md#camera-rays``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.constants import (
    CAMERA_IRRADIANCEMETER,
    CAMERA_ORTHOGRAPHIC,
    DISTORTED_CAMERAS,
    FISHEYES,
    PARALLEL_CAMERAS,
    THIN_LENSES,
)
from warp_psdr.kernels.sampling import square_to_disk
from warp_psdr.kernels.sensor.distortion import (
    NUMBERS,
    film_plane,
    load_coefficients,
    make_distorted_dot,
    make_distortion,
)
from warp_psdr.kernels.sensor.meter import meter_direction, meter_origin
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Camera, Scene


@wp.struct
class CameraRay:
    """A ray from the plane z = 0 of the camera; hits closer than ``t_min`` or farther than ``t_max`` are clipped."""

    o: wp.vec3
    d: wp.vec3
    t_min: wp.float32
    t_max: wp.float32


@wp.struct
class CameraSample:
    """What names a ray of the camera; both parts are detached."""

    film: wp.vec2  # in [0, 1]^2 of the uncropped film; irradiance meter: numbers that choose the point
    lens: wp.vec2  # point of the unit disk (thin lens); irradiance meter: numbers that choose the direction; else 0


@wp.func
def load_mat44(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.mat44:
    return wp.mat44(
        values[offset], values[offset + 1], values[offset + 2], values[offset + 3],
        values[offset + 4], values[offset + 5], values[offset + 6], values[offset + 7],
        values[offset + 8], values[offset + 9], values[offset + 10], values[offset + 11],
        values[offset + 12], values[offset + 13], values[offset + 14], values[offset + 15],
    )  # fmt: skip


@wp.func
def half_width(fov: wp.float32) -> wp.float32:
    """tan(fov / 2), ``fov`` in degrees."""
    return wp.tan(fov * wp.static(3.14159265358979 / 360.0))


@wp.func
def direction_of(m: wp.mat44, x: wp.float32, y: wp.float32) -> wp.vec3:
    """Unnormalised world direction of (x, y, 1)."""
    return wp.vec3(
        m[0, 0] * x + m[0, 1] * y + m[0, 2],
        m[1, 0] * x + m[1, 1] * y + m[1, 2],
        m[2, 0] * x + m[2, 1] * y + m[2, 2],
    )


@wp.func
def direction_through(
    m: wp.mat44, k: wp.float32, cx: wp.float32, cy: wp.float32, s: wp.float32, t: wp.float32, aspect: wp.float32
) -> wp.vec3:
    """Unnormalised world direction through (s, t); ``k`` is the ``half_width``, ``aspect`` width / height."""
    x = (1.0 - 2.0 * (s + cx)) * k
    y = (1.0 - 2.0 * (t + cy)) * k / aspect
    return wp.vec3(
        m[0, 0] * x + m[0, 1] * y + m[0, 2],
        m[1, 0] * x + m[1, 1] * y + m[1, 2],
        m[2, 0] * x + m[2, 1] * y + m[2, 2],
    )


@wp.func
def camera_direction(
    m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32, s: wp.float32, t: wp.float32, aspect: wp.float32
) -> wp.vec3:
    """``direction_through``, of the field of view."""
    return direction_through(m, half_width(fov), cx, cy, s, t, aspect)


@differentiable
@wp.func
def camera_dot(
    m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32,
    s: wp.float32, t: wp.float32, aspect: wp.float32, a_o: wp.vec3, a_d: wp.vec3,
) -> wp.float32:  # fmt: skip
    """Local factor of the camera."""
    d = wp.normalize(camera_direction(m, fov, cx, cy, s, t, aspect))
    return wp.dot(a_o, wp.vec3(m[0, 3], m[1, 3], m[2, 3])) + wp.dot(a_d, d)


@wp.func
def bent_to_focus(m: wp.mat44, d: wp.vec3, radius: wp.float32, focus: wp.float32, lens: wp.vec2) -> wp.vec3:
    """Direction from the lens point to where the pinhole's ray is in focus."""
    x = radius * lens[0] / focus
    y = radius * lens[1] / focus
    return wp.vec3(
        d[0] - m[0, 0] * x - m[0, 1] * y,
        d[1] - m[1, 0] * x - m[1, 1] * y,
        d[2] - m[2, 0] * x - m[2, 1] * y,
    )


@wp.func
def lens_direction(
    m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32, radius: wp.float32, focus: wp.float32,
    film: wp.vec2, lens: wp.vec2, aspect: wp.float32,
) -> wp.vec3:  # fmt: skip
    """Unnormalised world direction from the lens point through the film position's point in focus."""
    return bent_to_focus(m, camera_direction(m, fov, cx, cy, film[0], film[1], aspect), radius, focus, lens)


@wp.func
def lens_origin(m: wp.mat44, radius: wp.float32, lens: wp.vec2) -> wp.vec3:
    x = radius * lens[0]
    y = radius * lens[1]
    return wp.vec3(
        m[0, 0] * x + m[0, 1] * y + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 3],
    )


@wp.func
def parallel_origin(m: wp.mat44, film: wp.vec2, aspect: wp.float32) -> wp.vec3:
    x = 1.0 - 2.0 * film[0]
    y = (1.0 - 2.0 * film[1]) / aspect
    return wp.vec3(
        m[0, 0] * x + m[0, 1] * y + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 3],
    )


@differentiable
@wp.func
def lens_dot(
    m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32, radius: wp.float32, focus: wp.float32,
    film: wp.vec2, lens: wp.vec2, aspect: wp.float32, a_o: wp.vec3, a_d: wp.vec3,
) -> wp.float32:  # fmt: skip
    """Local factor of the thin lens."""
    d = wp.normalize(lens_direction(m, fov, cx, cy, radius, focus, film, lens, aspect))
    return wp.dot(a_o, lens_origin(m, radius, lens)) + wp.dot(a_d, d)


@differentiable
@wp.func
def parallel_dot(m: wp.mat44, film: wp.vec2, aspect: wp.float32, a_o: wp.vec3, a_d: wp.vec3) -> wp.float32:
    """Local factor of the orthographic camera."""
    d = wp.normalize(wp.vec3(m[0, 2], m[1, 2], m[2, 2]))
    return wp.dot(a_o, parallel_origin(m, film, aspect)) + wp.dot(a_d, d)


@functools.cache
def make_lens(kind: int):
    """Return ``lens_point(u: vec2) -> vec2``: the part ``CameraSample.lens``."""

    @wp.func
    def lens_point(u: wp.vec2) -> wp.vec2:
        if wp.static(kind in THIN_LENSES):
            return square_to_disk(u)
        elif wp.static(kind == CAMERA_IRRADIANCEMETER):
            return u
        else:
            return wp.vec2(0.0, 0.0)

    return lens_point


@functools.cache
def make_pinhole_image(kind: int):
    """Return ``pinhole_image(scene, camera, k, film) -> vec2``: (p, q) of the direction through a film position.

    A camera with distortion; ``k`` is its ``half_width``.
    """
    undistort = make_distortion(kind in FISHEYES).undistort

    @wp.func
    def pinhole_image(scene: Scene, camera: Camera, k: wp.float32, film: wp.vec2) -> wp.vec2:
        aspect = wp.float32(camera.width) / wp.float32(camera.height)
        cx = scene.values[camera.principal]
        cy = scene.values[camera.principal + 1]
        return undistort(load_coefficients(scene, camera), film_plane(k, cx, cy, film[0], film[1], aspect))

    return pinhole_image


@functools.cache
def make_camera_rays(kind: int):
    """Return ``(view, ray_in)`` for many rays: ``ray_in(scene, camera, view(scene, camera), sample) -> CameraRay``.

    ``view`` is what they share and takes a call of the C library.
    """
    camera_origin = make_camera_origin(kind)
    pinhole_image = make_pinhole_image(kind) if kind in DISTORTED_CAMERAS else None

    @wp.func
    def view(scene: Scene, camera: Camera) -> wp.float32:
        if wp.static(kind in PARALLEL_CAMERAS or kind == CAMERA_IRRADIANCEMETER):
            return 0.0
        else:
            return half_width(scene.values[camera.x_fov])

    @wp.func
    def ray_in(scene: Scene, camera: Camera, k: wp.float32, sample: CameraSample) -> CameraRay:
        if wp.static(kind == CAMERA_IRRADIANCEMETER):
            from_meter = CameraRay()
            from_meter.o = meter_origin(scene, camera, sample.film)
            from_meter.d = meter_direction(scene, camera, sample.film, sample.lens)
            from_meter.t_max = camera.far
            return from_meter
        m = load_mat44(scene.values, camera.to_world)
        aspect = wp.float32(camera.width) / wp.float32(camera.height)
        d = wp.vec3(m[0, 2], m[1, 2], m[2, 2])
        axis = wp.length(d)
        film = sample.film
        if wp.static(kind not in PARALLEL_CAMERAS):
            cx = scene.values[camera.principal]
            cy = scene.values[camera.principal + 1]
            if wp.static(pinhole_image is not None):
                x = pinhole_image(scene, camera, k, film)
                d = direction_of(m, x[0], x[1])
            else:
                d = direction_through(m, k, cx, cy, film[0], film[1], aspect)
        if wp.static(kind in THIN_LENSES):
            radius = scene.values[camera.aperture_radius]
            d = bent_to_focus(m, d, radius, scene.values[camera.focus_distance], sample.lens)
        length = wp.length(d)
        ray = CameraRay()
        ray.o = camera_origin(scene, camera, sample)
        ray.d = d / length
        if wp.static(kind in PARALLEL_CAMERAS):
            # As in Mitsuba the near plane scales with ``to_world`` and the distance between the two does not.
            ray.t_min = camera.near * axis
            ray.t_max = ray.t_min + (camera.far - camera.near)
        else:
            # Clip planes are perpendicular to the viewing axis; |d| is 1 / cos of the angle to it (times M's scale).
            slant = length / axis
            ray.t_min = camera.near * slant
            ray.t_max = camera.far * slant
        return ray

    return view, ray_in


@functools.cache
def make_camera_origin(kind: int):
    """Return ``camera_origin(scene, camera, sample) -> vec3``, where a ray starts, before it is clipped."""

    @wp.func
    def camera_origin(scene: Scene, camera: Camera, sample: CameraSample) -> wp.vec3:
        if wp.static(kind == CAMERA_IRRADIANCEMETER):
            return meter_origin(scene, camera, sample.film)
        m = load_mat44(scene.values, camera.to_world)
        if wp.static(kind in PARALLEL_CAMERAS):
            return parallel_origin(m, sample.film, wp.float32(camera.width) / wp.float32(camera.height))
        elif wp.static(kind in THIN_LENSES):
            return lens_origin(m, scene.values[camera.aperture_radius], sample.lens)
        else:
            return wp.vec3(m[0, 3], m[1, 3], m[2, 3])

    return camera_origin


@functools.cache
def make_eye(kind: int):
    """Return ``eye_of(scene, camera, x) -> vec3``: from where the camera looks at x; of parallel rays, at its plane."""

    @wp.func
    def eye_of(scene: Scene, camera: Camera, x: wp.vec3) -> wp.vec3:
        m = load_mat44(scene.values, camera.to_world)
        o = wp.vec3(m[0, 3], m[1, 3], m[2, 3])
        if wp.static(kind in PARALLEL_CAMERAS):
            forward = wp.normalize(wp.vec3(m[0, 2], m[1, 2], m[2, 2]))
            return x - wp.dot(x - o, forward) * forward
        return o

    return eye_of


@functools.cache
def make_camera_ray(kind: int):
    """Return ``(camera_ray, camera_origin)``, both of ``(scene, camera, sample)``; ``camera_origin`` is the ray's o."""
    view, ray_in = make_camera_rays(kind)

    @wp.func
    def camera_ray(scene: Scene, camera: Camera, sample: CameraSample) -> CameraRay:
        return ray_in(scene, camera, view(scene, camera), sample)

    return camera_ray, make_camera_origin(kind)


@functools.cache
def make_camera_sink(role: str, kind: int):
    """Return ``accumulate_camera(scene, target, camera, sample, a_o, a_d) -> float`` for a camera ray.

    An irradiance meter has no parameters of its own.
    """
    sink = make_sink(role)
    distorted = kind in DISTORTED_CAMERAS
    jacobian = make_distortion(kind in FISHEYES).jacobian if distorted else None
    distorted_dot = make_distorted_dot(kind in FISHEYES) if distorted else None
    pinhole_image = make_pinhole_image(kind) if distorted else None

    @wp.func
    def accumulate_camera(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        a_o: wp.vec3,
        a_d: wp.vec3,
    ) -> wp.float32:
        m = load_mat44(scene.values, camera.to_world)
        aspect = wp.float32(camera.width) / wp.float32(camera.height)
        film = sample.film
        total = wp.float32(0.0)
        g_m = wp.mat44()
        if wp.static(kind in PARALLEL_CAMERAS):
            g_m, _film, _aspect, _a_o, _a_d = wp.grad(parallel_dot)(m, film, aspect, a_o, a_d)
        else:
            fov = scene.values[camera.x_fov]
            cx = scene.values[camera.principal]
            cy = scene.values[camera.principal + 1]
            g_fov = wp.float32(0.0)
            g_cx = wp.float32(0.0)
            g_cy = wp.float32(0.0)
            if wp.static(distorted):
                c = load_coefficients(scene, camera)
                start = pinhole_image(scene, camera, half_width(fov), film)
                inverse = wp.inverse(jacobian(c, start))
                lens_radius = wp.float32(0.0)
                focal = wp.float32(1.0)
                if wp.static(kind in THIN_LENSES):
                    lens_radius = scene.values[camera.aperture_radius]
                    focal = scene.values[camera.focus_distance]
                (
                    g_m, g_fov, g_cx, g_cy, g_c, g_lens_radius, g_focal,
                    _film, _lens, _aspect, _start, _inverse, _a_o, _a_d,
                ) = wp.grad(distorted_dot)(
                    m, fov, cx, cy, c, lens_radius, focal, film, sample.lens, aspect, start, inverse, a_o, a_d
                )  # fmt: skip
                if wp.static(kind in THIN_LENSES):
                    total += sink(target, camera.aperture_radius, g_lens_radius)
                    total += sink(target, camera.focus_distance, g_focal)
                for i in range(wp.static(NUMBERS)):
                    total += sink(target, camera.distortion + i, g_c[i])
            elif wp.static(kind in THIN_LENSES):
                radius = scene.values[camera.aperture_radius]
                focus = scene.values[camera.focus_distance]
                g_m, g_fov, g_cx, g_cy, g_radius, g_focus, _film, _lens, _aspect, _a_o, _a_d = wp.grad(lens_dot)(
                    m, fov, cx, cy, radius, focus, film, sample.lens, aspect, a_o, a_d
                )
                total += sink(target, camera.aperture_radius, g_radius)
                total += sink(target, camera.focus_distance, g_focus)
            else:
                g_m, g_fov, g_cx, g_cy, _s, _t, _aspect, _a_o, _a_d = wp.grad(camera_dot)(
                    m, fov, cx, cy, film[0], film[1], aspect, a_o, a_d
                )
            total += sink(target, camera.x_fov, g_fov)
            total += sink(target, camera.principal, g_cx)
            total += sink(target, camera.principal + 1, g_cy)
        for row in range(3):
            for column in range(4):
                total += sink(target, camera.to_world + 4 * row + column, g_m[row, column])
        return total

    return accumulate_camera


@functools.cache
def make_camera_eye(kind: int):
    """Return ``camera_eye(scene, camera, lens) -> vec3``: where a camera's rays start, or the way they come from."""

    @wp.func
    def camera_eye(scene: Scene, camera: Camera, lens: wp.vec2) -> wp.vec3:
        m = load_mat44(scene.values, camera.to_world)
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            return wp.vec3(m[0, 2], m[1, 2], m[2, 2])
        if wp.static(kind in THIN_LENSES):
            return lens_origin(m, scene.values[camera.aperture_radius], lens)
        return wp.vec3(m[0, 3], m[1, 3], m[2, 3])

    return camera_eye

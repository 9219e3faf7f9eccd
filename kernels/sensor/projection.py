"""From a point to the film: projection, importance of the camera, and splats under the pixel filter.

With P = M^-1 (x - o) and (p, q) = (P_x, P_y) / P_z, a pinhole at o sees a point at film = (1 - p / k) / 2 - c_x, (1 - q
a / k) / 2 - c_y. The importance of the camera is the Jacobian of that map; a thin lens is the mean over pinholes.
Distortion moves (p, q) before (``distortion.py``).

Derivation: ``docs/theory/cameras.md#projection-and-importance``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import (
    CAMERA_IRRADIANCEMETER,
    CAMERA_ORTHOGRAPHIC,
    DISTORTED_CAMERAS,
    FISHEYES,
    RFILTER_BOX,
    RFILTER_TENT,
    THIN_LENSES,
)
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.camera import CameraSample, lens_origin, load_mat44, make_pinhole_image
from warp_psdr.kernels.sensor.distortion import SAME_RAY, load_coefficients, make_distortion
from warp_psdr.kernels.sensor.film import (
    GAUSSIAN_CUT,
    GAUSSIAN_FLOOR,
    GAUSSIAN_INTEGRAL,
    filter_extent,
    filter_margin,
    filter_share,
)
from warp_psdr.kernels.sensor.meter import meter_face, meter_origin
from warp_psdr.kernels.structs import Camera, Scene

#: Pixels beside each other for which the filter is evaluated once and not for every row: all under most filters.
TAP_COUNT = 5
TAPS = wp.types.vector(length=TAP_COUNT, dtype=wp.float32)


@wp.struct
class FilmPoint:
    """A point's image. ``scale``: pixels a unit of p and q."""

    valid: wp.int32  # 0: behind the camera, clipped, or outside of what counts for the crop window's pixels
    sample: CameraSample  # the camera's ray through the point
    pixel: wp.vec2  # in pixels of the crop window
    camera_space: wp.vec3
    origin: wp.vec3  # of that ray
    near: wp.float32  # distances of the clip planes along the ray
    far: wp.float32
    scale: wp.float32
    per_area: wp.float32  # pixels a unit of area at the point, perpendicular to the ray


@wp.func
def camera_block(scene: Scene, camera: Camera) -> wp.mat33:
    m = load_mat44(scene.values, camera.to_world)
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def filter_1d(camera: Camera, x: wp.float32) -> wp.float32:
    """Density of the whole pixel filter along one axis [1 / pixel]."""
    a = wp.abs(x)
    if camera.filter == RFILTER_BOX:
        # Half-open: a point on the border between two pixels counts for one of them.
        inside = x >= -camera.filter_radius and x < camera.filter_radius
        return wp.where(inside, 0.5 / camera.filter_radius, 0.0)
    if camera.filter == RFILTER_TENT:
        return wp.max(1.0 - a / camera.filter_radius, 0.0) / camera.filter_radius
    z = a / camera.filter_stddev
    if z >= GAUSSIAN_CUT:
        return 0.0
    return (wp.exp(-0.5 * z * z) - GAUSSIAN_FLOOR) / (GAUSSIAN_INTEGRAL * camera.filter_stddev)


@wp.func
def pixel_filter(camera: Camera, at: wp.float32, pixel: wp.int32, size: wp.int32) -> wp.float32:
    """What a point counts for a pixel, along an axis of ``size`` pixels [1 / pixel]; what ``film.py`` samples."""
    h = filter_1d(camera, at - wp.float32(pixel) - 0.5)
    return h / filter_share(camera, pixel, size)


@wp.func
def counts(camera: Camera, at: wp.vec2) -> wp.bool:
    """Whether a point, in pixels of the crop window, lies where it can count for a pixel."""
    margin = filter_margin(camera)
    across = at[0] >= -margin and at[0] < wp.float32(camera.crop_width) + margin
    return across and at[1] >= -margin and at[1] < wp.float32(camera.crop_height) + margin


@wp.struct
class FilmWindow:
    """The pixels under whose filters a point lies, first and last."""

    x0: wp.int32
    y0: wp.int32
    x1: wp.int32
    y1: wp.int32


@wp.func
def film_window(camera: Camera, at: wp.vec2) -> FilmWindow:
    """The window of a point, in pixels of the crop window."""
    r = filter_extent(camera)
    w = FilmWindow()
    w.x0 = wp.max(wp.int32(wp.ceil(at[0] - 0.5 - r)), 0)
    w.y0 = wp.max(wp.int32(wp.ceil(at[1] - 0.5 - r)), 0)
    w.x1 = wp.min(wp.int32(wp.floor(at[0] - 0.5 + r)), camera.crop_width - 1)
    w.y1 = wp.min(wp.int32(wp.floor(at[1] - 0.5 + r)), camera.crop_height - 1)
    return w


@functools.cache
def make_pinhole_point(kind: int):
    """Return ``pinhole_point(scene, camera, at) -> vec2``: (p, q), which the camera's distortion moves."""

    @wp.func
    def pinhole_point(scene: Scene, camera: Camera, at: FilmPoint) -> wp.vec2:
        c = at.camera_space
        point = wp.vec2(c[0] / c[2], c[1] / c[2])
        if wp.static(kind in THIN_LENSES):
            point += (scene.values[camera.aperture_radius] / scene.values[camera.focus_distance]) * at.sample.lens
        return point

    return pinhole_point


@functools.cache
def make_area_gradient(kind: int):
    """Return ``area_gradient(scene, camera, at) -> vec3``: gradient by x of the logarithm of distortion's Jacobian.

    None: the camera has no distortion.
    """
    if kind not in DISTORTED_CAMERAS:
        return None
    log_area = make_distortion(kind in FISHEYES).log_area
    pinhole_point = make_pinhole_point(kind)

    @wp.func
    def area_gradient(scene: Scene, camera: Camera, at: FilmPoint) -> wp.vec3:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        point = pinhole_point(scene, camera, at)
        _coefficients, g = wp.grad(log_area)(load_coefficients(scene, camera), point)
        c = at.camera_space
        by_camera_space = wp.vec3(g[0], g[1], -(g[0] * c[0] + g[1] * c[1]) / c[2]) / c[2]
        return wp.transpose(wp.inverse(camera_block(scene, camera))) * by_camera_space

    return area_gradient


@functools.cache
def make_projection(kind: int):
    """Return ``(project, film_gradient, film_velocity)`` of a kind of camera.

    ``project(scene, camera, x, lens) -> FilmPoint``, ``lens`` from ``camera.make_lens``; of an irradiance meter
    uniform numbers that choose a point of its shape, and it has none of the other two functions;
    ``film_gradient(scene, camera, at, n) -> vec3``: gradient of n . pixel(x) with respect to x;
    ``film_velocity(scene, camera, at, v) -> vec2``: velocity of pixel(x) for a velocity v of x.
    """
    distorted = kind in DISTORTED_CAMERAS
    distort, jacobian = make_distortion(kind in FISHEYES)[:2] if distorted else (None, None)
    pinhole_image = make_pinhole_image(kind) if distorted else None
    pinhole_point = make_pinhole_point(kind)

    @wp.func
    def project(scene: Scene, camera: Camera, x: wp.vec3, lens: wp.vec2) -> FilmPoint:
        r = FilmPoint()
        r.sample.lens = lens
        if wp.static(kind == CAMERA_IRRADIANCEMETER):
            # The point of the shape that ``lens`` chooses receives it; one pixel without a filter.
            r.origin = meter_origin(scene, camera, lens)
            n = scene.triangles[camera.first_face + meter_face(scene, camera, lens[0])].normal
            away = x - r.origin
            height = wp.dot(n, away)
            if height > 0.0:
                square = wp.length_sq(away)
                r.valid = 1
                r.pixel = wp.vec2(0.5, 0.5)
                r.per_area = height / (square * wp.sqrt(square))
            return r
        m = load_mat44(scene.values, camera.to_world)
        block = camera_block(scene, camera)
        axis = wp.vec3(m[0, 2], m[1, 2], m[2, 2])
        r.origin = wp.vec3(m[0, 3], m[1, 3], m[2, 3])
        if wp.static(kind in THIN_LENSES):
            r.origin = lens_origin(m, scene.values[camera.aperture_radius], lens)
        c = wp.inverse(block) * (x - r.origin)
        if c[2] <= 0.0:
            return r
        r.camera_space = c
        width = wp.float32(camera.width)
        height = wp.float32(camera.height)
        size = wp.length(axis)
        area = wp.abs(wp.determinant(block))
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            r.scale = 0.5 * width
            r.sample.film = wp.vec2(0.5 * (1.0 - c[0]), 0.5 * (1.0 - c[1] * width / height))
            r.origin = x - c[2] * axis
            r.near = camera.near * size
            r.far = r.near + (camera.far - camera.near)
            r.per_area = r.scale * r.scale * size / area
        else:
            k = wp.tan(scene.values[camera.x_fov] * wp.static(3.14159265358979 / 360.0))
            r.scale = 0.5 * width / k
            p = c[0] / c[2]
            q = c[1] / c[2]
            slant = wp.length(block * wp.vec3(p, q, 1.0))
            r.near = camera.near * slant / size
            r.far = camera.far * slant / size
            r.per_area = r.scale * r.scale * slant * slant * slant / (area * wp.length_sq(x - r.origin))
            if wp.static(kind in THIN_LENSES):
                shear = scene.values[camera.aperture_radius] / scene.values[camera.focus_distance]
                p += shear * lens[0]
                q += shear * lens[1]
            if wp.static(distorted):
                seen = wp.vec2(p, q)
                coefficients = load_coefficients(scene, camera)
                moved = distort(coefficients, seen)
                p = moved[0]
                q = moved[1]
                r.per_area *= wp.abs(wp.determinant(jacobian(coefficients, seen)))
            r.sample.film = wp.vec2(
                0.5 * (1.0 - p / k) - scene.values[camera.principal],
                0.5 * (1.0 - q * width / (height * k)) - scene.values[camera.principal + 1],
            )
        film = r.sample.film
        r.pixel = wp.vec2(film[0] * width - wp.float32(camera.crop_x), film[1] * height - wp.float32(camera.crop_y))
        distance = wp.length(x - r.origin)
        if counts(camera, r.pixel) and distance > r.near and distance < r.far:
            r.valid = 1
            if wp.static(distorted):
                # Beyond the film the lens may fold directions onto it, which no ray has.
                apart = pinhole_image(scene, camera, k, film) - seen
                if not wp.length(apart) < SAME_RAY * (1.0 + wp.length(seen)):
                    r.valid = 0
        return r

    @wp.func
    def jacobian_at(scene: Scene, camera: Camera, at: FilmPoint) -> wp.mat22:
        return jacobian(load_coefficients(scene, camera), pinhole_point(scene, camera, at))

    @wp.func
    def film_gradient(scene: Scene, camera: Camera, at: FilmPoint, n: wp.vec2) -> wp.vec3:
        c = at.camera_space
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            g = -at.scale * wp.vec3(n[0], n[1], 0.0)
            return wp.transpose(wp.inverse(camera_block(scene, camera))) * g
        else:
            p = c[0] / c[2]
            q = c[1] / c[2]
            by = n
            if wp.static(distorted):
                by = wp.transpose(jacobian_at(scene, camera, at)) * n
            g = (-at.scale / c[2]) * wp.vec3(by[0], by[1], -(by[0] * p + by[1] * q))
            return wp.transpose(wp.inverse(camera_block(scene, camera))) * g

    @wp.func
    def film_velocity(scene: Scene, camera: Camera, at: FilmPoint, v: wp.vec3) -> wp.vec2:
        c = at.camera_space
        w = wp.inverse(camera_block(scene, camera)) * v
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            return -at.scale * wp.vec2(w[0], w[1])
        else:
            p = c[0] / c[2]
            q = c[1] / c[2]
            rate = (-at.scale / c[2]) * wp.vec2(w[0] - p * w[2], w[1] - q * w[2])
            if wp.static(distorted):
                rate = jacobian_at(scene, camera, at) * rate
            return rate

    return project, film_gradient, film_velocity


@wp.func
def filter_taps(camera: Camera, at: wp.float32, first: wp.int32, size: wp.int32) -> TAPS:
    """What a point counts for the pixels ``first``, ``first`` + 1, ... of an axis."""
    r = TAPS()
    for i in range(wp.static(TAP_COUNT)):
        r[i] = pixel_filter(camera, at, first + i, size)
    return r


@functools.cache
def make_splat():
    """Return ``(splat, gather)``.

    ``splat(scene, sampler, camera, at, value, image)`` adds a contribution to all pixels under the filter;
    ``gather(camera, at, adjoint) -> vec3`` is its transpose.
    """

    @wp.func
    def splat(
        scene: Scene,
        sampler: Sampler,
        camera: Camera,
        at: wp.vec2,
        value: wp.vec3,
        image: wp.array2d(dtype=wp.vec3),
    ):
        if not finite(value):
            count_invalid(scene, sampler)
            return
        if not counts(camera, at):
            return
        window = film_window(camera, at)
        taps = filter_taps(camera, at[0], window.x0, camera.crop_width)
        for y in range(window.y0, window.y1 + 1):
            h_y = pixel_filter(camera, at[1], y, camera.crop_height)
            for x in range(window.x0, window.x1 + 1):
                if x - window.x0 < wp.static(TAP_COUNT):
                    h = h_y * taps[x - window.x0]
                else:
                    h = h_y * pixel_filter(camera, at[0], x, camera.crop_width)
                wp.atomic_add(image, y, x, h * value)

    @wp.func
    def gather(camera: Camera, at: wp.vec2, adjoint: wp.array2d(dtype=wp.vec3)) -> wp.vec3:
        if not counts(camera, at):
            return wp.vec3(0.0, 0.0, 0.0)
        window = film_window(camera, at)
        taps = filter_taps(camera, at[0], window.x0, camera.crop_width)
        total = wp.vec3(0.0, 0.0, 0.0)
        for y in range(window.y0, window.y1 + 1):
            h_y = pixel_filter(camera, at[1], y, camera.crop_height)
            for x in range(window.x0, window.x1 + 1):
                if x - window.x0 < wp.static(TAP_COUNT):
                    h = h_y * taps[x - window.x0]
                else:
                    h = h_y * pixel_filter(camera, at[0], x, camera.crop_width)
                total += h * adjoint[y, x]
        return total

    return splat, gather

"""From a point to the film: projection, importance of a pinhole camera, and splats under the pixel filter.

With P = M^-1 (x - o), M the upper 3x3 block of the camera's matrix, and (p, q) = (P_x, P_y) / P_z, a point is seen at

    film = (1 - p / k) / 2 - c_x,  (1 - q a / k) / 2 - c_y,      k = tan(fov / 2), a = width / height,

so that a step of one pixel is 2 k / width in p and in q. A pixel's value is the integral of h(film) L over the film in
pixels, the filter's integral being one. A surface element dA seen at a distance r under the angle theta fills
d(film) = dA cos(theta) / r^2 . |M (p, q, 1)|^3 / |det M| . (width / 2 k)^2 pixels: the importance of the camera.
"""

import functools

import warp as wp

from warp_psdr.kernels.camera import load_mat44
from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_GAUSSIAN, RFILTER_TENT
from warp_psdr.kernels.film import GAUSSIAN_CUT
from warp_psdr.kernels.structs import Camera, Scene

#: sqrt(2 pi) erf(4 / sqrt 2) - 8 exp(-8): the integral of the lowered Gaussian, over its standard deviation.
GAUSSIAN_INTEGRAL = 2.50378587
GAUSSIAN_FLOOR = 3.3546263e-4


@wp.struct
class FilmPoint:
    """A point's image. ``scale``: pixels a unit of p and q."""

    valid: wp.int32  # 0: behind the camera, clipped, or farther than the filter's radius outside the crop window
    film: wp.vec2  # in [0, 1]^2 of the uncropped film
    pixel: wp.vec2  # in pixels of the crop window
    camera_space: wp.vec3
    origin: wp.vec3
    near: wp.float32  # distances of the clip planes along the ray
    far: wp.float32
    scale: wp.float32
    density: wp.float32  # pixels a unit of solid angle


@wp.func
def camera_block(scene: Scene, camera: Camera) -> wp.mat33:
    m = load_mat44(scene.values, camera.to_world)
    return wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@wp.func
def camera_origin(scene: Scene, camera: Camera) -> wp.vec3:
    i = camera.to_world
    return wp.vec3(scene.values[i + 3], scene.values[i + 7], scene.values[i + 11])


@wp.func
def filter_extent(camera: Camera) -> wp.float32:
    """Radius of the pixel filter [pixels]."""
    if camera.filter == RFILTER_GAUSSIAN:
        return GAUSSIAN_CUT * camera.filter_stddev
    return camera.filter_radius


@wp.func
def filter_1d(camera: Camera, x: wp.float32) -> wp.float32:
    """Density of the pixel filter along one axis [1 / pixel]; what ``film.py`` samples."""
    a = wp.abs(x)
    if camera.filter == RFILTER_BOX:
        return wp.where(a < camera.filter_radius, 0.5 / camera.filter_radius, 0.0)
    if camera.filter == RFILTER_TENT:
        return wp.max(1.0 - a / camera.filter_radius, 0.0) / camera.filter_radius
    z = a / camera.filter_stddev
    if z >= GAUSSIAN_CUT:
        return 0.0
    return (wp.exp(-0.5 * z * z) - GAUSSIAN_FLOOR) / (GAUSSIAN_INTEGRAL * camera.filter_stddev)


@wp.func
def project(scene: Scene, camera: Camera, x: wp.vec3) -> FilmPoint:
    r = FilmPoint()
    block = camera_block(scene, camera)
    r.origin = camera_origin(scene, camera)
    c = wp.inverse(block) * (x - r.origin)
    if c[2] <= 0.0:
        return r
    r.camera_space = c
    k = wp.tan(scene.values[camera.x_fov] * wp.static(3.14159265358979 / 360.0))
    width = wp.float32(camera.width)
    height = wp.float32(camera.height)
    r.scale = 0.5 * width / k
    p = c[0] / c[2]
    q = c[1] / c[2]
    r.film = wp.vec2(
        0.5 * (1.0 - p / k) - scene.values[camera.principal],
        0.5 * (1.0 - q * width / (height * k)) - scene.values[camera.principal + 1],
    )
    r.pixel = wp.vec2(r.film[0] * width - wp.float32(camera.crop_x), r.film[1] * height - wp.float32(camera.crop_y))
    slant = wp.length(block * wp.vec3(p, q, 1.0))
    axis = wp.length(wp.vec3(block[0, 2], block[1, 2], block[2, 2]))
    r.near = camera.near * slant / axis
    r.far = camera.far * slant / axis
    r.density = r.scale * r.scale * slant * slant * slant / wp.abs(wp.determinant(block))
    distance = wp.length(x - r.origin)
    margin = filter_extent(camera)
    inside = (
        r.pixel[0] > -margin
        and r.pixel[0] < wp.float32(camera.crop_width) + margin
        and r.pixel[1] > -margin
        and r.pixel[1] < wp.float32(camera.crop_height) + margin
    )
    if inside and distance > r.near and distance < r.far:
        r.valid = 1
    return r


@wp.func
def film_gradient(scene: Scene, camera: Camera, at: FilmPoint, n: wp.vec2) -> wp.vec3:
    """Gradient of n . pixel(x) with respect to x."""
    c = at.camera_space
    p = c[0] / c[2]
    q = c[1] / c[2]
    g = (-at.scale / c[2]) * wp.vec3(n[0], n[1], -(n[0] * p + n[1] * q))
    return wp.transpose(wp.inverse(camera_block(scene, camera))) * g


@wp.func
def film_velocity(scene: Scene, camera: Camera, at: FilmPoint, v: wp.vec3) -> wp.vec2:
    """Velocity of pixel(x) for a velocity v of x."""
    c = at.camera_space
    w = wp.inverse(camera_block(scene, camera)) * v
    p = c[0] / c[2]
    q = c[1] / c[2]
    return (-at.scale / c[2]) * wp.vec2(w[0] - p * w[2], w[1] - q * w[2])


@functools.cache
def make_splat():
    """Return ``(splat, gather)``.

    ``splat(camera, at, value, image)`` adds a contribution to all pixels under the filter;
    ``gather(camera, at, adjoint) -> vec3`` is its transpose.
    """

    @wp.func
    def splat(camera: Camera, at: wp.vec2, value: wp.vec3, image: wp.array2d(dtype=wp.vec3)):
        r = filter_extent(camera)
        x0 = wp.max(wp.int32(wp.ceil(at[0] - 0.5 - r)), 0)
        y0 = wp.max(wp.int32(wp.ceil(at[1] - 0.5 - r)), 0)
        x1 = wp.min(wp.int32(wp.floor(at[0] - 0.5 + r)), camera.crop_width - 1)
        y1 = wp.min(wp.int32(wp.floor(at[1] - 0.5 + r)), camera.crop_height - 1)
        for y in range(y0, y1 + 1):
            h_y = filter_1d(camera, at[1] - wp.float32(y) - 0.5)
            for x in range(x0, x1 + 1):
                wp.atomic_add(image, y, x, (h_y * filter_1d(camera, at[0] - wp.float32(x) - 0.5)) * value)

    @wp.func
    def gather(camera: Camera, at: wp.vec2, adjoint: wp.array2d(dtype=wp.vec3)) -> wp.vec3:
        r = filter_extent(camera)
        x0 = wp.max(wp.int32(wp.ceil(at[0] - 0.5 - r)), 0)
        y0 = wp.max(wp.int32(wp.ceil(at[1] - 0.5 - r)), 0)
        x1 = wp.min(wp.int32(wp.floor(at[0] - 0.5 + r)), camera.crop_width - 1)
        y1 = wp.min(wp.int32(wp.floor(at[1] - 0.5 + r)), camera.crop_height - 1)
        total = wp.vec3(0.0, 0.0, 0.0)
        for y in range(y0, y1 + 1):
            h_y = filter_1d(camera, at[1] - wp.float32(y) - 0.5)
            for x in range(x0, x1 + 1):
                total += (h_y * filter_1d(camera, at[0] - wp.float32(x) - 0.5)) * adjoint[y, x]
        return total

    return splat, gather

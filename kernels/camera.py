"""The pinhole camera: a ray through a film position, and the adjoint of that ray.

Convention of Mitsuba's ``perspective``: camera space looks along +z, +y is up and +x points to the left of the image;
a film position (s, t) in [0, 1]^2 counts from the top left. With the horizontal field of view ``fov``,

    d_c = ((1 - 2 (s + c_x)) tan(fov / 2), (1 - 2 (t + c_y)) tan(fov / 2) height / width, 1),

(c_x, c_y) the principal point offset; ``d = normalize(M d_c)`` with the upper 3x3 block M of ``to_world``, ``o`` its
translation. The film position is fixed while pose and field of view move: the first vertex of a path slides over the
surface (the boundary term for that parametrisation is the primary one). Radiance averaged over the pixel filter needs
no further weight.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import differentiable
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Camera, Scene


@wp.struct
class Ray:
    """A ray; ``o`` is the camera's position, hits closer than ``t_min`` or farther than ``t_max`` are clipped."""

    o: wp.vec3
    d: wp.vec3
    t_min: wp.float32
    t_max: wp.float32


@wp.func
def load_mat44(values: wp.array(dtype=wp.float32), offset: wp.int32) -> wp.mat44:
    return wp.mat44(
        values[offset], values[offset + 1], values[offset + 2], values[offset + 3],
        values[offset + 4], values[offset + 5], values[offset + 6], values[offset + 7],
        values[offset + 8], values[offset + 9], values[offset + 10], values[offset + 11],
        values[offset + 12], values[offset + 13], values[offset + 14], values[offset + 15],
    )  # fmt: skip


@wp.func
def camera_direction(
    m: wp.mat44, fov: wp.float32, cx: wp.float32, cy: wp.float32, s: wp.float32, t: wp.float32, aspect: wp.float32
) -> wp.vec3:
    """Unnormalised world direction through (s, t); ``aspect`` is width / height, ``fov`` in degrees."""
    k = wp.tan(fov * wp.static(3.14159265358979 / 360.0))
    x = (1.0 - 2.0 * (s + cx)) * k
    y = (1.0 - 2.0 * (t + cy)) * k / aspect
    return wp.vec3(
        m[0, 0] * x + m[0, 1] * y + m[0, 2],
        m[1, 0] * x + m[1, 1] * y + m[1, 2],
        m[2, 0] * x + m[2, 1] * y + m[2, 2],
    )


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
def camera_ray(scene: Scene, camera: Camera, film: wp.vec2) -> Ray:
    """Ray through a film position in [0, 1]^2 of the uncropped film."""
    m = load_mat44(scene.values, camera.to_world)
    aspect = wp.float32(camera.width) / wp.float32(camera.height)
    d = camera_direction(
        m, scene.values[camera.x_fov], scene.values[camera.principal], scene.values[camera.principal + 1],
        film[0], film[1], aspect,
    )  # fmt: skip
    length = wp.length(d)
    ray = Ray()
    ray.o = wp.vec3(m[0, 3], m[1, 3], m[2, 3])
    ray.d = d / length
    # Clip planes are perpendicular to the viewing axis; |d| is 1 / cos of the angle to it (times the scale of M).
    slant = length / wp.length(wp.vec3(m[0, 2], m[1, 2], m[2, 2]))
    ray.t_min = camera.near * slant
    ray.t_max = camera.far * slant
    return ray


@functools.cache
def make_camera_sink(role: str):
    """Return ``push_camera(scene, target, camera, film, a_o, a_d) -> float``: scatter the adjoint of a camera ray."""
    sink = make_sink(role)

    @wp.func
    def push_camera(
        scene: Scene, target: wp.array(dtype=wp.float32), camera: Camera, film: wp.vec2, a_o: wp.vec3, a_d: wp.vec3
    ) -> wp.float32:
        m = load_mat44(scene.values, camera.to_world)
        aspect = wp.float32(camera.width) / wp.float32(camera.height)
        g_m, g_fov, g_cx, g_cy, _s, _t, _aspect, _a_o, _a_d = wp.grad(camera_dot)(
            m, scene.values[camera.x_fov], scene.values[camera.principal], scene.values[camera.principal + 1],
            film[0], film[1], aspect, a_o, a_d,
        )  # fmt: skip
        total = sink(target, camera.x_fov, g_fov)
        total += sink(target, camera.principal, g_cx)
        total += sink(target, camera.principal + 1, g_cy)
        for row in range(3):
            for column in range(4):
                total += sink(target, camera.to_world + 4 * row + column, g_m[row, column])
        return total

    return push_camera

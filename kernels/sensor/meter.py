"""Irradiance meter: the rays that a surface receives, by area and by the cosine.

The irradiance of a point is E = int L(x, w) cos(theta) dw over the hemisphere of its normal, and the meter shows its
mean over the shape, int E dA / A. A point drawn by area and a direction drawn by cos(theta) / pi leave the factor pi of
the radiance.
"""

import warp as wp

from warp_psdr.kernels.constants import ONE_MINUS_EPSILON
from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere, square_to_triangle
from warp_psdr.kernels.step import leaving_step
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import point_on


@wp.func
def meter_face(scene: Scene, camera: Camera, u: wp.float32) -> wp.int32:
    """Number of a triangle of the meter's shape, relative to its first one."""
    return find_interval(scene.face_cdf, camera.cdf_offset, camera.face_count, u)


@wp.func
def meter_origin(scene: Scene, camera: Camera, u: wp.vec2) -> wp.vec3:
    """A point uniform over the shape, moved off it; u[0] chooses the triangle, and is used again within it."""
    k = meter_face(scene, camera, u[0])
    low = load_float(scene.face_cdf, camera.cdf_offset + k)
    high = load_float(scene.face_cdf, camera.cdf_offset + k + 1)
    rest = wp.min((wp.min(u[0], ONE_MINUS_EPSILON) - low) / wp.max(high - low, 1.0e-30), ONE_MINUS_EPSILON)
    face = camera.first_face + k
    tri = scene.triangles[face]
    at = square_to_triangle(wp.vec2(rest, u[1]))
    return point_on(tri, at[0], at[1]) + leaving_step(scene, face) * tri.normal


@wp.func
def meter_direction(scene: Scene, camera: Camera, u: wp.vec2, v: wp.vec2) -> wp.vec3:
    """A direction by the cosine about the normal of the triangle that u chooses."""
    n = scene.triangles[camera.first_face + meter_face(scene, camera, u[0])].normal
    s = any_tangent(n)
    return to_world(s, wp.cross(n, s), n, square_to_cosine_hemisphere(v))

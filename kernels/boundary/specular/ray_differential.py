"""Ray differentials of a chain: how its rays move with q, the point of the line search's domain.

The scene is at rest. A ray (o, d) with the derivatives o_q and d_q meets a triangle at x_q = r - d (n_g . r) / (n_g .
d), r = o_q + t d_q. The derivative of the lobe's direction follows from its closed form [Igehy 1999, "Tracing Ray
Differentials"].

Derivation: ``docs/theory/specular.md#ray-differentials``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.specular.specular_chain import Link, film_point
from warp_psdr.kernels.constants import (
    CAMERA_ORTHOGRAPHIC,
    DISTORTED_CAMERAS,
    FISHEYES,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NULL,
    THIN_LENSES,
)
from warp_psdr.kernels.fresnel import refracted_cosine
from warp_psdr.kernels.primitive.affine import is_primitive, is_primitive_at
from warp_psdr.kernels.primitive.dispatch import make_turn
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sensor.camera import (
    bent_to_focus,
    camera_direction,
    direction_of,
    half_width,
    lens_direction,
    load_mat44,
    make_pinhole_image,
    parallel_origin,
)
from warp_psdr.kernels.sensor.distortion import load_coefficients, make_distortion
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex_motion import normalize_jvp


@wp.struct
class RayDifferential:
    """Derivative of a ray along one direction of q."""

    o: wp.vec3
    d: wp.vec3


@wp.struct
class PointDifferential:
    """Derivative of a point of a surface, and of the shading normal there."""

    x: wp.vec3
    n: wp.vec3


@functools.cache
def make_film_differential(kind: int):
    """Return ``film_differential(scene, camera, q, lens, step) -> RayDifferential`` by q [pixels] along ``step``."""
    distorted = kind in DISTORTED_CAMERAS
    pinhole_image = make_pinhole_image(kind) if distorted else None
    jacobian = make_distortion(kind in FISHEYES).jacobian if distorted else None

    @wp.func
    def film_differential(scene: Scene, camera: Camera, q: wp.vec2, lens: wp.vec2, step: wp.vec2) -> RayDifferential:
        r = RayDifferential()
        m = load_mat44(scene.values, camera.to_world)
        aspect = wp.float32(camera.width) / wp.float32(camera.height)
        here = film_point(camera, q)
        there = film_point(camera, q + step)
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            r.o = parallel_origin(m, there, aspect) - parallel_origin(m, here, aspect)
        else:
            fov = scene.values[camera.x_fov]
            cx = scene.values[camera.principal]
            cy = scene.values[camera.principal + 1]
            if wp.static(distorted):
                k = half_width(fov)
                x = pinhole_image(scene, camera, k, here)
                moved = -2.0 * k * wp.vec2(there[0] - here[0], (there[1] - here[1]) / aspect)
                x_q = wp.inverse(jacobian(load_coefficients(scene, camera), x)) * moved
                d = direction_of(m, x[0], x[1])
                d_q = direction_of(m, x_q[0], x_q[1]) - wp.vec3(m[0, 2], m[1, 2], m[2, 2])
                if wp.static(kind in THIN_LENSES):
                    radius = scene.values[camera.aperture_radius]
                    d = bent_to_focus(m, d, radius, scene.values[camera.focus_distance], lens)
            else:
                d = camera_direction(m, fov, cx, cy, here[0], here[1], aspect)
                d_q = camera_direction(m, fov, cx, cy, there[0], there[1], aspect) - d
                if wp.static(kind in THIN_LENSES):
                    radius = scene.values[camera.aperture_radius]
                    d = lens_direction(m, fov, cx, cy, radius, scene.values[camera.focus_distance], here, lens, aspect)
            length = wp.length(d)
            d = d / length
            r.d = (d_q - d * wp.dot(d, d_q)) / length
        return r

    return film_differential


@functools.cache
def make_point_differential(smooth: bool, flat: bool, primitives: tuple[int, ...]):
    """Return ``point_differential(scene, link, x, d, ray) -> PointDifferential`` for a ray from x along d."""
    turn = make_turn(primitives)

    @wp.func
    def point_differential(scene: Scene, link: Link, x: wp.vec3, d: wp.vec3, ray: RayDifferential) -> PointDifferential:
        result = PointDifferential()
        r = ray.o + wp.length(link.x - x) * ray.d
        result.x = r - (wp.dot(link.ng, r) / wp.dot(link.ng, d)) * d
        if wp.static(turn is not None):
            if is_primitive_at(scene, link.face):
                result.n = turn(scene, scene.triangles[link.face], link.u, link.v, result.x)
        if wp.static(smooth):
            tri = scene.triangles[link.face]
            shape = scene.shapes[tri.shape]
            if not is_primitive(tri) and (shape.smooth == 1 or wp.static(not flat)):
                e1 = tri.p1 - tri.p0
                e2 = tri.p2 - tri.p0
                c = wp.cross(e1, e2)
                squared = wp.dot(c, c)
                u_q = wp.dot(wp.cross(result.x, e2), c) / squared
                v_q = wp.dot(wp.cross(e1, result.x), c) / squared
                n0 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i0)
                n1 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i1)
                n2 = load_vec3(scene.values, shape.normal_offset + 3 * tri.i2)
                n = (1.0 - link.u - link.v) * n0 + link.u * n1 + link.v * n2
                turned = shape.orientation * (u_q * (n1 - n0) + v_q * (n2 - n0))
                result.n = normalize_jvp(link.n, wp.length(n), turned)
        return result

    return point_differential


@wp.func
def scattered_differential(link: Link, d: wp.vec3, ray: RayDifferential, point: PointDifferential) -> RayDifferential:
    """Differential of the ray that leaves a mirror or glass; the sign of the normal does not matter."""
    r = RayDifferential()
    r.o = point.x
    n = link.n
    c = wp.dot(d, n)
    c_q = wp.dot(ray.d, n) + wp.dot(d, point.n)
    if link.lobe == LOBE_DELTA_TRANSMISSION:
        g = refracted_cosine(wp.abs(c), link.eta)
        sign = wp.where(c < 0.0, -1.0, 1.0)
        normal = sign * g - c
        normal_q = sign * c * c_q / wp.max(g, 1.0e-20) - c_q
        r.d = (ray.d + normal_q * n + normal * point.n) / link.eta
    elif link.lobe == LOBE_NULL:
        r.d = ray.d
    else:
        r.d = ray.d - 2.0 * (c_q * n + c * point.n)
    return r

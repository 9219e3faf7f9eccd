"""Area lights: triangles that emit from the side their geometric normal points to.

A light point is drawn by area over the triangles of one shape: a triangle from the cumulative areas ``Scene.face_cdf``,
then a uniform point on it. In material form the point is (triangle, detached barycentrics). Its position, its radiance
texture and the geometric factor are attached; its pdf is detached. With the triangle's stored probability P and area A,
the pdf in solid angle seen from x is P t^2 / (A |cos|). Exact shapes have one record in place of triangles, and their
own points (``primitive/shining.py``).
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.primitive.affine import is_primitive, step_off_primitive
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.reading import load_float, triangle_at
from warp_psdr.kernels.sampling import square_to_triangle
from warp_psdr.kernels.step import step_off_triangle
from warp_psdr.kernels.structs import Emitter, LightSample, Scene, Triangle
from warp_psdr.kernels.surface import point_on, texcoords_at
from warp_psdr.kernels.texture.texture import make_texture


@wp.func
def light_uv(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec2:
    """Texture coordinates at a point of a triangle."""
    return texcoords_at(scene, scene.triangles[face], u, v)


@wp.func
def density_on(scene: Scene, e: Emitter, face: wp.int32, tri: Triangle) -> wp.float32:
    """Density per area with which points of a triangle are drawn; ``tri`` is that of the number ``face``."""
    k = e.cdf_offset + face - e.first_face
    doubled = wp.length(wp.cross(tri.p1 - tri.p0, tri.p2 - tri.p0))
    return 2.0 * (load_float(scene.face_cdf, k + 1) - load_float(scene.face_cdf, k)) / wp.max(doubled, 1.0e-30)


@wp.func
def area_density(scene: Scene, e: Emitter, face: wp.int32) -> wp.float32:
    """Density per area with which points of the triangle with the number ``face`` are drawn."""
    return density_on(scene, e, face, triangle_at(scene, face))


@wp.func
def pdf_area(scene: Scene, e: Emitter, face: wp.int32, d: wp.vec3, t: wp.float32) -> wp.float32:
    """Solid-angle density with which ``sample`` finds the point hit by direction d (unit) after distance t."""
    return area_density(scene, e, face) * t * t / wp.max(wp.abs(wp.dot(scene.triangles[face].normal, d)), 1.0e-12)


@functools.cache
def make_light_uv(shining: tuple[int, ...]):
    """Return ``light_uv``, for the exact shapes that shine as well; ``shining``: their kinds."""
    exact = make_shining(shining)
    if exact is None:
        return light_uv

    @wp.func
    def light_uv_of_any(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec2:
        tri = triangle_at(scene, face)
        if is_primitive(tri):
            return exact.uv(tri, u, v)
        return light_uv(scene, face, u, v)

    return light_uv_of_any


@functools.cache
def make_pdf_area(shining: tuple[int, ...], uniform: bool = False):
    """Return ``pdf_area``, which takes u and v behind the face, for the exact shapes that shine as well.

    ``uniform``: of points that are uniform in the area of their kinds, instead of those that ``sample_point`` draws.
    """
    exact = make_shining(shining)
    pdf_exact = None
    if exact is not None:
        pdf_exact = exact.pdf_uniform if uniform else exact.pdf

    @wp.func
    def pdf_of_any(
        scene: Scene, e: Emitter, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3, t: wp.float32
    ) -> wp.float32:
        if wp.static(pdf_exact is not None):
            tri = triangle_at(scene, face)
            if is_primitive(tri):
                return pdf_exact(tri, u, v, d, t)
        return pdf_area(scene, e, face, d, t)

    return pdf_of_any


class AreaFunctions(NamedTuple):
    """Warp functions of area lights.

    Attributes:
        emitted: ``(scene, e, face, u, v, d) -> vec3``, radiance leaving against d, the direction of the ray that
            arrives there.
        pick: ``(scene, e, u) -> int``, one of the light's triangles.
        draw: ``(scene, e, face, tri, x, u: vec2) -> LightSample``, a point on it, seen from x; ``tri`` is its record.
    """

    emitted: wp.Function
    select_triangle: wp.Function
    sample_point: wp.Function


@functools.cache
def make_area(radiance_kinds: tuple[int, ...], shining: tuple[int, ...] = ()) -> AreaFunctions:
    """Return the functions of area lights.

    Args:
        radiance_kinds: those of their radiance textures.
        shining: kinds of exact shapes among them.
    """
    exact = make_shining(shining)
    uv_at = make_light_uv(shining)
    texture_at = make_texture(radiance_kinds)
    textured = any(kind != 0 for kind in radiance_kinds)

    @wp.func
    def radiance_at(scene: Scene, e: Emitter, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
        uv = wp.vec2(0.0, 0.0)
        if wp.static(textured):
            uv = uv_at(scene, face, u, v)
        return texture_at(scene, e.texture, face, u, v, uv)

    @wp.func
    def emitted(scene: Scene, e: Emitter, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3) -> wp.vec3:
        facing = wp.dot(scene.triangles[face].normal, d)
        if wp.static(exact is not None):
            tri = triangle_at(scene, face)
            if is_primitive(tri):
                facing = wp.dot(exact.cross(tri, u, v), d)
        if facing >= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        return radiance_at(scene, e, face, u, v)

    @wp.func
    def select_triangle(scene: Scene, e: Emitter, u: wp.float32) -> wp.int32:
        return e.first_face + find_interval(scene.face_cdf, e.cdf_offset, e.face_count, u)

    @wp.func
    def sample_point(scene: Scene, e: Emitter, face: wp.int32, tri: Triangle, x: wp.vec3, u: wp.vec2) -> LightSample:
        result = LightSample()
        barycentrics = square_to_triangle(u)
        result.face = face
        result.u = barycentrics[0]
        result.v = barycentrics[1]
        y = point_on(tri, result.u, result.v)
        result.target = y + step_off_triangle(scene, tri) * tri.normal
        r = y - x
        squared = wp.dot(r, r)
        result.distance = wp.sqrt(squared)
        result.wi = (1.0 / wp.where(squared <= 0.0, 1.0, result.distance)) * r
        cosine = -wp.dot(tri.normal, result.wi)
        density = density_on(scene, e, face, tri) * squared / cosine
        result.pdf = wp.where(squared <= 0.0 or cosine <= 0.0, 0.0, density)
        result.radiance = radiance_at(scene, e, face, result.u, result.v)
        return result

    if exact is None:
        return AreaFunctions(emitted, select_triangle, sample_point)

    @wp.func
    def sample_any(scene: Scene, e: Emitter, face: wp.int32, tri: Triangle, x: wp.vec3, u: wp.vec2) -> LightSample:
        if not is_primitive(tri):
            return sample_point(scene, e, face, tri, x, u)
        result = LightSample()
        at = exact.draw(tri, x, u)
        result.face = face
        result.u = at[0]
        result.v = at[1]
        y = exact.position(tri, result.u, result.v)
        cross = exact.cross(tri, result.u, result.v)
        result.target = y + step_off_primitive(scene, tri) * wp.normalize(cross)
        r = y - x
        squared = wp.dot(r, r)
        result.distance = wp.sqrt(squared)
        result.wi = (1.0 / wp.where(squared <= 0.0, 1.0, result.distance)) * r
        if squared > 0.0 and wp.dot(cross, result.wi) < 0.0:
            result.pdf = exact.pdf(tri, result.u, result.v, result.wi, result.distance)
        result.radiance = radiance_at(scene, e, face, result.u, result.v)
        return result

    return AreaFunctions(emitted, select_triangle, sample_any)

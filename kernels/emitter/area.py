"""Area lights: triangles that emit from the side their geometric normal points to.

A light point is drawn uniformly by area over the triangles of one shape. In material form it is (triangle, detached
barycentrics): its position, its radiance texture and the geometric factor towards it are attached, its pdf is not.
The pdf in solid angle seen from x is t^2 / (area |cos|).
"""

import functools

import warp as wp

from warp_psdr.kernels.distribution import find_interval
from warp_psdr.kernels.structs import Emitter, LightSample, Scene
from warp_psdr.kernels.surface import load_vec2
from warp_psdr.kernels.texture import make_texture


@wp.func
def light_uv(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec2:
    """Texture coordinates at a point of a triangle."""
    tri = scene.triangles[face]
    shape = scene.shapes[tri.shape]
    if shape.has_uv == 0:
        return wp.vec2(u, v)
    t0 = load_vec2(scene.values, shape.uv_offset + 2 * tri.i0)
    t1 = load_vec2(scene.values, shape.uv_offset + 2 * tri.i1)
    t2 = load_vec2(scene.values, shape.uv_offset + 2 * tri.i2)
    return (1.0 - u - v) * t0 + u * t1 + v * t2


@wp.func
def pdf_area(scene: Scene, e: Emitter, face: wp.int32, d: wp.vec3, t: wp.float32) -> wp.float32:
    """Solid-angle density with which ``sample`` finds the point hit by direction d (unit) after distance t."""
    return t * t / (e.area * wp.max(wp.abs(wp.dot(scene.triangles[face].normal, d)), 1.0e-12))


@functools.cache
def make_area(radiance_kinds: tuple[int, ...]):
    """Return ``(emitted, sample)`` for area lights whose radiance textures are of the given kinds.

    ``emitted(scene, e, face, u, v, d)`` is the radiance leaving against direction d, the direction of the ray that
    arrives there. ``sample(scene, e, x, u3) -> LightSample`` draws a point.
    """
    texture_at = make_texture(radiance_kinds)
    textured = any(kind != 0 for kind in radiance_kinds)

    @wp.func
    def radiance_at(scene: Scene, e: Emitter, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
        uv = wp.vec2(0.0, 0.0)
        if wp.static(textured):
            uv = light_uv(scene, face, u, v)
        return texture_at(scene, e.texture, face, u, v, uv)

    @wp.func
    def emitted(scene: Scene, e: Emitter, face: wp.int32, u: wp.float32, v: wp.float32, d: wp.vec3) -> wp.vec3:
        if wp.dot(scene.triangles[face].normal, d) >= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
        return radiance_at(scene, e, face, u, v)

    @wp.func
    def sample(scene: Scene, e: Emitter, x: wp.vec3, u3: wp.vec3) -> LightSample:
        result = LightSample()
        cell = find_interval(scene.face_cdf, e.cdf_offset, e.face_count, u3[0])
        face = e.first_face + cell
        # Uniform barycentrics by folding the unit square.
        u = u3[1]
        v = u3[2]
        if u + v > 1.0:
            u = 1.0 - u
            v = 1.0 - v
        tri = scene.triangles[face]
        r = (1.0 - u - v) * tri.p0 + u * tri.p1 + v * tri.p2 - x
        squared = wp.dot(r, r)
        result.face = face
        result.u = u
        result.v = v
        if squared <= 0.0:
            return result
        result.distance = wp.sqrt(squared)
        result.wi = r / result.distance
        cosine = -wp.dot(tri.normal, result.wi)
        if cosine <= 0.0:
            return result
        result.pdf = squared / (e.area * cosine)
        result.radiance = radiance_at(scene, e, face, u, v)
        return result

    return emitted, sample

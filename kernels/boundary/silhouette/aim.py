"""The aim of a segment that touches a shape without triangles: a point of a light, or the light's direction."""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.light_square import envmap_to_square, outside_of, within
from warp_psdr.kernels.boundary.guiding.stripe import triangle_to_square
from warp_psdr.kernels.constants import (
    EMITTER_AREA,
    EMITTER_CONSTANT,
    EMITTER_DIRECTIONAL,
    EMITTER_ENVMAP,
    EMITTER_POINT,
)
from warp_psdr.kernels.distribution import find_interval_64
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.primitive.affine import is_primitive
from warp_psdr.kernels.primitive.shining import make_shining
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sampling import sphere_to_square, square_to_triangle
from warp_psdr.kernels.scattering import make_light_draw
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import LightConfig

#: Sample slots of a segment; those of the walk follow (``transport.py``).
SLOT_SILHOUETTE, SLOT_DIRECTION = 0, 1


@wp.struct
class TangentAim:
    """Where a segment that touches a shape leads to."""

    valid: wp.int32
    w: wp.vec3
    light: wp.int32  # emitter that it was aimed at, -1: none
    eye: wp.vec3  # its point, or the direction towards it
    distant: wp.bool
    cross: wp.vec3  # normal of an exact shape there, of any length; 0: it is none
    u: wp.float32  # fraction of the way around the silhouette


@functools.cache
def make_light_point(lights: LightConfig):
    """Return ``point(scene, x, index, face, u) -> TangentAim``: of a light, or its direction; face -1: no area light.

    x is where the shape is.
    """
    _pick, draw = make_light_draw(lights)
    exact = make_shining(lights.shining)
    area = bool(lights.area)
    deltas = make_delta_sample(lights.others) is not None

    @wp.func
    def light_point(scene: Scene, x: wp.vec3, index: wp.int32, face: wp.int32, u: wp.vec2) -> TangentAim:
        r = TangentAim()
        r.light = index
        r.valid = 1
        if wp.static(area):
            if face >= 0:
                if wp.static(exact is not None):
                    tri = scene.triangles[face]
                    if is_primitive(tri):
                        q = exact.draw_uniform(tri, u)
                        r.eye = exact.position(tri, q[0], q[1])
                        r.cross = exact.cross(tri, q[0], q[1])
                        return r
                uv = square_to_triangle(u)
                r.eye = point_on(scene.triangles[face], uv[0], uv[1])
                return r
        emitter = scene.emitters[index]
        if wp.static(deltas):
            if is_delta_light(emitter.kind):
                if emitter.kind == EMITTER_DIRECTIONAL:
                    r.eye = -wp.normalize(load_column(scene.values, emitter.to_world, 2))
                    r.distant = True
                elif emitter.kind == EMITTER_POINT:
                    r.eye = load_vec3(scene.values, emitter.to_world)
                else:
                    r.eye = load_column(scene.values, emitter.to_world, 3)
                return r
        ls = draw(scene, index, -1, Triangle(), x, u)
        r.eye = ls.wi
        r.distant = True
        r.valid = wp.where(ls.pdf > 0.0, 1, 0)
        return r

    return light_point


@functools.cache
def make_light_aim(lights: LightConfig):
    """Return ``aim(scene, x, u4) -> TangentAim``: a point of a light, or its direction; x is where the shape is."""
    pick, _draw = make_light_draw(lights)
    light_point = make_light_point(lights)

    @wp.func
    def light_aim(scene: Scene, x: wp.vec3, u4: wp.vec4) -> TangentAim:
        index, face = pick(scene, wp.vec2(u4[0], u4[1]))
        return light_point(scene, x, index, face, wp.vec2(u4[2], u4[3]))

    return light_aim


@functools.cache
def make_square_aim(lights: LightConfig):
    """Return ``aim(scene, x, u1, u2) -> TangentAim``: as ``make_light_aim``'s, of a point of the unit square.

    What is left of u1 after the choice of a light chooses a triangle of it, and what is left again is a coordinate.
    """
    light_point = make_light_point(lights)

    @wp.func
    def square_aim(scene: Scene, x: wp.vec3, u1: wp.float64, u2: wp.float64) -> TangentAim:
        index = find_interval_64(scene.emitter_cdf, 0, scene.emitters.shape[0], u1)
        rest = within(scene.emitter_cdf, index, u1)
        face = wp.int32(-1)
        if wp.static(bool(lights.area)):
            emitter = scene.emitters[index]
            if emitter.kind == EMITTER_AREA:
                k = find_interval_64(scene.face_cdf, emitter.cdf_offset, emitter.face_count, rest)
                rest = within(scene.face_cdf, emitter.cdf_offset + k, rest)
                face = emitter.first_face + k
        return light_point(scene, x, index, face, wp.vec2(wp.float32(rest), wp.float32(u2)))

    return square_aim


@functools.cache
def make_aim_square(lights: LightConfig):
    """Return ``square(scene, face, u, v, w) -> vec2d``: what ``make_square_aim``'s function is given for a point.

    (face, u, v) of an area light, or for face < 0 the direction w towards the environment; negative: no light is there.
    """
    has_area = bool(lights.area)
    exact = make_shining(lights.shining)
    constant = EMITTER_CONSTANT in lights.others
    envmap = EMITTER_ENVMAP in lights.others

    @wp.func
    def aim_square(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, w: wp.vec3) -> wp.vec2d:
        r = wp.vec2d(wp.float64(-1.0), wp.float64(-1.0))
        if face >= 0:
            if wp.static(has_area):
                index = scene.shapes[scene.triangles[face].shape].emitter
                if index >= 0:
                    emitter = scene.emitters[index]
                    at = triangle_to_square(u, v)
                    if wp.static(exact is not None):
                        tri = scene.triangles[face]
                        if is_primitive(tri):
                            at = exact.square_uniform(tri, u, v)
                    k = emitter.cdf_offset + face - emitter.first_face
                    rest = outside_of(scene.face_cdf, k, wp.float64(at[0]))
                    r = wp.vec2d(outside_of(scene.emitter_cdf, index, rest), wp.float64(at[1]))
        else:
            if wp.static(constant or envmap):
                if scene.environment >= 0:
                    if wp.static(envmap):
                        at = envmap_to_square(scene, scene.emitters[scene.environment], w)
                    else:
                        at = sphere_to_square(w)
                    first = outside_of(scene.emitter_cdf, scene.environment, wp.float64(at[0]))
                    r = wp.vec2d(first, wp.float64(at[1]))
        return r

    return aim_square

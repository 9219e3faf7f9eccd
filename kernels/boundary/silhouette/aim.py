"""Where a segment that touches a shape without triangles leads to: a point of a light, or its direction."""

import functools

import warp as wp

from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_delta_sample
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.reading import load_vec3
from warp_psdr.kernels.sampling import square_to_triangle
from warp_psdr.kernels.scattering import make_light_draw
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import point_on
from warp_psdr.kernels.vertex import PathConfig

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
    u: wp.float32  # fraction of the way around the silhouette


@functools.cache
def make_light_aim(config: PathConfig):
    """Return ``aim(scene, x, u4) -> TangentAim``: a point of a light, or its direction; x is where the shape is."""
    pick, draw = make_light_draw(config)
    area = bool(config.area)
    deltas = make_delta_sample(config.lights) is not None

    @wp.func
    def light_aim(scene: Scene, x: wp.vec3, u4: wp.vec4) -> TangentAim:
        r = TangentAim()
        index, face = pick(scene, wp.vec2(u4[0], u4[1]))
        r.light = index
        r.valid = 1
        if wp.static(area):
            if face >= 0:
                uv = square_to_triangle(wp.vec2(u4[2], u4[3]))
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
        ls = draw(scene, index, -1, Triangle(), x, wp.vec2(u4[2], u4[3]))
        r.eye = ls.wi
        r.distant = True
        r.valid = wp.where(ls.pdf > 0.0, 1, 0)
        return r

    return light_aim

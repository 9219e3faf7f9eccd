"""The frame of a projected image that a line crosses on a surface behind mirrors or glass (``discontinuity.py``).

It is the edge of a hard shadow at distance 1 from the pinhole (``path_space/light_frame.py``).
"""

import warp as wp

from warp_psdr.kernels.boundary.path_space.light_frame import on_screen
from warp_psdr.kernels.boundary.specular.chain_edges import Crossing
from warp_psdr.kernels.boundary.specular.ray_differential import PointDifferential
from warp_psdr.kernels.constants import EMITTER_PROJECTOR
from warp_psdr.kernels.emitter.projector import image_aspect, lies_in_frame, place_in_frame
from warp_psdr.kernels.emitter.spot import load_column
from warp_psdr.kernels.sensor.camera import half_width
from warp_psdr.kernels.structs import Scene


@wp.func
def frame_crossing(
    scene: Scene,
    low: wp.vec3,
    high: wp.vec3,
    a_x: PointDifferential,
    b_x: PointDifferential,
    light: wp.int32,
    last: wp.int32,
) -> Crossing:
    """The side of a projector's frame that ends its light between two points, with the differentials of the first."""
    r = Crossing()
    record = scene.emitters[light]
    if record.kind != EMITTER_PROJECTOR or lies_in_frame(scene, light, low) == lies_in_frame(scene, light, high):
        return r
    o = load_column(scene.values, record.to_world, 3)
    low_place = place_in_frame(scene, record, low - o)
    high_place = place_in_frame(scene, record, high - o)
    place = wp.vec2(low_place[0], low_place[1])
    along = wp.int32(-1)
    for k in range(2):
        for side in range(2):
            border = wp.float32(side)
            if along < 0 and (low_place[k] > border) != (high_place[k] > border):
                place[k] = border
                along = 1 - k
    if along < 0:
        return r
    x_axis = load_column(scene.values, record.to_world, 0)
    y_axis = load_column(scene.values, record.to_world, 1)
    at = on_screen(place, half_width(scene.values[record.cutoff]), image_aspect(scene, record))
    d = at[0] * x_axis + at[1] * y_axis + load_column(scene.values, record.to_world, 2)
    m = wp.cross(load_column(scene.values, record.to_world, along), d)
    distance = wp.length(low - o)
    r.edge = 5
    r.segment.x = o + d
    r.segment.w = -d / wp.length(d)
    r.segment.boundary_normal = m
    r.segment.face2 = -1
    r.segment.u2 = place[0]
    r.segment.v2 = place[1]
    r.segment.light = light
    r.segment.tau = 1.0 - wp.length(d) / distance
    r.last = last
    r.start.x = -(1.0 - r.segment.tau) * m
    r.phi_a = wp.dot(r.start.x, a_x.x)
    r.phi_b = wp.dot(r.start.x, b_x.x)
    r.valid = 1
    return r

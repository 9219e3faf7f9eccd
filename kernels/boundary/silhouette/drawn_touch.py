"""The beginning of a segment that touches a shape without triangles: an item, a point of it, and a direction.

The terms of vacuum (``secondary.py``) and of media (``media_secondary.py``) share it, with or without guiding.

Derivation: ``docs/theory/implicit.md#secondary-silhouettes``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.cube import make_cube
from warp_psdr.kernels.boundary.guiding.techniques import Guide
from warp_psdr.kernels.boundary.silhouette.aim import (
    SLOT_DIRECTION,
    SLOT_SILHOUETTE,
    TangentAim,
    make_light_aim,
    make_square_aim,
)
from warp_psdr.kernels.boundary.silhouette.table import touch_of
from warp_psdr.kernels.boundary.silhouette.touch import DrawnItem
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_drawn_touch(config: PathConfig, family: str, guided: bool, evaluates: bool):
    """Return ``drawn_touch(scene, found, guide, sampler, number, samples) -> (DrawnItem, point, TangentAim)``.

    ``aim.light`` is -1 where the direction is the item's own. Where ``point.valid`` is 0 there is no segment.

    Args:
        config: what the scene needs.
        family: a touch's.
        guided: numbers come from the cells of ``guide``.
        evaluates: ``guide`` gives points of the cube.
    """
    touch = touch_of(family, config.surfaces.primitives, config.sampler)
    items, point_type, choice_of, seen_from, own_at = touch.items, touch.point, touch.choice, touch.seen, touch.own
    draw, draw_guided = touch.draw, touch.draw_guided
    in_cube = guided or evaluates
    lit = bool(config.lights.area or config.lights.others)
    light_aim = make_light_aim(config.lights) if lit and not in_cube else None
    square_aim = make_square_aim(config.lights) if lit and in_cube else None
    cube = make_cube(evaluates) if in_cube else None
    numbers = make_sampler(config.sampler)
    sample_1d = numbers.sample_1d
    sample_4d = numbers.sample_4d

    @wp.func
    def drawn_touch(
        scene: Scene, found: items, guide: Guide, sampler: Sampler, number: wp.int32, samples: wp.int32
    ) -> tuple[DrawnItem, point_type, TangentAim]:
        u4 = sample_4d(sampler, SLOT_DIRECTION)
        # Edges take the direction from these numbers, surfaces one or two coordinates of the place, and theta.
        u3 = wp.vec3(u4[0], u4[1], u4[2])
        drawn = DrawnItem()
        own = wp.bool(True)
        if wp.static(in_cube):
            at = cube(guide, found.share, number, samples, u4)
            own = at.own
            u3 = wp.vec3(wp.float32(at.u[1]), wp.float32(at.u[2]), wp.float32(at.u[1]))
            drawn = draw_guided(found, own, at.u[0], at.weight)
        else:
            u = (wp.float64(number) + wp.float64(sample_1d(sampler, SLOT_SILHOUETTE))) / wp.float64(samples)
            own = u < wp.float64(found.share)
            if own:
                u = u / wp.float64(found.share)
            else:
                u = (u - wp.float64(found.share)) / wp.float64(1.0 - found.share)
            drawn = draw(found, own, u)
        choice = choice_of(sampler, False)
        aim = TangentAim()
        aim.light = -1
        point = point_type()
        if own:
            own_point, w = own_at(scene, found, drawn, u3, choice)
            point = own_point
            aim.w = w
        if wp.static(lit):
            if not own:
                center = scene.triangles[drawn.face].normal
                if wp.static(in_cube):
                    aim = square_aim(scene, center, at.u[1], at.u[2])
                else:
                    aim = light_aim(scene, center, u4)
                if aim.valid == 1:
                    point = seen_from(scene, found, drawn, aim.eye, aim.distant, choice)
                    aim.w = aim.eye
                    if not aim.distant:
                        aim.w = wp.normalize(aim.eye - point.x)
        return drawn, point, aim

    return drawn_touch

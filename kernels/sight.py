"""What the camera's rays meet: everything, or where lights are hidden (``hide_emitters``), all but area lights.

A structure of their own, without the lights, and no rays that go on behind what they met: a step past a light would
cross what touches it.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import Accel
from warp_psdr.kernels.structs import Scene


@functools.cache
def make_sight(hidden: bool):
    """Return ``sight(scene) -> Accel``."""

    @wp.func
    def sight(scene: Scene) -> Accel:
        if wp.static(hidden):
            return scene.sight
        return scene.accel

    return sight


@functools.cache
def make_accel_at(hidden: bool):
    """Return ``accel_at(scene, depth) -> Accel`` for rays behind ``depth`` path vertices: the camera's own at 0."""
    sight = make_sight(hidden)

    @wp.func
    def accel_at(scene: Scene, depth: wp.int32) -> Accel:
        if wp.static(hidden):
            if depth == 0:
                return sight(scene)
        return scene.accel

    return accel_at

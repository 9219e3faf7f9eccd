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

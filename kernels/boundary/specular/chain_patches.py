"""Patches of shapes without triangles, which tell apart the surfaces of a chain (``specular_chain.py``).

A shape may stand in front of itself, so that two rays of a chain meet one shape, but not one surface. A *patch* is a
voxel of a linear grid (the normal jumps to the next one), a block of voxels of a cubic grid, the segment of a curve, or
the side of an exact shape.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.primitive.table import join, kinds_of
from warp_psdr.kernels.structs import Scene, Triangle


@wp.func
def no_patch(scene: Scene, tri: Triangle, u: wp.float32, v: wp.float32) -> wp.int32:
    """What shapes have that their sides alone tell apart."""
    return -1


@functools.cache
def make_patch(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``patch(scene, face, u, v, facing) -> int`` of the point (u, v) of a record; None: there are none.

    ``facing``: 1 if the ray arrives on the front of its normal.
    """
    of_kind = join("patch_of_kind", {kind.number: kind.patch or no_patch for kind in kinds_of(primitives)})
    if of_kind is None:
        return None

    @wp.func
    def patch(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, facing: wp.int32) -> wp.int32:
        found = of_kind(scene, scene.triangles[face], u, v)
        return wp.where(found < 0, facing, found)

    return patch

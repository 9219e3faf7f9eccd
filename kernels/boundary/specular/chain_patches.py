"""Patches of shapes without triangles, which tell apart the surfaces of a chain (``specular_chain.py``).

A shape may stand in front of itself, so that two rays of a chain meet one shape, but not one surface. A *patch* is a
voxel of a linear grid (the normal jumps to the next one), a block of voxels of a cubic grid, the segment of a curve, or
the side of an exact shape.

Derivation: ``docs/theory/specular.md#outlines-of-shapes-without-triangles``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.crossing.levels import voxel_of
from warp_psdr.kernels.constants import PRIMITIVE_NEURALSDF
from warp_psdr.kernels.primitive.curves_surface import held_on
from warp_psdr.kernels.primitive.dispatch import (
    BOXED,
    CURVES,
    is_bspline,
    is_cubic,
    is_grid,
    is_linear,
    is_network,
)
from warp_psdr.kernels.primitive.network import network_of
from warp_psdr.kernels.primitive.sdfgrid import grid_of, unpack
from warp_psdr.kernels.structs import Scene, Triangle

#: Halvings of the number of a voxel of smooth grids, and a cell of networks, to that of a block.
BLOCK = 1


@wp.func
def cells_of(scene: Scene, tri: Triangle) -> wp.vec3:
    """Number of voxels of a grid, or of cells of a network, along its axes."""
    if is_network(tri):
        return network_of(scene, tri).cells
    return grid_of(scene, tri).cells


@functools.cache
def make_patch(primitives: tuple[int, ...]) -> wp.Function | None:
    """Return ``patch(scene, face, u, v, facing) -> int`` of the point (u, v) of a record; None: there are none.

    ``facing``: 1 if the ray arrives on the front of its normal.
    """
    if not primitives:
        return None
    boxed = bool(set(BOXED) & set(primitives))
    networks = PRIMITIVE_NEURALSDF in primitives
    curves = bool(set(CURVES) & set(primitives))

    @wp.func
    def patch(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, facing: wp.int32) -> wp.int32:
        tri = scene.triangles[face]
        if wp.static(curves):
            if is_linear(tri) or is_bspline(tri):
                segment, _along = held_on(u, v)
                return segment
        if wp.static(boxed):
            if is_grid(tri) or is_network(tri):
                g = grid_of(scene, tri)
                if wp.static(networks):
                    if is_network(tri):
                        g = network_of(scene, tri)
                at = voxel_of(g, wp.cw_mul(g.cells, unpack(u, v)))
                less = wp.where(is_cubic(tri) or is_network(tri), BLOCK, 0)
                return ((at[2] >> less) * g.ny + (at[1] >> less)) * g.nx + (at[0] >> less)
        return facing

    return patch

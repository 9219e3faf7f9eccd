"""The families of shapes without triangles whose silhouettes the boundary terms know; a new one is a file and a row.

A new exact kind needs no row: the family ``exact`` reads what its record declares.
"""

import functools
from collections.abc import Callable

from warp_psdr.kernels.boundary.silhouette.exact_touch import make_exact_touch
from warp_psdr.kernels.boundary.silhouette.grid_sampling import CREASES, LINEAR_VOXELS
from warp_psdr.kernels.boundary.silhouette.grid_touch import make_grid_touch
from warp_psdr.kernels.boundary.silhouette.network_points import NETWORK_CELLS
from warp_psdr.kernels.boundary.silhouette.spline_points import CUBIC_VOXELS
from warp_psdr.kernels.boundary.silhouette.touch import Touch
from warp_psdr.kernels.boundary.silhouette.tube_touch import make_tube_touch

#: Family -> maker of its functions for the kinds of shapes without triangles of a scene and a kind of sampler.
TOUCHES: dict[str, Callable[[tuple[int, ...], str], Touch]] = {
    "exact": make_exact_touch,
    "grid": functools.partial(make_grid_touch, voxels=LINEAR_VOXELS),
    "cubic": functools.partial(make_grid_touch, voxels=CUBIC_VOXELS),
    "network": functools.partial(make_grid_touch, voxels=NETWORK_CELLS),
    "tubes": make_tube_touch,
    # Not a family of its own: what grids show from the front.
    "grid creases": functools.partial(make_grid_touch, voxels=CREASES),
}


def touch_of(family: str, primitives: tuple[int, ...], sampler_kind: str) -> Touch:
    """Return the functions of a family for a scene."""
    return TOUCHES[family](primitives, sampler_kind)

"""The kernels that find where triangles meet: where they run through each other, and where they touch."""

import warp as wp

from warp_psdr.kernels.boundary.path_space.crossing import make_crossing_packets, make_crossing_triangles
from warp_psdr.kernels.boundary.touching import make_touching_pairs


def make_pair_kernels(width: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return the kernels ``crossing_pairs`` and ``touching_pairs``: both, for they share a module.

    Args:
        width: lanes of the wide BVH; 1: there is none.
    """
    crossing = make_crossing_packets(width) if width > 1 else make_crossing_triangles()
    return crossing, make_touching_pairs(width)

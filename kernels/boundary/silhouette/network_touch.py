"""Networks of signed distances as a family of touches: cubic grids (``grid_touch.py``) with cells for voxels.

Derivation: ``docs/theory/implicit.md#silhouettes-of-networks``.
"""

import functools

from warp_psdr.kernels.boundary.silhouette.grid_points import make_touch_sink
from warp_psdr.kernels.boundary.silhouette.grid_touch import CUBIC
from warp_psdr.kernels.boundary.silhouette.network_points import network_curve_point, network_surface_point
from warp_psdr.kernels.primitive.network import network_of

NETWORK = CUBIC._replace(
    record=network_of,
    seen=network_curve_point,
    place=network_surface_point,
    make_sink=functools.partial(make_touch_sink, network=True),
)

"""The kinds of shapes with a signed distance; a new kind is a file and a row of this table."""

from warp_psdr.kernels.boundary.signed_distance.cubic_distance import CUBIC
from warp_psdr.kernels.boundary.signed_distance.distance import Field
from warp_psdr.kernels.boundary.signed_distance.network_distance import NETWORK
from warp_psdr.kernels.boundary.signed_distance.sphere_distance import SPHERE
from warp_psdr.kernels.primitive import cubic_grid, network_kind, sphere

#: Number of a kind -> its functions.
FIELDS: dict[int, Field] = {
    sphere.SPHERE.number: SPHERE,
    cubic_grid.CUBIC_GRID.number: CUBIC,
    network_kind.NETWORK.number: NETWORK,
}

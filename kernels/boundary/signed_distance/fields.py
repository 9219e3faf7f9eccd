"""The kinds of shapes with a signed distance; a new kind is a file and a row of this table."""

from warp_psdr.kernels.boundary.signed_distance.cubic_distance import CUBIC
from warp_psdr.kernels.boundary.signed_distance.distance import Field
from warp_psdr.kernels.boundary.signed_distance.network_distance import NETWORK
from warp_psdr.kernels.boundary.signed_distance.sphere_distance import SPHERE
from warp_psdr.kernels.constants import PRIMITIVE_NEURALSDF, PRIMITIVE_SDFGRID_CUBIC, PRIMITIVE_SPHERE

#: Kind (PRIMITIVE_*) -> its functions.
FIELDS: dict[int, Field] = {
    PRIMITIVE_SPHERE: SPHERE,
    PRIMITIVE_SDFGRID_CUBIC: CUBIC,
    PRIMITIVE_NEURALSDF: NETWORK,
}

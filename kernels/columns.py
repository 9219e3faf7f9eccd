"""Several images side by side on one film."""

import warp as wp

from warp_psdr.kernels.modules import wide_vectors


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def place_columns(
    # In:
    part: wp.array2d(dtype=wp.vec3),
    first: wp.int32,
    # Out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Write an image into another one of the same height, from column ``first`` on; one thread a pixel."""
    y, x = wp.tid()
    image_out[y, first + x] = part[y, x]

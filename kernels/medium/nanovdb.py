"""Values of a NanoVDB grid as a dense grid, which kernels read and differentiate by."""

import warp as wp

from warp_psdr.kernels.modules import wide_vectors


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def dense_floats(grid: wp.uint64, low: wp.vec3i, out: wp.array(dtype=wp.float32, ndim=3)):
    """Fill ``out`` (Z, Y, X) with the values of a grid of floats from voxel ``low`` on."""
    z, y, x = wp.tid()
    out[z, y, x] = wp.volume_lookup_f(grid, low[0] + x, low[1] + y, low[2] + z)


@wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
def dense_vectors(grid: wp.uint64, low: wp.vec3i, out: wp.array(dtype=wp.vec3, ndim=3)):
    """Fill ``out`` (Z, Y, X) with the values of a grid of 3-vectors from voxel ``low`` on."""
    z, y, x = wp.tid()
    out[z, y, x] = wp.volume_lookup_v(grid, low[0] + x, low[1] + y, low[2] + z)

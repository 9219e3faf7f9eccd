"""Sums of gradients and images as they end: rounded, and added to what they belong to."""

import warp as wp

from warp_psdr.kernels.modules import SCENE


@wp.kernel(module=SCENE, enable_backward=False)
def round_range(
    # In:
    total: wp.array(dtype=wp.float64),
    offset: wp.int32,
    # Out:
    total_out: wp.array(dtype=wp.float32),
):
    """Round the values ``offset`` ... up of a sum."""
    i = offset + wp.tid()
    total_out[i] = wp.float32(total[i])


@wp.kernel(module=SCENE, enable_backward=False)
def add_range(
    # In:
    total: wp.array(dtype=wp.float32),
    offset: wp.int32,
    # In and out:
    grad_out: wp.array(dtype=wp.float32),
):
    """Add a stretch of the flat gradient to a parameter's own."""
    i = wp.tid()
    grad_out[i] = grad_out[i] + total[offset + i]


@wp.kernel(module=SCENE, enable_backward=False)
def add_image(
    # In:
    part: wp.array2d(dtype=wp.vec3),
    # In and out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Add an image to another."""
    y, x = wp.tid()
    image_out[y, x] = image_out[y, x] + part[y, x]

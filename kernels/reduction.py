"""Sums over the lanes' gradients and images, in a fixed order."""

import warp as wp

from warp_psdr.kernels.modules import SCENE


@wp.kernel(module=SCENE, enable_backward=False)
def add_lanes(
    # In:
    lanes: wp.array2d(dtype=wp.float64),
    offset: wp.int32,
    # Out:
    total_out: wp.array(dtype=wp.float32),
):
    """Add the lanes' values ``offset`` ... up, always in the same order, and round the total."""
    i = offset + wp.tid()
    total = wp.float64(0.0)
    for lane in range(lanes.shape[0]):
        total += lanes[lane, i]
    total_out[i] = wp.float32(total)


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
def add_images(
    # In:
    lanes: wp.array3d(dtype=wp.vec3),
    # In and out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Add the lanes' images to an image, always in the same order."""
    y, x = wp.tid()
    total = image_out[y, x]
    for lane in range(lanes.shape[0]):
        total += lanes[lane, y, x]
    image_out[y, x] = total

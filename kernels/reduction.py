"""Fixed-order sums over the lanes' gradient buffers.

A buffer is float32, and its sum of n terms of one sign has a relative error of some 2^-25 sqrt(n), or n 2^-25 if all
terms are equal and are rounded in the same direction; after 2^24 of them it stands still. So the host adds the lanes to
a total in double precision every so many samples.
"""

import warp as wp


@wp.kernel(module="unique", enable_backward=False)
def add_lanes(
    # In and out:
    lanes: wp.array2d(dtype=wp.float32),
    offset: wp.int32,
    # Out:
    total_out: wp.array(dtype=wp.float64),
):
    """Add the lanes' values ``offset`` ..., always in the same order, and clear them."""
    i = offset + wp.tid()
    total = total_out[i]
    for lane in range(lanes.shape[0]):
        total += wp.float64(lanes[lane, i])
        lanes[lane, i] = 0.0
    total_out[i] = total


@wp.kernel(module="unique", enable_backward=False)
def round_range(
    # In:
    total: wp.array(dtype=wp.float64),
    offset: wp.int32,
    # Out:
    total_out: wp.array(dtype=wp.float32),
):
    """Round a stretch of the total to float32."""
    i = offset + wp.tid()
    total_out[i] = wp.float32(total[i])


@wp.kernel(module="unique", enable_backward=False)
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


@wp.kernel(module="unique", enable_backward=False)
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

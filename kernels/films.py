"""Films: sums in double precision, the images that they give, and their channels."""

import warp as wp

from warp_psdr.kernels.modules import SCENE


@wp.kernel(module=SCENE, enable_backward=False)
def collect_band(
    # In:
    band: wp.array2d(dtype=wp.vec4),
    first_row: wp.int32,
    # In and out:
    film_out: wp.array2d(dtype=wp.vec4d),
):
    """Add a band of a film's rows to the film, in double precision."""
    row, column = wp.tid()
    film_out[first_row + row, column] = film_out[first_row + row, column] + wp.vec4d(band[row, column])


@wp.kernel(module=SCENE, enable_backward=False)
def resolve(
    # In:
    film: wp.array2d(dtype=wp.vec4d),
    # Out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Divide by the weights."""
    row, column = wp.tid()
    total = film[row, column]
    if total[3] > wp.float64(0.0):
        image_out[row, column] = wp.vec3(wp.vec3d(total[0], total[1], total[2]) / total[3])


@wp.kernel(module=SCENE, enable_backward=False)
def collect_splats(
    # In and out:
    films: wp.array3d(dtype=wp.vec3),
    totals_out: wp.array3d(dtype=wp.vec3d),
):
    """Add the lanes' films to those in double precision, and clear them."""
    lane, row, column = wp.tid()
    totals_out[lane, row, column] = totals_out[lane, row, column] + wp.vec3d(films[lane, row, column])
    films[lane, row, column] = wp.vec3()


@wp.kernel(module=SCENE, enable_backward=False)
def add_splats(
    # In:
    total: wp.array2d(dtype=wp.vec3d),
    # In and out:
    image_out: wp.array2d(dtype=wp.vec3),
):
    """Add the light paths' part to an image."""
    row, column = wp.tid()
    image_out[row, column] = wp.vec3(wp.vec3d(image_out[row, column]) + total[row, column])


@wp.kernel(module=SCENE, enable_backward=False)
def take_channel(
    # In:
    image: wp.array2d(dtype=wp.vec3),
    # Out:
    channel_out: wp.array2d(dtype=wp.float32),
):
    """Take the first channel of an image, whose channels are equal."""
    row, column = wp.tid()
    channel_out[row, column] = image[row, column][0]


@wp.kernel(module=SCENE, enable_backward=False)
def give_channel(
    # In:
    adjoint: wp.array2d(dtype=wp.float32),
    # In and out:
    adjoint_out: wp.array2d(dtype=wp.vec3),
):
    """Add the adjoint of the first channel to that of an image."""
    row, column = wp.tid()
    adjoint_out[row, column] = adjoint_out[row, column] + wp.vec3(adjoint[row, column], 0.0, 0.0)

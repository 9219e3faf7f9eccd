"""Films that several lanes of a launch have written: their sums in fixed order, in double precision, and the images."""

import warp as wp

from warp_psdr.kernels.modules import SCENE


@wp.kernel(module=SCENE, enable_backward=False)
def collect(
    # In and out:
    films: wp.array3d(dtype=wp.vec4),
    # Out:
    film_out: wp.array2d(dtype=wp.vec4d),
):
    """Add the lanes' films in fixed order to one in double precision, and clear them."""
    row, column = wp.tid()
    total = film_out[row, column]
    for lane in range(films.shape[0]):
        total += wp.vec4d(films[lane, row, column])
        films[lane, row, column] = wp.vec4()
    film_out[row, column] = total


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
    # Out:
    total_out: wp.array2d(dtype=wp.vec3d),
):
    """Add the lanes' films in fixed order to one in double precision, and clear them."""
    row, column = wp.tid()
    total = total_out[row, column]
    for lane in range(films.shape[0]):
        total += wp.vec3d(films[lane, row, column])
        films[lane, row, column] = wp.vec3()
    total_out[row, column] = total


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

"""The samples that one launch draws: samples of pixels, or samples of a boundary term, in one record.

Every kernel takes the scene, its own inputs, a job, and its outputs. A job is a range of numbered samples with a seed.
Disjoint ranges are independent, and their results add up.
"""

import functools

import warp as wp

from warp_psdr.kernels.structs import Camera


@wp.struct
class PixelJob:
    """Samples ``first_sample`` ... of some pixels: one thread a pixel."""

    pixels: wp.array(dtype=wp.int32)  # numbers in the raster, row * width + column, in the order of the threads
    first_pixel: wp.int32  # of this launch, in that list
    pixel_count: wp.int32
    margin: wp.int32  # by which the raster exceeds the image on each side, pixels
    first_film_row: wp.int32  # of the image, of a film that holds a band of its rows
    first_sample: wp.int32
    samples: wp.int32  # of each pixel
    scale: wp.float32  # of what they give: 1 over all of a pixel's samples
    seed: wp.uint32
    max_depth: wp.int32  # most path vertices, -1: no limit
    rr_depth: wp.int32  # vertex from which on Russian roulette ends paths
    image_adjoint: wp.array2d(dtype=wp.vec3)  # where a pass reads it; Warp takes ``job.adjoint[...]`` for its own


@wp.struct
class SampleJob:
    """Samples ``first`` ... of the ``samples`` of a boundary term: one thread a sample."""

    first: wp.int32
    samples: wp.int32  # of the term, all launches together
    seed: wp.uint32
    max_depth: wp.int32
    rr_depth: wp.int32
    image_adjoint: wp.array2d(dtype=wp.vec3)


@wp.struct
class Pixel:
    """A pixel of the crop window."""

    number: wp.int32  # row * width + column, which its samples are seeded with
    px: wp.int32
    py: wp.int32


@wp.func
def pixel_of(job: PixelJob, camera: Camera, thread: wp.int32) -> Pixel:
    """The pixel of a thread, in a raster without a margin."""
    pixel = Pixel()
    pixel.number = job.pixels[job.first_pixel + thread]
    pixel.px = pixel.number % camera.crop_width
    pixel.py = pixel.number // camera.crop_width
    return pixel


@functools.cache
def make_sample_weight(role: str) -> wp.Function:
    """Return ``weight(job, pixel) -> vec3``: what a sample's derivative counts, in reverse mode by the adjoint."""

    @wp.func
    def sample_weight(job: PixelJob, pixel: Pixel) -> wp.vec3:
        weight = wp.vec3(job.scale, job.scale, job.scale)
        if wp.static(role == "reverse"):
            weight = job.scale * job.image_adjoint[pixel.py, pixel.px]
        return weight

    return sample_weight

"""The image by light tracing: paths from the lights, whose vertices are joined to the camera and splatted.

The flux that a vertex sends to the camera counts for every pixel under whose filter it lies, with the weights of
``sensor/film.py``, which are those of the path tracer's images. On the CPU every lane of a launch has a film of its
own, which ``films.collect_splats`` adds to sums in double precision every so many samples.

Derivation: ``docs/theory/light_tracing.md#film-weights``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bidirectional_path import make_light_walk
from warp_psdr.kernels.invalid import count_invalid
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.light_path import light_sampler
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_light_image_kernel(config: PathConfig):
    """Return the kernel: one thread as many light paths as a pixel has samples."""
    _record, start, step = make_light_walk(config, False)
    splat, _gather = make_splat()

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_image(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        # Out:
        film_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.pixels[job.first_pixel + wp.tid()]
        for i in range(job.samples):
            sampler = light_sampler(job, camera, number, i)
            ray, state = start(scene, sphere, sampler)
            while state.alive == 1:
                vertex, state = step(scene, camera, sampler, state, job.max_depth, job.rr_depth)
                if vertex.invalid == 1:
                    count_invalid(scene, sampler)
                if vertex.joined == 1:
                    value = job.scale * wp.cw_mul(ray.flux, wp.cw_mul(vertex.throughput, vertex.value))
                    splat(scene, sampler, camera, vertex.pixel, value, film_out)

    return light_image

"""The image of a transient film: light of every path length in bins of its own [WCRZ21, YKC*21].

The path loop is that of ``path.py``. The light of a vertex goes to the bins of its path length
(``sensor/time_gate.py``) and not to the path's radiance. Camera rays are drawn from the pixel filter, so a sample
counts in one pixel.

Derivation: ``docs/theory/transient.md``.
"""

import functools

import warp as wp

from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path_length import make_timed_vertex
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_origin
from warp_psdr.kernels.sensor.time_gate import TimeGates, make_time_gate
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState


@functools.cache
def make_transient_kernel(config: PathConfig):
    """Return the kernel: one thread a pixel, all its samples in order.

    ``film_out``: (H, W bins) of vec3d, receives the mean over the samples.
    """
    lanes, starts, path_step = make_camera_paths(config, False)
    camera_origin = make_camera_origin(config.camera)
    timed_vertex = make_timed_vertex(config.surfaces, config.lights)
    gate = make_time_gate(config.pulse)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def transient(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        gates: TimeGates,
        job: PixelJob,
        # Out:
        film_out: wp.array2d(dtype=wp.vec3d),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            length = wp.float32(0.0)
            first = wp.bool(True)
            dropped = wp.bool(False)
            while state.alive == 1:
                eta = state.eta
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if first:
                    vertex.o = camera_origin(scene, camera, sample)
                timed = timed_vertex(scene, gates, vertex, first, eta, length)
                length = timed.length
                first = wp.bool(False)
                if finite(wp.cw_mul(vertex.throughput, vertex.direct)):
                    factor = job.scale * vertex.throughput
                    gate.add(gates, length, wp.cw_mul(factor, timed.emission), pixel.py, pixel.px, film_out)
                    late = length + timed.link
                    gate.add(gates, late, wp.cw_mul(factor, timed.direct), pixel.py, pixel.px, film_out)
                else:
                    dropped = wp.bool(True)
            if dropped:
                count_invalid(scene, sampler)

    return transient

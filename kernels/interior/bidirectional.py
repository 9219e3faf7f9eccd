"""Derivatives of bidirectional paths, by record and sweep [VSJ21], in both modes.

Weights and sampling are detached. A camera path is differentiated as in replay, with the weights that
``bidirectional_path.py`` gives to its emission and next-event estimates, and a light path as in light tracing
(``light_tracing.py``). In forward mode the sweep runs once for each channel.

Derivation: ``docs/theory/light_tracing.md#derivatives-of-weighted-paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bidirectional_path import CameraWalk, make_camera_walk, make_walk_from
from warp_psdr.kernels.camera_rays import make_bundled_starts, rays_together
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@functools.cache
def make_bidirectional_kernel(config: PathConfig, wanted: GradientRequest, role: str, block: int, blocks: int):
    """Return the kernel of the paths from the camera; arguments as ``make_replay_kernel``'s.

    Role "reverse": ``target`` receives the gradient; "forward": it holds the tangents, ``image_out`` receives the
    derivative.
    """
    lanes = rays_together(config.rays, config.surfaces.primitives)
    starts = make_bundled_starts(config)
    camera_walk = make_camera_walk(config, True, lanes > 1)
    walk_from = make_walk_from(config.camera)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, finish, _finish_vertex = make_sweep(config, wanted, role)
    sample_weight = make_sample_weight(role)
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def bidirectional(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        delta = sample_weight(job, pixel)
        if vanishes(delta):
            return
        derivative = wp.vec3d()  # in double precision, as the image
        record = wp.zeros(shape=(wp.static(block),), dtype=PathVertex)
        walks = wp.zeros(shape=(wp.static(blocks),), dtype=CameraWalk)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            origin = camera_origin(scene, camera, sample)
            walk = walk_from(state, sample)
            count = wp.int32(0)
            while walk.path.alive == 1:
                if wp.static(blocks > 1):
                    if count % wp.static(block) == 0:
                        walks[count // wp.static(block)] = walk
                vertex, walk = camera_walk(scene, camera, sampler, walk, job.max_depth, job.rr_depth)
                if count == 0:
                    vertex.o = origin
                record[count % wp.static(block)] = vertex
                count += 1
            loaded = (count - 1) // wp.static(block)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            valid = wp.bool(True)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                carry = Carry()
                carry.face = -2
                n = count - 1
                while n >= 0:
                    if wp.static(blocks > 1):
                        if n // wp.static(block) != loaded:
                            loaded = n // wp.static(block)
                            again = walks[loaded]
                            for j in range(wp.static(block)):
                                if again.path.alive == 1:
                                    vertex, again = camera_walk(
                                        scene, camera, sampler, again, job.max_depth, job.rr_depth
                                    )
                                    if loaded == 0 and j == 0:
                                        vertex.o = origin
                                    record[j] = vertex
                    carry = sweep(scene, target, record[n % wp.static(block)], weight, carry)
                    n -= 1
                of_sample += finish(scene, target, camera, sample, carry) * axis_vec3(channel)
                valid = valid and finite(carry.radiance)
            valid = valid and finite(of_sample)
            if wp.static(not forward):
                valid = valid and vanishes(of_sample)
            if not valid:
                count_invalid(scene, sampler)
            elif wp.static(forward):
                derivative += wp.vec3d(of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return bidirectional

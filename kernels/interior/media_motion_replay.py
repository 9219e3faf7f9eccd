"""The interior term of motions in media, by record and sweep, in both modes [ZYZ21].

``media_replay.py`` holds the kernel of all other derivatives. Here each step also keeps the point where the direction
of its ray was drawn, and the first surface behind it that is no interface; the ray is attached to both.

Derivation: ``docs/theory/media.md#what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import LOBE_NULL
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.media_motion import MovedCarry, make_moved_sweep
from warp_psdr.kernels.interior.factors.moved_step import MovedStep, make_stretch
from warp_psdr.kernels.invalid import finite, make_derivative_of_sample, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.medium.interface import make_interface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, steps_kept
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import MediaState, make_media_step, media_path_from
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_origin
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class MovedState:
    """What one step hands to the next."""

    media: MediaState
    start: wp.vec3  # where the direction of its ray was drawn
    reach: wp.float32  # as of a ``MovedStep``


@functools.cache
def make_media_motion_kernel(config: PathConfig, wanted: GradientRequest, role: str, block: int, longest: int):
    """Return the kernel.

    Args:
        config: what the scene needs.
        wanted: what of all that moves is differentiated.
        role: "reverse" or "forward".
        block: the number of vertices kept at a time; interfaces come on top.
        longest: most vertices of a path; the surfaces that it passes without a change of direction come on top.
    """
    start = make_camera_start(config)
    camera_origin = make_camera_origin(config.camera)
    assert config.media is not None
    # In grids the slope of the density is divided by what is drawn, which has to stay away from 0.
    media_step = make_media_step(config, True, config.media.grids)
    emissive = config.media.emissive
    moved_sweep, finish = make_moved_sweep(config, wanted, role)
    is_interface, behind_of = make_interface(config)
    _stretch_of, reach_of = make_stretch(config.media.grids, config.surfaces.primitives)
    channels = 3 if role == "forward" else 1
    derivative_of_sample = make_derivative_of_sample(role)
    sample_weight = make_sample_weight(role)
    room = steps_kept(block)
    blocks = -(-(longest + MOST_INTERFACES + 1) // room)

    @wp.func
    def channel_of(delta: wp.vec3, channel: wp.int32) -> wp.vec3:
        if wp.static(role == "reverse"):
            return delta
        weight = wp.vec3(0.0, 0.0, 0.0)
        weight[channel] = delta[channel]
        return weight

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def media_motion(
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
        record = wp.zeros(shape=(wp.static(room),), dtype=MovedStep)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=MovedState)
        carries = wp.zeros(shape=(wp.static(channels),), dtype=MovedCarry)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            started, sample = start(scene, camera, pixel.px, pixel.py, sampler)
            state = MovedState()
            state.media = media_path_from(started, camera.medium)
            state.start = camera_origin(scene, camera, sample)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            for channel in range(wp.static(channels)):
                none = MovedCarry()
                none.end.face = -2
                carries[channel] = none
            # Blocks are traced from the first to the last, and swept, and traced again, from the last to the first.
            b = wp.int32(0)
            tracing = wp.bool(True)
            while b >= 0:
                states[b] = state
                count = wp.int32(0)
                while state.media.path.alive == 1 and count < wp.static(room):
                    path = state.media.path
                    kept = MovedStep()
                    kept.start = state.start
                    kept.reach = state.reach
                    kept.before = wp.dot(path.o - state.start, path.d)
                    vertex, after = media_step(scene, sampler, state.media, job.max_depth, job.rr_depth)
                    kept.step = vertex
                    hit = RayHit()
                    hit.face = vertex.surface.face
                    hit.u = vertex.surface.u
                    hit.v = vertex.surface.v
                    if vertex.collides:
                        hit = behind_of(scene, hit, path.d, path.t_max, path.depth)
                    kept.face = hit.face
                    kept.u = hit.u
                    kept.v = hit.v
                    record[count] = kept
                    count += 1
                    passes = vertex.surface.lobe == LOBE_NULL and is_interface(scene, vertex.surface.face)
                    if vertex.collides or not passes:
                        state.start = after.path.o
                        state.reach = 0.0
                    if vertex.collides:
                        state.reach = reach_of(scene, kept)
                    state.media = after
                    if tracing:
                        radiance += wp.cw_mul(vertex.surface.throughput, vertex.surface.direct)
                        if wp.static(emissive):
                            radiance += wp.cw_mul(vertex.before, vertex.emitted)
                if tracing and state.media.path.alive == 1:
                    b += 1
                else:
                    tracing = False
                    for n in range(count):
                        kept = record[count - 1 - n]
                        for channel in range(wp.static(channels)):
                            weight = channel_of(delta, channel)
                            carries[channel] = moved_sweep(scene, target, sampler, kept, weight, carries[channel])
                            of_sample[channel] = of_sample[channel] + carries[channel].end.dot
                    b -= 1
                    if b >= 0:
                        state = states[b]
            for channel in range(wp.static(channels)):
                of_sample[channel] = of_sample[channel] + finish(scene, target, camera, sample, carries[channel])
            derivative += derivative_of_sample(scene, sampler, finite(radiance), of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return media_motion

"""The differential radiative transfer equation [ZWZ*19] for motions, with boundary terms of its own, in both modes.

The derivative of radiance obeys the same equation: a path is drawn as for an image, recorded, and swept once
(``transfer_sweep.py``). Further paths (``transfer_sphere.py``) are drawn at the ends of its flights, where surfaces
sweep the medium, and at each of its vertices, on surfaces and in the medium, for one edge that the vertex sees. Path
replay (``media_replay.py``) differentiates by everything that moves nothing; its equation is the same.

Derivation: ``docs/theory/media.md#the-differential-equation``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.constants import LOBE_NULL
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.invalid import finite, make_derivative_of_sample, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.medium.passage import MOST_INTERFACES
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import MediaState, make_media_step, media_path_from
from warp_psdr.kernels.rng import Sampler, salted, sampler_at
from warp_psdr.kernels.sensor.camera import make_camera_origin
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.transfer.transfer_sphere import SphereEdge, make_in_scattering, make_sphere_edge
from warp_psdr.kernels.transfer.transfer_sweep import FlightEnds, TransferCarry, TransferStep, make_transfer_sweep
from warp_psdr.kernels.vertex import PathConfig

#: Tells the random numbers at the ends of flights and at vertices from those of the path: their purposes at a step.
SALT = wp.constant(wp.uint32(0x510E527F))
NEAR_END, FAR_END, EDGE, PURPOSES = 0, 1, 2, 3


@wp.struct
class TransferState:
    """What one step hands to the next."""

    media: MediaState
    start: wp.vec3  # where the direction of its ray was drawn
    crossed: wp.bool  # the ray has just crossed an interface


@functools.cache
def make_transfer_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, block: int, longest: int, sees_edges: bool
):
    """Return the kernel.

    Args:
        config: what the scene needs.
        wanted: what of all that moves is differentiated.
        role: "reverse" or "forward".
        block: the number of steps kept at a time.
        longest: most vertices of a path; the surfaces that it passes without a change of direction come on top.
        sees_edges: the boundary of the sphere of directions is sampled.
    """
    start = make_camera_start(config)
    camera_origin = make_camera_origin(config.camera)
    media_step = make_media_step(config, True)
    transfer_sweep, finish = make_transfer_sweep(config, wanted, role, sees_edges)
    in_scattering = make_in_scattering(config)
    sphere_edge = make_sphere_edge(config) if sees_edges else None
    channels = 3 if role == "forward" else 1
    derivative_of_sample = make_derivative_of_sample(role)
    sample_weight = make_sample_weight(role)
    blocks = -(-(longest + MOST_INTERFACES + 1) // block)

    @wp.func
    def channel_of(delta: wp.vec3, channel: wp.int32) -> wp.vec3:
        if wp.static(role == "reverse"):
            return delta
        weight = wp.vec3(0.0, 0.0, 0.0)
        weight[channel] = delta[channel]
        return weight

    @wp.func
    def around(
        scene: Scene, edges: Edges, sampler: Sampler, s: TransferStep, max_depth: wp.int32, rr_depth: wp.int32
    ) -> tuple[FlightEnds, SphereEdge]:
        """What a step gathers besides its path."""
        ends = FlightEnds()
        edge = SphereEdge()
        v = s.step
        if max_depth < 0 or s.depth + 1 < max_depth:
            o = v.surface.o
            d = v.surface.d
            if v.medium >= 0:
                end = wp.int32(wp.where(s.crossed, NEAR_END, NEAR_END + 1))
                while end <= FAR_END:
                    if end == NEAR_END or (v.surface.face >= 0 and not v.collides):
                        t = wp.where(end == NEAR_END, wp.min(s.inner, v.length), v.length)
                        branch = salted(sampler, SALT, PURPOSES * v.step + end)
                        found = in_scattering(scene, branch, v.medium, s.depth, o, d, t, max_depth, rr_depth)
                        if end == NEAR_END:
                            ends.near = found
                        else:
                            ends.far = found
                    end += 1
            if wp.static(sees_edges):
                if v.collides or (v.surface.face >= 0 and v.surface.lobe != LOBE_NULL):
                    branch = salted(sampler, SALT, PURPOSES * v.step + EDGE)
                    edge = sphere_edge(scene, edges, branch, v, s.depth, max_depth, rr_depth)
        return ends, edge

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def radiative_transfer(
        # Scene:
        scene: Scene,
        camera: Camera,
        edges: Edges,
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
        record = wp.zeros(shape=(wp.static(block),), dtype=TransferStep)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=TransferState)
        carries = wp.zeros(shape=(wp.static(channels),), dtype=TransferCarry)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            started, sample = start(scene, camera, pixel.px, pixel.py, sampler)
            state = TransferState()
            state.media = media_path_from(started, camera.medium)
            state.start = camera_origin(scene, camera, sample)
            radiance = wp.vec3(0.0, 0.0, 0.0)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            for channel in range(wp.static(channels)):
                carries[channel] = TransferCarry()
            # Blocks are traced from the first to the last, and swept, and traced again, from the last to the first.
            b = wp.int32(0)
            tracing = wp.bool(True)
            while b >= 0:
                states[b] = state
                count = wp.int32(0)
                while state.media.path.alive == 1 and count < wp.static(block):
                    path = state.media.path
                    kept = TransferStep()
                    kept.start = state.start
                    kept.before = wp.dot(path.o - state.start, path.d)
                    kept.crossed = state.crossed
                    lead = wp.dot(state.media.skip, path.d)
                    if lead > 0.0:
                        kept.inner = wp.length_sq(state.media.skip) / lead
                    kept.depth = path.depth
                    vertex, after = media_step(scene, sampler, state.media, job.max_depth, job.rr_depth)
                    kept.step = vertex
                    record[count] = kept
                    count += 1
                    state.crossed = vertex.surface.lobe == LOBE_NULL and not vertex.collides
                    if not state.crossed:
                        state.start = after.path.o
                    state.media = after
                    if tracing:
                        radiance += wp.cw_mul(vertex.surface.throughput, vertex.surface.direct)
                if tracing and state.media.path.alive == 1:
                    b += 1
                else:
                    tracing = False
                    for n in range(count):
                        kept = record[count - 1 - n]
                        ends, edge = around(scene, edges, sampler, kept, job.max_depth, job.rr_depth)
                        for channel in range(wp.static(channels)):
                            weight = channel_of(delta, channel)
                            carry = transfer_sweep(scene, target, edges, kept, weight, carries[channel], ends, edge)
                            carries[channel] = carry
                            of_sample[channel] = of_sample[channel] + carry.dot
                    b -= 1
                    if b >= 0:
                        state = states[b]
            for channel in range(wp.static(channels)):
                of_sample[channel] = of_sample[channel] + finish(scene, target, camera, sample, carries[channel])
            derivative += derivative_of_sample(scene, sampler, finite(radiance), of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return radiative_transfer

"""Light of a boundary path on a transient film, splatted into the bins of its own path length.

The jump across a boundary is a difference of light that arrives at many times, so the light of a path is not added up.
Each emission and each next-event estimate goes to the bins of its length (forward mode), or is weighted with the
adjoints of these bins (reverse mode). The length is detached, because the boundary term moves jumps, and no length.

Derivation: ``docs/theory/transient.md#boundary-term``.
"""

import functools

import warp as wp

from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.path_length import make_timed_vertex
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.film import filter_extent
from warp_psdr.kernels.sensor.projection import counts, pixel_filter
from warp_psdr.kernels.sensor.time_gate import TimeGates, make_time_gate
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState


@functools.cache
def make_timed_light(config: PathConfig, role: str):
    """Return ``(send, send_path)``; both return what their light counts for the loss, 0 in forward mode.

    ``send(scene, sampler, camera, gates, at, length, value, job, image) -> float``: light of one length, at a point of
    the film in pixels of the crop window;
    ``send_path(scene, sampler, camera, gates, at, start, length, first, emits, factor, job, image) -> float``: all that
    a path finds, times a factor. ``length``: up to where it starts; ``first``: the camera sees the vertex that it meets
    first, ``emits``: whose emission counts.
    """
    gate = make_time_gate(config.pulse)
    path_step = make_path_step(config, False)
    timed_vertex = make_timed_vertex(config.surfaces, config.lights)

    @wp.func
    def send(
        scene: Scene,
        sampler: Sampler,
        camera: Camera,
        gates: TimeGates,
        at: wp.vec2,
        length: wp.float32,
        value: wp.vec3,
        job: SampleJob,
        image: wp.array2d(dtype=wp.vec3),
    ) -> wp.float32:
        total = wp.float32(0.0)
        if not finite(value):
            count_invalid(scene, sampler)
            return total
        if vanishes(value) or not counts(camera, at):
            return total
        r = filter_extent(camera)
        x0 = wp.max(wp.int32(wp.ceil(at[0] - 0.5 - r)), 0)
        y0 = wp.max(wp.int32(wp.ceil(at[1] - 0.5 - r)), 0)
        x1 = wp.min(wp.int32(wp.floor(at[0] - 0.5 + r)), camera.crop_width - 1)
        y1 = wp.min(wp.int32(wp.floor(at[1] - 0.5 + r)), camera.crop_height - 1)
        first, last = gate.reached(gates, length)
        for b in range(first, last + 1):
            w = gate.weight(gates, b, length) * value
            for y in range(y0, y1 + 1):
                h_y = pixel_filter(camera, at[1], y, camera.crop_height)
                for x in range(x0, x1 + 1):
                    h = h_y * pixel_filter(camera, at[0], x, camera.crop_width)
                    if wp.static(role == "forward"):
                        wp.atomic_add(image, y, x * gates.bins + b, h * w)
                    else:
                        total += h * wp.dot(job.image_adjoint[y, x * gates.bins + b], w)
        return total

    @wp.func
    def send_path(
        scene: Scene,
        sampler: Sampler,
        camera: Camera,
        gates: TimeGates,
        at: wp.vec2,
        start: PathState,
        length: wp.float32,
        first: wp.bool,
        emits: wp.bool,
        factor: wp.vec3,
        job: SampleJob,
        image: wp.array2d(dtype=wp.vec3),
    ) -> wp.float32:
        total = wp.float32(0.0)
        state = start
        before = wp.float32(length)
        sees = wp.bool(first)
        shines = wp.bool(emits)
        while state.alive == 1:
            eta = state.eta
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            time = timed_vertex(scene, gates, vertex, sees, eta, before)
            carried = wp.cw_mul(factor, vertex.throughput)
            if shines:
                emission = wp.cw_mul(carried, time.emission)
                total += send(scene, sampler, camera, gates, at, time.length, emission, job, image)
            direct = wp.cw_mul(carried, time.direct)
            total += send(scene, sampler, camera, gates, at, time.length + time.link, direct, job, image)
            before = time.length
            sees = wp.bool(False)
            shines = wp.bool(True)
        return total

    return send, send_path

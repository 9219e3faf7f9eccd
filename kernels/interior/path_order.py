"""Interior term in the order of the path: a vertex's factors are differentiated as soon as the path has left it.

A method of this kind needs L_{n+1}, the radiance at vertex n from the direction in which the path continues.
``textbook.py`` subtracts what the path meets from its total; ``radiative.py`` traces another path from there. The
factors are those of record and sweep. A vertex's adjoint is scattered in three parts (from the factor before, its own,
and the one after) and not collected first. This is exact because everything behind the camera is a material point.
Chains through smooth mirrors and glass would need the sum of the parts; the plan refuses them.
"""

from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.interior.factors.contact import make_contact_weights
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import finite, make_derivative_of_sample, on_channel
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@wp.func
def at_vertex(vertex: PathVertex) -> Carry:
    """A carry that names a vertex and holds no adjoint yet."""
    c = Carry()
    c.face = vertex.face
    c.u = vertex.u
    c.v = vertex.v
    c.o = vertex.o
    c.d = vertex.d
    return c


class Behind(NamedTuple):
    """How a method knows the radiance behind a vertex.

    Attributes:
        radiance: ``(scene, sampler, state, remaining, throughput, max_depth, rr_depth) -> vec3``: L_{n+1}. ``state``
            has left vertex n, ``throughput`` is that of vertex n + 1.
        remaining: whether it needs what the path finds from vertex n + 1 on, for which the path is traced twice.
    """

    radiance: wp.Function
    remaining: bool


def make_path_order_kernel(config: PathConfig, wanted: GradientRequest, role: str, behind: Behind):
    """Return the kernel of a method; other arguments as ``make_replay_kernel``'s."""
    radiance_behind = behind.radiance
    lanes, starts, path_step = make_camera_paths(config, True)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, _finish, finish_vertex = make_sweep(config, wanted, role)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    geometry = wanted.geometry
    weight_before, _weight_of_light = make_contact_weights(
        config.rays.backend, config.rays.width, config.surfaces.primitives
    )
    channels = 3 if role == "forward" else 1
    derivative_of_sample = make_derivative_of_sample(role)
    sample_weight = make_sample_weight(role)

    @wp.func
    def accumulate(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        carry: Carry,
        first: wp.bool,
    ) -> wp.float32:
        """Scatter the adjoint of one vertex; the first one hangs on the camera ray."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        c = carry
        c.dot = wp.float32(0.0)
        done = finish_vertex(scene, target, c, first)
        total = done.dot
        if wp.static(wanted.camera):
            if first:
                total += accumulate_camera(scene, target, camera, sample, done.a_x, done.a_d)
        return total

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def path_order(
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
        derivative = wp.vec3d()  # in double precision, as the image
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            origin = camera_origin(scene, camera, sample)
            first_state = state
            total_radiance = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(behind.remaining):
                while state.alive == 1:
                    vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                    total_radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(role == "forward"):
                    weight = wp.vec3(0.0, 0.0, 0.0)
                    weight[channel] = delta[channel]
                total = wp.float32(0.0)
                remaining = total_radiance
                state = first_state
                current, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                current.o = origin
                before = PathVertex()
                n = wp.int32(1)
                more = wp.bool(True)
                while more:
                    remaining = remaining - wp.cw_mul(current.throughput, current.direct)
                    following = PathVertex()
                    carry = Carry()
                    carry.face = -2
                    more = state.alive == 1
                    if more:
                        left = state
                        following, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                        carry = at_vertex(following)
                        if wp.static(geometry):
                            carry.chi = weight_before(scene, following)
                        carry.radiance = radiance_behind(
                            scene, sampler, left, remaining, following.throughput, job.max_depth, job.rr_depth
                        )
                    result = sweep(scene, target, current, weight, carry)
                    total += result.dot
                    if wp.static(geometry):
                        own = at_vertex(current)
                        own.adjoint = result.adjoint
                        own.a_d = result.a_d
                        if n == 1:
                            own.a_x = result.a_x
                        total += accumulate(scene, target, camera, sample, own, n == 1)
                        if n > 1:
                            previous = at_vertex(before)
                            previous.adjoint.x = result.a_x
                            total += accumulate(scene, target, camera, sample, previous, n == 2)
                    before = current
                    current = following
                    n += 1
                of_sample += on_channel(channel, total)
            derivative += derivative_of_sample(scene, sampler, finite(total_radiance), of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return path_order

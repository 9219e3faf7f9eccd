"""Interior term by textbook path replay [VSJ21]: nothing kept, everything divided. For comparison.

A first pass computes L of the sample. The second one traces the same path again and subtracts what it meets, so that
the remaining radiance after vertex n is R_n = A_{n+1} . L_{n+1}; the derivative of beta_n then is R_n dbeta_n / beta_n.
Where a component of the throughput is 0 the quotient is lost, and with it the derivative of a factor that is exactly
zero: this is the textbook's bias, which ``kernels/interior/replay.py`` does not have.

The factors are those of record and sweep. The path is seen in forward order, so a vertex's adjoint is not collected
but scattered in three parts (from the factor before, its own, and the one after), which is exact because everything
behind the camera is a material point. Chains through smooth mirrors and glass would need the parts summed first; the
plan refuses them.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.interior.contact import make_contact_weights
from warp_psdr.kernels.interior.gradient_request import GradientRequest
from warp_psdr.kernels.interior.sweep import Carry, make_sweep
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@wp.func
def safe_quotient(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Componentwise a / b; 0 where b is 0."""
    return wp.vec3(
        wp.where(b[0] != 0.0, a[0] / b[0], 0.0),
        wp.where(b[1] != 0.0, a[1] / b[1], 0.0),
        wp.where(b[2] != 0.0, a[2] / b[2], 0.0),
    )


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


@functools.cache
def make_textbook_kernel(config: PathConfig, wanted: GradientRequest, role: str):
    """Return the kernel of ``interior.Textbook()``; arguments as ``make_replay_kernel``'s."""
    lanes, starts, path_step = make_camera_paths(config, True)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, _finish, finish_vertex = make_sweep(config, wanted, role)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    geometry = wanted.geometry
    weight_before, _weight_of_light = make_contact_weights(config.ray_backend, config.ray_width)
    channels = 3 if role == "forward" else 1

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

    @wp.kernel(module="unique", enable_backward=False)
    def textbook(
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
        delta = wp.vec3(job.scale, job.scale, job.scale)
        if wp.static(role == "reverse"):
            delta = job.scale * job.image_adjoint[pixel.py, pixel.px]
        derivative = wp.vec3d()  # in double precision, as the image
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            total_radiance = wp.vec3(0.0, 0.0, 0.0)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            origin = camera_origin(scene, camera, sample)
            first_state = state
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
                        following, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                        carry = at_vertex(following)
                        if wp.static(geometry):
                            carry.chi = weight_before(scene, following)
                        carry.radiance = safe_quotient(remaining, following.throughput)
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
                of_sample[0] = of_sample[0] + wp.where(channel == 0, total, 0.0)
                of_sample[1] = of_sample[1] + wp.where(channel == 1, total, 0.0)
                of_sample[2] = of_sample[2] + wp.where(channel == 2, total, 0.0)
            # In reverse mode it is the number of derivatives dropped.
            valid = finite(total_radiance) and finite(of_sample)
            if wp.static(role == "reverse"):
                valid = valid and vanishes(of_sample)
            if not valid:
                count_invalid(scene, sampler)
            elif wp.static(role == "forward"):
                derivative += wp.vec3d(of_sample)
        if wp.static(role == "forward"):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return textbook

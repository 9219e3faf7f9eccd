"""The kernels of light paths whose vertices move (``light_motion.py``): recorded as a whole, and swept to the light.

In reverse mode one sweep serves a path: the adjoint image and its slope are read where the camera sees a vertex. In
forward mode each vertex that the camera sees has one sweep for every colour, and one for each direction on the film.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.light_motion import LightCarry, make_light_motion
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.light_path import LightVertex, light_sampler, make_light_path
from warp_psdr.kernels.light_ray import LightRay
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.sensor.film_slope import make_moving_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_light_motion_kernel(config: PathConfig, wanted: GradientRequest, longest: int):
    """Return the reverse-mode kernel. ``longest``: most vertices of a path, all of which are kept."""
    start, step = make_light_path(config, True)
    motion = make_light_motion(config, wanted, "reverse")
    _splat, gather = make_moving_splat()

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_motion(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        # Out:
        target: wp.array(dtype=wp.float32),
    ):
        number = job.pixels[job.first_pixel + wp.tid()]
        record = wp.zeros(shape=(wp.static(longest),), dtype=LightVertex)
        for i in range(job.samples):
            sampler = light_sampler(job, camera, number, i)
            ray, state = start(scene, sphere, sampler)
            count = wp.int32(0)
            last = wp.int32(-1)  # that is joined
            invalid = wp.int32(0)
            while state.alive == 1:
                vertex, state = step(scene, camera, sampler, state, job.max_depth, job.rr_depth)
                record[count] = vertex
                invalid += vertex.invalid
                if vertex.joined == 1:
                    last = count
                count += 1
            if last >= 0:
                carry = LightCarry()
                carry.face = -1
                n = last
                while n >= 0:
                    here = record[n]
                    flux = wp.cw_mul(ray.flux, here.throughput)
                    asked = wp.vec3(0.0, 0.0, 0.0)
                    a_pixel = wp.vec2(0.0, 0.0)
                    if here.joined == 1:
                        sent = wp.cw_mul(flux, here.value)
                        asked, a_pixel = gather(camera, here.pixel, sent, job.image_adjoint)
                    carry = motion.sweep(
                        scene, target, camera, here, motion.lens(sampler, n), flux, job.scale * asked,
                        job.scale * a_pixel, carry,
                    )  # fmt: skip
                    n -= 1
                lost = motion.leave(scene, target, ray, carry)
                if lost != 0.0 or not finite(wp.cw_mul(ray.flux, carry.received)):
                    invalid += 1
            if invalid > 0:
                count_invalid(scene, sampler)

    return light_motion


@functools.cache
def make_light_motion_forward_kernel(config: PathConfig, wanted: GradientRequest, longest: int):
    """Return the forward-mode kernel: ``target`` holds the tangents, ``film_out`` receives the derivative."""
    start, step = make_light_path(config, True)
    motion = make_light_motion(config, wanted, "forward")
    splat, _gather = make_moving_splat()

    @wp.func
    def velocity(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        camera: Camera,
        sampler: Sampler,
        ray: LightRay,
        record: wp.array(dtype=LightVertex),
        last: wp.int32,
        asked: wp.vec3,
        a_pixel: wp.vec2,
    ) -> wp.float32:
        """Velocity of asked . (what vertex ``last`` sends to the camera) + a_pixel . (its place on the film)."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        carry = LightCarry()
        carry.face = -1
        n = last
        while n >= 0:
            here = record[n]
            flux = wp.cw_mul(ray.flux, here.throughput)
            seen = wp.where(n == last, 1.0, 0.0)
            carry = motion.sweep(
                scene, tangents, camera, here, motion.lens(sampler, n), flux, seen * asked, seen * a_pixel, carry
            )
            n -= 1
        return motion.leave(scene, tangents, ray, carry)

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_motion_forward(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        target: wp.array(dtype=wp.float32),
        # Out:
        film_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.pixels[job.first_pixel + wp.tid()]
        record = wp.zeros(shape=(wp.static(longest),), dtype=LightVertex)
        none = wp.vec3(0.0, 0.0, 0.0)
        for i in range(job.samples):
            sampler = light_sampler(job, camera, number, i)
            ray, state = start(scene, sphere, sampler)
            count = wp.int32(0)
            while state.alive == 1:
                vertex, state = step(scene, camera, sampler, state, job.max_depth, job.rr_depth)
                record[count] = vertex
                if vertex.invalid == 1:
                    count_invalid(scene, sampler)
                if vertex.joined == 1:
                    value = wp.cw_mul(ray.flux, wp.cw_mul(vertex.throughput, vertex.value))
                    value_dot = wp.vec3(0.0, 0.0, 0.0)
                    at_dot = wp.vec2(0.0, 0.0)
                    k = wp.int32(0)
                    while k < 5:
                        asked = none
                        a_pixel = wp.vec2(0.0, 0.0)
                        if k < 3:
                            asked = axis_vec3(k)
                        else:
                            a_pixel[k - 3] = 1.0
                        found = velocity(scene, target, camera, sampler, ray, record, count, asked, a_pixel)
                        if k < 3:
                            value_dot[k] = found
                        else:
                            at_dot[k - 3] = found
                        k += 1
                    splat(
                        scene, sampler, camera, vertex.pixel, job.scale * value, at_dot, job.scale * value_dot, film_out
                    )
                count += 1

    return light_motion_forward

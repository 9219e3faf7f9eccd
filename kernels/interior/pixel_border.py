"""Flux of moving film points across the border of a box filter, beside ``film_antithetic.py`` [YZN*22].

A box filter counts nothing beyond its border, and material points move across it. The integral over a pixel loses or
gains h u' . N L along the border, with its outward normal N. Four points lie at the same place on the four sides, each
with a path that has the random numbers of the others: where L is even, what enters on one side leaves on the other.

Derivation: ``docs/theory/interior.md#mirrored-film-points``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.interior.factors.film_points import MIRRORED, make_film_sink
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import make_derivative_of_sample, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink
from warp_psdr.kernels.vertex import PathConfig, film_position, path_from


@functools.cache
def make_pixel_border_kernel(config: PathConfig, wanted: GradientRequest, role: str, mirrored: bool) -> wp.Kernel:
    """Return the kernel; arguments as ``make_film_antithetic_kernel``'s, but that no path is kept."""
    path_step = make_path_step(config, False)
    camera_ray, _origin = make_camera_ray(config.camera)
    accumulate_film = make_film_sink(role, wanted.camera)
    accumulate_vertex = make_vertex_sink(role, False, False, False, False, False, False)
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    derivative_of_sample = make_derivative_of_sample(role)
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def pixel_border(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        pixel = pixel_of(job, camera, wp.tid())
        delta = sample_weight(job, pixel)
        if vanishes(delta):
            return
        derivative = wp.vec3d()  # in double precision, as the image
        radius = camera.filter_radius
        for i in range(job.samples):
            number = job.first_sample + i
            sampler = sampler_at(pixel.number, number // wp.static(MIRRORED if mirrored else 1), job.seed)
            u = sample_4d(sampler, 0)
            side = wp.min(wp.int32(4.0 * u[2]), 3)
            if wp.static(mirrored):
                side = number % wp.static(MIRRORED)
            outward = wp.where(side % 2 == 0, 1.0, -1.0)
            along = radius * (2.0 * u[0] - 1.0)
            n = wp.vec2(outward, 0.0)
            offset = wp.vec2(outward * radius, along)
            if side >= 2:
                n = wp.vec2(0.0, outward)
                offset = wp.vec2(along, outward * radius)
            sample = CameraSample()
            sample.film = film_position(camera, pixel.px, pixel.py, offset)
            ray = camera_ray(scene, camera, sample)
            state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
            first, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            radiance = wp.cw_mul(first.throughput, first.direct)
            while state.alive == 1:
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                radiance += wp.cw_mul(vertex.throughput, vertex.direct)
            # h = 1 / (2 r)^2, over the density 1 / (8 r) of a point of the border.
            flux = -2.0 / radius
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                found = flux * wp.dot(weight, radiance)
                image = accumulate_film(scene, target, camera, first, found * n, 0.0)
                total = image.dot
                if first.face >= 0:
                    adjoint = VertexAdjoint()
                    adjoint.x = image.x
                    done = accumulate_vertex(
                        scene, target, first.face, first.u, first.v, adjoint, False, first.o, first.d
                    )
                    total += done.dot
                of_sample += total * axis_vec3(channel)
            derivative += derivative_of_sample(scene, sampler, True, of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return pixel_border

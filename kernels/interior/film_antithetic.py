"""Interior term with a first vertex that is a material point, and film points mirrored about the pixel [YZN*22].

If the first vertex of a path stays on its surface while camera or surface move, its image moves under the pixel filter
h, and the derivative has the term grad h . u' L, of both signs and large where h is steep. Film points are drawn in
fours, mirrored about the pixel's centre, each with a path that has the random numbers of the others. grad h is odd, so
what their radiances have in common cancels. Four points of equal density are one estimate by multiple importance
sampling, and each alone has the right mean. A box filter has its term at its border (``pixel_border.py``).

Derivation: ``docs/theory/interior.md#mirrored-film-points``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import RFILTER_BOX, RFILTER_TENT
from warp_psdr.kernels.interior.factors.film_points import MIRRORED, make_film_sink
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import make_derivative_of_sample, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray, make_camera_sink
from warp_psdr.kernels.sensor.film import GAUSSIAN_INTEGRAL, filter_extent, make_filter
from warp_psdr.kernels.sensor.projection import filter_1d
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex, film_position, path_from


@wp.func
def spread_density(camera: Camera, x: wp.float32) -> wp.float32:
    """Density of film points along one axis [1 / pixel]: half by the filter, half even, for h' where h is small."""
    return 0.5 * filter_1d(camera, x) + 0.25 / filter_extent(camera)


@functools.cache
def make_spread_offset(kind: int):
    """Return ``spread_offset(camera, u: vec4) -> vec2``: from a pixel's centre, by ``spread_density`` on both axes."""
    sample_filter = make_filter(kind)

    @wp.func
    def spread_offset(camera: Camera, u: wp.vec4) -> wp.vec2:
        by_filter = sample_filter(wp.vec2(u[0], u[1]), camera.filter_radius, camera.filter_stddev)
        r = filter_extent(camera)
        return wp.vec2(
            wp.where(u[2] < 0.5, by_filter[0], r * (2.0 * u[0] - 1.0)),
            wp.where(u[3] < 0.5, by_filter[1], r * (2.0 * u[1] - 1.0)),
        )

    return spread_offset


@wp.func
def mirrored_offset(offset: wp.vec2, number: wp.int32) -> wp.vec2:
    """The film point of a sample, of four that are mirrored about the pixel's centre."""
    x = wp.where(number % 2 == 1, -offset[0], offset[0])
    y = wp.where((number // 2) % 2 == 1, -offset[1], offset[1])
    return wp.vec2(x, y)


@functools.cache
def make_filter_slope(kind: int):
    """Return ``slope(camera, x) -> float32``: the derivative of ``filter_1d`` [1 / pixel^2]."""

    @wp.func
    def slope(camera: Camera, x: wp.float32) -> wp.float32:
        if wp.static(kind == RFILTER_BOX):
            return 0.0  # but for the jump at its border (``pixel_border.py``)
        elif wp.static(kind == RFILTER_TENT):
            return -wp.sign(x) / (camera.filter_radius * camera.filter_radius)
        else:
            z = x / camera.filter_stddev
            return -z * wp.exp(-0.5 * z * z) / (GAUSSIAN_INTEGRAL * camera.filter_stddev * camera.filter_stddev)

    return slope


@functools.cache
def make_film_antithetic_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, block: int, mirrored: bool
) -> wp.Kernel:
    """Return the kernel of ``interior.FilmAntithetic``; other arguments as ``make_replay_kernel``'s, for one block.

    ``mirrored``: film points come in fours; else each is drawn by itself.
    """
    path_step = make_path_step(config, True)
    camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, _finish, finish_vertex = make_sweep(config, wanted, role)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    spread_offset = make_spread_offset(config.filter)
    slope = make_filter_slope(config.filter)
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    derivative_of_sample = make_derivative_of_sample(role)
    accumulate_film = make_film_sink(role, wanted.camera)
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.func
    def finish_first(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        sample: CameraSample,
        first: PathVertex,
        carry: Carry,
        n: wp.vec2,
        h: wp.float32,
    ) -> wp.float32:
        """Scatter the adjoint of the first vertex and of the camera; ``n`` and ``h`` as of ``film_form``."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        image = accumulate_film(scene, target, camera, first, n, h)
        last = carry
        last.adjoint.x = last.adjoint.x + image.x
        last.adjoint.c = last.adjoint.c + image.c
        done = finish_vertex(scene, target, last, False)
        total = done.dot + image.dot
        if wp.static(wanted.camera):
            total += accumulate_camera(scene, target, camera, sample, done.a_x, wp.vec3(0.0, 0.0, 0.0))
        return total

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def film_antithetic(
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
        for i in range(job.samples):
            number = job.first_sample + i
            sampler = sampler_at(pixel.number, number // wp.static(MIRRORED if mirrored else 1), job.seed)
            offset = spread_offset(camera, sample_4d(sampler, 0))
            if wp.static(mirrored):
                offset = mirrored_offset(offset, number)
            sample = CameraSample()
            sample.film = film_position(camera, pixel.px, pixel.py, offset)
            ray = camera_ray(scene, camera, sample)
            state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
            count = wp.int32(0)
            while state.alive == 1:
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if count == 0:
                    vertex.o = camera_origin(scene, camera, sample)
                record[count] = vertex
                count += 1
            # h and its gradient over the density of the film point.
            h_x = filter_1d(camera, offset[0]) / spread_density(camera, offset[0])
            h_y = filter_1d(camera, offset[1]) / spread_density(camera, offset[1])
            steep = wp.vec2(
                h_y * slope(camera, offset[0]) / spread_density(camera, offset[0]),
                h_x * slope(camera, offset[1]) / spread_density(camera, offset[1]),
            )
            h = h_x * h_y
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                carry = Carry()
                carry.face = -2
                n = count - 1
                while n >= 0:
                    carry = sweep(scene, target, record[n], h * weight, carry)
                    n -= 1
                found = wp.dot(weight, carry.radiance)
                total = finish_first(scene, target, camera, sample, record[0], carry, found * steep, found * h)
                of_sample += total * axis_vec3(channel)
            derivative += derivative_of_sample(scene, sampler, True, of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return film_antithetic

"""Derivatives whose rays move with the edges of meshes: warped-area sampling [BLD20] ([ZCZ25] eq. 32).

The directions w of a path's rays move by a field V(w) that is continuous and moves with every edge, so that they meet
no moving discontinuity. The integral of f L over the directions from a vertex then has the derivative d(f L), with the
ray attached to w' = V, plus f L div V. Record and sweep (``interior/factors/sweep.py``) therefore finds every vertex by
the ray from the one before it, lights included, and hands the adjoint of the ray's direction to its auxiliary rays.

Derivation: ``docs/theory/reparameterisation.md``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.signed_distance.reparametrised import make_film_point, make_film_turn
from warp_psdr.kernels.boundary.signed_distance.warp_field import WarpAdjoint
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle, WarpedOptions
from warp_psdr.kernels.boundary.warped_area.directions import make_direction_from
from warp_psdr.kernels.boundary.warped_area.ray_motion import make_ray_motion
from warp_psdr.kernels.boundary.warped_area.rotation import RotationOptions
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex, film_position, path_from


@functools.cache
def make_warped_area_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, options: WarpedOptions | RotationOptions, most: int
) -> wp.Kernel:
    """Return the kernel, one thread a pixel; ``most``: vertices of a path; others as of ``make_replay_kernel``."""
    path_step = make_path_step(config, True)
    camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, _finish, finish_vertex = make_sweep(config, wanted, role, links=False)
    moved = make_ray_motion(config.rays, config.surfaces.primitives, options, role)
    draw_point, weigh_point = make_film_point(config.filter)
    turn = make_film_turn(config.camera)
    interaction = make_interaction(config.surfaces, config.lights)
    direction_from = make_direction_from(config, wanted, role)
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.func
    def pull_directions(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        n: wp.int32,
        a_n: wp.vec3,
        vertex: PathVertex,
        radiance: wp.vec3,
        a_d: wp.vec3,
    ) -> WarpAdjoint:
        """The rays from vertex n: to the light that was sampled, and the one along which the path goes on.

        ``radiance`` is what the latter finds, and ``a_d`` the adjoint of its direction behind n.
        """
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = WarpAdjoint()
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
        technique = wp.int32(0)
        while technique < 2:  # one copy of what is called, which takes minutes to compile for CUDA
            ask = direction_from(scene, target, technique, n, a_n, vertex, at, radiance, a_d)
            if ask.moves == 1:
                motion = moved.trace(scene, sampler, 1 + 2 * n + technique, ask.bundle)
                found = moved.pull(scene, target, motion, ask.value, ask.a_w)
                r.o += found.o
                r.dot += found.dot
            technique += 1
        return r

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def warped_area(
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
        record = wp.zeros(shape=(wp.static(most),), dtype=PathVertex)
        derivative = wp.vec3d()  # in double precision, as the image
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            # ---- The path ----
            offset = draw_point(camera, pixel.px, pixel.py, sample_4d(sampler, 0))
            film = weigh_point(camera, pixel.px, pixel.py, offset)
            sample = CameraSample()
            sample.film = film_position(camera, pixel.px, pixel.py, offset)
            ray = camera_ray(scene, camera, sample)
            origin = camera_origin(scene, camera, sample)
            state = path_from(ray.o + ray.t_min * ray.d, ray.d, ray.t_max - ray.t_min, 0)
            count = wp.int32(0)
            while state.alive == 1 and count < wp.static(most):
                vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if count == 0:
                    vertex.o = origin
                record[count] = vertex
                count += 1
            bundle = AuxiliaryBundle()
            bundle.o = origin
            bundle.start = ray.o + ray.t_min * ray.d
            bundle.w = ray.d
            bundle.pixels = wp.length(turn(scene, camera, origin, ray.d, 0.0, wp.vec2(1.0, 0.0)))
            seen = moved.trace(scene, sampler, 0, bundle)
            turned = turn(scene, camera, origin, ray.d, film.h, film.slope)
            # ---- Its derivative ----
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            channel = wp.int32(0)
            while channel < wp.static(channels):  # not unrolled, for the same reason
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                carry = Carry()
                carry.face = -2
                n = count - 1
                while n >= 0:
                    vertex = record[n]
                    found = finish_vertex(scene, target, carry, True)
                    onward = Carry()  # of vertex n + 1 there is the light that it sends, along a direction that rests
                    onward.face = -2
                    onward.chi = 1.0
                    onward.radiance = carry.radiance
                    onward.dot = found.dot
                    carry = sweep(scene, target, vertex, film.h * weight, onward)
                    if wp.static(config.scatter):
                        if vertex.face >= 0:
                            a_n = film.h * wp.cw_mul(weight, vertex.throughput)
                            behind = pull_directions(
                                scene, target, sampler, n, a_n, vertex, onward.radiance, found.a_d
                            )  # fmt: skip
                            carry.adjoint.x += found.a_x + behind.o
                            carry.dot += behind.dot
                    n -= 1
                radiance = wp.dot(weight, carry.radiance)
                done = finish_vertex(scene, target, carry, True)
                a_w = done.a_d + radiance * turned
                moves = moved.pull(scene, target, seen, film.h * radiance, a_w)
                of_sample += (done.dot + moves.dot) * axis_vec3(channel)
                channel += 1
            valid = finite(of_sample)
            if wp.static(not forward):
                valid = valid and vanishes(of_sample)
            if not valid:
                count_invalid(scene, sampler)
            elif wp.static(forward):
                derivative += wp.vec3d(of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return warped_area

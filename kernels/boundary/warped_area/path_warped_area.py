"""Warped-area sampling beside path space's interior term [XBLZ23] ([ZCZ25] eq. 34 to 36).

The interior term keeps vertices on their triangles. Along each segment of a path, the boundary term is the integral of
div (f V_K), where V_K = V - m is the motion of rays against the points that they find: zero where nothing is occluded.
Separate camera paths estimate it, in the measure of directions. The gradient of f by the direction is that of
scattering and, as the point that is found slides, of everything behind it: an adjoint that record and sweep has
already.

Derivation: ``docs/theory/reparameterisation.md#in-path-space``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.signed_distance.reparametrised import make_film_point, make_film_turn
from warp_psdr.kernels.boundary.warped_area.auxiliary import AuxiliaryBundle, WarpedOptions
from warp_psdr.kernels.boundary.warped_area.directions import make_direction_from
from warp_psdr.kernels.boundary.warped_area.material_motion import make_material_motion
from warp_psdr.kernels.boundary.warped_area.warp_motion import make_warp_motion
from warp_psdr.kernels.constants import EMITTER_AREA
from warp_psdr.kernels.interaction import make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import SampleJob
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_path_step
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex import PathConfig, PathVertex, film_position, path_from


@functools.cache
def make_path_warped_area_kernel(
    config: PathConfig, wanted: GradientRequest, role: str, options: WarpedOptions, most: int
) -> wp.Kernel:
    """Return the kernel: one thread a sample; ``job.samples`` of them a pixel, ``most`` vertices of a path."""
    path_step = make_path_step(config, True)
    camera_ray, camera_origin = make_camera_ray(config.camera)
    # Its sinks drop what they get: adjoints of vertices are all that is asked for.
    sweep, _finish, finish_vertex = make_sweep(config, wanted, "samples")
    moved = make_warp_motion(config.rays, config.surfaces.primitives, options, role)
    pull_material = make_material_motion(role)
    accumulate_vertex = make_adjoint_sink(
        role,
        config.surfaces.smooth,
        config.surfaces.flat,
        config.surfaces.uv,
        config.surfaces.tangent,
        False,
        True,
        config.surfaces.primitives,
    )
    draw_point, weigh_point = make_film_point(config.filter)
    turn = make_film_turn(config.camera)
    interaction = make_interaction(config.surfaces, config.lights)
    direction_from = make_direction_from(config, wanted, "samples")
    sample_4d = make_sampler(config.sampler).sample_4d
    forward = role == "forward"
    channels = 3 if forward else 1

    @wp.func
    def pull_segments(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        n: wp.int32,
        a_n: wp.vec3,
        vertex: PathVertex,
        onward: Carry,
        a_d: wp.vec3,
    ) -> wp.float32:
        """The segments from vertex n: to the light that was sampled, and to vertex n + 1, which ``onward`` is of."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        a_x = wp.vec3(0.0, 0.0, 0.0)
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
        technique = wp.int32(0)
        while technique < 2:  # one copy of what is called, which takes minutes to compile for CUDA
            ask = direction_from(scene, target, technique, n, a_n, vertex, at, onward.radiance, a_d)
            if ask.moves == 1:
                face = wp.int32(onward.face)
                u = wp.float32(onward.u)
                v = wp.float32(onward.v)
                if technique == 0:
                    face = wp.where(scene.emitters[vertex.light].kind == EMITTER_AREA, vertex.light_face, -1)
                    u = vertex.light_u
                    v = vertex.light_v
                motion = moved.trace(scene, sampler, 1 + 2 * n + technique, ask.bundle)
                found = moved.pull(scene, target, motion, ask.value, ask.a_w)
                a_x += found.o
                total += found.dot
                if face >= 0:
                    material = pull_material(scene, target, face, u, v, at.x, ask.bundle.w, -ask.value, -ask.a_w)
                    a_x += material.o
                    total += material.dot
            technique += 1
        start = VertexAdjoint()
        start.x = a_x
        # The first vertex lies where the ray of its film point finds it.
        done = accumulate_vertex(scene, target, vertex.face, vertex.u, vertex.v, start, n == 0, vertex.o, vertex.d)
        return total + done.dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def path_warped_area(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: SampleJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        number = job.first + wp.tid()
        pixel = number // job.samples
        px = pixel % camera.crop_width
        py = pixel // camera.crop_width
        sampler = sampler_at(pixel, number % job.samples, job.seed)
        scale = 1.0 / wp.float32(job.samples)
        delta = wp.vec3(scale, scale, scale)
        if wp.static(role != "forward"):
            delta = scale * job.image_adjoint[py, px]
            if vanishes(delta):
                return
        # ---- The path ----
        record = wp.zeros(shape=(wp.static(most),), dtype=PathVertex)
        offset = draw_point(camera, px, py, sample_4d(sampler, 0))
        film = weigh_point(camera, px, py, offset)
        sample = CameraSample()
        sample.film = film_position(camera, px, py, offset)
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
        seen = moved.trace(scene, sampler, 0, bundle)
        turned = turn(scene, camera, origin, ray.d, film.h, film.slope)
        # ---- Its segments ----
        of_sample = wp.vec3(0.0, 0.0, 0.0)
        channel = wp.int32(0)
        while channel < wp.static(channels):  # not unrolled, for the same reason
            weight = delta
            if wp.static(forward):
                weight = delta[channel] * axis_vec3(channel)
            total = wp.float32(0.0)
            carry = Carry()
            carry.face = -2
            n = count - 1
            while n >= 0:
                vertex = record[n]
                if wp.static(config.scatter):
                    if vertex.face >= 0:
                        found = finish_vertex(scene, target, carry, True)
                        a_n = film.h * wp.cw_mul(weight, vertex.throughput)
                        total += pull_segments(scene, target, sampler, n, a_n, vertex, carry, found.a_d)
                carry = sweep(scene, target, vertex, film.h * weight, carry)
                n -= 1
            radiance = wp.dot(weight, carry.radiance)
            done = finish_vertex(scene, target, carry, True)
            total += moved.pull(scene, target, seen, film.h * radiance, done.a_d + radiance * turned).dot
            of_sample += total * axis_vec3(channel)
            channel += 1
        valid = finite(of_sample)
        if wp.static(not forward):
            valid = valid and vanishes(of_sample)
        if not valid:
            count_invalid(scene, sampler)
        elif wp.static(forward):
            wp.atomic_add(image_out, py, px, of_sample)

    return path_warped_area

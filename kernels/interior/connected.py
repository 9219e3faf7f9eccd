"""Derivatives of bidirectional paths with inner connections, by record and sweep of both subpaths.

A sample is a camera path and a light path, both kept. A connection of x_n and z_j contributes A_n (g f_x f_z) Phi_j,
with g detached. With the adjoint delta of the pixel its local factors have the adjoints

    f_x:  delta A_n g f_z Phi_j,        f_z:  delta A_n g f_x Phi_j.

The adjoint S_j of the light path's vertex (``light_tracing.py``) gains delta A_n g f_x f_z. Both sweeps otherwise run
as without connections [NDSRJ20, VSJ21].

Derivation: ``docs/theory/light_tracing.md#inner-connections``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bidirectional_path import make_camera_walk, make_walk_from
from warp_psdr.kernels.bidirectional_weights import Cuts
from warp_psdr.kernels.camera_rays import make_bundled_starts, rays_together
from warp_psdr.kernels.connection import CAMERA_STREAM, Joint, make_subpaths
from warp_psdr.kernels.constants import LOBE_NONE
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_material_sink
from warp_psdr.kernels.interior.factors.sweep import Carry, make_sweep
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.interior.light_tracing import make_light_factors
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.light_path import LightVertex
from warp_psdr.kernels.light_ray import LightRay
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex


@functools.cache
def make_connected_kernel(config: PathConfig, wanted: GradientRequest, role: str):
    """Return the kernel of the derivatives.

    Role "reverse": ``target`` receives the gradient, of joined light paths too. "forward": it holds the tangents, and
    ``film_out`` receives the derivative but for that of joined light paths, which ``make_light_forward_kernel`` draws.
    """
    most = config.most_vertices
    forward = role == "forward"
    channels = 3 if forward else 1
    light_path, connections = make_subpaths(config, True)
    factors = make_light_factors(config.surfaces, config.lights, wanted, role)
    lanes = rays_together(config.rays, config.surfaces.primitives)
    starts = make_bundled_starts(config)
    camera_walk = make_camera_walk(config, True, lanes > 1)
    walk_from = make_walk_from(config.camera)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    sweep, finish, _finish_vertex = make_sweep(config, wanted, role)
    interaction = make_interaction(config.surfaces, config.lights)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    sample_weight = make_sample_weight(role)
    _splat, gather = make_splat()
    materials = any(wanted.material) or wanted.to_uv

    @wp.func
    def near_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: PathVertex, w: wp.vec3, a: wp.vec3
    ) -> wp.float32:
        """Scatter the adjoint of f(x, w); vertices are at rest."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        if wp.static(materials):
            surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
            at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
            fa = interaction.eval_vjp(at, enter_frame(at.frame, w), a)
            _adjoint, total = accumulate_material(
                scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, fa.material, VertexAdjoint()
            )
        return total

    @wp.func
    def light_sweep(
        scene: Scene,
        camera: Camera,
        job: PixelJob,
        target: wp.array(dtype=wp.float32),
        ray: LightRay,
        count: wp.int32,
        lights: wp.array(dtype=LightVertex),
        asked: wp.array(dtype=wp.vec3),
        a_first: wp.vec3,
    ) -> tuple[wp.float32, wp.vec3]:
        """The sweep of ``make_light_replay_kernel`` with what connections ask for; the second is dPhi's adjoint."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        received = wp.vec3(0.0, 0.0, 0.0)
        j = count - 1
        while j >= 0:
            here = lights[j]
            flux = wp.cw_mul(ray.flux, here.throughput)
            a_light = wp.vec3(0.0, 0.0, 0.0)
            own = asked[j]
            if wp.static(not forward):
                if here.joined == 1:
                    seen = job.scale * gather(camera, here.pixel, job.image_adjoint)
                    if not vanishes(seen):
                        a_join, dot_join = factors.join(scene, target, here, wp.cw_mul(flux, seen))
                        a_light += a_join
                        total += dot_join
                        own += wp.cw_mul(seen, here.value)
            if here.lobe != LOBE_NONE and not vanishes(received):
                a_beta, dot_beta = factors.scatter(scene, target, here, wp.cw_mul(flux, received))
                a_light += a_beta
                total += dot_beta
            received = own + wp.cw_mul(here.beta, received)
            if j == 0:
                x = point_on(triangle_at(scene, here.face), here.u, here.v)
                total += factors.emission(scene, target, ray, x, received, a_light + a_first)
            j -= 1
        return total, received

    @wp.func
    def sample_derivative(
        scene: Scene,
        camera: Camera,
        job: PixelJob,
        target: wp.array(dtype=wp.float32),
        sample: CameraSample,
        delta: wp.vec3,
        depth: wp.int32,
        record: wp.array(dtype=PathVertex),
        ray: LightRay,
        count: wp.int32,
        lights: wp.array(dtype=LightVertex),
        found: wp.array(dtype=Joint),
        asked: wp.array(dtype=wp.vec3),
    ) -> tuple[wp.float32, wp.bool]:
        """Sweep both subpaths; the derivative in forward mode, and whether all is finite."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        a_first = wp.vec3(0.0, 0.0, 0.0)
        for j in range(count):
            asked[j] = wp.vec3(0.0, 0.0, 0.0)
        carry = Carry()
        carry.face = -2
        n = depth - 1
        while n >= 0:
            vertex = record[n]
            a_n = wp.cw_mul(delta, vertex.throughput)
            for j in range(count):
                c = found[n * wp.static(most) + j]
                if vertex.face >= 0 and c.joined == 1:
                    other = lights[j]
                    flux = wp.cw_mul(ray.flux, other.throughput)
                    a_c = c.factor * a_n
                    total += near_vjp(scene, target, vertex, c.w, wp.cw_mul(a_c, wp.cw_mul(c.far, flux)))
                    other.to_camera = -c.w
                    other.join = 1.0
                    a_light, dot = factors.join(scene, target, other, wp.cw_mul(a_c, wp.cw_mul(c.near, flux)))
                    total += dot
                    if j == 0:
                        a_first += a_light
                    asked[j] = asked[j] + wp.cw_mul(a_c, wp.cw_mul(c.near, c.far))
            carry = sweep(scene, target, vertex, delta, carry)
            n -= 1
        total += finish(scene, target, camera, sample, carry)
        dot_light, received = light_sweep(scene, camera, job, target, ray, count, lights, asked, a_first)
        return total + dot_light, finite(carry.radiance) and finite(wp.cw_mul(ray.flux, received))

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def connected(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        sphere: wp.vec4,
        # Out:
        target: wp.array(dtype=wp.float32),
        film_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        # The job's scale is that of light paths: one over those of the image.
        pixels = wp.float32(camera.crop_width) * wp.float32(camera.crop_height)
        delta = pixels * sample_weight(job, pixel)
        record = wp.zeros(shape=(wp.static(most),), dtype=PathVertex)
        lights = wp.zeros(shape=(wp.static(most),), dtype=LightVertex)
        light_cuts = wp.zeros(shape=(wp.static(most),), dtype=Cuts)
        found = wp.zeros(shape=(wp.static(most * most),), dtype=Joint)
        asked = wp.zeros(shape=(wp.static(most),), dtype=wp.vec3)
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            ray, count = light_path(scene, camera, job, sphere, pixel.number, i, lights, light_cuts)
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed ^ wp.uint32(CAMERA_STREAM))
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            origin = camera_origin(scene, camera, sample)
            walk = walk_from(state, sample)
            depth = wp.int32(0)
            while walk.path.alive == 1 and depth < wp.static(most):
                vertex, walk = camera_walk(scene, camera, sampler, walk, job.max_depth, job.rr_depth)
                if vertex.face >= 0:
                    vertex.direct = vertex.direct + connections(
                        scene, job.max_depth, vertex, walk.cuts, depth, ray, count, lights, light_cuts, found
                    )
                if depth == 0:
                    vertex.o = origin
                record[depth] = vertex
                depth += 1
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            valid = wp.bool(True)
            for channel in range(wp.static(channels)):
                weight = delta
                if wp.static(forward):
                    weight = delta[channel] * axis_vec3(channel)
                total, sound = sample_derivative(
                    scene, camera, job, target, sample, weight, depth, record, ray, count, lights, found, asked
                )
                of_sample += total * axis_vec3(channel)
                valid = valid and sound
            valid = valid and finite(of_sample)
            if wp.static(not forward):
                valid = valid and vanishes(of_sample)
            if not valid:
                count_invalid(scene, sampler)
            elif wp.static(forward):
                wp.atomic_add(film_out, pixel.py, pixel.px, of_sample)

    return connected

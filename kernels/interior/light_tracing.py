"""Derivatives of light tracing, by record and sweep of its paths, and in forward mode.

The adjoint image asks S_k = A_k J_k + beta_k S_{k+1} of vertex k and all vertices behind it. The derivative of a path
is dPhi . S_1 + sum_k Phi_k (A_k dJ_k + dbeta_k S_{k+1}). The adjoint image is read where the camera sees a vertex, as
in radiative backpropagation [NDSRJ20] with light and camera exchanged. Vertices are at rest.

Derivation: ``docs/theory/light_tracing.md#derivatives``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bidirectional_path import make_light_walk
from warp_psdr.kernels.constants import DELTA_LIGHTS, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.interior.factors.velocities import axis_vec3
from warp_psdr.kernels.invalid import count_invalid, finite, vanishes
from warp_psdr.kernels.jobs import PixelJob
from warp_psdr.kernels.light_path import LightVertex, light_sampler
from warp_psdr.kernels.light_ray import LightRay, light_vertex, radiance_scale
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.reading import triangle_at
from warp_psdr.kernels.sensor.projection import make_splat
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.vertex import LightConfig, PathConfig, SurfaceConfig


class LightFactors(NamedTuple):
    """Vector-Jacobian products of a light path's factors; ``target`` as in ``sink.py``.

    Attributes:
        aims: whether the direction towards the light may move; else the adjoints of it are 0.
        join: ``(scene, target, vertex, w) -> (adjoint of the direction towards the light, dot)``: of w . J.
        scatter: the same of w . beta.
        emission: ``(scene, target, ray, x, w, a_light) -> dot``: of w . (flux of the ray that ends at x), and of the
            direction from x towards the light.
    """

    aims: bool
    join: wp.Function
    scatter: wp.Function
    emission: wp.Function


@functools.cache
def make_light_factors(
    surfaces: SurfaceConfig, lights: LightConfig, wanted: GradientRequest, role: str
) -> LightFactors:
    """Return the functions; ``role``: "reverse" or "forward"."""
    interaction = make_interaction(surfaces, lights)
    material = interaction.bsdf.record
    accumulate_material = make_material_sink(surfaces, wanted, role)
    _radiance_of, accumulate_light = make_light_sink(surfaces, lights, wanted, role, links=False)
    eval_vjp, delta_vjp = interaction.eval_vjp, interaction.scatter_vjp
    aims = "pose" in wanted.lights and bool(DELTA_LIGHTS & set(lights.others))
    materials = any(wanted.material) or wanted.to_uv or aims
    emits = bool(wanted.lights) or wanted.radiance or wanted.to_uv

    @wp.func
    def push(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: LightVertex, slots: wp.int32, uv: wp.vec2, m: material
    ) -> wp.float32:
        """Scatter the adjoint of a vertex's material; vertices are at rest."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        _adjoint, total = accumulate_material(
            scene, target, slots, vertex.face, vertex.u, vertex.v, uv, m, VertexAdjoint()
        )
        return total

    @wp.func
    def join_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: LightVertex, w: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        a_light = wp.vec3(0.0, 0.0, 0.0)
        total = wp.float32(0.0)
        if wp.static(materials):
            surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
            here = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, -vertex.to_camera)
            fa = eval_vjp(here, enter_frame(here.frame, -vertex.d), vertex.join * w)
            total = push(scene, target, vertex, here.slots, surface.uv, fa.material)
            if wp.static(aims):
                a_light = leave_frame(here.frame, fa.wo)
        return a_light, total

    @wp.func
    def scatter_on_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: LightVertex, w: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        a_light = wp.vec3(0.0, 0.0, 0.0)
        total = wp.float32(0.0)
        if wp.static(materials):
            surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
            at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
            if vertex.lobe == LOBE_SMOOTH:
                # Seen from the new direction.
                to_light = at.wi
                at.wi = enter_frame(at.frame, vertex.wo)
                fa = eval_vjp(at, to_light, vertex.factor * w)
                total = push(scene, target, vertex, at.slots, surface.uv, fa.material)
                if wp.static(aims):
                    a_light = leave_frame(at.frame, fa.wo)
            if wp.static(delta_vjp is not None):
                if vertex.lobe > LOBE_SMOOTH:
                    va = delta_vjp(at, vertex.lobe, vertex.factor * w, wp.vec3(0.0, 0.0, 0.0))
                    total += push(scene, target, vertex, at.slots, surface.uv, va.material)
        return a_light, total

    @wp.func
    def emission_vjp(
        scene: Scene, target: wp.array(dtype=wp.float32), ray: LightRay, x: wp.vec3, w: wp.vec3, a_light: wp.vec3
    ) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        if wp.static(emits):
            _a_x, total = accumulate_light(
                scene, target, light_vertex(ray), x, radiance_scale(ray, x) * w, 0.0, a_light, 1.0
            )
        return total

    return LightFactors(aims, join_vjp, scatter_on_vjp, emission_vjp)


@functools.cache
def make_light_replay_kernel(config: PathConfig, wanted: GradientRequest, block: int, blocks: int):
    """Return the reverse-mode kernel of ``interior.LightTracing``; arguments as ``make_replay_kernel``'s."""
    walk, start, step = make_light_walk(config, True)
    factors = make_light_factors(config.surfaces, config.lights, wanted, "reverse")
    _splat, gather = make_splat()

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_replay(
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
        record = wp.zeros(shape=(wp.static(block),), dtype=LightVertex)
        states = wp.zeros(shape=(wp.static(blocks),), dtype=walk)
        for i in range(job.samples):
            sampler = light_sampler(job, camera, number, i)
            ray, state = start(scene, sphere, sampler)
            count = wp.int32(0)
            joined = wp.int32(0)
            invalid = wp.int32(0)
            while state.alive == 1:
                if wp.static(blocks > 1):
                    if count % wp.static(block) == 0:
                        states[count // wp.static(block)] = state
                vertex, state = step(scene, camera, sampler, state, job.max_depth, job.rr_depth)
                record[count % wp.static(block)] = vertex
                count += 1
                joined += vertex.joined
                invalid += vertex.invalid
            if joined > 0:
                lost = wp.float32(0.0)
                received = wp.vec3(0.0, 0.0, 0.0)  # S of vertex n + 1
                a_light = wp.vec3(0.0, 0.0, 0.0)
                loaded = (count - 1) // wp.static(block)
                n = count - 1
                while n >= 0:
                    if wp.static(blocks > 1):
                        if n // wp.static(block) != loaded:
                            loaded = n // wp.static(block)
                            again = states[loaded]
                            for j in range(wp.static(block)):
                                if again.alive == 1:
                                    vertex, again = step(scene, camera, sampler, again, job.max_depth, job.rr_depth)
                                    record[j] = vertex
                    here = record[n % wp.static(block)]
                    flux = wp.cw_mul(ray.flux, here.throughput)
                    asked = wp.vec3(0.0, 0.0, 0.0)
                    a_light = wp.vec3(0.0, 0.0, 0.0)
                    if here.joined == 1:
                        asked = job.scale * gather(camera, here.pixel, job.image_adjoint)
                        if not vanishes(asked):
                            a_join, lost_join = factors.join(scene, target, here, wp.cw_mul(flux, asked))
                            a_light += a_join
                            lost += lost_join
                    if here.lobe != LOBE_NONE and not vanishes(received):
                        a_beta, lost_beta = factors.scatter(scene, target, here, wp.cw_mul(flux, received))
                        a_light += a_beta
                        lost += lost_beta
                    received = wp.cw_mul(asked, here.value) + wp.cw_mul(here.beta, received)
                    if n == 0:
                        x = point_on(triangle_at(scene, here.face), here.u, here.v)
                        lost += factors.emission(scene, target, ray, x, received, a_light)
                    n -= 1
                if lost != 0.0 or not finite(wp.cw_mul(ray.flux, received)):
                    invalid += 1
            if invalid > 0:
                count_invalid(scene, sampler)

    return light_replay


@functools.cache
def make_light_forward_kernel(config: PathConfig, wanted: GradientRequest):
    """Return the forward-mode kernel: ``target`` holds the tangents, ``film_out`` receives the derivative."""
    _walk, start, step = make_light_walk(config, True)
    factors = make_light_factors(config.surfaces, config.lights, wanted, "forward")
    splat, _gather = make_splat()

    @wp.func
    def flux_jvp(
        scene: Scene, tangents: wp.array(dtype=wp.float32), ray: LightRay, vertex: LightVertex
    ) -> tuple[wp.vec3, wp.vec3]:
        """Velocities of the ray's flux and of the direction towards the light."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        flux_dot = wp.vec3(0.0, 0.0, 0.0)
        light_dot = wp.vec3(0.0, 0.0, 0.0)
        zero = wp.vec3(0.0, 0.0, 0.0)
        x = point_on(triangle_at(scene, vertex.face), vertex.u, vertex.v)
        for channel in range(3):
            flux_dot[channel] = factors.emission(scene, tangents, ray, x, axis_vec3(channel), zero)
            if wp.static(factors.aims):
                light_dot[channel] = factors.emission(scene, tangents, ray, x, zero, axis_vec3(channel))
        return flux_dot, light_dot

    @wp.func
    def vertex_factors_jvp(
        scene: Scene, tangents: wp.array(dtype=wp.float32), vertex: LightVertex, light_dot: wp.vec3
    ) -> tuple[wp.vec3, wp.vec3]:
        """Velocities of J and beta."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        value_dot = wp.vec3(0.0, 0.0, 0.0)
        beta_dot = wp.vec3(0.0, 0.0, 0.0)
        for channel in range(3):
            if vertex.joined == 1:
                a_join, dot_join = factors.join(scene, tangents, vertex, axis_vec3(channel))
                value_dot[channel] = dot_join + wp.dot(a_join, light_dot)
            if vertex.lobe != LOBE_NONE:
                a_beta, dot_beta = factors.scatter(scene, tangents, vertex, axis_vec3(channel))
                beta_dot[channel] = dot_beta + wp.dot(a_beta, light_dot)
        return value_dot, beta_dot

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def light_forward(
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
        for i in range(job.samples):
            sampler = light_sampler(job, camera, number, i)
            ray, state = start(scene, sphere, sampler)
            flux_dot = wp.vec3(0.0, 0.0, 0.0)
            light_dot = wp.vec3(0.0, 0.0, 0.0)
            throughput_dot = wp.vec3(0.0, 0.0, 0.0)
            while state.alive == 1:
                first = state.depth == 0
                vertex, state = step(scene, camera, sampler, state, job.max_depth, job.rr_depth)
                if vertex.invalid == 1:
                    count_invalid(scene, sampler)
                if vertex.face >= 0:
                    if first:
                        flux_dot, light_dot = flux_jvp(scene, target, ray, vertex)
                    value_dot, beta_dot = vertex_factors_jvp(scene, target, vertex, light_dot)
                    light_dot = wp.vec3(0.0, 0.0, 0.0)  # the next vertex sees this one, which is at rest
                    if vertex.joined == 1:
                        value = wp.cw_mul(wp.cw_mul(flux_dot, vertex.throughput), vertex.value)
                        value += wp.cw_mul(wp.cw_mul(ray.flux, throughput_dot), vertex.value)
                        value += wp.cw_mul(wp.cw_mul(ray.flux, vertex.throughput), value_dot)
                        splat(scene, sampler, camera, vertex.pixel, job.scale * value, film_out)
                    throughput_dot = wp.cw_mul(throughput_dot, vertex.beta)
                    throughput_dot += wp.cw_mul(vertex.throughput, beta_dot)

    return light_forward

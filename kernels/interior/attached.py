"""Interior term with attached samples [ZSGJ21]: directions move with the roughness by which they are drawn.

At a vertex of rough metal whose reflected rays meet nothing but the sky, the sampled part of the derivative is that of
f(w) L(w) w_b(w) / p(w) along the direction w(alpha; u), which the sampling routine draws from fixed random numbers u.
It has the slope of the sky in place of the sign changes of df. Next-event estimation keeps its directions. The weights
of multiple importance sampling move too, or by their position alone; fixed weights would bias the sum. ``moves=False``
leaves the samples where they are and adds the derivative of attached weights, whose mean is zero.

Derivation: ``docs/theory/interior.md#attached-samples``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.motion import make_sample_motion
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.constants import EMITTER_AREA, LOBE_SMOOTH
from warp_psdr.kernels.emitter.area import pdf_area
from warp_psdr.kernels.emitter.dispatch import is_delta_light, make_lights
from warp_psdr.kernels.interaction import enter_frame, leave_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.interior.factors.velocities import axis_vec3, make_material_jvp
from warp_psdr.kernels.invalid import count_invalid, finite, inverse_pdf, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.rng import make_sampler, sampler_at
from warp_psdr.kernels.sampling import mis_weight, sphere_pdf
from warp_psdr.kernels.scattering import SLOTS_PER_VERTEX, samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, point_on
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.vertex_motion import VertexTangent


@wp.struct
class RoughnessPartials:
    """Derivatives of a vertex's terms by both roughnesses, one number a colour, over the throughput up to there."""

    u: wp.vec3
    v: wp.vec3


@functools.cache
def make_attached_kernel(config: PathConfig, wanted: GradientRequest, role: str, moves: bool, weights: str):
    """Return the kernel of ``interior.Attached``; other arguments as ``make_replay_kernel``'s.

    Args:
        config: what the scene needs.
        wanted: the roughnesses that are differentiated, and nothing else.
        role: "reverse" or "forward".
        moves: whether directions are attached.
        weights: "attached", or "position": through the direction alone.
    """
    lanes, starts, path_step = make_camera_paths(config, True)
    interaction = make_interaction(config.surfaces, config.lights)
    record = interaction.record
    material_record = interaction.bsdf.record
    moves_smoothly, motion_of = make_sample_motion(config.surfaces.bsdfs)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    material_jvp = make_material_jvp(config.surfaces, wanted)
    has_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of = make_light_sink(config.surfaces, config.lights, wanted, role)[0] if has_lights else None
    lights = make_lights(config.lights.others, role, ()) if config.lights.others else None
    environment_eval_pdf = lights.environment_eval_pdf if lights else None
    environment_vjp = lights.environment_vjp if lights else None
    environment = environment_eval_pdf is not None
    emitted = interaction.emitted
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    forward = role == "forward"
    with_weights = weights == "attached"

    @wp.func
    def sky_share(scene: Scene) -> wp.float32:
        """Density of light points that the weights stand against: even, for that of a sky's cells has steps."""
        return sphere_pdf() * scene.emitters[scene.environment].probability

    @wp.func
    def light_density(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.float32:
        """Density of the light point that next-event estimation has drawn, solid angle; not of lights of no area."""
        emitter = scene.emitters[vertex.light]
        density = wp.float32(0.0)
        if emitter.kind == EMITTER_AREA:
            y = point_on(scene.triangles[vertex.light_face], vertex.light_u, vertex.light_v)
            density = pdf_area(scene, emitter, vertex.light_face, vertex.light_wi, wp.length(y - x))
        if wp.static(environment):
            if emitter.kind != EMITTER_AREA:
                _radiance, found = environment_eval_pdf(scene, vertex.light_wi)
                density = found
        return density * emitter.probability

    @wp.func
    def of_light(scene: Scene, at: record, vertex: PathVertex) -> RoughnessPartials:
        """The next-event estimate: its direction stays, its weight may change."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = RoughnessPartials()
        wo = enter_frame(at.frame, vertex.light_wi)
        delta_light = is_delta_light(scene.emitters[vertex.light].kind)
        radiance = radiance_of(scene, vertex, at.x)
        weight = vertex.light_weight
        rate = wp.vec2(0.0, 0.0)
        if not delta_light:
            p_b = interaction.pdf(at, wo)
            p_e = light_density(scene, vertex, at.x)
            against = p_e
            if wp.static(moves):
                against = sky_share(scene)
            weight = mis_weight(against, p_b) * inverse_pdf(p_e)
            if wp.static(with_weights):
                m = motion_of(at.model, at.material, at.wi, wo, wp.vec2(0.5, 0.5))
                rate = -2.0 * mis_weight(p_b, against) * m.log_pdf
        f = interaction.eval(at, wo)
        for channel in range(3):
            scale = weight * radiance[channel]
            d_u = f[channel] * rate[0]
            d_v = f[channel] * rate[1]
            if wp.static(moves):
                fa = interaction.eval_vjp(at, wo, axis_vec3(channel))
                d_u += fa.material.alpha_u
                d_v += fa.material.alpha_v
            result.u[channel] = scale * d_u
            result.v[channel] = scale * d_v
        return result

    @wp.func
    def of_weight(scene: Scene, at: record, vertex: PathVertex, following: PathVertex) -> RoughnessPartials:
        """What the weight changes of the emission that a direction which stays has found."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = RoughnessPartials()
        light = wp.vec3(0.0, 0.0, 0.0)
        if following.face < 0:
            if wp.static(environment):
                light, _density = environment_eval_pdf(scene, following.d)
        else:
            if wp.static(emitted is not None):
                light = emitted(scene, following.face, following.u, following.v, following.d)
        m = motion_of(at.model, at.material, at.wi, enter_frame(at.frame, vertex.wo), wp.vec2(0.5, 0.5))
        found = (2.0 * following.e_weight * (1.0 - following.e_weight)) * wp.cw_mul(vertex.beta, light)
        result.u = m.log_pdf[0] * found
        result.v = m.log_pdf[1] * found
        return result

    @wp.func
    def of_direction(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        at: record,
        vertex: PathVertex,
        following: PathVertex,
        v: wp.vec2,
    ) -> RoughnessPartials:
        """The sky in a direction that moves."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = RoughnessPartials()
        if wp.static(environment):
            wo = enter_frame(at.frame, vertex.wo)
            p_b = interaction.pdf(at, wo)
            against = sky_share(scene)
            m = motion_of(at.model, at.material, at.wi, wo, v)
            # d ln p: of the roughness and of the direction.
            turned = wp.vec2(wp.dot(m.log_pdf_wo, m.by_u), wp.dot(m.log_pdf_wo, m.by_v))
            along = m.log_pdf + turned
            kept = turned
            if wp.static(with_weights):
                kept = along
            # d ln (w_b / p).
            rate = 2.0 * mis_weight(against, p_b) * kept - along
            scale = vertex.inv_pdf * mis_weight(p_b, against)
            light, _density = environment_eval_pdf(scene, following.d)
            f = interaction.eval(at, wo)
            world_u = leave_frame(at.frame, m.by_u)
            world_v = leave_frame(at.frame, m.by_v)
            for channel in range(3):
                axis = axis_vec3(channel)
                fa = interaction.eval_vjp(at, wo, axis)
                slope = environment_vjp(scene, target, following.d, axis).x
                d_u = fa.material.alpha_u + wp.dot(fa.wo, m.by_u) + rate[0] * f[channel]
                d_v = fa.material.alpha_v + wp.dot(fa.wo, m.by_v) + rate[1] * f[channel]
                result.u[channel] = scale * (light[channel] * d_u + f[channel] * wp.dot(slope, world_u))
                result.v[channel] = scale * (light[channel] * d_v + f[channel] * wp.dot(slope, world_v))
        return result

    @wp.func
    def of_vertex(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        delta: wp.vec3,
        vertex: PathVertex,
        following: PathVertex,
        v: wp.vec2,
    ) -> tuple[wp.vec3, wp.float32]:
        """In forward mode the derivative of a vertex's terms; in reverse mode it is scattered, and what was dropped."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        found = wp.vec3(0.0, 0.0, 0.0)
        dropped = wp.float32(0.0)
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
        if not moves_smoothly(at.model):
            return found, dropped
        d = RoughnessPartials()
        if wp.static(has_lights):
            if vertex.light >= 0:
                d = of_light(scene, at, vertex)
        if vertex.lobe == LOBE_SMOOTH:
            sampled = RoughnessPartials()
            if wp.static(moves):
                if following.face < 0:
                    sampled = of_direction(scene, target, at, vertex, following, v)
            else:
                sampled = of_weight(scene, at, vertex, following)
            d.u += sampled.u
            d.v += sampled.v
        a_n = wp.cw_mul(delta, vertex.throughput)
        if wp.static(forward):
            m = material_jvp(scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, VertexTangent())
            found = wp.cw_mul(a_n, m.alpha_u * d.u + m.alpha_v * d.v)
        else:
            a_material = material_record()
            a_material.alpha_u = wp.dot(a_n, d.u)
            a_material.alpha_v = wp.dot(a_n, d.v)
            _adjoint, dropped = accumulate_material(
                scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, a_material, VertexAdjoint()
            )
        return found, dropped

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def attached(
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
        always = scene.requested_shapes[scene.requested_shapes.shape[0] - 1]
        derivative = wp.vec3d()  # in double precision, as the image
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, _sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            of_sample = wp.vec3(0.0, 0.0, 0.0)
            lost = wp.float32(0.0)
            depth = state.depth
            current, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            more = wp.bool(True)
            while more:
                r4 = sample_4d(sampler, 2 + SLOTS_PER_VERTEX * depth)
                following = PathVertex()
                following.face = -1
                more = state.alive == 1
                if more:
                    depth = state.depth
                    following, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                if current.face >= 0 and (current.lobe == LOBE_SMOOTH or current.light >= 0):
                    shape = scene.triangles[current.face].shape
                    if always + scene.requested_shapes[shape] > 0:
                        found, dropped = of_vertex(scene, target, delta, current, following, wp.vec2(r4[2], r4[3]))
                        of_sample += found
                        lost += dropped
                current = following
            if not finite(of_sample) or lost != 0.0:
                count_invalid(scene, sampler)
            elif wp.static(forward):
                derivative += wp.vec3d(of_sample)
        if wp.static(forward):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return attached

"""Interior term in forward mode: the derivative travels with the path.

Factors, parametrisation and detached sampling are those of record and sweep (``replay.py``), in the other order. With
A_n' the derivative of the throughput, dI = sum_n A_n' (E_n + D_n) + A_n (E_n' + D_n'). One trace suffices, and nothing
is recorded.

Derivation: ``docs/theory/interior.md#forward-mode``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.camera_rays import make_camera_paths
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_CONSTANT, EMITTER_ENVMAP, LOBE_SMOOTH
from warp_psdr.kernels.emitter.area import make_light_uv
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.contact import make_contact_weights
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import make_light_sink
from warp_psdr.kernels.interior.factors.tangents import Moving, local_jvp, log_geometry_jvp, make_frame_jvp
from warp_psdr.kernels.interior.factors.tilts import make_tilts, upright
from warp_psdr.kernels.interior.factors.transmittance import make_transmittance_sink
from warp_psdr.kernels.interior.factors.velocities import axis_vec3, make_material_jvp, make_pair, make_texture_jvp
from warp_psdr.kernels.interior.forward_lanes import make_lane_forward_kernel
from warp_psdr.kernels.interior.time_gated_forward import make_time_gated_forward_kernel
from warp_psdr.kernels.invalid import count_invalid, finite
from warp_psdr.kernels.jobs import PixelJob, pixel_of
from warp_psdr.kernels.lanes.path_lanes import side_by_side
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.primitive.dispatch import (
    flows_on,
    has_flow,
    has_slides,
    make_position,
    make_velocity,
    slides_on,
)
from warp_psdr.kernels.rng import sampler_at
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_ray, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig, PathState, PathVertex
from warp_psdr.kernels.vertex_motion import VertexTangent, normalize_jvp


@functools.cache
def make_forward_kernel(config: PathConfig, wanted: GradientRequest):
    """Return the forward-mode kernel of ``interior.Replay``.

    Arguments as ``make_replay_kernel``'s; ``target`` holds the tangents, ``image_out`` receives the derivative. Before
    a transient film it is that of ``time_gated_forward.py``.
    """
    lanes, starts, path_step = make_camera_paths(config, True)
    _camera_ray, camera_origin = make_camera_ray(config.camera)
    interaction = make_interaction(config.surfaces, config.lights)
    frame_jvp = make_frame_jvp(config.surfaces.tangent)
    vertex_jvp = make_velocity(
        config.surfaces.smooth,
        config.surfaces.flat,
        config.surfaces.uv,
        config.surfaces.tangent,
        config.surfaces.primitives,
    )
    position, cross_of = make_position(config.surfaces.primitives)
    light_uv = make_light_uv(config.lights.shining)
    has_sliding, has_flowing = has_slides(config.surfaces.primitives), has_flow(config.surfaces.primitives)
    material_jvp = make_material_jvp(config.surfaces, wanted)
    glossy, still = interaction.bsdf.glossy, make_tilts(config.surfaces).still
    pair = make_pair(config.surfaces.bsdfs)
    smooth_lobes = interaction.eval is not None
    delta_lobes = interaction.scatter is not None
    has_lights = bool(config.lights.area or config.lights.others) and smooth_lobes
    radiance_of = make_light_sink(config.surfaces, config.lights, wanted, "forward")[0] if has_lights else None
    through = (config.through or config.points_pass) and has_lights
    transmittance = make_transmittance_sink(config, wanted, "forward") if through else None
    geometry = wanted.geometry
    weight_before, weight_of_light = make_contact_weights(
        config.rays.backend, config.rays.width, config.surfaces.primitives
    )
    accumulate_camera = make_camera_sink("forward", config.camera) if wanted.camera else None
    emission_jvp = (
        make_texture_jvp(config.lights.area, False, wanted.radiance, wanted.to_uv, geometry or wanted.texcoords, ())
        if config.lights.area
        else None
    )
    emission = emission_jvp is not None and (wanted.radiance or wanted.to_uv or geometry)
    lights = make_lights(config.lights.others, "forward", wanted.lights) if config.lights.others else None
    environment_vjp = lights.environment_vjp if lights else None
    light_vjp = lights.sample_vjp if lights else None
    environment = environment_vjp is not None and (bool(wanted.lights) or geometry)
    delta_lights = light_vjp is not None and (bool(wanted.lights) or geometry)
    scatters = any(wanted.material) or wanted.to_uv or geometry or delta_lights

    @wp.func
    def environment_jvp(scene: Scene, tangents: wp.array(dtype=wp.float32), d: wp.vec3, d_dot: wp.vec3) -> wp.vec3:
        result = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(environment):
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            for channel in range(3):
                a = environment_vjp(scene, tangents, d, axis_vec3(channel))
                result[channel] = a.dot + wp.dot(a.x, d_dot)
        return result

    @wp.func
    def light_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        vertex: PathVertex,
        x: wp.vec3,
        x_dot: wp.vec3,
        chi: wp.float32,
    ) -> tuple[wp.vec3, wp.vec3, wp.float32]:
        """Velocity of the sampled light's radiance and direction, and G' / G of the connection, weighted with chi."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        radiance = wp.vec3(0.0, 0.0, 0.0)
        wo = wp.vec3(0.0, 0.0, 0.0)
        log_g = wp.float32(0.0)
        emitter = scene.emitters[vertex.light]
        if wp.static(bool(config.lights.area)):
            if emitter.kind == EMITTER_AREA:
                face = vertex.light_face
                u = vertex.light_u
                v = vertex.light_v
                zero = wp.vec3(0.0, 0.0, 0.0)
                moved = VertexTangent()
                if wp.static(geometry):
                    moved = vertex_jvp(scene, tangents, face, u, v, False, zero, zero, zero, zero)
                    tri = scene.triangles[face]
                    y = position(tri, u, v)
                    r = y - x
                    r_dot = moved.x - x_dot
                    wo = normalize_jvp(vertex.light_wi, wp.length(r), r_dot)
                    log_g = log_geometry_jvp(cross_of(tri, u, v), r, moved.c, r_dot, chi)
                if wp.static(emission):
                    radiance = emission_jvp(
                        scene, tangents, emitter.texture, face, u, v, light_uv(scene, face, u, v), moved
                    )
                return radiance, wo, log_g
        if wp.static(environment):
            if emitter.kind == EMITTER_CONSTANT or emitter.kind == EMITTER_ENVMAP:
                radiance = environment_jvp(scene, tangents, vertex.light_wi, wp.vec3(0.0, 0.0, 0.0))
                return radiance, wo, log_g
        if wp.static(delta_lights):
            if emitter.kind != EMITTER_CONSTANT and emitter.kind != EMITTER_ENVMAP:
                zero = wp.vec3(0.0, 0.0, 0.0)
                for channel in range(3):
                    a = light_vjp(scene, tangents, emitter, x, vertex.light_wi, axis_vec3(channel), zero)
                    b = light_vjp(scene, tangents, emitter, x, vertex.light_wi, zero, axis_vec3(channel))
                    radiance[channel] = a.dot + wp.dot(a.x, x_dot)
                    wo[channel] = b.dot + wp.dot(b.x, x_dot)
        return radiance, wo, log_g

    @wp.func
    def advance(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        vertex: PathVertex,
        following: PathVertex,
        moving: Moving,
        throughput_dot: wp.vec3,
    ) -> tuple[wp.vec3, wp.vec3, Moving]:
        """Derivative of vertex n's terms, A_{n+1}', and how vertex n + 1 moves."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        after = Moving()
        if wp.static(geometry):
            after.chi = weight_before(scene, following)
        a_n = vertex.throughput
        derivative = wp.cw_mul(throughput_dot, vertex.direct)
        next_dot = wp.cw_mul(throughput_dot, vertex.beta)
        if vertex.face < 0:
            if wp.static(environment):
                if vertex.e_weight > 0.0:
                    d_dot = wp.vec3(0.0, 0.0, 0.0)
                    if moving.by_ray:
                        d_dot = moving.d
                    l_dot = environment_jvp(scene, tangents, vertex.d, d_dot)
                    derivative += vertex.e_weight * wp.cw_mul(a_n, l_dot)
            return derivative, next_dot, after
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        shape = scene.shapes[surface.shape]
        if wp.static(emission):
            if shape.emitter >= 0 and vertex.e_weight > 0.0 and wp.dot(surface.ng, vertex.d) < 0.0:
                emitter = scene.emitters[shape.emitter]
                e_dot = emission_jvp(
                    scene, tangents, emitter.texture, vertex.face, vertex.u, vertex.v, surface.uv, moving.vertex
                )
                derivative += vertex.e_weight * wp.cw_mul(a_n, e_dot)
        if vertex.lobe == 0 and vertex.light < 0:
            return derivative, next_dot, after

        wi_world = -vertex.d
        at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
        frame = at.frame
        material_dot = material_jvp(
            scene, tangents, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, moving.vertex
        )
        turning = frame_jvp(frame, surface.tangent, moving.vertex)
        if wp.static(wanted.paired):
            if glossy(at.model):
                material_dot = still(material_dot)
                turning = frame_jvp(frame, surface.tangent, upright(moving.vertex))
        wi_dot = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(geometry):
            # wi = normalize(x_{n-1} - x_n).
            wi_world_dot = normalize_jvp(wi_world, wp.length(vertex.o - surface.x), moving.o - moving.vertex.x)
            wi_dot = moving.chi * local_jvp(frame, turning, wi_world, wi_world_dot)

        # D_n.
        if wp.static(has_lights):
            if vertex.light >= 0:
                wo = enter_frame(frame, vertex.light_wi)
                f = interaction.eval(at, wo)
                radiance = radiance_of(scene, vertex, surface.x)
                chi = wp.float32(1.0)
                if wp.static(geometry):
                    chi = weight_of_light(scene, vertex, surface.x)
                l_dot, wo_world_dot, log_g = light_jvp(scene, tangents, vertex, surface.x, moving.vertex.x, chi)
                f_dot = wp.vec3(0.0, 0.0, 0.0)
                if wp.static(scatters):
                    wo_dot = chi * local_jvp(frame, turning, vertex.light_wi, wo_world_dot)
                    for channel in range(3):
                        fa = interaction.eval_vjp(at, wo, axis_vec3(channel))
                        f_dot[channel] = pair(fa, material_dot, wi_dot, wo_dot)
                d_dot = wp.cw_mul(f_dot + log_g * f, radiance) + wp.cw_mul(f, l_dot)
                if wp.static(transmittance is not None):
                    segment = transmittance.segment(scene, at, vertex)
                    d_dot = wp.cw_mul(d_dot, segment.transmittance)
                    if wp.static(scatters):
                        if segment.passage.crossings > 0:
                            w_t = wp.cw_mul(f, radiance)
                            for channel in range(3):
                                w = w_t[channel] * axis_vec3(channel)
                                crossed = transmittance.accumulate(scene, tangents, segment, w)
                                along = wp.dot(crossed.o, moving.vertex.x) + wp.dot(crossed.d, wo_world_dot)
                                d_dot[channel] += crossed.dot + along
                derivative += vertex.light_weight * wp.cw_mul(a_n, d_dot)

        # beta_n and the way to vertex n + 1.
        beta_dot = wp.vec3(0.0, 0.0, 0.0)
        zero = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(smooth_lobes):
            if vertex.lobe == LOBE_SMOOTH:
                wo_world_dot = wp.vec3(0.0, 0.0, 0.0)
                if wp.static(geometry):
                    if following.face >= 0:
                        tri = scene.triangles[following.face]
                        y = position(tri, following.u, following.v)
                        r = y - following.o
                        slides = wp.bool(False)
                        if wp.static(has_sliding):
                            slides = slides_on(tri)
                        start = VertexTangent()
                        if slides:
                            # The ray that finds it starts where x_n is tied to its surface (form S).
                            start = vertex_jvp(
                                scene, tangents, vertex.face, vertex.u, vertex.v, False, zero, zero, zero, zero
                            )
                        after.vertex = vertex_jvp(
                            scene, tangents, following.face, following.u, following.v, slides,
                            following.o, following.d, start.x, zero,
                        )  # fmt: skip
                        r_dot = after.vertex.x - moving.vertex.x
                        cross = cross_of(tri, following.u, following.v)
                        if wp.static(has_sliding):
                            if slides:
                                r_dot = start.x - moving.vertex.x
                                found_on = interaction.surface(scene, following.face, following.u, following.v)
                                r = found_on.x - following.o
                                cross = found_on.ng
                        if wp.static(has_flowing):
                            if flows_on(tri):
                                cross = interaction.surface(scene, following.face, following.u, following.v).ng
                        wo_world_dot = normalize_jvp(vertex.wo, wp.length(r), r_dot)
                        beta_dot = log_geometry_jvp(cross, r, after.vertex.c, r_dot, after.chi) * vertex.beta
                if wp.static(scatters):
                    wo = enter_frame(frame, vertex.wo)
                    wo_dot = local_jvp(frame, turning, vertex.wo, wo_world_dot)
                    if wp.static(geometry):
                        wo_dot *= after.chi
                    f_dot = wp.vec3(0.0, 0.0, 0.0)
                    for channel in range(3):
                        fa = interaction.eval_vjp(at, wo, axis_vec3(channel))
                        f_dot[channel] = pair(fa, material_dot, wi_dot, wo_dot)
                    beta_dot += vertex.inv_pdf * f_dot
        if wp.static(delta_lobes):
            if vertex.lobe > LOBE_SMOOTH:
                wo = enter_frame(frame, vertex.wo)
                f_dot = wp.vec3(0.0, 0.0, 0.0)
                wo_dot = wp.vec3(0.0, 0.0, 0.0)
                for channel in range(3):
                    va = interaction.scatter_vjp(at, vertex.lobe, axis_vec3(channel), zero)
                    f_dot[channel] = pair(va, material_dot, wi_dot, zero)
                    if wp.static(geometry):
                        da = interaction.scatter_vjp(at, vertex.lobe, zero, axis_vec3(channel))
                        wo_dot[channel] = pair(da, material_dot, wi_dot, zero)
                beta_dot = vertex.inv_pdf * f_dot
                if wp.static(geometry):
                    after.by_ray = True
                    after.d = (
                        wo_dot[0] * frame.s + wo_dot[1] * frame.t + wo_dot[2] * frame.n
                        + wo[0] * turning.s + wo[1] * turning.t + wo[2] * turning.n
                    )  # fmt: skip
                    if following.face >= 0:
                        after.vertex = vertex_jvp(
                            scene, tangents, following.face, following.u, following.v, True,
                            following.o, following.d, moving.vertex.x, after.d,
                        )  # fmt: skip
        after.o = moving.vertex.x
        next_dot += wp.cw_mul(a_n, beta_dot)
        return derivative, next_dot, after

    @wp.func
    def first_moving(
        scene: Scene,
        camera: Camera,
        tangents: wp.array(dtype=wp.float32),
        sample: CameraSample,
        vertex: PathVertex,
    ) -> Moving:
        """How the camera ray and the vertex that it finds move."""
        result = Moving()
        result.by_ray = True
        result.chi = 1.0
        if wp.static(geometry):
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            zero = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(wanted.camera):
                for axis in range(3):
                    result.o[axis] = accumulate_camera(scene, tangents, camera, sample, axis_vec3(axis), zero)
                    result.d[axis] = accumulate_camera(scene, tangents, camera, sample, zero, axis_vec3(axis))
            if vertex.face >= 0:
                result.vertex = vertex_jvp(
                    scene, tangents, vertex.face, vertex.u, vertex.v, True, vertex.o, vertex.d, result.o, result.d
                )
        return result

    if config.pulse:
        return make_time_gated_forward_kernel(config, wanted, advance, first_moving)
    if side_by_side(config):
        together = make_lane_forward_kernel(config, wanted, advance, first_moving)
        if together is not None:
            return together

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def forward(
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
        total = wp.vec3d()  # in double precision, as the image
        starting = wp.zeros(shape=(wp.static(lanes),), dtype=PathState)
        cameras = wp.zeros(shape=(wp.static(lanes),), dtype=CameraSample)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            state, sample = starts(scene, camera, pixel.px, pixel.py, sampler, i, job.samples, starting, cameras)
            vertex, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
            vertex.o = camera_origin(scene, camera, sample)
            moving = first_moving(scene, camera, target, sample, vertex)
            sum_dot = wp.vec3(0.0, 0.0, 0.0)
            throughput_dot = wp.vec3(0.0, 0.0, 0.0)
            more = wp.bool(True)
            while more:
                following = PathVertex()
                following.face = -1
                more = state.alive == 1
                if more:
                    following, state = path_step(scene, sampler, state, job.max_depth, job.rr_depth)
                derivative, throughput_dot, moving = advance(scene, target, vertex, following, moving, throughput_dot)
                sum_dot += derivative
                vertex = following
            if finite(sum_dot):
                total += wp.vec3d(sum_dot)
            else:
                count_invalid(scene, sampler)
        image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(wp.float64(job.scale) * total)

    return forward

"""The backward sweep over a path's vertices: the derivatives of one vertex's factors (``replay.py``)."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.contact import make_contact_weights, no_weight_before, no_weight_of_light
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import connection_vjp, make_frame_vjp
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.interior.factors.tilts import make_tilts
from warp_psdr.kernels.interior.factors.transmittance import make_transmittance_sink
from warp_psdr.kernels.primitive.dispatch import (
    flows_on,
    has_flow,
    has_slides,
    make_adjoint_sink,
    make_position,
    slides_on,
)
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, normalize_vjp
from warp_psdr.kernels.texture.texture import make_texture_sink
from warp_psdr.kernels.vertex import PathConfig, PathVertex


@wp.struct
class Carry:
    """What the sweep hands from a vertex to the one before it."""

    radiance: wp.vec3  # L_{n+1}
    lit: wp.vec3  # radiance of the light that vertex n has drawn, if the sweep is told
    crosses: wp.int32  # 1: its shadow ray crosses surfaces, if the sweep is told
    face: wp.int32  # vertex n + 1; -1: it left the scene, -2: there is none
    u: wp.float32
    v: wp.float32
    o: wp.vec3
    d: wp.vec3
    adjoint: VertexAdjoint  # of vertex n + 1, complete but for beta_n
    a_x: wp.vec3  # adjoint of x_n, seen as the point before vertex n + 1
    a_d: wp.vec3  # adjoint of the direction of a ray that left the scene
    chi: wp.float32  # weight of the connection of the two
    dot: wp.float32  # forward mode: what the sinks returned so far


@functools.cache
def make_sweep(
    config: PathConfig,
    wanted: GradientRequest,
    role: str,
    direct: bool = True,
    links: bool = True,
    before: wp.Function | None = None,
    told: bool = False,
):
    """Return ``(sweep, finish, finish_vertex)``. ``direct=False``: D_n is the caller's to differentiate.

    ``links=False``: light points are found by directions that rest, and contacts weigh nothing.
    ``before``: in place of ``weight_before`` of ``make_contact_weights``. ``told``: ``Carry.lit`` and
    ``Carry.crosses`` are set.

    ``sweep(scene, target, vertex, delta, carry) -> Carry``: the step from vertex n + 1 to vertex n.
    ``finish(scene, target, camera, sample, carry) -> float``: the last one, from vertex 1 to the camera; in forward
    mode it returns the derivative of the sample.
    ``finish_vertex(scene, target, carry, by_ray) -> Carry``: scatter the adjoint of one vertex.
    """
    interaction = make_interaction(config.surfaces, config.lights)
    material_record = interaction.bsdf.record
    add_materials = interaction.bsdf.algebra.add
    scatter_vjp = interaction.scatter_vjp
    has_delta = scatter_vjp is not None
    glossy, still = interaction.bsdf.glossy, make_tilts(config.surfaces).still
    has_smooth = interaction.eval is not None
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    has_lights = direct and bool(config.lights.area or config.lights.others) and has_smooth
    radiance_of, accumulate_light = (
        make_light_sink(config.surfaces, config.lights, wanted, role, links) if has_lights else (None, None)
    )
    accumulate_vertex = make_adjoint_sink(
        role,
        config.surfaces.smooth,
        config.surfaces.flat,
        config.surfaces.uv,
        config.surfaces.tangent,
        wanted.texcoords,
        True,
        config.surfaces.primitives,
    )
    position, cross_of = make_position(config.surfaces.primitives)
    has_sliding, has_flowing = has_slides(config.surfaces.primitives), has_flow(config.surfaces.primitives)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None
    emission = bool(config.lights.area) and (wanted.radiance or wanted.to_uv or wanted.geometry)
    accumulate_emission = (
        make_texture_sink(role, config.lights.area, wanted.radiance, wanted.to_uv, wanted.geometry)
        if emission
        else None
    )
    lights = make_lights(config.lights.others, role, wanted.lights) if config.lights.others else None
    environment_vjp = lights.environment_vjp if lights else None
    environment = environment_vjp is not None and (bool(wanted.lights) or wanted.geometry)
    geometry = wanted.geometry
    weight_before, weight_of_light = (
        make_contact_weights(config.rays.backend, config.rays.width, config.surfaces.primitives)
        if links
        else (no_weight_before, no_weight_of_light)
    )
    weight_before = before or weight_before
    # The direction towards a point, spot or directional light moves with the light.
    aims = geometry or ("pose" in wanted.lights and lights is not None and lights.sample_vjp is not None)
    materials = any(wanted.material) or wanted.to_uv or aims
    light_terms = materials or wanted.radiance or bool(wanted.lights)
    area_radiance = bool(config.lights.area) and (wanted.radiance or wanted.to_uv or wanted.texcoords)
    through = (config.through or config.points_pass) and has_lights
    transmittance = make_transmittance_sink(config, wanted, role) if through else None
    accumulate_lights = has_lights and (geometry or area_radiance or bool(wanted.lights))

    @wp.func
    def finish_vertex(scene: Scene, target: wp.array(dtype=wp.float32), carry: Carry, by_ray: wp.bool) -> Carry:
        """Scatter the adjoint of vertex n + 1; ``a_x`` and ``a_d`` of the result are those of its ray, if attached."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        c = carry
        if carry.face >= 0:
            accumulated = accumulate_vertex(
                scene, target, carry.face, carry.u, carry.v, carry.adjoint, by_ray, carry.o, carry.d
            )
            c.dot += accumulated.dot
            c.a_x = carry.a_x + accumulated.o
            c.a_d = accumulated.d
        return c

    @wp.func
    def sweep(
        scene: Scene, target: wp.array(dtype=wp.float32), vertex: PathVertex, delta: wp.vec3, carry_in: Carry
    ) -> Carry:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        carry = carry_in
        result = Carry()
        a_n = wp.cw_mul(delta, vertex.throughput)
        result.face = vertex.face
        result.u = vertex.u
        result.v = vertex.v
        result.o = vertex.o
        result.d = vertex.d
        if wp.static(geometry):
            result.chi = weight_before(scene, vertex)
        result.radiance = vertex.direct + wp.cw_mul(vertex.beta, carry.radiance)

        if vertex.face < 0:
            if wp.static(environment):
                if vertex.e_weight > 0.0:
                    ea = environment_vjp(scene, target, vertex.d, vertex.e_weight * a_n)
                    result.dot = carry.dot + ea.dot
                    result.a_d = ea.x
            return result

        total = carry.dot
        adjoint = VertexAdjoint()
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        shape = scene.shapes[surface.shape]

        # E_n: emission met by the incoming ray.
        if wp.static(emission):
            if shape.emitter >= 0 and vertex.e_weight > 0.0 and wp.dot(surface.ng, vertex.d) < 0.0:
                emitter = scene.emitters[shape.emitter]
                ta = accumulate_emission(
                    scene, target, emitter.texture, vertex.face, vertex.u, vertex.v, surface.uv, vertex.e_weight * a_n
                )
                total += ta.dot
                adjoint.uv = ta.uv
                adjoint.u = ta.u
                adjoint.v = ta.v

        if vertex.lobe == LOBE_NONE and vertex.light < 0:
            result.dot = total
            result.adjoint = adjoint
            return result

        if wp.static(light_terms):
            wi_world = -vertex.d
            at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
            frame = at.frame
            a_material = material_record()
            a_wi_world = wp.vec3(0.0, 0.0, 0.0)
            a_frame_n = wp.vec3(0.0, 0.0, 0.0)
            a_tangent = wp.vec3(0.0, 0.0, 0.0)

            # D_n: next-event estimate.
            if wp.static(has_lights):
                if vertex.light >= 0:
                    wo = enter_frame(frame, vertex.light_wi)
                    radiance = carry.lit
                    if wp.static(not told):
                        radiance = radiance_of(scene, vertex, surface.x)
                    a_direct = a_n
                    a_wo_world = wp.vec3(0.0, 0.0, 0.0)
                    if wp.static(transmittance is not None):
                        if wp.static(not told) or carry.crosses == 1:
                            segment = transmittance.segment(scene, at, vertex)
                            if wp.static(materials):
                                if segment.passage.crossings > 0:
                                    w_t = vertex.light_weight * wp.cw_mul(a_n, radiance)
                                    w_t = wp.cw_mul(w_t, interaction.eval(at, wo))
                                    crossed = transmittance.accumulate(scene, target, segment, w_t)
                                    total += crossed.dot
                                    adjoint.x += crossed.o
                                    a_wo_world = crossed.d
                            a_direct = wp.cw_mul(a_n, segment.transmittance)
                    w_f = vertex.light_weight * wp.cw_mul(a_direct, radiance)
                    chi = wp.float32(1.0)
                    if wp.static(materials):
                        fa = interaction.eval_vjp(at, wo, w_f)
                        a_material = fa.material
                        if wp.static(geometry):
                            chi = weight_of_light(scene, vertex, surface.x)
                            fa.wi *= result.chi
                            fa.wo *= chi
                        if wp.static(aims):
                            turned = frame_vjp(frame, surface.tangent, wi_world, vertex.light_wi, fa.wi, fa.wo)
                            a_frame_n += turned.n
                            a_tangent += turned.tangent
                            a_wi_world += turned.wi
                            a_wo_world += turned.wo
                    if wp.static(accumulate_lights):
                        f = interaction.eval(at, wo)
                        a_x, dot = accumulate_light(
                            scene, target, vertex, surface.x,
                            vertex.light_weight * wp.cw_mul(a_direct, f), wp.dot(w_f, f), a_wo_world, chi,
                        )  # fmt: skip
                        adjoint.x += a_x
                        total += dot

            # beta_n L_{n+1}.
            if wp.static(materials):
                if wp.static(has_smooth):
                    if vertex.lobe == LOBE_SMOOTH:
                        wo = enter_frame(frame, vertex.wo)
                        w_f = vertex.inv_pdf * wp.cw_mul(a_n, carry.radiance)
                        fa = interaction.eval_vjp(at, wo, w_f)
                        a_material = add_materials(a_material, fa.material)
                        if wp.static(geometry):
                            turned = frame_vjp(
                                frame, surface.tangent, wi_world, vertex.wo, result.chi * fa.wi, carry.chi * fa.wo
                            )
                            a_frame_n += turned.n
                            a_tangent += turned.tangent
                            a_wi_world += turned.wi
                            slides = wp.bool(False)
                            tied = wp.vec3(0.0, 0.0, 0.0)
                            if carry.face >= 0:
                                tri = scene.triangles[carry.face]
                                y = position(tri, carry.u, carry.v)
                                value = wp.dot(wp.cw_mul(a_n, vertex.beta), carry.radiance)
                                cross = cross_of(tri, carry.u, carry.v)
                                if wp.static(has_sliding):
                                    slides = slides_on(tri)
                                    if slides:
                                        found_on = interaction.surface(scene, carry.face, carry.u, carry.v)
                                        y = found_on.x
                                        cross = found_on.ng
                                if wp.static(has_flowing):
                                    if flows_on(tri):
                                        found_on = interaction.surface(scene, carry.face, carry.u, carry.v)
                                        y = found_on.x
                                        cross = found_on.ng
                                link = connection_vjp(carry.o, y, cross, vertex.wo, turned.wo, value, carry.chi)
                                adjoint.x += link.x
                                tied = link.x
                                if not slides:
                                    carry.adjoint.x = carry.adjoint.x - link.x
                                    carry.adjoint.c = carry.adjoint.c + link.c
                            carry.dot = wp.float32(0.0)
                            if wp.static(has_sliding):
                                if slides:
                                    # The ray that finds it starts where x_n is tied to its surface (form S).
                                    adjoint.x += carry.a_x
                                    carry.a_x = wp.vec3(0.0, 0.0, 0.0)
                                    found = finish_vertex(scene, target, carry, True)
                                    start = VertexAdjoint()
                                    start.x = found.a_x - tied
                                    started = accumulate_vertex(
                                        scene, target, vertex.face, vertex.u, vertex.v, start, False, vertex.o, vertex.d
                                    )
                                    total += found.dot + started.dot
                                    carry.face = -1
                                    carry.dot = wp.float32(0.0)
                            done = finish_vertex(scene, target, carry, False)
                            adjoint.x += done.a_x
                            total += done.dot
                if wp.static(has_delta):
                    if vertex.lobe > LOBE_SMOOTH:
                        w = vertex.inv_pdf * wp.cw_mul(a_n, carry.radiance)
                        wo = enter_frame(frame, vertex.wo)
                        a_d = wp.vec3(0.0, 0.0, 0.0)
                        if wp.static(geometry):
                            carry.dot = wp.float32(0.0)
                            done = finish_vertex(scene, target, carry, True)
                            total += done.dot
                            adjoint.x += done.a_x
                            a_d = done.a_d
                        fa = scatter_vjp(at, vertex.lobe, w, enter_frame(frame, a_d))
                        a_material = add_materials(a_material, fa.material)
                        if wp.static(geometry):
                            # The local direction leaves the frame: d = F wo, the transpose of entering it.
                            turned = frame_vjp(frame, surface.tangent, wi_world, a_d, result.chi * fa.wi, wo)
                            a_frame_n += turned.n
                            a_tangent += turned.tangent
                            a_wi_world += turned.wi

                if wp.static(wanted.paired):
                    if glossy(at.model):
                        a_material = still(a_material)
                        a_frame_n = wp.vec3(0.0, 0.0, 0.0)
                adjoint, dot = accumulate_material(
                    scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, a_material, adjoint
                )
                total += dot
            if wp.static(geometry):
                adjoint.n = frame.side * a_frame_n
                if wp.static(config.surfaces.tangent):
                    adjoint.tangent = a_tangent
                # wi = normalize(x_{n-1} - x_n).
                result.a_x = normalize_vjp(wi_world, wp.length(vertex.o - surface.x), a_wi_world)
                adjoint.x -= result.a_x
        result.adjoint = adjoint
        result.dot = total
        return result

    @wp.func
    def finish(
        scene: Scene, target: wp.array(dtype=wp.float32), camera: Camera, sample: CameraSample, carry: Carry
    ) -> wp.float32:
        if wp.static(not geometry):
            return carry.dot
        else:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            done = finish_vertex(scene, target, carry, True)
            total = done.dot
            if wp.static(wanted.camera):
                total += accumulate_camera(scene, target, camera, sample, done.a_x, done.a_d)
            return total

    return sweep, finish, finish_vertex

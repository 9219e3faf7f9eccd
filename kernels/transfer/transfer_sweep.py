"""The sweep of the differential radiative transfer equation [ZWZ*19], with directions and distances fixed in the world.

The end of a ray rides on the surface there and slides over it. A point of a medium lies at a fixed distance from the
start of its ray, and a new direction is fixed in the world. A vertex therefore hands back the adjoint of its position
alone; only the camera's ray has an adjoint of its direction. Two terms are added: the in-scattering at both ends of a
flight, times the speeds of these ends, and an edge that the vertex sees (``transfer_sphere.py``).

Derivation: ``docs/theory/media.md#the-differential-equation``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.local_form import Edges, make_edge_sink
from warp_psdr.kernels.constants import (
    EMITTER_AREA,
    EMITTER_CONSTANT,
    EMITTER_ENVMAP,
    LOBE_NULL,
    LOBE_SMOOTH,
)
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import make_frame_vjp
from warp_psdr.kernels.interior.factors.shadow_motion import make_light_end_sink, make_shadow_sink
from warp_psdr.kernels.interior.factors.sinks import make_light_sink
from warp_psdr.kernels.medium.coefficients import coefficients_of
from warp_psdr.kernels.medium.interface import make_interface_sink
from warp_psdr.kernels.path_media import MediaVertex, collision_point
from warp_psdr.kernels.phase.dispatch import make_phase, make_phase_slopes
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.sensor.camera import CameraSample, make_camera_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink, point_on
from warp_psdr.kernels.transfer.transfer_sphere import SphereEdge
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class TransferStep:
    """A step of a path, and what its ray hangs on."""

    step: MediaVertex
    start: wp.vec3  # y: where its direction was drawn
    before: wp.float32  # distance from there to where its flight starts
    crossed: wp.bool  # its flight starts at an interface
    inner: wp.float32  # distance from there to a point that float32 tells from the interface
    depth: wp.int32  # path vertices in front of it


@wp.struct
class FlightEnds:
    """sigma_s times the in-scattering at the ends of a flight; 0 where the end does not move against the ray."""

    near: wp.vec3
    far: wp.vec3


@wp.struct
class TransferCarry:
    """What the sweep hands from a step to the one before it."""

    radiance: wp.vec3
    a_o: wp.vec3  # adjoint of y
    a_d: wp.vec3  # adjoint of the direction of the ray from y
    a_t: wp.float32  # adjoint of the distance from y to where the step's flight starts
    dot: wp.float32  # what the sinks of this step returned


@wp.struct
class TransferVertex:
    """Adjoint of a vertex and of the direction in which it is reached."""

    vertex: VertexAdjoint
    d: wp.vec3
    dot: wp.float32


@functools.cache
def make_transfer_sweep(config: PathConfig, wanted: GradientRequest, role: str, sees_edges: bool):
    """Return ``(transfer_sweep, finish)``.

    ``transfer_sweep(scene, target, edges, step, delta, carry, ends, edge) -> TransferCarry``.
    ``finish(scene, target, camera, sample, carry) -> float32``: from the first step to the camera.
    """
    assert config.media is not None
    interaction = make_interaction(config.surfaces, config.lights)
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    phase = make_phase(config.media.phases)
    by_cosine, _by_place = make_phase_slopes(config.media.phases)
    has_lights = bool(config.lights.area or config.lights.others)
    has_smooth = interaction.eval is not None
    smooth_lights = samples_lights(config.lights, config.surfaces.bsdfs)
    radiance_of, accumulate_light = (
        make_light_sink(config.surfaces, config.lights, wanted, role, False) if has_lights else (None, None)
    )
    lights = make_lights(config.lights.others, role, wanted.lights) if config.lights.others else None
    environment_vjp = lights.environment_vjp if lights else None
    accumulate_shadow = make_shadow_sink(config, role)
    accumulate_end = make_light_end_sink(config.surfaces, config.lights, wanted, role)
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    accumulate_edge = make_edge_sink(role) if sees_edges else None
    accumulate_vertex = make_vertex_sink(role, False, True, False, config.surfaces.tangent, False, True)
    accumulate_camera = make_camera_sink(role, config.camera) if wanted.camera else None

    @wp.func
    def towards_light(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, x: wp.vec3, w_radiance: wp.vec3, a_wo: wp.vec3
    ) -> tuple[wp.vec3, wp.float32]:
        """Adjoint of x, where light arrives; ``a_wo``: of its direction, which lights without an area move alone."""
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        vertex = v.surface
        segment = accumulate_shadow(scene, target, v, wp.cw_mul(w_radiance, radiance_of(scene, vertex, x)))
        a_x = segment.o
        total = segment.dot
        kind = scene.emitters[vertex.light].kind
        along = segment.length * v.shadow_d
        if kind == EMITTER_AREA:
            # Not along the shadow ray, which ends in front of the light and so may be parallel to it.
            along = segment.length * vertex.light_wi
            adjoint = VertexAdjoint()
            adjoint.x = along
            found = accumulate_vertex(
                scene, target, vertex.light_face, vertex.light_u, vertex.light_v, adjoint, True, x, vertex.light_wi
            )
            a_x += found.o - along
            total += found.dot
        elif kind != EMITTER_CONSTANT and kind != EMITTER_ENVMAP:
            lit, dot = accumulate_light(scene, target, vertex, x, w_radiance, 0.0, a_wo + segment.d, 1.0)
            a_x += lit
            total += dot
            ends, end_dot = accumulate_end(scene, target, v, along)
            if ends:
                a_x -= along
                total += end_dot
        return a_x, total

    @wp.func
    def of_collision(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, a_n: wp.vec3, radiance: wp.vec3
    ) -> TransferVertex:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = TransferVertex()
        vertex = v.surface
        m = scene.media.records[v.medium]
        x = collision_point(v)
        if vertex.lobe == LOBE_SMOOTH:
            w = vertex.inv_pdf * wp.dot(a_n, radiance)
            r.d = (w * by_cosine(scene, m, x, wp.dot(vertex.d, vertex.wo))) * vertex.wo
        if wp.static(has_lights):
            if vertex.light >= 0:
                a_direct = vertex.light_weight * wp.cw_mul(a_n, v.transmittance)
                turned = wp.dot(a_direct, radiance_of(scene, vertex, x))
                turned *= by_cosine(scene, m, x, wp.dot(vertex.d, vertex.light_wi))
                w_radiance = phase.eval(scene, m, x, vertex.d, vertex.light_wi) * a_direct
                a_x, dot = towards_light(scene, target, v, x, w_radiance, turned * vertex.d)
                r.vertex.x = a_x
                r.d = r.d + turned * vertex.light_wi
                r.dot = dot
        return r

    @wp.func
    def of_surface(
        scene: Scene, target: wp.array(dtype=wp.float32), v: MediaVertex, a_n: wp.vec3, radiance: wp.vec3
    ) -> TransferVertex:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = TransferVertex()
        vertex = v.surface
        if wp.static(has_smooth):
            surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
            at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
            wi = -vertex.d
            a_normal = wp.vec3(0.0, 0.0, 0.0)
            a_tangent = wp.vec3(0.0, 0.0, 0.0)
            if wp.static(smooth_lights):
                if vertex.light >= 0:
                    wo = enter_frame(at.frame, vertex.light_wi)
                    a_direct = vertex.light_weight * wp.cw_mul(a_n, v.transmittance)
                    fa = interaction.eval_vjp(at, wo, wp.cw_mul(a_direct, radiance_of(scene, vertex, surface.x)))
                    turned = frame_vjp(at.frame, surface.tangent, wi, vertex.light_wi, fa.wi, fa.wo)
                    w_radiance = wp.cw_mul(a_direct, interaction.eval(at, wo))
                    a_x, dot = towards_light(scene, target, v, surface.x, w_radiance, turned.wo)
                    r.vertex.x = a_x
                    r.dot = dot
                    a_normal += turned.n
                    a_tangent += turned.tangent
                    r.d = r.d - turned.wi
            if vertex.lobe == LOBE_SMOOTH:
                wo = enter_frame(at.frame, vertex.wo)
                fa = interaction.eval_vjp(at, wo, vertex.inv_pdf * wp.cw_mul(a_n, radiance))
                turned = frame_vjp(at.frame, surface.tangent, wi, vertex.wo, fa.wi, fa.wo)
                a_normal += turned.n
                a_tangent += turned.tangent
                r.d = r.d - turned.wi
            r.vertex.n = at.frame.side * a_normal
            r.vertex.tangent = a_tangent
        return r

    @wp.func
    def transfer_sweep(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        edges: Edges,
        s: TransferStep,
        delta: wp.vec3,
        carry: TransferCarry,
        ends: FlightEnds,
        edge: SphereEdge,
    ) -> TransferCarry:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        v = s.step
        vertex = v.surface
        d = vertex.d
        a_n = wp.cw_mul(delta, vertex.throughput)
        a_before = wp.cw_mul(delta, v.before)
        r = TransferCarry()
        r.radiance = wp.cw_mul(v.weight, vertex.direct + wp.cw_mul(vertex.beta, carry.radiance))
        # ---- The flight: its transmittance, and the integrand at its ends ----
        a_near = -wp.dot(a_before, ends.near)
        a_far = wp.dot(a_n, ends.far)
        if v.medium >= 0:
            sigma_t = coefficients_of(scene, scene.media.records[v.medium]).sigma_t
            thins = wp.dot(sigma_t, wp.cw_mul(a_before, r.radiance))
            a_near += thins
            if not v.collides:
                a_far -= thins
        r.a_t = a_near
        # ---- The boundary of the sphere of directions ----
        a_x = carry.a_o
        if wp.static(sees_edges):
            if edge.valid:
                g = wp.dot(a_n, edge.value) * edge.m
                r.dot = accumulate_edge(scene, target, edges, edge.point, g)
                a_x -= g
        # ---- The vertex ----
        if v.collides:
            found = of_collision(scene, target, v, a_n, carry.radiance)
            r.a_o = a_x + found.vertex.x
            r.a_d = found.d + (s.before + v.t) * r.a_o
            r.dot = r.dot + found.dot
        elif vertex.face < 0:
            if wp.static(environment_vjp is not None):
                if vertex.e_weight > 0.0:
                    sky = environment_vjp(scene, target, d, vertex.e_weight * a_n)
                    r.a_d = sky.x
                    r.dot = r.dot + sky.dot
        elif vertex.lobe == LOBE_NULL:
            far = wp.dot(point_on(scene.triangles[vertex.face], vertex.u, vertex.v) - s.start, d)
            crossing = accumulate_crossing(scene, target, vertex.face, vertex.u, vertex.v, d, far, a_far + carry.a_t)
            r.a_o = carry.a_o + crossing.o
            r.a_d = carry.a_d + crossing.d
            r.dot = r.dot + crossing.dot
        else:
            found = of_surface(scene, target, v, a_n, carry.radiance)
            adjoint = found.vertex
            adjoint.x = adjoint.x + a_x + a_far * d
            slid = accumulate_vertex(scene, target, vertex.face, vertex.u, vertex.v, adjoint, True, s.start, d)
            r.a_o = slid.o - a_far * d
            r.a_d = found.d + slid.d
            r.dot = r.dot + found.dot + slid.dot
        return r

    @wp.func
    def finish(
        scene: Scene, target: wp.array(dtype=wp.float32), camera: Camera, sample: CameraSample, carry: TransferCarry
    ) -> wp.float32:
        total = wp.float32(0.0)
        if wp.static(wanted.camera):
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            total = accumulate_camera(scene, target, camera, sample, carry.a_o, carry.a_d)
        return total

    return transfer_sweep, finish

"""Light paths whose vertices move: derivatives of caustics by glass, mirrors, indices of refraction and lights.

Every vertex rides on the ray that finds it. Rays leave lights and smooth lobes in fixed directions; mirrors and glass
turn them. The measure is that of solid angles, which do not move. The places on the film, the camera's importance,
scattering functions and the cosines of flux move. The correction for shading normals jumps from triangle to triangle
with a mean of 1, and is held fixed. Edges that such paths cross are a boundary term that is not estimated here.

Derivation: ``docs/theory/light_tracing.md#vertices-that-move``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import (
    CAMERA_ORTHOGRAPHIC,
    EMITTER_POINT,
    EMITTER_PROJECTOR,
    LOBE_DELTA_TRANSMISSION,
    LOBE_SMOOTH,
    SPOTS,
    THIN_LENSES,
)
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import make_frame_vjp
from warp_psdr.kernels.interior.factors.sinks import make_light_sink, make_material_sink
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.light_path import SLOT_FIRST, SLOTS_PER_LIGHT_VERTEX, LightVertex
from warp_psdr.kernels.light_ray import LightRay, light_vertex, radiance_scale
from warp_psdr.kernels.reading import emitter_at, triangle_at
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.sensor.camera import make_lens
from warp_psdr.kernels.sensor.projection import FilmPoint, camera_block, make_area_gradient, make_projection
from warp_psdr.kernels.sink import make_sink, make_sink_vec3
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.surface import VertexAdjoint, make_vertex_sink, normalize_vjp, point_on
from warp_psdr.kernels.vertex import PathConfig


@wp.struct
class LightCarry:
    """What the sweep hands from a vertex of a light path to the one before it, towards the light."""

    face: wp.int32  # -1: there is none
    u: wp.float32
    v: wp.float32
    received: wp.vec3  # S, what the camera asks of the flux that arrives
    adjoint: VertexAdjoint  # of the vertex
    a_d: wp.vec3  # of the direction of its ray, its place held
    dot: wp.float32  # forward mode: what the sinks returned so far


class LightMotion(NamedTuple):
    """Functions of the sweep; ``target`` as in ``sink.py``.

    Attributes:
        lens: ``(sampler, n) -> vec2``: the numbers that join vertex n to a point of the lens.
        sweep: ``(scene, target, camera, vertex, lens, flux, asked, a_pixel, carry) -> LightCarry``: to the vertex from
            the one behind it. ``flux`` arrives at it; ``asked``: adjoint of what it sends to the camera, ``a_pixel``:
            of its place on the film.
        leave: ``(scene, target, ray, carry) -> float``: the last step, to the light.
    """

    lens: wp.Function
    sweep: wp.Function
    leave: wp.Function


@functools.cache
def make_importance_gradient(kind: int):
    """Return ``importance_gradient(scene, camera, at, x) -> vec3``: gradient of log ``FilmPoint.per_area`` by x."""
    area_gradient = make_area_gradient(kind)

    @wp.func
    def importance_gradient(scene: Scene, camera: Camera, at: FilmPoint, x: wp.vec3) -> wp.vec3:
        if wp.static(kind == CAMERA_ORTHOGRAPHIC):
            return wp.vec3(0.0, 0.0, 0.0)
        else:
            # |x - o| / depth^3
            away = x - at.origin
            inverse = wp.inverse(camera_block(scene, camera))
            depth = wp.vec3(inverse[2, 0], inverse[2, 1], inverse[2, 2])
            g = away / wp.length_sq(away) - (3.0 / at.camera_space[2]) * depth
            if wp.static(area_gradient is not None):
                _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
                g += area_gradient(scene, camera, at)
            return g

    return importance_gradient


@functools.cache
def make_place_sink(lights: tuple[int, ...], role: str):
    """Return ``accumulate_place(scene, target, emitter, a) -> float``: adjoint of where a light of no area is."""
    sink, sink_vec3 = make_sink(role), make_sink_vec3(role)
    posed = bool({*SPOTS, EMITTER_PROJECTOR} & set(lights))

    @wp.func
    def accumulate_place(scene: Scene, target: wp.array(dtype=wp.float32), emitter: wp.int32, a: wp.vec3) -> wp.float32:
        light = emitter_at(scene, emitter)
        total = wp.float32(0.0)
        if light.kind == EMITTER_POINT:
            total = sink_vec3(target, light.to_world, a)
        elif wp.static(posed):
            for i in range(3):
                total += sink(target, light.to_world + 4 * i + 3, a[i])
        return total

    return accumulate_place


@functools.cache
def make_light_motion(config: PathConfig, wanted: GradientRequest, role: str) -> LightMotion:
    """Return the functions; ``role``: "reverse" or "forward"."""
    interaction = make_interaction(config.surfaces, config.lights)
    material_record, add_materials = interaction.bsdf.record, interaction.bsdf.algebra.add
    eval_vjp, delta_vjp = interaction.eval_vjp, interaction.scatter_vjp
    relative_eta = interaction.bsdf.relative_eta
    has_smooth = eval_vjp is not None
    frame_vjp = make_frame_vjp(config.surfaces.tangent)
    accumulate_material = make_material_sink(config.surfaces, wanted, role)
    accumulate_vertex = make_vertex_sink(
        role,
        config.surfaces.smooth,
        config.surfaces.flat,
        config.surfaces.uv,
        config.surfaces.tangent,
        wanted.texcoords,
        True,
    )
    _radiance_of, accumulate_light = make_light_sink(config.surfaces, config.lights, wanted, role, links=False)
    accumulate_place = make_place_sink(config.lights.others, role)
    importance_gradient = make_importance_gradient(config.camera)
    project, film_gradient, _film_velocity = make_projection(config.camera)
    lens_point = make_lens(config.camera)
    sample_2d = make_sampler(config.sampler).sample_2d
    posed = "pose" in wanted.lights

    @wp.func
    def lens_of(sampler: Sampler, n: wp.int32) -> wp.vec2:
        lens = wp.vec2(0.0, 0.0)
        if wp.static(config.camera in THIN_LENSES):
            lens = lens_point(sample_2d(sampler, SLOT_FIRST + SLOTS_PER_LIGHT_VERTEX * n + 1))
        return lens

    @wp.func
    def sweep(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        camera: Camera,
        vertex: LightVertex,
        lens: wp.vec2,
        flux: wp.vec3,
        asked: wp.vec3,
        a_pixel: wp.vec2,
        carry: LightCarry,
    ) -> LightCarry:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = LightCarry()
        result.face = vertex.face
        result.u = vertex.u
        result.v = vertex.v
        result.received = wp.cw_mul(asked, vertex.value)
        total = carry.dot
        surface = interaction.surface(scene, vertex.face, vertex.u, vertex.v)
        at = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, vertex.d)
        adjoint = VertexAdjoint()
        a_d = wp.vec3(0.0, 0.0, 0.0)
        a_n = wp.vec3(0.0, 0.0, 0.0)
        to_light = -vertex.d
        lit = wp.dot(at.frame.n, to_light)

        # beta S: what goes on.
        if carry.face >= 0:
            found = accumulate_vertex(
                scene, target, carry.face, carry.u, carry.v, carry.adjoint, True,
                interaction.offset(at, vertex.wo), vertex.wo,
            )  # fmt: skip
            total += found.dot
            adjoint.x += found.o
            result.received += wp.cw_mul(vertex.beta, carry.received)
            w = vertex.factor * wp.cw_mul(flux, carry.received)
            wo = enter_frame(at.frame, vertex.wo)
            a_material = material_record()
            if wp.static(has_smooth):
                if vertex.lobe == LOBE_SMOOTH:
                    value = wp.dot(wp.cw_mul(flux, carry.received), vertex.beta)
                    leaving = wp.dot(at.frame.n, vertex.wo)
                    a_n += value * (vertex.wo / leaving - to_light / lit)
                    a_d += (value / lit) * at.frame.n
                    # Seen from the new direction, which rests.
                    seen = at
                    seen.wi = wo
                    fa = eval_vjp(seen, at.wi, w)
                    turned = frame_vjp(at.frame, surface.tangent, vertex.wo, to_light, fa.wi, fa.wo)
                    a_n += turned.n
                    adjoint.tangent += turned.tangent
                    a_d -= turned.wo
                    a_material = fa.material
            if wp.static(delta_vjp is not None):
                if vertex.lobe > LOBE_SMOOTH:
                    a_wo = found.d + carry.a_d
                    a_local = enter_frame(at.frame, a_wo)
                    if wp.static(relative_eta is not None):
                        if vertex.lobe == LOBE_DELTA_TRANSMISSION:
                            # Flux has no squared index: log T is the mean of the logarithms from both sides.
                            eta = relative_eta(at.model, at.material, at.wi)
                            w *= 0.5
                            behind = at
                            behind.wi = wo
                            ba = delta_vjp(
                                behind, vertex.lobe, (1.0 / (eta * eta * eta * eta)) * w, wp.vec3(0.0, 0.0, 0.0)
                            )
                            a_local += ba.wi
                            a_material = ba.material
                    da = delta_vjp(at, vertex.lobe, w, a_local)
                    # The local direction leaves the frame: the transpose of entering it.
                    bent = frame_vjp(at.frame, surface.tangent, to_light, a_wo, da.wi, wo)
                    a_n += bent.n
                    adjoint.tangent += bent.tangent
                    a_d -= bent.wi
                    a_material = add_materials(a_material, da.material)
            adjoint, dot = accumulate_material(
                scene, target, at.slots, vertex.face, vertex.u, vertex.v, surface.uv, a_material, adjoint
            )
            total += dot
        adjoint.n = at.frame.side * a_n

        # J: what the camera sees.
        if wp.static(has_smooth):
            if vertex.joined == 1 and not (vanishes(asked) and wp.length_sq(a_pixel) == 0.0):
                film = project(scene, camera, surface.x, lens)
                here = interaction.on(scene, surface, vertex.face, vertex.u, vertex.v, -vertex.to_camera)
                sent = wp.dot(wp.cw_mul(flux, asked), vertex.value)
                n = here.frame.n
                facing = wp.dot(n, vertex.to_camera)
                shaded = wp.dot(n, to_light)
                adjoint.x += film_gradient(scene, camera, film, a_pixel)
                adjoint.x += sent * importance_gradient(scene, camera, film, surface.x)
                a_d += (sent / shaded) * n
                ja = eval_vjp(here, enter_frame(here.frame, to_light), vertex.join * wp.cw_mul(flux, asked))
                shown = frame_vjp(here.frame, surface.tangent, vertex.to_camera, to_light, ja.wi, ja.wo)
                adjoint.n += here.frame.side * (shown.n + sent * (vertex.to_camera / facing - to_light / shaded))
                adjoint.tangent += shown.tangent
                a_d -= shown.wo
                if wp.static(config.camera != CAMERA_ORTHOGRAPHIC):
                    a_to_camera = shown.wi + (sent / facing) * n
                    adjoint.x -= normalize_vjp(vertex.to_camera, wp.length(film.origin - surface.x), a_to_camera)
                adjoint, dot_join = accumulate_material(
                    scene, target, here.slots, vertex.face, vertex.u, vertex.v, surface.uv, ja.material, adjoint
                )
                total += dot_join
        result.adjoint = adjoint
        result.a_d = a_d
        result.dot = total
        return result

    @wp.func
    def leave(scene: Scene, target: wp.array(dtype=wp.float32), ray: LightRay, carry: LightCarry) -> wp.float32:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        found = accumulate_vertex(scene, target, carry.face, carry.u, carry.v, carry.adjoint, True, ray.o, ray.d)
        total = carry.dot + found.dot
        emitted = light_vertex(ray)
        # Of lights at a finite distance the direction rests, of light from infinity the place where it starts.
        aim = wp.where(ray.from_point == 1, 0.0, -1.0) * (found.d + carry.a_d)
        x = point_on(triangle_at(scene, carry.face), carry.u, carry.v)
        a_x, dot = accumulate_light(scene, target, emitted, x, radiance_scale(ray, x) * carry.received, 0.0, aim, 1.0)
        total += dot
        if wp.static(posed):
            if ray.from_point == 1:
                total += accumulate_place(scene, target, ray.emitter, found.o + a_x)
        return total

    return LightMotion(lens_of, sweep, leave)

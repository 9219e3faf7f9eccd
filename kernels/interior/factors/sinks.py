"""The sinks for the adjoints of a vertex's factors: material values, and the light that next-event estimation found."""

import functools
from dataclasses import replace

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import declaration_of, make_bsdf
from warp_psdr.kernels.constants import EMITTER_AREA, EMITTER_CONSTANT, EMITTER_ENVMAP
from warp_psdr.kernels.emitter.area import make_area, make_light_uv
from warp_psdr.kernels.emitter.dispatch import make_lights
from warp_psdr.kernels.generated import make_generated, make_switch
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.pullback import connection_vjp
from warp_psdr.kernels.material import slot_at
from warp_psdr.kernels.primitive.dispatch import make_adjoint_sink, make_position
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.texture.gradient import is_placed, make_reader_sink
from warp_psdr.kernels.texture.texture import make_texture_sink
from warp_psdr.kernels.vertex import LightConfig, PathVertex, SurfaceConfig


@functools.cache
def make_material_sink(surfaces: SurfaceConfig, wanted: GradientRequest, role: str, more: str = ""):
    """Return ``accumulate_material(scene, target, slots, face, u, v, uv, m, adjoint) -> (VertexAdjoint, float)``.

    ``more``: further arguments, which it leaves alone.
    """
    scope = {
        "record": make_bsdf(surfaces.bsdfs).record,
        "Scene": Scene,
        "VertexAdjoint": VertexAdjoint,
        "anchor": anchor,
        "slot_at": slot_at,
    }
    lines = [
        "def accumulate_material(",
        "    scene: Scene, target: wp.array(dtype=wp.float32), slots: wp.int32, face: wp.int32, u: wp.float32,",
        f"    v: wp.float32, uv: wp.vec2, m: record, adjoint: VertexAdjoint{more},",
        ") -> tuple[VertexAdjoint, wp.float32]:",
        "    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py",
        "    a = adjoint",
        "    total = wp.float32(0.0)",
    ]
    for k, (slot, values) in enumerate(zip(surfaces.material, wanted.material, strict=True)):
        if slot.kinds and (values or wanted.geometry or wanted.to_uv):
            read = slot.kinds, slot.rises
            scope[f"push_{k}"] = make_reader_sink(
                role, *read, values, wanted.to_uv, wanted.geometry, surfaces.primitives
            )
            value = f"m.{slot.name}" if slot.color else f"wp.vec3(m.{slot.name}, 0.0, 0.0)"
            lines += [
                f"    i{k} = slot_at(scene, slots, {k})",
                f"    if i{k} >= 0:",
                f"        t{k} = push_{k}(scene, target, i{k}, face, u, v, uv, {value})",
                f"        total += t{k}.dot",
                f"        a.uv += t{k}.uv",
                f"        a.u += t{k}.u",
                f"        a.v += t{k}.v",
            ]
            if wanted.geometry and is_placed(*read, surfaces.primitives):
                lines.append(f"        a.x += t{k}.x")
    lines.append("    return a, total\n")
    return make_generated("\n".join(lines), **scope)


@functools.cache
def make_material_sink_of_each(surfaces: SurfaceConfig, wanted: GradientRequest):
    """Return ``make_material_sink``'s in reverse mode, with a model's number behind, whose values alone it looks at.

    It serves vertices that are taken one by one, of which each has a few of a scene's values.
    """
    more = ", model: wp.int32"
    sinks = {k: make_material_sink(own, wanted, "reverse", more) for k, own in enumerate(surfaces_of_each(surfaces))}
    return make_switch("accumulate_material_of_each", "model", sinks, anchored=True)


def surfaces_of_each(surfaces: SurfaceConfig) -> list[SurfaceConfig]:
    """Return the same surfaces for each model, without textures of values that the model does not have."""
    found = []
    for key in surfaces.bsdfs:
        names = {value.name for value in declaration_of(key)[0].values}
        own = tuple(slot if slot.name in names else slot._replace(kinds=()) for slot in surfaces.material)
        found.append(replace(surfaces, material=own))
    return found


@functools.cache
def make_light_sink(
    surfaces: SurfaceConfig, lights: LightConfig, wanted: GradientRequest, role: str, links: bool = True
):
    """Return ``accumulate_light(scene, target, vertex, x, f, w_f, a_wo, w) -> (adjoint of x, float)``.

    ``radiance_of(scene, vertex, x)`` beside it gives the attached radiance of the sampled light. ``links=False``: the
    connection with a point of an area light is the caller's to pull.
    """
    corners = wanted.texcoords or (links and wanted.shapes)
    light_uv = make_light_uv(lights.shining)
    emitted = make_area(lights.area, lights.shining).emitted if lights.area else None
    others = make_lights(lights.others, role, wanted.lights) if lights.others else None
    sample = others.sample if others else None
    sample_vjp = others.sample_vjp if others else None
    environment_vjp = others.environment_vjp if others else None
    environment_eval = others.environment_eval if others else None
    has_area = bool(lights.area)
    has_environment = environment_eval is not None
    has_delta_lights = sample_vjp is not None
    accumulate_radiance = (
        make_texture_sink(role, lights.area, True, wanted.to_uv, wanted.texcoords) if has_area else None
    )
    accumulate_vertex = make_adjoint_sink(
        role,
        surfaces.smooth,
        surfaces.flat,
        surfaces.uv,
        surfaces.tangent,
        wanted.texcoords,
        False,
        surfaces.primitives,
    )
    position, cross_of = make_position(surfaces.primitives)

    @wp.func
    def radiance_of(scene: Scene, vertex: PathVertex, x: wp.vec3) -> wp.vec3:
        emitter = scene.emitters[vertex.light]
        if wp.static(has_area):
            if emitter.kind == EMITTER_AREA:
                return emitted(scene, emitter, vertex.light_face, vertex.light_u, vertex.light_v, vertex.light_wi)
        if wp.static(has_environment):
            if emitter.kind == EMITTER_CONSTANT or emitter.kind == EMITTER_ENVMAP:
                return environment_eval(scene, vertex.light_wi)
        if wp.static(has_delta_lights):
            return sample(scene, emitter, x, wp.vec2(0.0, 0.0)).radiance
        return wp.vec3(0.0, 0.0, 0.0)

    @wp.func
    def accumulate_light(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        vertex: PathVertex,
        x: wp.vec3,
        w_radiance: wp.vec3,
        value: wp.float32,
        a_wo: wp.vec3,
        chi: wp.float32,
    ) -> tuple[wp.vec3, wp.float32]:
        """Adjoint of x; ``w_radiance``: adjoint of the radiance, ``value``: A . D_n, ``a_wo``: of the direction.

        ``chi``: ``weight_of_light``, which ``a_wo`` has already.
        """
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        total = wp.float32(0.0)
        a_x = wp.vec3(0.0, 0.0, 0.0)
        emitter = scene.emitters[vertex.light]
        if wp.static(has_area):
            if emitter.kind == EMITTER_AREA:
                face = vertex.light_face
                uv = light_uv(scene, face, vertex.light_u, vertex.light_v)
                adjoint = VertexAdjoint()
                if wp.static(wanted.radiance or wanted.to_uv or wanted.texcoords):
                    ta = accumulate_radiance(
                        scene, target, emitter.texture, face, vertex.light_u, vertex.light_v, uv, w_radiance
                    )
                    total += ta.dot
                    adjoint.uv = ta.uv
                if wp.static(links and wanted.geometry):
                    tri = scene.triangles[face]
                    y = position(tri, vertex.light_u, vertex.light_v)
                    cross = cross_of(tri, vertex.light_u, vertex.light_v)
                    link = connection_vjp(x, y, cross, vertex.light_wi, a_wo, value, chi)
                    a_x = link.x
                    adjoint.x = -link.x
                    adjoint.c = link.c
                if wp.static(corners):
                    accumulated = accumulate_vertex(
                        scene, target, face, vertex.light_u, vertex.light_v, adjoint, False, x, a_wo
                    )
                    total += accumulated.dot
                return a_x, total
        if wp.static(has_environment):
            if emitter.kind == EMITTER_CONSTANT or emitter.kind == EMITTER_ENVMAP:
                if wp.static(len(wanted.lights) > 0):
                    ea = environment_vjp(scene, target, vertex.light_wi, w_radiance)
                    total += ea.dot
                return a_x, total
        if wp.static(has_delta_lights):
            if wp.static(len(wanted.lights) > 0 or wanted.geometry):
                la = sample_vjp(scene, target, emitter, x, vertex.light_wi, w_radiance, a_wo)
                total += la.dot
                a_x = la.x
        return a_x, total

    return radiance_of, accumulate_light

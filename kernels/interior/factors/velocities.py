"""Velocities of the values read at a path vertex, from the factors' adjoints: ``sinks.py`` in forward mode.

A sink in the role "forward" turns the adjoint of one colour channel into its derivative along the tangent. Three
channels of a texture, a material or a scattering value are therefore three vector-Jacobian products.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.generated import make_generated, make_switch
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.sinks import surfaces_of_each
from warp_psdr.kernels.material import slot_at
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.texture.gradient import is_placed, make_reader_sink
from warp_psdr.kernels.vertex import SurfaceConfig
from warp_psdr.kernels.vertex_motion import VertexTangent


@wp.func
def axis_vec3(axis: wp.int32) -> wp.vec3:
    e = wp.vec3(0.0, 0.0, 0.0)
    e[axis] = 1.0
    return e


@functools.cache
def make_pair(models: tuple[str, ...]):
    """Return ``pair(adjoint, material, wi, wo) -> float32``: the adjoint of a scattering value times velocities."""
    bsdf = make_bsdf(models)
    adjoint, record, dot = bsdf.adjoint, bsdf.record, bsdf.algebra.dot

    @wp.func
    def pair(a: adjoint, material: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        return dot(a.material, material) + wp.dot(a.wi, wi) + wp.dot(a.wo, wo)

    return pair


@functools.cache
def make_texture_jvp(
    kinds: tuple[int, ...], rises: bool, values: bool, to_uv: bool, slide: bool, primitives: tuple[int, ...]
):
    """Return ``texture_jvp(scene, tangents, index, face, u, v, uv, vertex) -> vec3``: the velocity of a value read."""
    accumulate = make_reader_sink("forward", kinds, rises, values, to_uv, slide, primitives)

    @wp.func
    def texture_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        index: wp.int32,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        vertex: VertexTangent,
    ) -> wp.vec3:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = wp.vec3(0.0, 0.0, 0.0)
        for channel in range(3):
            t = accumulate(scene, tangents, index, face, u, v, uv, axis_vec3(channel))
            result[channel] = t.dot + wp.dot(t.uv, vertex.uv) + t.u * vertex.u + t.v * vertex.v
        return result

    @wp.func
    def placed_texture_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        index: wp.int32,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        vertex: VertexTangent,
    ) -> wp.vec3:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = wp.vec3(0.0, 0.0, 0.0)
        for channel in range(3):
            t = accumulate(scene, tangents, index, face, u, v, uv, axis_vec3(channel))
            moved = wp.dot(t.uv, vertex.uv) + t.u * vertex.u + t.v * vertex.v
            result[channel] = t.dot + moved + wp.dot(t.x, vertex.x)
        return result

    return placed_texture_jvp if is_placed(kinds, rises, primitives) else texture_jvp


@functools.cache
def make_material_jvp(surfaces: SurfaceConfig, wanted: GradientRequest, more: str = ""):
    """Return ``material_jvp(scene, tangents, slots, face, u, v, uv, vertex) -> record``: velocities of its values.

    ``more``: further arguments, which it leaves alone.
    """
    scope = {
        "record": make_bsdf(surfaces.bsdfs).record,
        "Scene": Scene,
        "VertexTangent": VertexTangent,
        "anchor": anchor,
        "slot_at": slot_at,
    }
    lines = [
        "def material_jvp(",
        "    scene: Scene, tangents: wp.array(dtype=wp.float32), slots: wp.int32, face: wp.int32, u: wp.float32,",
        f"    v: wp.float32, uv: wp.vec2, vertex: VertexTangent{more},",
        ") -> record:",
        "    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py",
        "    m = record()",
    ]
    for k, (slot, values) in enumerate(zip(surfaces.material, wanted.material, strict=True)):
        if slot.kinds and (values or wanted.geometry or wanted.to_uv):
            scope[f"jvp_{k}"] = make_texture_jvp(
                slot.kinds, slot.rises, values, wanted.to_uv, wanted.geometry, surfaces.primitives
            )
            value = f"jvp_{k}(scene, tangents, i{k}, face, u, v, uv, vertex)" + ("" if slot.color else "[0]")
            lines += [
                f"    i{k} = slot_at(scene, slots, {k})",
                f"    if i{k} >= 0:",
                f"        m.{slot.name} = {value}",
            ]
    lines.append("    return m\n")
    return make_generated("\n".join(lines), **scope)


@functools.cache
def make_material_jvp_of_each(surfaces: SurfaceConfig, wanted: GradientRequest):
    """Return ``make_material_jvp``'s with a model's number behind; see ``make_material_sink_of_each``."""
    more = ", model: wp.int32"
    velocities = {k: make_material_jvp(own, wanted, more) for k, own in enumerate(surfaces_of_each(surfaces))}
    return make_switch("material_jvp_of_each", "model", velocities, anchored=True)

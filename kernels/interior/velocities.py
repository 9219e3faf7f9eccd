"""Velocities of what is read at a path vertex, from the factors' adjoints: ``factors.py`` in forward mode.

A sink in the "forward" role turns the adjoint of one colour channel into its derivative along the tangent, so three
channels of a texture, a material or a scattering value are three vector-Jacobian products.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.interior.tangents import VertexTangent
from warp_psdr.kernels.interior.wanted import Wanted
from warp_psdr.kernels.structs import Bsdf, BsdfAdjoint, Material, Scene
from warp_psdr.kernels.texture.texture import make_texture_sink
from warp_psdr.kernels.vertex import PathConfig


@wp.func
def axis_vec3(axis: wp.int32) -> wp.vec3:
    e = wp.vec3(0.0, 0.0, 0.0)
    e[axis] = 1.0
    return e


@wp.func
def pair_material(a: Material, b: Material) -> wp.float32:
    return wp.dot(a.c0, b.c0) + wp.dot(a.c1, b.c1) + wp.dot(a.c2, b.c2) + a.s0 * b.s0 + a.s1 * b.s1


@wp.func
def pair(a: BsdfAdjoint, material: Material, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
    """Adjoint times velocity."""
    return pair_material(a.material, material) + wp.dot(a.wi, wi) + wp.dot(a.wo, wo)


@functools.cache
def make_texture_jvp(kinds: tuple[int, ...], values: bool, to_uv: bool, slide: bool):
    """Return ``texture_jvp(scene, tangents, index, face, u, v, uv, vertex) -> vec3``: the velocity of a value read."""
    push = make_texture_sink("forward", kinds, values, to_uv, slide)

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
            t = push(scene, tangents, index, face, u, v, uv, axis_vec3(channel))
            result[channel] = t.dot + wp.dot(t.uv, vertex.uv) + t.u * vertex.u + t.v * vertex.v
        return result

    return texture_jvp


@functools.cache
def make_material_jvp(config: PathConfig, wanted: Wanted):
    """Return ``material_jvp(scene, tangents, b, face, u, v, uv, vertex) -> Material``."""
    slide = wanted.geometry
    use = tuple(
        bool(kinds) and (w or slide or wanted.to_uv) for kinds, w in zip(config.slots, wanted.slots, strict=True)
    )
    p0, p1, p2, p3, p4 = (
        make_texture_jvp(kinds, w, wanted.to_uv, slide) if needed else None
        for kinds, w, needed in zip(config.slots, wanted.slots, use, strict=True)
    )

    @wp.func
    def material_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        b: Bsdf,
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        uv: wp.vec2,
        vertex: VertexTangent,
    ) -> Material:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        m = Material()
        if wp.static(use[0]):
            if b.c0 >= 0:
                m.c0 = p0(scene, tangents, b.c0, face, u, v, uv, vertex)
        if wp.static(use[1]):
            if b.c1 >= 0:
                m.c1 = p1(scene, tangents, b.c1, face, u, v, uv, vertex)
        if wp.static(use[2]):
            if b.c2 >= 0:
                m.c2 = p2(scene, tangents, b.c2, face, u, v, uv, vertex)
        if wp.static(use[3]):
            if b.s0 >= 0:
                m.s0 = p3(scene, tangents, b.s0, face, u, v, uv, vertex)[0]
        if wp.static(use[4]):
            if b.s1 >= 0:
                m.s1 = p4(scene, tangents, b.s1, face, u, v, uv, vertex)[0]
        return m

    return material_jvp

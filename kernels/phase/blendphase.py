"""Two phase functions (Mitsuba's ``blendphase``): f_p = (1 - w) f_0 + w f_1 with a weight w from 0 to 1.

One of the two is drawn with its share and then a direction from it, so that the density of a sample is the value. The
derivative by w is f_1 - f_0, also where one of them is never drawn: both are positive in all directions, but for tables
with zeros. A blend is the record of a texture: at ``offset`` the weight, ``width`` and ``height`` the kinds (PHASE_*)
of both, ``first`` and ``second`` their places, as ``Medium.g``.

Derivation: ``docs/theory/media.md#paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import PHASE_BLEND
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Medium, Scene, Texture


@wp.func
def blended_first(blend: Texture) -> Medium:
    """Return a medium of which nothing but the phase function is set: that of weight 1 - w."""
    m = Medium()
    m.phase = blend.width
    m.g = blend.first
    return m


@wp.func
def blended_second(blend: Texture) -> Medium:
    """As ``blended_first``, of weight w."""
    m = Medium()
    m.phase = blend.height
    m.g = blend.second
    return m


@wp.func
def blend_weight(scene: Scene, blend: Texture) -> wp.float32:
    return wp.clamp(load_float(scene.values, blend.offset), 0.0, 1.0)


@functools.cache
def make_blend(inner_eval: wp.Function, inner_sample: wp.Function) -> tuple[wp.Function, wp.Function]:
    """Return ``eval`` and ``sample`` of ``phase/dispatch.py``, from those of all other kinds."""

    @wp.func
    def blend_eval(scene: Scene, m: Medium, d: wp.vec3, wo: wp.vec3) -> wp.float32:
        if m.phase != PHASE_BLEND:
            return inner_eval(scene, m, d, wo)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, blend)
        first = inner_eval(scene, blended_first(blend), d, wo)
        return (1.0 - w) * first + w * inner_eval(scene, blended_second(blend), d, wo)

    @wp.func
    def blend_sample(scene: Scene, m: Medium, d: wp.vec3, u: wp.vec2) -> wp.vec3:
        if m.phase != PHASE_BLEND:
            return inner_sample(scene, m, d, u)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, blend)
        # The number is stretched to be drawn from again. Neither share is divided by where it is 0.
        if u[0] < w:
            return inner_sample(scene, blended_second(blend), d, wp.vec2(u[0] / w, u[1]))
        return inner_sample(scene, blended_first(blend), d, wp.vec2((u[0] - w) / (1.0 - w), u[1]))

    return blend_eval, blend_sample


@functools.cache
def make_blend_by_cosine(inner: wp.Function) -> wp.Function:
    """Return ``by_cosine`` of ``phase/dispatch.py``, from that of all other kinds."""

    @wp.func
    def blend_by_cosine(scene: Scene, m: Medium, mu: wp.float32) -> wp.float32:
        if m.phase != PHASE_BLEND:
            return inner(scene, m, mu)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, blend)
        return (1.0 - w) * inner(scene, blended_first(blend), mu) + w * inner(scene, blended_second(blend), mu)

    return blend_by_cosine


@functools.cache
def make_blend_sink(inner_eval: wp.Function, accumulate_inner: wp.Function, role: str):
    """Return ``accumulate_phase`` of ``phase/dispatch.py``, from that of all other kinds."""
    sink = make_sink(role)

    @wp.func
    def accumulate_blend(
        scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, d: wp.vec3, wo: wp.vec3, w: wp.float32
    ) -> wp.float32:
        if m.phase != PHASE_BLEND:
            return accumulate_inner(scene, target, m, d, wo, w)
        blend = texture_record(scene, m.g)
        share = blend_weight(scene, blend)
        first = blended_first(blend)
        second = blended_second(blend)
        slope = inner_eval(scene, second, d, wo) - inner_eval(scene, first, d, wo)
        total = sink(target, blend.offset, w * slope)
        total += accumulate_inner(scene, target, first, d, wo, (1.0 - share) * w)
        total += accumulate_inner(scene, target, second, d, wo, share * w)
        return total

    return accumulate_blend

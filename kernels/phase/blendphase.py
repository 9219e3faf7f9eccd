"""Two phase functions (Mitsuba's ``blendphase``): f_p = (1 - w) f_0 + w f_1 with a weight w from 0 to 1.

One of the two is drawn by its share and then a direction from it, so that the density of a sample is the value. The
derivative by w is f_1 - f_0, even where one of the two is never drawn: both are positive in all directions, except for
tables with zeros. A blend is the record of a texture: at ``offset`` the weight, ``width`` and ``height`` the kinds
(PHASE_*) of both, ``first`` and ``second`` the places of their values, as ``Medium.g``. The weight of the kind
PHASE_BLEND_GRID varies in the medium: its ``offset`` is the number of a grid (``medium/volume.py``).

Derivation: ``docs/theory/media.md#paths``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import PHASE_BLEND, PHASE_BLEND_GRID
from warp_psdr.kernels.medium.volume import grid_point, grid_size, grid_value_at, make_grid_sink
from warp_psdr.kernels.reading import load_float, load_vec3, texture_record
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Medium, Scene, Texture
from warp_psdr.kernels.texture.volume import trilinear_slope


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


@functools.cache
def make_blend_weight(kinds: tuple[int, ...]):
    """Return ``(is_blend, blend_weight)`` for the kinds of a scene.

    ``is_blend(m) -> bool``; ``blend_weight(scene, m, blend, x) -> float32``: w where the light is scattered, at x.
    """
    constant, varies = PHASE_BLEND in kinds, PHASE_BLEND_GRID in kinds

    @wp.func
    def is_blend(m: Medium) -> wp.bool:
        found = wp.bool(False)
        if wp.static(constant):
            found = m.phase == PHASE_BLEND
        if wp.static(varies):
            found = found or m.phase == PHASE_BLEND_GRID
        return found

    @wp.func
    def blend_weight(scene: Scene, m: Medium, blend: Texture, x: wp.vec3) -> wp.float32:
        w = wp.float32(0.0)
        if wp.static(varies):
            if m.phase == PHASE_BLEND_GRID:
                w = grid_value_at(scene, blend.offset, x)[0]
        if wp.static(constant):
            if m.phase == PHASE_BLEND:
                w = load_float(scene.values, blend.offset)
        return wp.clamp(w, 0.0, 1.0)

    return is_blend, blend_weight


@functools.cache
def make_phase_blend(
    kinds: tuple[int, ...], inner_eval: wp.Function, inner_sample: wp.Function
) -> tuple[wp.Function, wp.Function]:
    """Return ``eval`` and ``sample`` of ``phase/dispatch.py``, from those of all other kinds."""
    is_blend, blend_weight = make_blend_weight(kinds)

    @wp.func
    def blend_eval(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, wo: wp.vec3) -> wp.float32:
        if not is_blend(m):
            return inner_eval(scene, m, x, d, wo)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, m, blend, x)
        first = inner_eval(scene, blended_first(blend), x, d, wo)
        return (1.0 - w) * first + w * inner_eval(scene, blended_second(blend), x, d, wo)

    @wp.func
    def blend_sample(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, u: wp.vec2) -> wp.vec3:
        if not is_blend(m):
            return inner_sample(scene, m, x, d, u)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, m, blend, x)
        # The number is stretched to be drawn from again. Neither share is divided by where it is 0.
        if u[0] < w:
            return inner_sample(scene, blended_second(blend), x, d, wp.vec2(u[0] / w, u[1]))
        return inner_sample(scene, blended_first(blend), x, d, wp.vec2((u[0] - w) / (1.0 - w), u[1]))

    return blend_eval, blend_sample


@functools.cache
def make_blend_slopes(
    kinds: tuple[int, ...], inner_eval: wp.Function, inner_by_cosine: wp.Function
) -> tuple[wp.Function, wp.Function]:
    """Return ``by_cosine`` and ``by_place`` of ``phase/dispatch.py``, from those of all other kinds."""
    is_blend, blend_weight = make_blend_weight(kinds)
    varies = PHASE_BLEND_GRID in kinds

    @wp.func
    def blend_by_cosine(scene: Scene, m: Medium, x: wp.vec3, mu: wp.float32) -> wp.float32:
        if not is_blend(m):
            return inner_by_cosine(scene, m, x, mu)
        blend = texture_record(scene, m.g)
        w = blend_weight(scene, m, blend, x)
        first = inner_by_cosine(scene, blended_first(blend), x, mu)
        return (1.0 - w) * first + w * inner_by_cosine(scene, blended_second(blend), x, mu)

    @wp.func
    def blend_by_place(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, wo: wp.vec3) -> wp.vec3:
        a = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(varies):
            if m.phase == PHASE_BLEND_GRID:
                blend = texture_record(scene, m.g)
                g = texture_record(scene, blend.offset)
                slope = inner_eval(scene, blended_second(blend), x, d, wo)
                slope -= inner_eval(scene, blended_first(blend), x, d, wo)
                q = trilinear_slope(scene, g, grid_point(scene, g, x), wp.vec3(slope, 0.0, 0.0))
                q = wp.cw_mul(grid_size(g), q)
                for row in range(3):
                    a += q[row] * load_vec3(scene.values, g.to_uv + 4 * row)
        return a

    return blend_by_cosine, blend_by_place


@functools.cache
def make_blend_sink(kinds: tuple[int, ...], inner_eval: wp.Function, accumulate_inner: wp.Function, role: str):
    """Return ``accumulate_phase`` of ``phase/dispatch.py``, from that of all other kinds."""
    is_blend, blend_weight = make_blend_weight(kinds)
    constant, varies = PHASE_BLEND in kinds, PHASE_BLEND_GRID in kinds
    sink = make_sink(role)
    accumulate_grid = make_grid_sink(role)

    @wp.func
    def accumulate_blend(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        x: wp.vec3,
        d: wp.vec3,
        wo: wp.vec3,
        w: wp.float32,
    ) -> wp.float32:
        if not is_blend(m):
            return accumulate_inner(scene, target, m, x, d, wo, w)
        blend = texture_record(scene, m.g)
        share = blend_weight(scene, m, blend, x)
        first = blended_first(blend)
        second = blended_second(blend)
        slope = w * (inner_eval(scene, second, x, d, wo) - inner_eval(scene, first, x, d, wo))
        total = wp.float32(0.0)
        if wp.static(varies):
            if m.phase == PHASE_BLEND_GRID:
                g = texture_record(scene, blend.offset)
                total += accumulate_grid(target, g, grid_point(scene, g, x), wp.vec3(slope, 0.0, 0.0))
        if wp.static(constant):
            if m.phase == PHASE_BLEND:
                total += sink(target, blend.offset, slope)
        total += accumulate_inner(scene, target, first, x, d, wo, (1.0 - share) * w)
        total += accumulate_inner(scene, target, second, x, d, wo, share * w)
        return total

    return accumulate_blend

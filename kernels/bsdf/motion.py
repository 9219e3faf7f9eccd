"""How a direction drawn from rough metal's lobe moves with the roughness while the random numbers stay.

[ZSGJ21] call such a sample attached. For a rough mirror it is wi reflected at a visible normal, a smooth function of
both roughnesses. GGX's sampling routine is differentiated as it stands. Beckmann's routine inverts a cumulative
distribution by iteration; its derivative is that of one more Newton step, by the implicit function theorem.

Derivation: ``docs/theory/interior.md#attached-samples``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.bsdf.microfacet import (
    BECKMANN_MAX_SLOPE,
    INV_SQRT_PI,
    at_least_min,
    make_microfacet,
    make_reflection,
    visible_below,
)
from warp_psdr.kernels.bsdf.model import key_of
from warp_psdr.kernels.generated import make_generated
from warp_psdr.kernels.math import unit_vector

#: Keys of the models whose directions move smoothly with the values ``MOVED_BY`` -> distribution of their normals.
MOVING = {key_of("roughconductor", name): name for name in ("ggx", "beckmann")}
MOVED_BY = ("alpha_u", "alpha_v")
#: Squared horizontal part of a stretched direction below which it has no azimuth.
UPRIGHT = 1.0e-20
#: Smallest derivative of Beckmann's cumulative distribution by the slope; where it is less, the numerator vanishes too.
LEAST_SLOPE = 1.0e-12
#: Density below which its logarithm counts as constant: a weight of multiple importance sampling is 0 there.
LEAST_DENSITY = 1.0e-30


@wp.struct
class SampleMotion:
    """Velocity of a drawn direction by each roughness, and how its density changes; local coordinates."""

    by_u: wp.vec3  # d wo / d alpha_u
    by_v: wp.vec3
    log_pdf: wp.vec2  # d ln p / d (alpha_u, alpha_v) while wo stays
    log_pdf_wo: wp.vec3  # d ln p / d wo while the roughness stays


@wp.func
def all_visible(z: wp.float32, r: wp.float32) -> wp.float32:
    """C at the largest visible slope."""
    return visible_below(wp.min(z / r, BECKMANN_MAX_SLOPE), z, r)


@wp.func
def azimuth_of(w: wp.vec3) -> wp.vec3:
    """Cosine and sine of the azimuth of a direction, and the length of its horizontal part."""
    squared = w[0] * w[0] + w[1] * w[1]
    r = wp.sqrt(wp.max(squared, UPRIGHT))
    upright = squared <= UPRIGHT
    return wp.vec3(wp.where(upright, 1.0, w[0] / r), wp.where(upright, 0.0, w[1] / r), r)


@functools.cache
def make_held_normal(distribution: str) -> tuple[wp.Function, wp.Function]:
    """Return ``(hold, follow)``: ``follow(w, hold(w0, v))`` is the stretched normal that ``v`` means under ``w``.

    ``w`` and ``w0`` are stretched unit vectors with positive z. Only the second argument of ``hold`` is random. The
    result is right at ``w0`` and to first order about it, for ``follow`` is what is differentiated.
    """
    sample_visible = make_microfacet(distribution).sample_visible
    if distribution == "ggx":

        @wp.func
        def hold_ggx(w: wp.vec3, v: wp.vec2) -> wp.vec4:
            return wp.vec4(v[0], v[1], 0.0, 0.0)

        @wp.func
        def follow_ggx(w: wp.vec3, held: wp.vec4) -> wp.vec3:
            return sample_visible(w, wp.vec2(held[0], held[1]))

        return hold_ggx, follow_ggx

    @wp.func
    def hold_beckmann(w: wp.vec3, v: wp.vec2) -> wp.vec4:
        """Slopes along ``w`` and across it, C of the former over that of all, and 1 / C'."""
        m = sample_visible(w, v)
        a = azimuth_of(w)
        x = -(a[0] * m[0] + a[1] * m[1])
        y = a[1] * m[0] - a[0] * m[1]
        slope = (w[2] - x * a[2]) * INV_SQRT_PI * wp.exp(-x * x)
        share = visible_below(x, w[2], a[2]) / all_visible(w[2], a[2])
        return wp.vec4(x, y, share, 1.0 / wp.max(slope, LEAST_SLOPE))

    @wp.func
    def follow_beckmann(w: wp.vec3, held: wp.vec4) -> wp.vec3:
        a = azimuth_of(w)
        missing = held[2] * all_visible(w[2], a[2]) - visible_below(held[0], w[2], a[2])
        x = held[0] + missing * held[3]
        return wp.vec3(-(a[0] * x - a[1] * held[1]), -(a[1] * x + a[0] * held[1]), 1.0)

    return hold_beckmann, follow_beckmann


@functools.cache
def make_reflection_motion(distribution: str) -> wp.Function:
    """Return ``motion(wi, wo, alpha_u, alpha_v, v) -> SampleMotion`` of a rough mirror; ``v`` has drawn ``wo``."""
    hold, follow = make_held_normal(distribution)
    pdf = make_reflection(distribution).pdf

    @wp.func
    def stretched(wi: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.vec3:
        return unit_vector(wp.vec3(alpha_u * wi[0], alpha_v * wi[1], wi[2]))

    @differentiable
    @wp.func
    def drawn_dot(wi: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32, held: wp.vec4, a: wp.vec3) -> wp.float32:
        m = follow(stretched(wi, alpha_u, alpha_v), held)
        n = unit_vector(wp.vec3(alpha_u * m[0], alpha_v * m[1], m[2]))
        return wp.dot(a, unit_vector(2.0 * wp.dot(wi, n) * n - wi))

    @differentiable
    @wp.func
    def log_density(wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32) -> wp.float32:
        return wp.log(wp.max(pdf(wi, wo, alpha_u, alpha_v), LEAST_DENSITY))

    @wp.func
    def reflection_motion(
        wi: wp.vec3, wo: wp.vec3, alpha_u: wp.float32, alpha_v: wp.float32, v: wp.vec2
    ) -> SampleMotion:
        result = SampleMotion()
        held = hold(stretched(wi, alpha_u, alpha_v), v)
        for axis in range(3):
            e = wp.vec3(0.0, 0.0, 0.0)
            e[axis] = 1.0
            _wi, d_u, d_v, _held, _e = wp.grad(drawn_dot)(wi, alpha_u, alpha_v, held, e)
            result.by_u[axis] = d_u
            result.by_v[axis] = d_v
        _wi, g_wo, g_u, g_v = wp.grad(log_density)(wi, wo, alpha_u, alpha_v)
        result.log_pdf = wp.vec2(g_u, g_v)
        result.log_pdf_wo = g_wo
        return result

    return reflection_motion


@functools.cache
def make_sample_motion(models: tuple[str, ...]) -> tuple[wp.Function, wp.Function]:
    """Return ``(moves, motion)`` for the models of a scene, at least one of which is among ``MOVING``.

    ``moves(model) -> bool``: whether its directions move smoothly with the roughness.
    ``motion(model, mat, wi, wo, v) -> SampleMotion``: of a direction ``wo`` above the surface that ``v`` has drawn.
    """
    moving = {number: MOVING[key] for number, key in enumerate(models) if key in MOVING}
    scope = {"record": make_bsdf(models).record, "SampleMotion": SampleMotion, "anchor": anchor, "least": at_least_min}
    lines = [
        "def sample_motion(",
        "    model: wp.int32, mat: record, wi: wp.vec3, wo: wp.vec3, v: wp.vec2",
        ") -> SampleMotion:",
        "    _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py",
    ]
    for number, distribution in moving.items():
        scope[f"f{number}"] = make_reflection_motion(distribution)
        lines += [
            f"    if model == {number}:",
            f"        return f{number}(wi, wo, least(mat.alpha_u), least(mat.alpha_v), v)",
        ]
    lines.append("    return SampleMotion()\n")
    bits = sum(1 << number for number in moving)

    @wp.func
    def moves(model: wp.int32) -> wp.bool:
        return ((wp.static(bits) >> model) & 1) == 1

    return moves, make_generated("\n".join(lines), **scope)

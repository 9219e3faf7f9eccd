"""The derivative of a microfacet distribution by its roughness, split into two lobes of one sign each [BXB*24].

With slopes X = h_x / (h_z alpha_u), Y = h_y / (h_z alpha_v) and P(X, Y) their density, D cos = P / (alpha_u alpha_v
h_z^3). An axis is one of ALONG (alpha_u moves), ACROSS (alpha_v), BOTH (they are one number). The derivative of P is
negative in the middle and positive outside; both lobes have the same mass.

Derivation: ``docs/theory/interior.md#decomposed-branches``.
"""

import functools
import math
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import PI

#: What moves: alpha_u, alpha_v, or both alike.
ALONG, ACROSS, BOTH = 0, 1, 2
#: Newton steps of the Lambert function, which converge from one side, and of the quartic of GGX.
LAMBERT_STEPS, QUARTIC_STEPS = 6, 10
#: Nearest that a random number comes to 1.
ALMOST_ONE = 0.9999999
#: Largest slope over the roughness that is drawn.
MOST_SLOPE = 3.0e3
#: Masses of each lobe, times alpha.
GGX_BOTH, GGX_ONE = 0.5, 9.0 / (4.0 * math.pi * math.sqrt(3.0))
BECKMANN_BOTH, BECKMANN_ONE = 2.0 / math.e, math.sqrt(2.0 / math.pi) * math.exp(-0.5)
#: Largest value of x / (1 + x^2)^2, at the root of 1/3.
MOST, TURN = 3.0 * math.sqrt(3.0) / 16.0, 1.0 / math.sqrt(3.0)


class Split(NamedTuple):
    """Warp functions of a model whose derivative by its roughness is split; with the model's number first in dispatch.

    With f_D the part of f_s that is proportional to D:

    Attributes:
        draw: ``(mat, wi, axis, outer, u) -> vec3``: a direction of one of the two lobes; it may point below.
        density: ``(mat, wi, wo) -> float32``: of normals, drawn by D, as directions ``wo``, 1/sr.
        value: ``(mat, wi, wo) -> vec3``: f_D, with the cosine.
        mass: ``(mat, axis) -> float32``: of each lobe, over what moves; below 0 where the outer one is the negative.
        rate: ``(mat, wi, wo, axis) -> float32``: d log D over d of what moves.
    """

    draw: wp.Function
    density: wp.Function
    value: wp.Function
    mass: wp.Function
    rate: wp.Function


class SignedLobes(NamedTuple):
    """Warp functions of a model whose derivative by a number is the sum of two lobes, each of one sign as it stands.

    Attributes:
        draw: ``(mat, wi, number, second, u) -> vec3``: a direction of one of the two; it may point below. ``number`` is
            the place of the value in ``Model.signed``, ``u`` two random numbers.
        weight: ``(mat, wi, wo, number, second) -> vec3``: that lobe of the derivative of f_s cos over the density of
            ``draw``.
    """

    draw: wp.Function
    weight: wp.Function


class Decomposition(NamedTuple):
    """Warp functions over the axes of a distribution, in slopes over the roughness.

    Attributes:
        mass: ``(axis) -> float32``: of each lobe, times the roughness that moves.
        rate: ``(x, y, axis) -> float32``: d log P / d log alpha; below 0 in the inner lobe.
        draw: ``(axis, outer, u) -> vec2``: slopes drawn from a lobe, with three numbers.
    """

    mass: wp.Function
    rate: wp.Function
    draw: wp.Function


@wp.func
def lambert(t: wp.float32, outer: wp.bool) -> wp.float32:
    """The s > 1 (``outer``) or s < 1 with s exp(1 - s) = t, for t in (0, 1]: -W(-t / e).

    The bounds at which Newton's method on s - log s starts are those of [Chatzigeorgiou 2013].
    """
    u = -wp.log(wp.max(t, 1.0e-30))
    r = wp.sqrt(2.0 * u)
    s = wp.where(outer, 1.0 + r + u, wp.max(1.0 - r, wp.exp(-1.0 - u)))
    for _i in range(wp.static(LAMBERT_STEPS)):
        slope = (s - 1.0) / s
        step = (s - wp.log(s) - 1.0 - u) / wp.where(wp.abs(slope) < 1.0e-6, 1.0, slope)
        s = wp.where(wp.abs(slope) < 1.0e-6, s, wp.max(s - step, 1.0e-35))
    return s


@wp.func
def quartic(t: wp.float32, outer: wp.bool) -> wp.float32:
    """The x > 1 / sqrt(3) (``outer``) or x < 1 / sqrt(3) with x / (1 + x^2)^2 = t, for t in (0, MOST]."""
    low = wp.where(outer, TURN, 0.0)
    high = wp.where(outer, MOST_SLOPE, TURN)
    x = wp.where(outer, wp.clamp(wp.pow(wp.max(t, 1.0e-12), -1.0 / 3.0), TURN, MOST_SLOPE), wp.min(t, TURN))
    for _i in range(wp.static(QUARTIC_STEPS)):
        q = 1.0 + x * x
        f = x / (q * q) - t
        beyond = (f > 0.0) != outer
        high = wp.where(beyond, x, high)
        low = wp.where(beyond, low, x)
        slope = (1.0 - 3.0 * x * x) / (q * q * q)
        newton = x - f / wp.where(wp.abs(slope) < 1.0e-12, 1.0, slope)
        x = wp.where(newton >= low and newton <= high, newton, 0.5 * (low + high))
    return x


@wp.func
def around(s: wp.float32, u: wp.float32) -> wp.vec2:
    """A slope of squared length s in a random direction."""
    r = wp.sqrt(s)
    return wp.vec2(r * wp.cos(2.0 * PI * u), r * wp.sin(2.0 * PI * u))


@wp.func
def placed(x: wp.float32, y: wp.float32, axis: wp.int32) -> wp.vec2:
    """``x`` along the axis that moves."""
    return wp.where(axis == ACROSS, wp.vec2(y, x), wp.vec2(x, y))


@functools.cache
def make_decomposition(distribution: str) -> Decomposition:
    """Return the functions of ``distribution``, "ggx" or "beckmann"."""
    ggx = distribution == "ggx"
    both, one = (GGX_BOTH, GGX_ONE) if ggx else (BECKMANN_BOTH, BECKMANN_ONE)

    @wp.func
    def lobe_mass(axis: wp.int32) -> wp.float32:
        return wp.where(axis == BOTH, wp.float32(both), wp.float32(one))

    @wp.func
    def lobe_rate(x: wp.float32, y: wp.float32, axis: wp.int32) -> wp.float32:
        moving = wp.where(axis == ACROSS, y, x)
        s = wp.where(axis == BOTH, x * x + y * y, moving * moving)
        if wp.static(ggx):
            s = 2.0 * s / (1.0 + x * x + y * y)
        return 2.0 * s - wp.where(axis == BOTH, 2.0, 1.0)

    @wp.func
    def lobe_draw(axis: wp.int32, outer: wp.bool, u: wp.vec3) -> wp.vec2:
        v = wp.min(u[0], ALMOST_ONE)
        side = wp.where(u[2] < 0.5, -1.0, 1.0)
        w = wp.clamp(2.0 * u[1] - 1.0, -ALMOST_ONE, ALMOST_ONE)
        share = wp.where(outer, 1.0 - v, v)
        if wp.static(ggx):
            if axis == BOTH:
                root = wp.sqrt(wp.where(outer, v, 1.0 - v))
                s = (1.0 - root) / (1.0 + root)
                return around(wp.where(outer, 1.0 / wp.max(s, 1.0e-7), s), u[1])
            y = w / wp.sqrt(1.0 - w * w)
            return placed(side * wp.sqrt(1.0 + y * y) * quartic(MOST * share, outer), y, axis)
        else:
            if axis == BOTH:
                return around(lambert(share, outer), u[1])
            return placed(side * wp.sqrt(0.5 * lambert(share * share, outer)), wp.erfinv(w), axis)

    return Decomposition(lobe_mass, lobe_rate, lobe_draw)

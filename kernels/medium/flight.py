"""The length of a flight in a homogeneous medium before a collision, and the weight of that flight.

Free flights have the density p(t) = mean over the channels of sigma_k exp(-sigma_k t), and pass a stretch of the length
L with the probability P = mean_k exp(-sigma_k L): one channel is drawn, and all of them weigh (spectral multiple
importance sampling). If derivatives by the density are requested, a share q of the flights must end on the stretch, by
the same exponential cut off at L. p is then at least q / L where sigma vanishes, so the derivative of in-scattering,
albedo / p, can be estimated there. On a stretch without an end, the forced share has a density like 1 / (1 + kappa
t)^2.

Derivation: ``docs/theory/media.md#flights``.
"""

import functools

import warp as wp

from warp_psdr.kernels.medium.coefficients import coefficients_of, exp_minus
from warp_psdr.kernels.structs import Medium, Scene
from warp_psdr.kernels.vertex import MediaConfig

#: Below it 1 - exp(-x) and -log(1 - x) are computed by their series, whose next term is 3e-7 of the sum.
SHORT_FLIGHT = 0.02
#: Optical thickness below which a cut-off exponential is uniform in float32.
UNIFORM_FLIGHT = 1.0e-6
#: Share q of forced collisions on the n-th stretch of a path: 1 / (FORCED + n). Their product falls as 1 / n.
FORCED = 4.0


@wp.struct
class Flight:
    """A flight through a stretch of a medium."""

    collides: wp.bool
    t: wp.float32
    weight: wp.vec3  # albedo sigma T / p, or T / P
    inv_p: wp.float32  # 1 / p, or 1 / P
    passing: wp.float32  # mean_k T_k of a flight that passes: what multiple importance sampling takes for P; grids: 1
    passed: wp.vec3  # in grids: the weight without the factor a sigma of a collision


@wp.func
def one_minus_exp(x: wp.float32) -> wp.float32:
    """1 - exp(-x) for x >= 0, to float32's relative precision."""
    if x < SHORT_FLIGHT:
        return x * (1.0 - x * (0.5 - x * (1.0 / 6.0)))
    return 1.0 - wp.exp(-x)


@wp.func
def minus_log_one_minus(y: wp.float32) -> wp.float32:
    """-log(1 - y) for y in [0, 1), to float32's relative precision."""
    if y < SHORT_FLIGHT:
        return y * (1.0 + y * (0.5 + y * (1.0 / 3.0)))
    return -wp.log(1.0 - y)


@wp.func
def mean_of(v: wp.vec3) -> wp.float32:
    return (v[0] + v[1] + v[2]) * (1.0 / 3.0)


@wp.func
def forced_distance(
    sigma: wp.float32, length: wp.float32, inv_extent: wp.float32, open: wp.bool, u: wp.float32
) -> wp.float32:
    """A distance on the stretch from the forced density."""
    if open:
        y = inv_extent * length
        v = u * (y / (1.0 + y))
        return wp.min(v / ((1.0 - v) * inv_extent), length)
    x = sigma * length
    if x < UNIFORM_FLIGHT:
        return u * length
    return minus_log_one_minus(u * one_minus_exp(x)) / sigma


@wp.func
def forced_density(
    sigma: wp.float32, t: wp.float32, length: wp.float32, inv_extent: wp.float32, open: wp.bool
) -> wp.float32:
    """The forced density at t, per unit length."""
    if open:
        s = 1.0 + inv_extent * t
        return (inv_extent + 1.0 / length) / (s * s)
    x = sigma * length
    if x < UNIFORM_FLIGHT:
        return 1.0 / length
    return sigma * wp.exp(-sigma * t) / one_minus_exp(x)


@functools.cache
def make_flight(config: MediaConfig, explores: bool):
    """Return ``flight(scene, m, length, end, open, u, number, draws) -> Flight``.

    The stretch has the ``length``, collisions lie before ``end``; ``open``: nothing is there. ``u`` has numbers for the
    channel, the choice and the distance, ``number`` is that of the stretch, ``draws`` false: the flight passes for
    sure, since nothing would come of a collision. ``explores``: some collisions are forced.
    """
    chromatic = config.chromatic

    @wp.func
    def flight(
        scene: Scene,
        m: Medium,
        length: wp.float32,
        end: wp.float32,
        open: wp.bool,
        u: wp.vec4,
        number: wp.int32,
        draws: wp.bool,
    ) -> Flight:
        c = coefficients_of(scene, m)
        f = Flight()
        f.t = length
        f.passing = 1.0
        rate = c.sigma_t[0]
        if wp.static(chromatic):
            rate = c.sigma_t[wp.min(wp.int32(3.0 * u[0]), 2)]
        q = wp.float32(0.0)
        inv_extent = 1.0 / scene.media.extent
        if draws:
            forced = wp.bool(False)
            if wp.static(explores):
                q = 1.0 / (FORCED + wp.float32(number))
                forced = u[1] < q
            if forced:
                f.collides = True
                f.t = forced_distance(rate, length, inv_extent, open, u[2])
            elif rate > 0.0:
                t = minus_log_one_minus(u[2]) / rate
                f.collides = t < length
                f.t = wp.where(f.collides, t, length)
        if f.collides:
            f.t = wp.clamp(f.t, 0.0, wp.max(end, 0.0))
            collided = wp.cw_mul(c.sigma_t, exp_minus(c.sigma_t, f.t))
            p = collided[0]
            if wp.static(chromatic):
                p = mean_of(collided)
            if wp.static(explores):
                g = forced_density(c.sigma_t[0], f.t, length, inv_extent, open)
                if wp.static(chromatic):
                    g += forced_density(c.sigma_t[1], f.t, length, inv_extent, open)
                    g += forced_density(c.sigma_t[2], f.t, length, inv_extent, open)
                    g *= 1.0 / 3.0
                p = (1.0 - q) * p + q * g
            f.inv_p = 1.0 / p
            f.weight = f.inv_p * wp.cw_mul(c.albedo, collided)
        else:
            passed = exp_minus(c.sigma_t, length)
            if draws:
                f.passing = passed[0]
                if wp.static(chromatic):
                    f.passing = mean_of(passed)
            f.inv_p = 1.0 / ((1.0 - q) * f.passing)
            f.weight = f.inv_p * passed
        return f

    return flight

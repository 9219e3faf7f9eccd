"""Flights through grids by delta tracking, and the transmittance of segments by ratio tracking.

Tentative points come at the rate M of the cell that the ray is in. Delta tracking [Woodcock et al. 1965] accepts one as
a collision with the probability sum_k h_k sigma_k / M, h_k the share of a channel in the weight W so far, and
multiplies W by the remainder. Ratio tracking [Novak et al. 2014] multiplies W by 1 - sigma / M at each point. For
microflakes sigma has the factor A(x, d), and M a bound on it (``phase/microflakes.py``).

If derivatives by the density are requested, a clock of the rate epsilon = q / l runs along, l the length of the stretch
in the grid, and the path also collides where the clock rings. Collisions then have the density (h . sigma + epsilon) T
exp(-epsilon t), whose unknown T cancels: V = W a sigma exp(epsilon t) / (h . sigma + epsilon) is at most W a e^q. Where
sigma vanishes, the derivative of in-scattering is at most a l e^q / q.

Derivation: ``docs/theory/media.md#grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.coefficients import albedo_at
from warp_psdr.kernels.medium.flight import FORCED, Flight, minus_log_one_minus
from warp_psdr.kernels.medium.majorant import before_tentative, grid_ray, next_tentative
from warp_psdr.kernels.medium.volume import grid_value, grid_value_at
from warp_psdr.kernels.phase.microflakes import has_flakes, make_microflakes
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d, salted
from warp_psdr.kernels.structs import Medium, Scene
from warp_psdr.kernels.vertex import MediaConfig

#: Salts of the numbers of flights and of shadow rays.
SALT_FLIGHT = wp.constant(wp.uint32(0x51F15E27))
SALT_SHADOW = wp.constant(wp.uint32(0x7A3C9D41))
#: Slot of a flight's clock, before those of its tentative points.
CLOCK = 0


@wp.struct
class Tracked:
    """How far tracking came."""

    collides: wp.bool
    t: wp.float32  # where it collides
    sigma: wp.vec3  # extinction there
    weight: wp.vec3  # W


@wp.func
def share_of(weight: wp.vec3) -> wp.vec3:
    """h: the share of each channel."""
    return weight * (1.0 / wp.max(weight[0] + weight[1] + weight[2], 1.0e-30))


@functools.cache
def make_tracking(config: MediaConfig, explores: bool):
    """Return ``(tracked_flight, tracked_transmittance)``.

    ``tracked_flight(scene, m, o, d, length, end, sampler, number, draws) -> Flight``: as ``make_flight`` has it;
    ``number`` is that of the step, whose numbers are used.
    ``tracked_transmittance(scene, m, o, d, length, sampler, number) -> vec3``: an estimate of T.
    """
    chromatic = config.chromatic
    flakes = has_flakes(config.phases)
    microflakes = make_microflakes(config.phases)

    @wp.func
    def track(
        scene: Scene, m: Medium, o: wp.vec3, d: wp.vec3, length: wp.float32, stream: Sampler, ratio: wp.bool
    ) -> Tracked:
        """Track until a collision; ``ratio``: there is none."""
        result = Tracked()
        result.weight = wp.vec3(1.0, 1.0, 1.0)
        g = texture_record(scene, m.sigma_t)
        scale = load_float(scene.values, m.scale)
        r = grid_ray(scene, g, o, d, length)
        if not r.t0 < r.t1:
            return result
        w = result.weight
        most = scale
        if wp.static(flakes):
            most *= microflakes.most_area(scene, m, d)
        point = next_tentative(scene.values, g, r, most, 0.0, stream, before_tentative(g, r, CLOCK))
        while point.t < r.t1:
            sigma = scale * grid_value(scene.values, g, r.o + point.t * r.d)
            if wp.static(flakes):
                sigma *= microflakes.area_at(scene, m, o + point.t * d, d)
            kept = wp.vec3(1.0, 1.0, 1.0) - sigma / point.rate
            if ratio:
                w = wp.cw_mul(w, kept)
            else:
                if wp.static(chromatic):
                    stays = wp.dot(share_of(w), kept)
                    if point.u < stays:
                        w = wp.cw_mul(w, kept) / stays
                    else:
                        result.collides = True
                else:
                    result.collides = not point.u < kept[0]
            if result.collides:
                result.t = point.t
                result.sigma = sigma
            if result.collides or vanishes(w):
                point.t = r.t1
            else:
                point = next_tentative(scene.values, g, r, most, 0.0, stream, point)
        result.weight = w
        return result

    @wp.func
    def tracked_flight(
        scene: Scene,
        m: Medium,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        end: wp.float32,
        sampler: Sampler,
        number: wp.int32,
        draws: wp.bool,
    ) -> Flight:
        stream = salted(sampler, SALT_FLIGHT, number)
        f = Flight()
        f.passing = 1.0
        f.inv_p = 1.0
        stop = length
        rate = wp.float32(0.0)
        start = wp.float32(0.0)
        if wp.static(explores):
            if draws:
                r = grid_ray(scene, texture_record(scene, m.sigma_t), o, d, length)
                if r.t0 < r.t1:
                    q = 1.0 / (FORCED + wp.float32(number))
                    rate = q / (r.t1 - r.t0)
                    start = r.t0
                    rings = r.t0 + minus_log_one_minus(independent_1d(stream, CLOCK)) / rate
                    f.collides = rings < r.t1
                    stop = wp.min(rings, r.t1)
        found = track(scene, m, o, d, stop, stream, not draws)
        if found.collides:
            f.collides = True
            f.t = found.t
        elif f.collides:
            f.t = stop
            found.sigma = load_float(scene.values, m.scale) * grid_value_at(scene, m.sigma_t, o + stop * d)
            if wp.static(flakes):
                found.sigma *= microflakes.area_at(scene, m, o + stop * d, d)
        else:
            f.t = length
        f.passed = found.weight
        if wp.static(explores):
            # The clock has not rung on the way.
            f.passed *= wp.exp(rate * (wp.min(f.t, stop) - start))
        f.weight = f.passed
        if f.collides:
            f.passed /= wp.dot(share_of(found.weight), found.sigma) + rate
            f.t = wp.clamp(f.t, 0.0, wp.max(end, 0.0))
            f.weight = wp.cw_mul(f.passed, wp.cw_mul(albedo_at(scene, m, o + f.t * d), found.sigma))
        return f

    @wp.func
    def tracked_transmittance(
        scene: Scene,
        m: Medium,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        sampler: Sampler,
        number: wp.int32,
    ) -> wp.vec3:
        found = track(scene, m, o, d, length, salted(sampler, SALT_SHADOW, number), True)
        return found.weight

    return tracked_flight, tracked_transmittance

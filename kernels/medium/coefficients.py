"""Coefficients of media, and the sinks for the derivatives of a flight's factor.

A flight of the length t has the factor V = a sigma T(t) if it ends in a collision, and V = T(t) if it passes, with T(t)
= exp(-sigma t). Both have derivatives at sigma = 0 and a = 0.

Derivation: ``docs/theory/media.md#flights``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.medium.volume import GRID, grid_value_at
from warp_psdr.kernels.reading import load_float, load_vec3
from warp_psdr.kernels.sink import make_sink, make_sink_texel
from warp_psdr.kernels.structs import Medium, Scene

#: Coefficients that derivatives are asked of.
SIGMA_T = "sigma_t"
ALBEDO = "albedo"
SCALE = "scale"
EMISSION = "emission"
PHASE = "phase"
POSE = "pose"  # where grids are


@wp.struct
class Coefficients:
    """Values of a medium."""

    sigma_t: wp.vec3  # extinction coefficient, per unit length
    albedo: wp.vec3


@wp.func
def load_channels(values: wp.array(dtype=wp.float32), offset: wp.int32, channels: wp.int32) -> wp.vec3:
    """A colour, or the grey value (one channel) in all components."""
    if channels == 1:
        value = load_float(values, offset)
        return wp.vec3(value, value, value)
    return load_vec3(values, offset)


@wp.func
def coefficients_of(scene: Scene, m: Medium) -> Coefficients:
    c = Coefficients()
    c.sigma_t = load_float(scene.values, m.scale) * load_channels(scene.values, m.sigma_t, m.sigma_t_channels)
    c.albedo = load_channels(scene.values, m.albedo, m.albedo_channels)
    return c


@wp.func
def albedo_at(scene: Scene, m: Medium, x: wp.vec3) -> wp.vec3:
    """The albedo of a medium of grids."""
    if m.albedo_channels == GRID:
        return grid_value_at(scene, m.albedo, x)
    return load_channels(scene.values, m.albedo, m.albedo_channels)


@wp.func
def exp_minus(sigma: wp.vec3, t: wp.float32) -> wp.vec3:
    """Transmittance of a length in a medium."""
    return wp.vec3(wp.exp(-sigma[0] * t), wp.exp(-sigma[1] * t), wp.exp(-sigma[2] * t))


@wp.func
def exp_slope(sigma: wp.float32, t: wp.float32) -> wp.float32:
    """T' = -t exp(-sigma t) by sigma; of a length without end 0, or minus infinity at sigma = 0."""
    if t >= FAR:
        return wp.where(sigma > 0.0, 0.0, -wp.INF)
    return -t * wp.exp(-sigma * t)


@functools.cache
def make_coefficient_sinks(role: str, wanted: tuple[str, ...]):
    """Return ``(accumulate_extinction, accumulate_flight)``.

    ``accumulate_extinction(scene, target, m, w) -> float32``: ``w`` is the adjoint of sigma_t.
    ``accumulate_flight(scene, target, m, t, collides, w) -> float32``: ``w`` is the adjoint of V.
    """
    sink = make_sink(role)
    sink_texel = make_sink_texel(role)

    @wp.func
    def accumulate_extinction(scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, w: wp.vec3) -> wp.float32:
        total = wp.float32(0.0)
        if wp.static(SIGMA_T in wanted):
            scale = load_float(scene.values, m.scale)
            total += sink_texel(target, m.sigma_t, m.sigma_t_channels, scale * w)
        if wp.static(SCALE in wanted):
            sigma = load_channels(scene.values, m.sigma_t, m.sigma_t_channels)
            total += sink(target, m.scale, wp.dot(sigma, w))
        return total

    @wp.func
    def accumulate_flight(
        scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, t: wp.float32, collides: wp.bool, w: wp.vec3
    ) -> wp.float32:
        total = wp.float32(0.0)
        c = coefficients_of(scene, m)
        if wp.static(SIGMA_T in wanted or SCALE in wanted):
            a_sigma = wp.vec3(0.0, 0.0, 0.0)
            for k in range(3):
                sigma = c.sigma_t[k]
                slope = wp.float32(0.0)
                if collides:
                    slope = c.albedo[k] * (1.0 - sigma * t) * wp.exp(-sigma * t)
                elif w[k] != 0.0:
                    slope = exp_slope(sigma, t)
                a_sigma[k] = w[k] * slope
            total += accumulate_extinction(scene, target, m, a_sigma)
        if wp.static(ALBEDO in wanted):
            if collides:
                a_albedo = wp.cw_mul(w, wp.cw_mul(c.sigma_t, exp_minus(c.sigma_t, t)))
                total += sink_texel(target, m.albedo, m.albedo_channels, a_albedo)
        return total

    return accumulate_extinction, accumulate_flight

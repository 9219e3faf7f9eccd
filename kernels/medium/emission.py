"""Light that a homogeneous medium emits along a stretch of a path, and its derivatives.

A medium emits the radiance epsilon per unit length (W / (m^2 sr m)). A stretch of the length l sends E = epsilon
w(sigma, l), w = (1 - exp(-sigma l)) / sigma, to its beginning; w = l without extinction. This closed form needs no
sample. The extinction of microflakes is A(d) sigma_t (``phase/sggx.py``). Nothing moves here. ``grid_emission.py``
treats grids.

Derivation: ``docs/theory/media.md#emission``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR, PHASE_SGGX
from warp_psdr.kernels.medium.coefficients import (
    EMISSION,
    PHASE,
    SCALE,
    SIGMA_T,
    load_channels,
    make_coefficient_sinks,
)
from warp_psdr.kernels.medium.flight import SHORT_FLIGHT, one_minus_exp
from warp_psdr.kernels.phase.microflakes import make_flake_sinks
from warp_psdr.kernels.phase.sggx import flake_area, flakes_of, make_extinction_along
from warp_psdr.kernels.sink import make_sink_texel
from warp_psdr.kernels.structs import Medium, Scene

#: Optical thickness below which the derivative of w by sigma is computed by its series, the next term 1e-8 of it.
SHORT_SLOPE = 0.1


@wp.func
def seen_length(sigma: wp.float32, length: wp.float32) -> wp.float32:
    """w: the length that is seen of a stretch, each point as far as it is not hidden by those before it."""
    if length >= FAR:
        return wp.where(sigma > 0.0, 1.0 / sigma, wp.INF)
    x = sigma * length
    if x < SHORT_FLIGHT:
        return length * (1.0 - x * (0.5 - x * (1.0 / 6.0)))
    return one_minus_exp(x) / sigma


@wp.func
def seen_length_slope(sigma: wp.float32, length: wp.float32) -> wp.float32:
    """The derivative of w by sigma; of a stretch without end minus infinity at sigma = 0."""
    if length >= FAR:
        return wp.where(sigma > 0.0, -1.0 / (sigma * sigma), -wp.INF)
    x = sigma * length
    if x < SHORT_SLOPE:
        series = 0.5 - x * (1.0 / 3.0 - x * (0.125 - x * (1.0 / 30.0 - x * (1.0 / 144.0))))
        return -length * length * series
    return (length * wp.exp(-x) - one_minus_exp(x) / sigma) / sigma


@wp.func
def emission_of(scene: Scene, m: Medium) -> wp.vec3:
    """epsilon; black where a medium emits nothing."""
    if m.emission < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return load_channels(scene.values, m.emission, m.emission_channels)


@functools.cache
def make_emission(kinds: tuple[int, ...]):
    """Return ``emitted_along(scene, m, d, length) -> vec3``: E of a stretch, for kinds of phase functions."""
    extinction_along = make_extinction_along(kinds)

    @wp.func
    def emitted_along(scene: Scene, m: Medium, d: wp.vec3, length: wp.float32) -> wp.vec3:
        sigma = extinction_along(scene, m, d).sigma_t
        emission = emission_of(scene, m)
        emitted = wp.vec3(0.0, 0.0, 0.0)
        for k in range(3):
            if emission[k] > 0.0:
                emitted[k] = emission[k] * seen_length(sigma[k], length)
        return emitted

    return emitted_along


@functools.cache
def make_emission_sink(kinds: tuple[int, ...], role: str, wanted: tuple[str, ...]):
    """Return ``accumulate_emission(scene, target, m, d, length, w) -> float32``; ``w`` is the adjoint of E."""
    accumulate_extinction, _accumulate_flight = make_coefficient_sinks(role, wanted)
    sink_texel = make_sink_texel(role)
    extinction_along = make_extinction_along(kinds)
    _value, accumulate_area = make_flake_sinks(kinds, role)
    flakes = PHASE_SGGX in kinds

    @wp.func
    def accumulate_emission(
        scene: Scene, target: wp.array(dtype=wp.float32), m: Medium, d: wp.vec3, length: wp.float32, w: wp.vec3
    ) -> wp.float32:
        total = wp.float32(0.0)
        if m.emission < 0:
            return total
        sigma = extinction_along(scene, m, d).sigma_t
        emission = emission_of(scene, m)
        a_emission = wp.vec3(0.0, 0.0, 0.0)
        a_sigma = wp.vec3(0.0, 0.0, 0.0)
        for k in range(3):
            if w[k] != 0.0:
                a_emission[k] = w[k] * seen_length(sigma[k], length)
                if emission[k] > 0.0:
                    a_sigma[k] = w[k] * emission[k] * seen_length_slope(sigma[k], length)
        if wp.static(flakes):
            if m.phase == PHASE_SGGX:
                if wp.static(PHASE in wanted):
                    total += accumulate_area(scene, target, m, d, d, wp.dot(a_sigma, sigma))
                a_sigma *= flake_area(flakes_of(scene, m.g), d)
        if wp.static(SIGMA_T in wanted or SCALE in wanted):
            total += accumulate_extinction(scene, target, m, a_sigma)
        if wp.static(EMISSION in wanted):
            total += sink_texel(target, m.emission, m.emission_channels, a_emission)
        return total

    return accumulate_emission

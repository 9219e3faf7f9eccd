"""The phase functions of a scene: those of its own media and no others."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import PHASE_HG, PHASE_ISOTROPIC, TWO_PI
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.phase.hg import hg_cosine, hg_eval, hg_slope
from warp_psdr.kernels.phase.isotropic import isotropic_cosine, isotropic_eval
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.structs import Medium, Scene


class PhaseFunctions(NamedTuple):
    """Warp functions of a medium's phase function; ``d`` is the direction of flight, ``wo`` the new one, both unit.

    Attributes:
        eval: ``(scene, m, d, wo) -> float32``: value, 1/sr, which is the density of ``sample`` as well.
        slope: ``(scene, m, d, wo) -> float32``: derivative of the value by g.
        sample: ``(scene, m, d, u: vec2) -> vec3``: a new direction.
    """

    eval: wp.Function
    slope: wp.Function
    sample: wp.Function


@functools.cache
def make_phase(kinds: tuple[int, ...]) -> PhaseFunctions:
    """Return the functions for the kinds (PHASE_*) of a scene."""
    isotropic = PHASE_ISOTROPIC in kinds
    forward = PHASE_HG in kinds

    @wp.func
    def phase_eval(scene: Scene, m: Medium, d: wp.vec3, wo: wp.vec3) -> wp.float32:
        value = isotropic_eval()
        if wp.static(forward):
            if wp.static(not isotropic) or m.phase == PHASE_HG:
                value = hg_eval(load_float(scene.values, m.g), wp.dot(d, wo))
        return value

    @wp.func
    def phase_slope(scene: Scene, m: Medium, d: wp.vec3, wo: wp.vec3) -> wp.float32:
        slope = wp.float32(0.0)
        if wp.static(forward):
            if wp.static(not isotropic) or m.phase == PHASE_HG:
                slope = hg_slope(load_float(scene.values, m.g), wp.dot(d, wo))
        return slope

    @wp.func
    def phase_sample(scene: Scene, m: Medium, d: wp.vec3, u: wp.vec2) -> wp.vec3:
        mu = isotropic_cosine(u[0])
        if wp.static(forward):
            if wp.static(not isotropic) or m.phase == PHASE_HG:
                mu = hg_cosine(load_float(scene.values, m.g), u[0])
        sine = wp.sqrt(wp.max(0.0, 1.0 - mu * mu))
        s = any_tangent(d)
        phi = TWO_PI * u[1]
        return to_world(s, wp.cross(d, s), d, wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), mu))

    return PhaseFunctions(phase_eval, phase_slope, phase_sample)

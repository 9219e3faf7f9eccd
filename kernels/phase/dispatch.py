"""The phase functions of a scene, compiled for the kinds that its media use."""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import (
    PHASE_BLEND,
    PHASE_BLEND_GRID,
    PHASE_HG,
    PHASE_RAYLEIGH,
    PHASE_TABLE,
    TWO_PI,
)
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.phase.blendphase import make_blend_sink, make_blend_slopes, make_phase_blend
from warp_psdr.kernels.phase.hg import hg_by_cosine, hg_cosine, hg_eval, hg_slope
from warp_psdr.kernels.phase.isotropic import isotropic_cosine, isotropic_eval
from warp_psdr.kernels.phase.microflakes import has_flakes, make_flake_sinks, make_microflakes
from warp_psdr.kernels.phase.rayleigh import rayleigh_by_cosine, rayleigh_cosine, rayleigh_eval
from warp_psdr.kernels.phase.sggx import sggx_eval, sggx_sample
from warp_psdr.kernels.phase.tabphase import make_table_sink, tabphase_by_cosine, tabphase_cosine, tabphase_eval
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Medium, Scene

BLENDS = (PHASE_BLEND, PHASE_BLEND_GRID)


def unblended(kinds: tuple[int, ...]) -> tuple[int, ...]:
    """Return the kinds of phase functions that are no blends of others."""
    return tuple(kind for kind in kinds if kind not in BLENDS)


class PhaseFunctions(NamedTuple):
    """Warp functions of a medium's phase function at a point x of it.

    ``d`` is the direction of flight, ``wo`` the new one, both unit.

    Attributes:
        eval: ``(scene, m, x, d, wo) -> float32``: value, 1/sr, which is the density of ``sample`` as well.
        sample: ``(scene, m, x, d, u: vec2) -> vec3``: a new direction.
    """

    eval: wp.Function
    sample: wp.Function


@functools.cache
def make_phase(kinds: tuple[int, ...]) -> PhaseFunctions:
    """Return the functions for the kinds (PHASE_*) of a scene."""
    rest = unblended(kinds)
    if rest != kinds:
        return PhaseFunctions(*make_phase_blend(kinds, *make_phase(rest)))
    one = len(kinds) == 1
    forward, rayleigh, table = (kind in kinds for kind in (PHASE_HG, PHASE_RAYLEIGH, PHASE_TABLE))
    flakes = has_flakes(kinds)
    microflakes = make_microflakes(kinds)

    @wp.func
    def phase_eval(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, wo: wp.vec3) -> wp.float32:
        value = isotropic_eval()
        if wp.static(forward):
            if wp.static(one) or m.phase == PHASE_HG:
                value = hg_eval(load_float(scene.values, m.g), wp.dot(d, wo))
        if wp.static(rayleigh):
            if wp.static(one) or m.phase == PHASE_RAYLEIGH:
                value = rayleigh_eval(wp.dot(d, wo))
        if wp.static(table):
            if wp.static(one) or m.phase == PHASE_TABLE:
                value = tabphase_eval(scene, m.g, wp.dot(d, wo))
        if wp.static(flakes):
            if microflakes.is_flakes(m):
                value = sggx_eval(microflakes.at(scene, m, x), d, wo)
        return value

    @wp.func
    def phase_sample(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, u: wp.vec2) -> wp.vec3:
        if wp.static(flakes):
            if microflakes.is_flakes(m):
                return sggx_sample(microflakes.at(scene, m, x), d, u)
        mu = isotropic_cosine(u[0])
        if wp.static(forward):
            if wp.static(one) or m.phase == PHASE_HG:
                mu = hg_cosine(load_float(scene.values, m.g), u[0])
        if wp.static(rayleigh):
            if wp.static(one) or m.phase == PHASE_RAYLEIGH:
                mu = rayleigh_cosine(u[0])
        if wp.static(table):
            if wp.static(one) or m.phase == PHASE_TABLE:
                mu = tabphase_cosine(scene, m.g, u[0])
        sine = wp.sqrt(wp.max(0.0, 1.0 - mu * mu))
        s = any_tangent(d)
        phi = TWO_PI * u[1]
        return to_world(s, wp.cross(d, s), d, wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), mu))

    return PhaseFunctions(phase_eval, phase_sample)


@functools.cache
def make_phase_slopes(kinds: tuple[int, ...]):
    """Return ``(by_cosine, by_place)``: the derivatives of the value by the cosine of the turn, and by x.

    ``by_cosine(scene, m, x, mu) -> float32``; that of ``sggx`` does not depend on the cosine alone (``sggx_slopes``),
    and is 0 here. ``by_place(scene, m, x, d, wo) -> vec3``.
    """
    rest = unblended(kinds)
    if rest != kinds:
        return make_blend_slopes(kinds, make_phase(rest).eval, make_phase_slopes(rest)[0])
    one = len(kinds) == 1
    forward, rayleigh, table = (kind in kinds for kind in (PHASE_HG, PHASE_RAYLEIGH, PHASE_TABLE))

    @wp.func
    def by_cosine(scene: Scene, m: Medium, x: wp.vec3, mu: wp.float32) -> wp.float32:
        slope = wp.float32(0.0)
        if wp.static(forward):
            if wp.static(one) or m.phase == PHASE_HG:
                slope = hg_by_cosine(load_float(scene.values, m.g), mu)
        if wp.static(rayleigh):
            if wp.static(one) or m.phase == PHASE_RAYLEIGH:
                slope = rayleigh_by_cosine(mu)
        if wp.static(table):
            if wp.static(one) or m.phase == PHASE_TABLE:
                slope = tabphase_by_cosine(scene, m.g, mu)
        return slope

    @wp.func
    def by_place(scene: Scene, m: Medium, x: wp.vec3, d: wp.vec3, wo: wp.vec3) -> wp.vec3:
        return wp.vec3(0.0, 0.0, 0.0)

    return by_cosine, by_place


@functools.cache
def make_phase_sink(kinds: tuple[int, ...], role: str):
    """Return ``accumulate_phase(scene, target, m, x, d, wo, w) -> float32``: ``w`` is the adjoint of the value."""
    rest = unblended(kinds)
    if rest != kinds:
        return make_blend_sink(kinds, make_phase(rest).eval, make_phase_sink(rest, role), role)
    sink = make_sink(role)
    accumulate_table = make_table_sink(role)
    accumulate_sggx, _area = make_flake_sinks(kinds, role)
    is_flakes = make_microflakes(kinds).is_flakes
    one = len(kinds) == 1
    forward, table, flakes = PHASE_HG in kinds, PHASE_TABLE in kinds, has_flakes(kinds)

    @wp.func
    def accumulate_phase(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        x: wp.vec3,
        d: wp.vec3,
        wo: wp.vec3,
        w: wp.float32,
    ) -> wp.float32:
        dot = wp.float32(0.0)
        if wp.static(forward):
            if wp.static(one) or m.phase == PHASE_HG:
                slope = hg_slope(load_float(scene.values, m.g), wp.dot(d, wo))
                dot = sink(target, m.g, w * slope)
        if wp.static(table):
            if wp.static(one) or m.phase == PHASE_TABLE:
                dot = accumulate_table(scene, target, m.g, wp.dot(d, wo), w)
        if wp.static(flakes):
            if is_flakes(m):
                dot = accumulate_sggx(scene, target, m, x, d, wo, w)
        return dot

    return accumulate_phase

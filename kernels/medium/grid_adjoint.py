"""The sinks for the derivatives of flights through grids, and of the transmittance of segments.

The derivative of T = exp(-int sigma) is -T int dsigma, whatever tracking drew. The integral is estimated at four
stratified points of the stretch, from random numbers of their own; T is tracking's estimate [Nimier-David et al. 2022,
section 4.1]. Majorants and the weights of tracking are not differentiated, so a density that vanishes, or that equals
its majorant, needs no special case.

Derivation: ``docs/theory/media.md#derivatives-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.medium.coefficients import ALBEDO, PHASE, SCALE, SIGMA_T, albedo_at
from warp_psdr.kernels.medium.flight import mean_of
from warp_psdr.kernels.medium.majorant import grid_ray, mean_majorant
from warp_psdr.kernels.medium.volume import GRID, grid_point, grid_value, grid_value_at, make_grid_sink
from warp_psdr.kernels.phase.microflakes import has_flakes, make_flake_sinks, make_microflakes
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d
from warp_psdr.kernels.sink import make_sink, make_sink_texel
from warp_psdr.kernels.structs import Medium, Scene, Texture
from warp_psdr.kernels.vertex import MediaConfig

#: Salt of the numbers that place points on stretches.
SALT_POINTS = wp.constant(wp.uint32(0x2E6B83D5))
#: Points on a stretch.
POINTS = 4


@wp.func
def power_share(a: wp.float32, b: wp.float32) -> wp.float32:
    """The share of the first of two techniques by the power heuristic: a^2 / (a^2 + b^2)."""
    ratio = wp.min(a / wp.max(b, 1.0e-30), 1.0e15)
    return ratio * ratio / (1.0 + ratio * ratio)


@functools.cache
def make_grid_adjoint(config: MediaConfig, role: str, wanted: tuple[str, ...], shared: bool = False):
    """Return ``(accumulate_depth, accumulate_tracked, accumulate_extinction_at)``.

    ``accumulate_depth(scene, target, m, o, d, length, stream, w) -> float32``: ``w`` is the adjoint of int sigma dt.
    ``accumulate_tracked(scene, target, m, o, d, t, collides, passed, stream, w) -> float32``: ``w`` is the adjoint of
    the weight of a flight (``Flight``).
    ``accumulate_extinction_at(scene, target, m, g, p, x, d, w) -> float32``: ``w`` is the adjoint of sigma along d at
    x, in voxels p. That of microflakes, A(x, d) times the grid's, depends on S.

    ``shared``: of in-scattering collisions have their share of the power heuristic
    (``interior/differential_ratio_tracking.py``).
    """
    sink = make_sink(role)
    sink_texel = make_sink_texel(role)
    accumulate_grid = make_grid_sink(role)
    flakes = has_flakes(config.phases)
    microflakes = make_microflakes(config.phases)
    _value, accumulate_area = make_flake_sinks(config.phases, role)
    turned = flakes and PHASE in wanted
    density = SIGMA_T in wanted or SCALE in wanted or turned

    @wp.func
    def accumulate_extinction_at(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        g: Texture,
        p: wp.vec3,
        x: wp.vec3,
        d: wp.vec3,
        w: wp.vec3,
    ) -> wp.float32:
        total = wp.float32(0.0)
        w_value = w
        if wp.static(flakes):
            w_value = microflakes.area_at(scene, m, x, d) * w
        if wp.static(turned):
            if microflakes.is_flakes(m):
                sigma = load_float(scene.values, m.scale) * wp.dot(grid_value(scene.values, g, p), w_value)
                total += accumulate_area(scene, target, m, x, d, sigma)
        if wp.static(SIGMA_T in wanted):
            total += accumulate_grid(target, g, p, load_float(scene.values, m.scale) * w_value)
        if wp.static(SCALE in wanted):
            total += sink(target, m.scale, wp.dot(grid_value(scene.values, g, p), w_value))
        return total

    @wp.func
    def accumulate_depth(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        stream: Sampler,
        w: wp.vec3,
    ) -> wp.float32:
        total = wp.float32(0.0)
        g = texture_record(scene, m.sigma_t)
        r = grid_ray(scene, g, o, d, length)
        if r.t0 < r.t1:
            step = (r.t1 - r.t0) * (1.0 / float(POINTS))
            points = wp.int32(POINTS)
            for i in range(points):
                t = r.t0 + (wp.float32(i) + independent_1d(stream, i)) * step
                total += accumulate_extinction_at(scene, target, m, g, r.o + t * r.d, o + t * d, d, step * w)
        return total

    @wp.func
    def accumulate_tracked(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        o: wp.vec3,
        d: wp.vec3,
        t: wp.float32,
        collides: wp.bool,
        passed: wp.vec3,
        stream: Sampler,
        w: wp.vec3,
    ) -> wp.float32:
        total = wp.float32(0.0)
        w_passed = wp.cw_mul(w, passed)
        w_weight = w_passed
        if collides:
            x = o + t * d
            sigma = load_float(scene.values, m.scale) * grid_value_at(scene, m.sigma_t, x)
            if wp.static(flakes):
                sigma *= microflakes.area_at(scene, m, x, d)
            albedo = albedo_at(scene, m, x)
            w_weight = wp.cw_mul(w_passed, wp.cw_mul(albedo, sigma))
            if wp.static(density):
                g = texture_record(scene, m.sigma_t)
                p = grid_point(scene, g, x)
                a_sigma = wp.cw_mul(w_passed, albedo)
                if wp.static(shared):
                    a_sigma *= power_share(mean_of(sigma), mean_majorant(scene, m, g, o, d))
                total += accumulate_extinction_at(scene, target, m, g, p, x, d, a_sigma)
            if wp.static(ALBEDO in wanted):
                a_albedo = wp.cw_mul(w_passed, sigma)
                if m.albedo_channels == GRID:
                    g_albedo = texture_record(scene, m.albedo)
                    total += accumulate_grid(target, g_albedo, grid_point(scene, g_albedo, x), a_albedo)
                else:
                    total += sink_texel(target, m.albedo, m.albedo_channels, a_albedo)
        if wp.static(density):
            total += accumulate_depth(scene, target, m, o, d, t, stream, -w_weight)
        return total

    return accumulate_depth, accumulate_tracked, accumulate_extinction_at

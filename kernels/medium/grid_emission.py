"""Light that a medium of grids emits along a stretch of a path, and its derivatives.

With the radiance epsilon(t) per unit length, a stretch sends M = int epsilon T dt to its beginning. One point is drawn
in each quarter of the stretch, and ratio tracking estimates T from point to point. Nothing is divided by the density,
which may vanish. The boxes of the extinction and of ``emission`` bound the emission, as the albedo's box bounds
scattering. The derivative of T up to a point is -T int dsigma, at one point of its own before each of them. All random
numbers come from a stream of the step's own, so that a sweep finds the points of the path again.

Derivation: ``docs/theory/media.md#emission-of-grids``.
"""

import functools

import warp as wp

from warp_psdr.kernels.medium.coefficients import EMISSION, PHASE, SCALE, SIGMA_T, load_channels
from warp_psdr.kernels.medium.grid_adjoint import make_grid_adjoint
from warp_psdr.kernels.medium.majorant import GridRay, grid_ray
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID, grid_point, grid_value_at, make_grid_sink
from warp_psdr.kernels.phase.microflakes import has_flakes
from warp_psdr.kernels.reading import texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d, salted
from warp_psdr.kernels.sink import make_sink_texel
from warp_psdr.kernels.structs import Medium, Scene
from warp_psdr.kernels.vertex import MediaConfig

#: Salt of the numbers of a stretch.
SALT_EMISSION = wp.constant(wp.uint32(0x3D94A6B7))
#: Points on a stretch.
POINTS = 4


@wp.func
def emission_at(scene: Scene, m: Medium, x: wp.vec3) -> wp.vec3:
    """The emitted radiance per unit length."""
    if m.emission_channels == GRID:
        return grid_value_at(scene, m.emission, x)
    return load_channels(scene.values, m.emission, m.emission_channels)


@wp.func
def emission_point(r: GridRay, stream: Sampler, i: wp.int32) -> wp.float32:
    """The distance of the i-th point."""
    return r.t0 + (wp.float32(i) + independent_1d(stream, i)) * (1.0 / float(POINTS)) * (r.t1 - r.t0)


@functools.cache
def make_grid_emission(config: MediaConfig):
    """Return ``emitted_in_grid(scene, m, o, d, length, sampler, step) -> vec3``: M of a stretch."""
    _flight, transmittance = make_tracking(config, False)

    @wp.func
    def emitted_in_grid(
        scene: Scene, m: Medium, o: wp.vec3, d: wp.vec3, length: wp.float32, sampler: Sampler, step: wp.int32
    ) -> wp.vec3:
        emitted = wp.vec3(0.0, 0.0, 0.0)
        if m.emission < 0:
            return emitted
        r = grid_ray(scene, texture_record(scene, m.sigma_t), o, d, length)
        if not r.t0 < r.t1:
            return emitted
        stream = salted(sampler, SALT_EMISSION, step)
        passed = wp.vec3(1.0, 1.0, 1.0)
        start = r.t0
        points = wp.int32(POINTS)
        for i in range(points):
            t = emission_point(r, stream, i)
            passed = wp.cw_mul(passed, transmittance(scene, m, o + start * d, d, t - start, stream, i))
            emitted += wp.cw_mul(passed, emission_at(scene, m, o + t * d))
            start = t
        return (r.t1 - r.t0) * (1.0 / float(POINTS)) * emitted

    return emitted_in_grid


@functools.cache
def make_grid_emission_sink(config: MediaConfig, role: str, wanted: tuple[str, ...]):
    """Return ``accumulate_grid_emission(scene, target, m, o, d, length, sampler, step, emitted, w) -> float32``.

    ``emitted`` is M of the stretch, and ``w`` its adjoint.
    """
    _flight, transmittance = make_tracking(config, False)
    _depth, _tracked, accumulate_extinction_at = make_grid_adjoint(config, role, wanted)
    sink_texel = make_sink_texel(role)
    accumulate_grid = make_grid_sink(role)
    density = SIGMA_T in wanted or SCALE in wanted or (PHASE in wanted and has_flakes(config.phases))

    @wp.func
    def accumulate_grid_emission(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        o: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        sampler: Sampler,
        step: wp.int32,
        emitted: wp.vec3,
        w: wp.vec3,
    ) -> wp.float32:
        total = wp.float32(0.0)
        if m.emission < 0:
            return total
        g = texture_record(scene, m.sigma_t)
        r = grid_ray(scene, g, o, d, length)
        if not r.t0 < r.t1:
            return total
        stream = salted(sampler, SALT_EMISSION, step)
        share = (r.t1 - r.t0) * (1.0 / float(POINTS))
        passed = wp.vec3(1.0, 1.0, 1.0)
        behind = emitted  # what is emitted from this point on
        start = r.t0
        points = wp.int32(POINTS)
        for i in range(points):
            t = emission_point(r, stream, i)
            if wp.static(density):
                between = wp.lerp(start, t, independent_1d(stream, points + i))
                w_depth = -(t - start) * wp.cw_mul(w, behind)
                total += accumulate_extinction_at(scene, target, m, g, r.o + between * r.d, o + between * d, d, w_depth)
            passed = wp.cw_mul(passed, transmittance(scene, m, o + start * d, d, t - start, stream, i))
            x = o + t * d
            behind -= share * wp.cw_mul(passed, emission_at(scene, m, x))
            if wp.static(EMISSION in wanted):
                a_emission = share * wp.cw_mul(w, passed)
                if m.emission_channels == GRID:
                    g_emission = texture_record(scene, m.emission)
                    total += accumulate_grid(target, g_emission, grid_point(scene, g_emission, x), a_emission)
                else:
                    total += sink_texel(target, m.emission, m.emission_channels, a_emission)
            start = t
        return total

    return accumulate_grid_emission

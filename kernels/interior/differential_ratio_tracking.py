"""Differential ratio tracking: points for in-scattering by transmittance alone [NDMKJ22, section 4].

The derivative of in-scattering by the density is int a dsigma T S dt. Collisions come by sigma T and estimate it with a
division by sigma. Ratio tracking draws a point by T: of its tentative points t_i with the weights w_i = prod_{j<i} (1 -
sigma_j / M_j), one is chosen by w_i / M_i and weighted with the sum of these numbers. The power heuristic joins both
techniques, with sigma and with c, a mean majorant of the ray (the paper has 1, which depends on the unit of length).
One stretch of a path is chosen by its throughput, and a new path from its point estimates the in-scattered light.

Derivation: ``docs/theory/media.md#differential-ratio-tracking``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.coefficients import albedo_at
from warp_psdr.kernels.medium.flight import mean_of
from warp_psdr.kernels.medium.grid_adjoint import make_grid_adjoint, power_share
from warp_psdr.kernels.medium.majorant import GridRay, before_tentative, grid_ray, mean_majorant, next_tentative
from warp_psdr.kernels.medium.volume import GRID, grid_value
from warp_psdr.kernels.path_media import SLOTS_PER_STEP, MediaState, MediaVertex, make_collision, make_media_step
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d, make_sampler, salted
from warp_psdr.kernels.structs import Scene, Texture
from warp_psdr.kernels.vertex import PathConfig

#: Salt of the numbers that choose a stretch (0) and a point on it (1), and of the path that starts there (2).
SALT_BRANCH = wp.constant(wp.uint32(0x1B873593))


@wp.struct
class Stretch:
    """The stretch of a path that was chosen."""

    state: MediaState  # before it
    length: wp.float32
    weight: wp.float32  # its own
    total: wp.float32  # of all; 0: there is none


@wp.struct
class TransmittedPoint:
    """A point of a stretch that was chosen by T."""

    t: wp.float32
    total: wp.float32  # int T dt is its expectation, the mean over channels; 0: there is no point
    share: wp.vec3  # T of each channel there over their mean
    sigma: wp.vec3  # extinction there


@wp.func
def transmitted_point(
    scene: Scene, g: Texture, r: GridRay, scale: wp.float32, least: wp.float32, stream: Sampler
) -> TransmittedPoint:
    """A reservoir over the tentative points of ratio tracking, which come at the rate ``least`` at least."""
    found = TransmittedPoint()
    w = wp.vec3(1.0, 1.0, 1.0)
    point = next_tentative(scene.values, g, r, scale, least, stream, before_tentative(g, r, 0))
    while point.t < r.t1:
        sigma = scale * grid_value(scene.values, g, r.o + point.t * r.d)
        weight = mean_of(w)
        found.total += weight / point.rate
        if point.u * found.total < weight / point.rate:
            found.t = point.t
            found.share = w / weight
            found.sigma = sigma
        w = wp.cw_mul(w, wp.vec3(1.0, 1.0, 1.0) - sigma / point.rate)
        if vanishes(w):
            point.t = r.t1
        else:
            point = next_tentative(scene.values, g, r, scale, least, stream, point)
    return found


@functools.cache
def make_ratio_branch(config: PathConfig, wanted: GradientRequest, role: str):
    """Return ``(consider_stretch, from_stretch)``.

    ``consider_stretch(scene, sampler, stretch, state, vertex, delta, max_depth) -> Stretch``: weighted reservoir
    sampling; ``state`` is that before the step of ``vertex``.
    ``from_stretch(scene, target, sampler, stretch, delta, max_depth, rr_depth) -> vec3``: what the sinks returned, in
    forward mode of each channel.
    """
    assert config.media is not None
    collide = make_collision(config, True)
    media_step = make_media_step(config, True, True, False)
    _depth, _tracked, accumulate_extinction_at = make_grid_adjoint(config.media, role, wanted.media, True)
    sample_4d = make_sampler(config.sampler).sample_4d
    channels = 3 if role == "forward" else 1

    @wp.func
    def consider_stretch(
        scene: Scene,
        sampler: Sampler,
        stretch: Stretch,
        state: MediaState,
        v: MediaVertex,
        delta: wp.vec3,
        max_depth: wp.int32,
    ) -> Stretch:
        r = stretch
        if state.medium >= 0 and (max_depth < 0 or state.path.depth + 1 < max_depth):
            if scene.media.records[state.medium].sigma_t_channels == GRID:
                weight = wp.dot(wp.abs(delta), wp.abs(state.path.throughput))
                r.total += weight
                if independent_1d(salted(sampler, SALT_BRANCH, 0), state.steps) * r.total < weight:
                    r.state = state
                    r.length = v.length
                    r.weight = weight
        return r

    @wp.func
    def from_stretch(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        sampler: Sampler,
        stretch: Stretch,
        delta: wp.vec3,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        dots = wp.vec3(0.0, 0.0, 0.0)
        o = stretch.state.path.o
        d = stretch.state.path.d
        m = scene.media.records[stretch.state.medium]
        g = texture_record(scene, m.sigma_t)
        scale = load_float(scene.values, m.scale)
        r = grid_ray(scene, g, o, d, stretch.length)
        if not r.t0 < r.t1:
            return dots
        # ---- A point by T ----
        least = 1.0 / (r.t1 - r.t0)
        point = transmitted_point(scene, g, r, scale, least, salted(sampler, SALT_BRANCH, 1))
        if point.total <= 0.0:
            return dots
        # ---- S: what is scattered in there ----
        branch = salted(sampler, SALT_BRANCH, 2)
        state = stretch.state
        slot = 1 + SLOTS_PER_STEP * state.steps
        vertex = MediaVertex()
        vertex.t = point.t
        vertex.surface.o = o
        vertex.surface.d = d
        vertex.surface.throughput = wp.vec3(1.0, 1.0, 1.0)
        u4 = sample_4d(branch, slot + 1)
        r4 = sample_4d(branch, slot + 2)
        reached, after = collide(scene, branch, state, vertex, u4, r4, max_depth, rr_depth)
        radiance = reached.surface.direct
        while after.path.alive == 1:
            behind, after = media_step(scene, branch, after, max_depth, rr_depth)
            radiance += wp.cw_mul(behind.surface.throughput, behind.surface.direct)
        # ---- a dsigma T S, weighed against collisions ----
        shared = power_share(mean_majorant(scene, m, g, o, d), mean_of(point.sigma))
        size = shared * point.total * stretch.total / stretch.weight
        a_sigma = size * wp.cw_mul(wp.cw_mul(point.share, albedo_at(scene, m, o + point.t * d)), radiance)
        a_sigma = wp.cw_mul(a_sigma, wp.cw_mul(delta, state.path.throughput))
        p = r.o + point.t * r.d
        for channel in range(wp.static(channels)):
            a = a_sigma
            if wp.static(role == "forward"):
                a = wp.vec3(0.0, 0.0, 0.0)
                a[channel] = a_sigma[channel]
            dots[channel] = accumulate_extinction_at(scene, target, m, g, p, o + point.t * d, d, a)
        return dots

    return consider_stretch, from_stretch

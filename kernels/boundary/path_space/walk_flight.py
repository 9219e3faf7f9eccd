"""Flights of the walk towards the camera: a collision on a stretch of a medium or a passage, with a known density.

Free flights do not serve, because only a part of what x_1 carries has the transmittance up to x_1. Half of the
collisions are drawn by extinction (in grids by that of some bins along the ray), and half by how near the camera is.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.medium.coefficients import Coefficients, albedo_at, exp_minus
from warp_psdr.kernels.medium.flight import forced_density, forced_distance, mean_of
from warp_psdr.kernels.medium.majorant import grid_ray
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import grid_value, grid_value_at
from warp_psdr.kernels.phase.sggx import make_extinction_along
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Medium, Scene
from warp_psdr.kernels.vertex import MediaConfig

#: Least probability with which x_1 is beyond a stretch of a medium: fog in front of an edge that hides it is lit, too.
PASSES = 1.0 / 3.0
#: Least width of the density of distances that the camera is near to: over the distance of the stretch from where it is
#: nearest, and over the extent of the scene. Length of a stretch over that width below which the density is even.
FLAT, SHARPEST, SHORT = 0.25, 1.0e-4, 0.01
#: Bins of a ray through a grid, the share of their mean that each of them has at least, and the largest probability to
#: pass a grid, of which the bins may have seen nothing.
BINS, EVEN_SHARE, MOST_PASSES = 8, 0.25, 0.8


@wp.struct
class Flown:
    """Where a flight ends: on its stretch of a medium, or beyond."""

    collides: wp.bool
    t: wp.float32
    inv_p: wp.float32  # 1 / p, or 1 / P


@wp.struct
class Bell:
    """A density of distances on a stretch, 1 / (h^2 + (t - t0)^2): that at which the camera sees them."""

    t0: wp.float32
    h: wp.float32
    start: wp.float32  # angles of its two ends
    width: wp.float32
    even: wp.bool  # instead: the stretch is short


@wp.func
def bell_on(way: wp.vec3, d: wp.vec3, length: wp.float32, extent: wp.float32) -> Bell:
    """``way``: from the start of the stretch to the camera."""
    r = Bell()
    r.t0 = wp.dot(way, d)
    outside = wp.max(wp.max(-r.t0, r.t0 - length), 0.0)
    r.h = wp.max(wp.max(wp.length(way - r.t0 * d), FLAT * outside), SHARPEST * extent)
    r.even = length < SHORT * r.h
    r.start = wp.atan2(-r.t0, r.h)
    r.width = wp.atan2(length - r.t0, r.h) - r.start
    return r


@wp.func
def bell_distance(b: Bell, length: wp.float32, u: wp.float32) -> wp.float32:
    if b.even:
        return u * length
    return wp.clamp(b.t0 + b.h * wp.tan(b.start + u * b.width), 0.0, length)


@wp.func
def bell_density(b: Bell, length: wp.float32, t: wp.float32) -> wp.float32:
    if b.even:
        return 1.0 / length
    return b.h / (b.width * (b.h * b.h + (t - b.t0) * (t - b.t0)))


@functools.cache
def make_flown(media: MediaConfig):
    """Return ``flown(scene, m, way, d, length, open, u) -> Flown``; ``way``: from the start to the camera."""
    assert media is not None
    chromatic = media.chromatic
    extinction_along = make_extinction_along(media.phases)

    @wp.func
    def density(sigma: wp.float32, t: wp.float32, length: wp.float32, open: wp.bool) -> wp.float32:
        if open:
            return sigma * wp.exp(-sigma * t)
        return forced_density(sigma, t, length, 0.0, False)

    @wp.func
    def flown(
        scene: Scene, m: Medium, way: wp.vec3, d: wp.vec3, length: wp.float32, open: wp.bool, u: wp.vec4
    ) -> Flown:
        c = extinction_along(scene, m, d)
        r = Flown()
        r.t = length
        passing = wp.float32(0.0)
        if not open or wp.max(c.sigma_t) <= 0.0:
            passing = wp.max(mean_of(exp_minus(c.sigma_t, length)), PASSES)
        if u[0] < passing:
            r.inv_p = 1.0 / passing
            return r
        r.collides = True
        rate = c.sigma_t[wp.min(wp.int32(3.0 * u[3]), 2)]
        bell = bell_on(way, d, length, scene.media.extent)
        if u[1] < 0.5:
            r.t = bell_distance(bell, length, u[2])
        elif open:
            r.t = wp.min(-wp.log(wp.max(1.0 - u[2], 1.0e-30)) / wp.max(rate, 1.0e-30), length)
        else:
            r.t = forced_distance(rate, length, 0.0, False, u[2])
        p = density(c.sigma_t[0], r.t, length, open)
        if wp.static(chromatic):
            p += density(c.sigma_t[1], r.t, length, open)
            p += density(c.sigma_t[2], r.t, length, open)
            p *= 1.0 / 3.0
        p = 0.5 * p + 0.5 * bell_density(bell, length, r.t)
        r.inv_p = 1.0 / ((1.0 - passing) * p)
        return r

    return flown


@functools.cache
def make_flown_in_grid(media: MediaConfig):
    """Return ``flown_in_grid(scene, m, o, way, d, length, u, sampler, number)``.

    The results are the Flown, the Coefficients where it collides, and an estimate of the transmittance up to where it
    ends; ``way``: from o to the camera.
    """
    assert media is not None
    _tracked_flight, tracked_transmittance = make_tracking(media, False)
    bins = BINS

    @wp.func
    def flown_in_grid(
        scene: Scene,
        m: Medium,
        o: wp.vec3,
        way: wp.vec3,
        d: wp.vec3,
        length: wp.float32,
        u: wp.vec4,
        sampler: Sampler,
        number: wp.int32,
    ) -> tuple[Flown, Coefficients, wp.vec3]:
        r = Flown()
        c = Coefficients()
        r.t = length
        r.inv_p = 1.0
        g = texture_record(scene, m.sigma_t)
        ray = grid_ray(scene, g, o, d, length)
        inside = ray.t1 - ray.t0
        if inside > 0.0:
            scale = load_float(scene.values, m.scale)
            width = inside / wp.float32(bins)
            depth = wp.float32(0.0)
            count = wp.int32(bins)
            for i in range(count):
                p = ray.o + (ray.t0 + (wp.float32(i) + 0.5) * width) * ray.d
                depth += width * scale * mean_of(grid_value(scene.values, g, p))
            passing = wp.clamp(wp.exp(-depth), PASSES, MOST_PASSES)
            r.inv_p = 1.0 / passing
            if u[0] >= passing:
                r.collides = True
                bell = bell_on(way - ray.t0 * d, d, inside, scene.media.extent)
                # Extinction of a bin, never 0, over that of all of them.
                least = (EVEN_SHARE * depth + 1.0e-6) / inside
                total = (1.0 + EVEN_SHARE) * depth + 1.0e-6
                t = bell_distance(bell, inside, u[2])
                wanted = u[2] * total
                by_bins = u[1] >= 0.5
                density = wp.float32(0.0)
                sought = wp.bool(True)
                for i in range(count):
                    p = ray.o + (ray.t0 + (wp.float32(i) + 0.5) * width) * ray.d
                    weight = scale * mean_of(grid_value(scene.values, g, p)) + least
                    last = i == count - 1
                    if sought:
                        if by_bins and (wanted < width * weight or last):
                            t = (wp.float32(i) + wp.clamp(wanted / (width * weight), 0.0, 1.0)) * width
                            density = weight / total
                            sought = False
                        if not by_bins and (t < wp.float32(i + 1) * width or last):
                            density = weight / total
                            sought = False
                    wanted -= width * weight
                r.t = wp.min(ray.t0 + t, ray.t1)
                r.inv_p = 1.0 / ((1.0 - passing) * (0.5 * density + 0.5 * bell_density(bell, inside, t)))
                x = o + r.t * d
                c.sigma_t = scale * grid_value_at(scene, m.sigma_t, x)
                c.albedo = albedo_at(scene, m, x)
        return r, c, tracked_transmittance(scene, m, o, d, r.t, sampler, number)

    return flown_in_grid

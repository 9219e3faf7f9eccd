"""Motion of a path through grids of voxels, beside ``media_motion.py``: densities along rays, and at collisions.

A collision keeps its fraction of its stretch's part in the grid's box. Its coefficients change by grad(a sigma) . dx.
The transmittance to it changes by the density along the ray, whether or not tracking met that density.

Derivation: ``docs/theory/media.md#grids-beside-what-moves``.
"""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.constants import FAR, PHASE_SGGX
from warp_psdr.kernels.interior.factors.media_sweep import number_of
from warp_psdr.kernels.interior.factors.shadow_crossings import make_crossed_surface
from warp_psdr.kernels.interior.factors.shadow_motion import ShadowAdjoint, make_thinning
from warp_psdr.kernels.medium.coefficients import albedo_at
from warp_psdr.kernels.medium.grid_adjoint import SALT_POINTS
from warp_psdr.kernels.medium.grid_emission import POINTS as EMISSION_POINTS
from warp_psdr.kernels.medium.grid_emission import SALT_EMISSION, emission_at, emission_point
from warp_psdr.kernels.medium.grid_span import Span, SpanAdjoint, make_grid_span, span_length, span_of
from warp_psdr.kernels.medium.interface import make_interface_sink
from warp_psdr.kernels.medium.majorant import grid_ray
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, medium_towards
from warp_psdr.kernels.medium.tracking import make_tracking
from warp_psdr.kernels.medium.volume import GRID, grid_point, grid_value
from warp_psdr.kernels.path_media import MediaVertex
from warp_psdr.kernels.reading import load_float, texture_record
from warp_psdr.kernels.rng import Sampler, independent_1d, salted
from warp_psdr.kernels.structs import Medium, Scene
from warp_psdr.kernels.texture.volume import trilinear_slope
from warp_psdr.kernels.vertex import MediaConfig, PathConfig


@functools.cache
def make_grid_flight_sink(role: str, pose: bool):
    """Return ``accumulate_grid_flight(scene, target, m, span, y, d, t, collides, stream, w, w_at, a_x)``.

    Of a flight along the ray from y that ends at the distance t, ``w`` is the adjoint of the logarithm of its factor,
    ``w_at`` that of the product a sigma where it collides, and ``a_x`` what else pulls at that point.
    ``pose``: grids move.
    """
    accumulate_point, accumulate_depth, accumulate_ends = make_grid_span(role, pose)

    @wp.func
    def accumulate_grid_flight(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        span: Span,
        y: wp.vec3,
        d: wp.vec3,
        t: wp.float32,
        collides: wp.bool,
        stream: Sampler,
        w: wp.vec3,
        w_at: wp.vec3,
        a_x: wp.vec3,
    ) -> SpanAdjoint:
        g = texture_record(scene, m.sigma_t)
        r = accumulate_depth(scene, target, m, span, y, d, wp.where(collides, t, span.far), stream, -w)
        if collides:
            x = y + t * d
            p = span.o + t * span.d
            scale = load_float(scene.values, m.scale)
            w_sigma = scale * wp.cw_mul(w_at, albedo_at(scene, m, x))
            pulled, dot = accumulate_point(scene, target, g, x, trilinear_slope(scene, g, p, w_sigma))
            a_point = a_x + pulled
            r.dot += dot
            if m.albedo_channels == GRID:
                g_albedo = texture_record(scene, m.albedo)
                w_albedo = scale * wp.cw_mul(w_at, grid_value(scene.values, g, p))
                slope = trilinear_slope(scene, g_albedo, grid_point(scene, g_albedo, x), w_albedo)
                slid, dot_albedo = accumulate_point(scene, target, g_albedo, x, slope)
                a_point += slid
                r.dot += dot_albedo
            length = span_length(span)  # of what is tracked: where rounding leaves none, the factor is as small
            share = wp.clamp((t - span.near) / length, 0.0, 1.0)
            longer = (w[0] + w[1] + w[2]) / length
            a_t = r.far + wp.dot(d, a_point)
            r.o += a_point
            r.d += t * a_point
            r.far = share * a_t + longer
            r.near += (1.0 - share) * a_t - longer
        return accumulate_ends(scene, target, g, span, y, d, r)

    return accumulate_grid_flight


@functools.cache
def make_grid_emission_motion(config: MediaConfig, role: str, pose: bool):
    """Return ``accumulate_glow(scene, target, m, span, before, v, sampler, w) -> SpanAdjoint``.

    ``w`` is the adjoint of what a step's stretch emits (``medium/grid_emission.py``), whose points keep their fractions
    of the span; ``before``: distance from y to where the step starts. ``pose``: grids move.
    """
    accumulate_point, _depth, accumulate_ends = make_grid_span(role, pose)
    _flight, transmittance = make_tracking(config, False)

    @wp.func
    def accumulate_glow(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        m: Medium,
        span: Span,
        before: wp.float32,
        v: MediaVertex,
        sampler: Sampler,
        w: wp.vec3,
    ) -> SpanAdjoint:
        r = SpanAdjoint()
        g = texture_record(scene, m.sigma_t)
        o = v.surface.o
        d = v.surface.d
        ray = grid_ray(scene, g, o, d, v.stretch)
        if m.emission < 0 or not ray.t0 < ray.t1:
            return r
        y = o - before * d
        scale = load_float(scene.values, m.scale)
        stream = salted(sampler, SALT_EMISSION, v.step)
        share = (ray.t1 - ray.t0) * (1.0 / float(EMISSION_POINTS))
        length = span_length(span)
        passed = wp.vec3(1.0, 1.0, 1.0)
        behind = v.emitted  # what is emitted from this point on
        start = ray.t0
        points = wp.int32(EMISSION_POINTS)
        for i in range(points):
            t = emission_point(ray, stream, i)
            # ---- T, between this point and the one before ----
            between = wp.lerp(start, t, independent_1d(stream, points + i))
            thins = (start - t) * scale * wp.cw_mul(w, behind)
            slope = trilinear_slope(scene, g, ray.o + between * ray.d, thins)
            a_between, dot_between = accumulate_point(scene, target, g, o + between * d, slope)
            r.o += a_between
            r.d += (before + between) * a_between
            r.dot += dot_between
            # ---- epsilon at the point ----
            passed = wp.cw_mul(passed, transmittance(scene, m, o + start * d, d, t - start, stream, i))
            x = o + t * d
            sent = share * wp.cw_mul(passed, emission_at(scene, m, x))
            behind -= sent
            a_t = -scale * wp.dot(wp.cw_mul(w, sent), grid_value(scene.values, g, ray.o + t * ray.d))
            if m.emission_channels == GRID:
                g_emission = texture_record(scene, m.emission)
                w_point = share * wp.cw_mul(w, passed)
                slope = trilinear_slope(scene, g_emission, grid_point(scene, g_emission, x), w_point)
                a_x, dot = accumulate_point(scene, target, g_emission, x, slope)
                a_t += wp.dot(d, a_x)
                r.o += a_x
                r.d += (before + t) * a_x
                r.dot += dot
            fraction = wp.clamp((before + t - span.near) / length, 0.0, 1.0)
            r.far += fraction * a_t
            r.near += (1.0 - fraction) * a_t
            start = t
        w_all = wp.cw_mul(w, v.emitted)
        longer = (w_all[0] + w_all[1] + w_all[2]) / length
        r.far += longer
        r.near += scale * wp.dot(w_all, grid_value(scene.values, g, span.o + span.near * span.d)) - longer
        return accumulate_ends(scene, target, g, span, y, d, r)

    return accumulate_glow


@functools.cache
def make_grid_shadow_sink(config: PathConfig, role: str, pose: bool):
    """Return ``accumulate_shadow(scene, target, sampler, vertex, w)`` as ``make_shadow_sink`` does, through grids."""
    shadow_crossing = make_crossed_surface(config.rays, config.surfaces.primitives)
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    accumulate_crossing = make_interface_sink(role, config.surfaces.primitives)
    _point, accumulate_depth, accumulate_ends = make_grid_span(role, pose)
    assert config.media is not None
    flakes = PHASE_SGGX in config.media.phases
    thinning, turning = make_thinning(config.media.phases)

    @wp.func
    def accumulate_shadow(
        scene: Scene, target: wp.array(dtype=wp.float32), sampler: Sampler, v: MediaVertex, w: wp.vec3
    ) -> ShadowAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = ShadowAdjoint()
        d = v.shadow_d
        start = v.shadow_o
        inside = v.shadow_medium
        face = wp.int32(-1)  # the interface where the stretch begins
        u = wp.float32(0.0)
        v_face = wp.float32(0.0)
        near = wp.float32(0.0)
        a_near = wp.float32(0.0)
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            t = wp.dot(start - v.shadow_o, d)
            hit = shadow_crossing(scene, v, crossings, start, v.shadow_t - t)
            far = wp.where(hit.face >= 0, t + hit.t, v.shadow_t)
            a_far = wp.float32(0.0)
            if inside >= 0:
                m = scene.media.records[inside]
                if m.sigma_t_channels == GRID:
                    g = texture_record(scene, m.sigma_t)
                    o = start - t * d  # the ray that was tracked
                    span = span_of(scene, g, o, d, near, far)
                    stream = salted(sampler, SALT_POINTS, number_of(v) + 1 + crossings)
                    a = accumulate_depth(scene, target, m, span, o, d, span.far, stream, -w)
                    a = accumulate_ends(scene, target, g, span, o, d, a)
                    r.o += a.o
                    r.d += a.d
                    r.dot += a.dot
                    a_near += a.near
                    a_far = a.far
                else:
                    a_far = thinning(scene, inside, d, w)
                    a_near -= a_far
                    if wp.static(flakes):
                        r.d += turning(scene, inside, d, far - near, w)
            if face >= 0:
                crossed = accumulate_crossing(scene, target, face, u, v_face, d, near, a_near)
                r.o += crossed.o
                r.d += crossed.d
                r.dot += crossed.dot
            a_near = a_far
            crossings += 1
            if is_interface(scene, hit.face):
                at = past(scene, hit.face, hit.u, hit.v, d)
                inside = medium_towards(scene, at.shape, at.ng, d, d, inside)
                start = at.o
                face = hit.face
                u = hit.u
                v_face = hit.v
                near = far
            else:
                crossings = MOST_INTERFACES + 1
        r.length = wp.where(v.shadow_t >= 0.5 * FAR, 0.0, a_near)
        return r

    return accumulate_shadow

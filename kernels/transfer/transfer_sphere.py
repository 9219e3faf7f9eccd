"""Integrals over the sphere of directions at a point of a path, for the differential radiative transfer equation.

One integral is the in-scattering at a point of a medium, which a moving end of a flight adds or removes. The other is
the boundary of the sphere: an edge of the scene, and the jump of the radiance of whole rays across it [ZWZ*19, eq. 32].
The point on a chosen edge is drawn by the angle at which the vertex sees it. This leaves 1 / h of the element sin(phi)
dl / t_1^2, with the distance h of the vertex from the edge's line.

Derivation: ``docs/theory/media.md#the-differential-equation``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.local_form import EdgePoint, Edges, edge_at, edge_behind, edge_step
from warp_psdr.kernels.constants import FAR
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.coefficients import coefficients_of
from warp_psdr.kernels.medium.passage import make_media_passage, medium_towards
from warp_psdr.kernels.path_media import (
    MediaState,
    MediaVertex,
    collision_point,
    make_collision,
    make_media_step,
    media_path_from,
)
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.rng import Sampler, independent_4d
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig, path_from

#: Slots of the numbers that draw an edge, light and direction at a point; those of the paths from there follow.
SLOT_EDGE, SLOT_LIGHT, SLOT_DIRECTION = 0, 1, 2


@wp.struct
class SphereEdge:
    """An edge that a vertex sees."""

    valid: wp.bool
    point: EdgePoint
    m: wp.vec3  # normal of the plane through edge and vertex, as long as the sine between edge and direction
    value: wp.vec3  # f times the radiance behind m minus that before it, over t_1^2 and the density of the point


@functools.cache
def make_radiance_along(config: PathConfig):
    """Return ``radiance_along(scene, sampler, state, max_depth, rr_depth) -> vec3``: what a path finds from a state."""
    media_step = make_media_step(config, False)

    @wp.func
    def radiance_along(
        scene: Scene, sampler: Sampler, start: MediaState, max_depth: wp.int32, rr_depth: wp.int32
    ) -> wp.vec3:
        state = start
        radiance = wp.vec3(0.0, 0.0, 0.0)
        while state.path.alive == 1:
            vertex, state = media_step(scene, sampler, state, max_depth, rr_depth)
            radiance += wp.cw_mul(vertex.surface.throughput, vertex.surface.direct)
        return radiance

    return radiance_along


@functools.cache
def make_in_scattering(config: PathConfig):
    """Return ``in_scattering(scene, sampler, medium, depth, o, d, t, max_depth, rr_depth) -> vec3``.

    sigma_s times the integral of f_p L over all directions, at a distance t along a ray in a medium.
    """
    collide = make_collision(config, False)
    radiance_along = make_radiance_along(config)

    @wp.func
    def in_scattering(
        scene: Scene,
        sampler: Sampler,
        medium: wp.int32,
        depth: wp.int32,
        o: wp.vec3,
        d: wp.vec3,
        t: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        c = coefficients_of(scene, scene.media.records[medium])
        scattered = wp.cw_mul(c.albedo, c.sigma_t)
        if vanishes(scattered):
            return scattered
        vertex = MediaVertex()
        vertex.t = t
        vertex.surface.o = o
        vertex.surface.d = d
        vertex.surface.throughput = wp.vec3(1.0, 1.0, 1.0)
        u4 = independent_4d(sampler, SLOT_LIGHT)
        r4 = independent_4d(sampler, SLOT_DIRECTION)
        state = media_path_from(path_from(o, d, FAR, depth), medium)
        reached, after = collide(scene, sampler, state, vertex, u4, r4, max_depth, rr_depth)
        found = reached.surface.direct + radiance_along(scene, sampler, after, max_depth, rr_depth)
        return wp.cw_mul(scattered, found)

    return in_scattering


@functools.cache
def make_sphere_edge(config: PathConfig):
    """Return ``sphere_edge(scene, edges, sampler, vertex, depth, max_depth, rr_depth) -> SphereEdge``."""
    assert config.media is not None
    interaction = make_interaction(config.surfaces, config.lights)
    phase = make_phase(config.media.phases)
    passage = make_media_passage(config, False)
    radiance_along = make_radiance_along(config)

    @wp.func
    def sphere_edge(
        scene: Scene,
        edges: Edges,
        sampler: Sampler,
        v: MediaVertex,
        depth: wp.int32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> SphereEdge:
        r = SphereEdge()
        vertex = v.surface
        x = collision_point(v)
        if not v.collides:
            at = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
            x = at.x
        # ---- A point of an edge, by the angle at which it is seen ----
        u4 = independent_4d(sampler, SLOT_EDGE)
        r.point = edge_at(scene, edges, wp.float64(u4[0]))
        probability = edges.cdf[r.point.edge + 1] - edges.cdf[r.point.edge]
        along = r.point.p1 - r.point.p0
        length = wp.length(along)
        along = along / length
        foot = wp.dot(x - r.point.p0, along)
        h = wp.length(x - r.point.p0 - foot * along)
        step = edge_step(scene, edges, r.point.edge)
        if not h > step:
            return r
        low = wp.atan(-foot / h)
        seen = wp.atan((length - foot) / h) - low
        s = wp.clamp(foot + h * wp.tan(low + u4[1] * seen), 0.0, length)
        r.point.s = s / length
        r.point.x = r.point.p0 + s * along
        # ---- The scattering function in its direction ----
        w = wp.normalize(r.point.x - x)
        f = wp.vec3(0.0, 0.0, 0.0)
        o = x
        medium = v.medium
        if v.collides:
            value = phase.eval(scene, scene.media.records[v.medium], x, vertex.d, w)
            f = wp.vec3(value, value, value)
        else:
            if wp.static(interaction.eval is not None):
                f = interaction.eval(at, enter_frame(at.frame, w))
                o = interaction.offset(at, w)
                medium = medium_towards(scene, at.shape, at.ng, vertex.d, w, v.medium)
        if vanishes(f):
            return r
        to = r.point.x - o
        distance = wp.length(to)
        free = distance - edge_behind(scene, step)
        if free > 0.0:
            passed, _first = passage(scene, o, to / distance, free, medium, False, sampler, 0)
            if passed.blocked != 0:
                return r
        # ---- The radiance of the rays beside it, from the same random numbers ----
        r.m = wp.cross(along, w)
        aside = (step / wp.length(r.m)) * r.m
        jump = wp.vec3(0.0, 0.0, 0.0)
        sign = wp.float32(-1.0)
        while sign < 2.0:
            ray = wp.normalize(r.point.x + sign * aside - o)
            state = media_path_from(path_from(o, ray, FAR, depth + 1), medium)
            jump -= sign * radiance_along(scene, sampler, state, max_depth, rr_depth)
            sign += 2.0
        if not vanishes(jump):
            r.value = (seen / (h * probability)) * wp.cw_mul(f, jump)
            r.valid = True
        return r

    return sphere_edge

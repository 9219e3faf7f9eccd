"""The walk in media from a boundary segment's x_1 towards the camera.

The walk of ``detector.py`` has surface vertices only. Here a vertex may be a point of the medium, with sigma_s f_p in
place of f_s and no cosine. ``media_ride.py`` says what such a vertex rides on.

Derivation: ``docs/theory/media.md#boundaries-in-media``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.detector import MIN_COSINE, make_sensor_turn
from warp_psdr.kernels.boundary.path_space.walk_flight import Flown, make_flown, make_flown_in_grid
from warp_psdr.kernels.bvh.wide import RayHit
from warp_psdr.kernels.constants import FAR, PHASE_SGGX
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.invalid import vanishes
from warp_psdr.kernels.medium.coefficients import Coefficients, exp_minus
from warp_psdr.kernels.medium.line import ClearLine, make_line
from warp_psdr.kernels.medium.null_surface import make_null_surface
from warp_psdr.kernels.medium.passage import MOST_INTERFACES, is_lost, medium_towards
from warp_psdr.kernels.medium.volume import GRID
from warp_psdr.kernels.path_media import GRAZING
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.phase.sggx import make_extinction_along
from warp_psdr.kernels.primitive.dispatch import make_geometric_normal, make_leaving, make_position
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.scattering import ROULETTE_MAX
from warp_psdr.kernels.sensor.projection import FilmPoint, make_projection
from warp_psdr.kernels.step import step_beside
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.kernels.visibility import visibility_of

#: Sample slots of a vertex of the walk: its scattering, and the flights to it.
SLOT_WALK, SLOTS_PER_VERTEX = 4, MOST_INTERFACES + 2


@wp.struct
class MediaWalk:
    """A vertex of the walk, a surface point or a volume vertex, and the ray on which it was found."""

    alive: wp.int32
    collides: wp.bool
    face: wp.int32  # of a surface
    u: wp.float32
    v: wp.float32
    x: wp.vec3
    to: wp.vec3  # direction towards the vertex before
    medium: wp.int32  # that the segment from there arrives through
    weight: wp.vec3  # of a volume vertex sigma_s, too
    transmittance: wp.vec3  # of x_1: from the edge; else it is in ``weight``
    near: wp.float32  # where the way from the vertex before crosses its first interface: distance from there
    near_face: wp.int32  # -1: it crosses none
    near_u: wp.float32
    near_v: wp.float32


@wp.struct
class Sight:
    """A vertex of the walk as the camera sees it."""

    weight: wp.vec3  # 0: not seen
    at: FilmPoint
    d: wp.vec3  # from the camera
    t: wp.float32  # distance
    line: ClearLine  # up to the vertex, from the near plane on


@functools.cache
def make_grazing_step(primitives: tuple[int, ...]):
    """Return ``grazing_step(scene, face, u, v, w) -> float``: along w, how far off a surface rays start."""
    step_off = make_leaving(primitives)
    normal_at = make_geometric_normal(primitives)

    @wp.func
    def grazing_step(scene: Scene, face: wp.int32, u: wp.float32, v: wp.float32, w: wp.vec3) -> wp.float32:
        tri = scene.triangles[face]
        return step_off(scene, tri) / wp.max(wp.abs(wp.dot(normal_at(scene, tri, u, v), w)), GRAZING)

    return grazing_step


@functools.cache
def make_leaves_first(primitives: tuple[int, ...]):
    """Return ``leaves_first(scene, first, w, t1) -> float``: how far from x_1 on, along w, paths from it start.

    ``t1``: the length of the segment up to the edge.
    """
    grazing_step = make_grazing_step(primitives)

    @wp.func
    def leaves_first(scene: Scene, first: MediaWalk, w: wp.vec3, t1: wp.float32) -> wp.float32:
        if first.collides:
            return 0.0
        return wp.min(grazing_step(scene, first.face, first.u, first.v, w), 0.5 * t1)

    return leaves_first


@functools.cache
def make_media_walk(config: PathConfig):
    """Return ``(first_vertex, sight, extend)``.

    ``first_vertex(scene, sampler, o, d, eye, medium) -> MediaWalk``: x_1, drawn along a ray from an edge.
    ``sight(scene, camera, sampler, number, walk, lens) -> Sight``, ``number`` as of ``make_line``.
    ``extend(scene, sampler, walk, eye, k, roulette) -> MediaWalk``: the vertex behind the k-th.
    ``eye``: the camera's position, which flights turn to.
    """
    assert config.media is not None
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    is_interface, past = make_null_surface(config.surfaces, config.lights)
    line, _medium_at = make_line(config)
    flown = make_flown(config.media)
    grids = config.media.grids
    flown_in_grid = make_flown_in_grid(config.media) if grids else None
    phase = make_phase(config.media.phases)
    flakes = PHASE_SGGX in config.media.phases
    extinction_along = make_extinction_along(config.media.phases)
    sample_4d = make_sampler(config.sampler).sample_4d
    project = make_projection(config.camera)[0]
    position, _cross_of = make_position(config.surfaces.primitives)
    grazing_step = make_grazing_step(config.surfaces.primitives)
    scatters = interaction.eval is not None
    turn = make_sensor_turn(config.surfaces, config.lights) if scatters else None

    @wp.func
    def last_point(scene: Scene, hit: RayHit, d: wp.vec3) -> wp.float32:
        """Where collisions end: as far before a surface as rays start off it."""
        if hit.face < 0:
            return FAR
        return wp.max(hit.t - grazing_step(scene, hit.face, hit.u, hit.v, d), 0.0)

    @wp.func
    def found(
        scene: Scene,
        sampler: Sampler,
        walk: MediaWalk,
        o: wp.vec3,
        d: wp.vec3,
        eye: wp.vec3,
        slot: wp.int32,
    ) -> MediaWalk:
        """The next vertex on a ray, through interfaces."""
        r = walk
        r.alive = 0
        r.to = -d
        r.near_face = -1
        r.transmittance = wp.vec3(1.0, 1.0, 1.0)
        start = o
        crossings = wp.int32(0)
        while crossings <= MOST_INTERFACES:
            hit = visibility.closest(scene, start, d, FAR)
            length = wp.where(hit.face >= 0, hit.t, FAR)
            if r.medium >= 0:
                m = scene.media.records[r.medium]
                c = Coefficients()
                f = Flown()
                passed = wp.vec3(1.0, 1.0, 1.0)
                u4 = sample_4d(sampler, slot + crossings)
                in_grid = wp.bool(False)
                if wp.static(grids):
                    in_grid = m.sigma_t_channels == GRID
                    if in_grid:
                        last = wp.min(last_point(scene, hit, d), length)
                        f, c, passed = flown_in_grid(
                            scene, m, start, eye - start, d, last, u4, sampler, slot + crossings
                        )
                t = f.t
                if not in_grid:
                    c = extinction_along(scene, m, d)
                    f = flown(scene, m, eye - start, d, length, hit.face < 0, u4)
                    t = wp.min(f.t, last_point(scene, hit, d))
                    passed = exp_minus(c.sigma_t, t)
                r.weight *= f.inv_p
                r.transmittance = wp.cw_mul(r.transmittance, passed)
                if f.collides:
                    r.weight = wp.cw_mul(r.weight, wp.cw_mul(c.albedo, c.sigma_t))
                    r.x = start + t * d
                    r.collides = True
                    r.face = -1
                    r.alive = 1
                    return r
            if hit.face < 0:
                return r
            crossings += 1
            if is_interface(scene, hit.face):
                at = past(scene, hit.face, hit.u, hit.v, d)
                if is_lost(scene, at.shape, at.ng, d, r.medium):
                    return r
                r.medium = medium_towards(scene, at.shape, at.ng, d, d, r.medium)
                if crossings == 1:
                    r.near = hit.t
                    r.near_face = hit.face
                    r.near_u = hit.u
                    r.near_v = hit.v
                start = at.o
            else:
                r.collides = False
                r.face = hit.face
                r.u = hit.u
                r.v = hit.v
                r.x = position(scene.triangles[hit.face], hit.u, hit.v)
                r.alive = 1
                return r
        return r

    @wp.func
    def first_vertex(
        scene: Scene, sampler: Sampler, o: wp.vec3, d: wp.vec3, eye: wp.vec3, medium: wp.int32
    ) -> MediaWalk:
        walk = MediaWalk()
        walk.medium = medium
        walk.weight = wp.vec3(1.0, 1.0, 1.0)
        return found(scene, sampler, walk, o, d, eye, SLOT_WALK)

    @wp.func
    def sight(
        scene: Scene, camera: Camera, sampler: Sampler, number: wp.int32, walk: MediaWalk, lens: wp.vec2
    ) -> Sight:
        r = Sight()
        r.at = project(scene, camera, walk.x, lens)
        if r.at.valid == 0:
            return r
        r.t = wp.length(walk.x - r.at.origin)
        r.d = (walk.x - r.at.origin) / r.t
        end = walk.x
        value = wp.vec3(0.0, 0.0, 0.0)
        if walk.collides:
            m = scene.media.records[walk.medium]
            if wp.static(flakes):
                # ``weight`` has their area along ``to``: A f_p is reciprocal, f_p is not.
                value = wp.vec3(1.0, 1.0, 1.0) * phase.eval(scene, m, walk.x, -walk.to, -r.d)
            else:
                value = wp.vec3(1.0, 1.0, 1.0) * phase.eval(scene, m, walk.x, r.d, walk.to)
        else:
            if wp.static(scatters):
                here = interaction.at(scene, walk.face, walk.u, walk.v, r.d)
                cosine = wp.abs(wp.dot(here.ng, walk.to))
                if cosine >= MIN_COSINE:
                    f = interaction.eval(here, enter_frame(here.frame, walk.to))
                    value = (wp.abs(wp.dot(here.ng, r.d)) / cosine) * f
                end = step_beside(walk.x, here.ng, -r.d, here.step)
        if vanishes(value):
            return r
        ray = end - r.at.origin
        length = wp.length(ray)
        ray = ray / length
        start = r.at.origin + r.at.near * ray
        r.line = line(scene, sampler, number, start, ray, length - r.at.near, camera.medium, 0)
        if r.line.face >= 0 or r.line.lost or (walk.collides and r.line.medium != walk.medium):
            return r
        r.weight = r.at.per_area * wp.cw_mul(r.line.transmittance, wp.cw_mul(value, walk.weight))
        return r

    @wp.func
    def extend(
        scene: Scene, sampler: Sampler, walk: MediaWalk, eye: wp.vec3, k: wp.int32, roulette: wp.bool
    ) -> MediaWalk:
        r = walk
        r.alive = 0
        slot = SLOT_WALK + k * SLOTS_PER_VERTEX
        u4 = sample_4d(sampler, slot)
        o = walk.x
        w = wp.vec3(0.0, 0.0, 0.0)
        if walk.collides:
            w = phase.sample(scene, scene.media.records[walk.medium], o, -walk.to, wp.vec2(u4[2], u4[3]))
        else:
            if wp.static(scatters):
                left = turn(scene, walk.face, walk.u, walk.v, walk.x, walk.to, u4)
                if left.valid == 0:
                    return r
                w = left.w
                o = left.o
                r.weight = wp.cw_mul(walk.weight, left.weight)
                r.medium = medium_towards(scene, left.shape, left.ng, -walk.to, w, walk.medium)
            else:
                return r
        if vanishes(r.weight):
            return r
        if roulette:
            survival = wp.min(wp.max(r.weight), ROULETTE_MAX)
            if u4[1] >= survival:
                return r
            r.weight /= survival
        r = found(scene, sampler, r, o, w, eye, slot + 1)
        r.weight = wp.cw_mul(r.weight, r.transmittance)
        return r

    return first_vertex, sight, extend

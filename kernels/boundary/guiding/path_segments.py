"""Segments of camera paths that end on a surface: projective sampling projects them [ZRJ23, section 4].

Each path gives one segment, drawn in proportion to what it would carry: a ray towards a light point that is occluded,
or a scattered ray. ``media_segments.py`` treats paths through media.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.light_square import outside_of
from warp_psdr.kernels.constants import FAR, LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.path import make_camera_start, make_path_step
from warp_psdr.kernels.rng import Sampler, make_sampler, sampler_at
from warp_psdr.kernels.scattering import make_light_sampler
from warp_psdr.kernels.structs import Camera, LightSample, Scene
from warp_psdr.kernels.vertex import PathConfig, PathVertex
from warp_psdr.kernels.visibility import visibility_of

#: A ray towards a light point counts as blocked if it is stopped before this fraction of its length.
BLOCKED = 0.999
#: First sample slot of the seeds' own numbers; the path's are far below.
SLOT_SEED = 1 << 20
#: Which rays are projected.
BLOCKED_LIGHT, SCATTERED = 0, 1
#: Light at infinity is put this many scene radii away: an angle of a thousandth, far below a cell's.
INFINITY_RADII = 1.0e3


@wp.struct
class Candidate:
    """A segment of a path that may be projected."""

    weight: wp.float32  # 0: there is none
    face: wp.int32  # what stops the ray
    o: wp.vec3
    d: wp.vec3
    light: wp.vec3  # the light point behind
    light_face: wp.int32  # its triangle and barycentrics; -1: of an environment or a point-like light
    light_u: wp.float32
    light_v: wp.float32
    coordinate: wp.float64  # of a point-like light in the square of ``light_square.py``, else -1


@wp.func
def with_light(
    scene: Scene, candidate: Candidate, ls: LightSample, index: wp.int32, radius: wp.float32, u4: wp.vec4
) -> Candidate:
    """The candidate with the light point that was drawn for it by ``u4``, of the light ``index``."""
    r = candidate
    distance = ls.distance
    if ls.distance > 0.5 * FAR:
        distance = INFINITY_RADII * radius
    r.light = r.o + distance * ls.wi
    r.light_face = ls.face
    r.light_u = ls.u
    r.light_v = ls.v
    r.coordinate = wp.float64(-1.0)
    if ls.delta == 1:
        r.coordinate = outside_of(scene.emitter_cdf, index, wp.float64(u4[2]))
    return r


@functools.cache
def make_blocked_light(config: PathConfig):
    """Return ``blocked_light(scene, vertex, radius, u4) -> Candidate``: a light point that something hides from x_1."""
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    interaction = make_interaction(config.surfaces, config.lights)
    sample_light = make_light_sampler(config.lights)

    @wp.func
    def blocked_light(scene: Scene, vertex: PathVertex, radius: wp.float32, u4: wp.vec4) -> Candidate:
        r = Candidate()
        at = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
        if not interaction.bsdf.has_smooth(at.model):
            return r
        ls, index, probability = sample_light(scene, at.x, u4)
        if ls.pdf <= 0.0:
            return r
        f = interaction.eval(at, enter_frame(at.frame, ls.wi))
        value = wp.max(wp.cw_mul(vertex.throughput, wp.cw_mul(f, ls.radiance)))
        if value <= 0.0:
            return r
        r.o = interaction.offset(at, ls.wi)
        r.d = ls.wi
        hit = visibility.closest(scene, r.o, r.d, wp.min(BLOCKED * ls.distance, FAR))
        if hit.face < 0:
            return r
        r.weight = value / (ls.pdf * probability)
        r.face = hit.face
        return with_light(scene, r, ls, index, radius, u4)

    return blocked_light


@wp.func
def seed_sampler(camera: Camera, number: wp.int32, seed: wp.uint32) -> tuple[Sampler, wp.int32]:
    """Random numbers of a path, and its pixel."""
    pixels = camera.crop_width * camera.crop_height
    pixel = number % pixels
    return sampler_at(pixel, number // pixels, seed), pixel


@functools.cache
def make_candidate(config: PathConfig, kind: int):
    """Return ``candidate(scene, camera, radius, number, seed, max_depth, rr_depth) -> (Candidate, total)``.

    Of the segments of a camera path, and the sum of all their weights (arguments as in ``make_seeds_kernel``).
    """
    visibility = visibility_of(config.rays, config.surfaces.primitives)
    path_step = make_path_step(config, False)
    start = make_camera_start(config)
    to_light = kind == BLOCKED_LIGHT
    blocked_light = make_blocked_light(config) if to_light else None
    draw = make_sampler(config.sampler)
    sample_1d = draw.sample_1d
    sample_4d = draw.sample_4d

    @wp.func
    def candidate(
        scene: Scene,
        camera: Camera,
        radius: wp.float32,
        number: wp.int32,
        seed: wp.uint32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> tuple[Candidate, wp.float32]:
        sampler, pixel = seed_sampler(camera, number, seed)
        state, _film = start(scene, camera, pixel % camera.crop_width, pixel // camera.crop_width, sampler)
        total = wp.float32(0.0)
        kept = Candidate()
        while state.alive == 1:
            depth = state.depth
            vertex, state = path_step(scene, sampler, state, max_depth, rr_depth)
            found = Candidate()
            if wp.static(to_light):
                if vertex.face >= 0 and (max_depth < 0 or depth + 2 <= max_depth):
                    found = blocked_light(scene, vertex, radius, sample_4d(sampler, SLOT_SEED + 2 * depth))
            else:
                if state.alive == 1 and vertex.lobe == LOBE_SMOOTH:
                    hit = visibility.closest(scene, state.o, state.d, FAR)
                    if hit.face >= 0:
                        found.weight = wp.max(state.throughput)
                        found.face = hit.face
                        found.o = state.o
                        found.d = state.d
            if found.weight > 0.0:
                total += found.weight
                if sample_1d(sampler, SLOT_SEED + 2 * depth + 1) * total <= found.weight:
                    kept = found
        return kept, total

    return candidate

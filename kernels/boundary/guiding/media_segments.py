"""Segments of camera paths through media that end on a surface: projective sampling projects them [ZRJ23, section 4].

As in ``path_segments.py``, but rays start on surfaces and at points that scatter in a medium. They end at the first
surface that is not an interface of a medium.

Derivation: ``docs/theory/guiding.md#projected-path-segments``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.guiding.path_segments import (
    BLOCKED,
    BLOCKED_LIGHT,
    SLOT_SEED,
    Candidate,
    seed_sampler,
    with_light,
)
from warp_psdr.kernels.constants import FAR, LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.medium.line import make_line
from warp_psdr.kernels.medium.passage import medium_towards
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import MediaVertex, collision_point, make_media_step, media_path_from
from warp_psdr.kernels.phase.dispatch import make_phase
from warp_psdr.kernels.rng import Sampler, make_sampler
from warp_psdr.kernels.scattering import make_light_sampler
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig


@functools.cache
def make_media_blocked_light(config: PathConfig):
    """Return ``blocked_light(scene, sampler, step, radius, u4) -> Candidate``: a light point hidden from a step's end.

    The transmittance up to what hides it weighs, that of grids aside.
    """
    assert config.media is not None
    interaction = make_interaction(config.surfaces, config.lights)
    phase = make_phase(config.media.phases)
    line, _medium_at = make_line(config)
    sample_light = make_light_sampler(config.lights)

    @wp.func
    def blocked_light(scene: Scene, sampler: Sampler, step: MediaVertex, radius: wp.float32, u4: wp.vec4) -> Candidate:
        r = Candidate()
        vertex = step.surface
        medium = step.medium
        x = vertex.o
        at = interaction.record()
        if step.collides:
            x = collision_point(step)
        else:
            at = interaction.at(scene, vertex.face, vertex.u, vertex.v, vertex.d)
            x = at.x
            if not interaction.bsdf.has_smooth(at.model):
                return r
        ls, index, probability = sample_light(scene, x, u4)
        if ls.pdf <= 0.0:
            return r
        f = wp.vec3(0.0, 0.0, 0.0)
        if step.collides:
            scattered = phase.eval(scene, scene.media.records[medium], x, vertex.d, ls.wi)
            f = wp.vec3(scattered, scattered, scattered)
        else:
            if wp.static(interaction.eval is not None):
                f = interaction.eval(at, enter_frame(at.frame, ls.wi))
            medium = medium_towards(scene, at.shape, at.ng, vertex.d, ls.wi, medium)
            x = interaction.offset(at, ls.wi)
        value = wp.cw_mul(vertex.throughput, wp.cw_mul(f, ls.radiance))
        if wp.max(value) <= 0.0:
            return r
        r.o = x
        r.d = ls.wi
        stop = line(scene, sampler, -1, x, ls.wi, wp.min(BLOCKED * ls.distance, FAR), medium, 1)
        if stop.face < 0:
            return r
        r.weight = wp.max(wp.cw_mul(value, stop.transmittance)) / (ls.pdf * probability)
        r.face = stop.face
        return with_light(scene, r, ls, index, radius, u4)

    return blocked_light


@functools.cache
def make_media_candidate(config: PathConfig, kind: int):
    """Return ``candidate`` as ``make_candidate`` does, of camera paths through media."""
    media_step = make_media_step(config, False)
    start = make_camera_start(config)
    line, _medium_at = make_line(config)
    to_light = kind == BLOCKED_LIGHT
    blocked_light = make_media_blocked_light(config) if to_light else None
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
        begun, _film = start(scene, camera, pixel % camera.crop_width, pixel // camera.crop_width, sampler)
        state = media_path_from(begun, camera.medium)
        total = wp.float32(0.0)
        kept = Candidate()
        while state.path.alive == 1:
            depth = state.path.depth
            number_of_step = state.steps
            step, state = media_step(scene, sampler, state, max_depth, rr_depth)
            turns = step.collides or step.surface.lobe == LOBE_SMOOTH
            found = Candidate()
            if wp.static(to_light):
                ends = step.collides or step.surface.face >= 0
                if ends and (max_depth < 0 or depth + 2 <= max_depth):
                    u4 = sample_4d(sampler, SLOT_SEED + 2 * number_of_step)
                    found = blocked_light(scene, sampler, step, radius, u4)
            else:
                if state.path.alive == 1 and turns:
                    o = state.path.o
                    d = state.path.d
                    stop = line(scene, sampler, -1, o, d, FAR, state.medium, 1)
                    if stop.face >= 0:
                        found.weight = wp.max(wp.cw_mul(state.path.throughput, stop.transmittance))
                        found.face = stop.face
                        found.o = o
                        found.d = d
            if found.weight > 0.0:
                total += found.weight
                if sample_1d(sampler, SLOT_SEED + 2 * number_of_step + 1) * total <= found.weight:
                    kept = found
        return kept, total

    return candidate

"""Branches in participating media: the derivative by g of ``hg``, from directions that are drawn for it.

As on surfaces (``branch.py``), a path is drawn as for an image, and one of its collisions in a medium with that phase
function is chosen. There, a direction is drawn from each lobe of the derivative, in closed form or from candidates of
the phase function, and both are traced with equal random numbers. Two of the image's light points are drawn likewise.
MIS weights are those of the image.

Derivation: ``docs/theory/media.md#lobes-of-a-phase-function``.
"""

import functools

import warp as wp

from warp_psdr.kernels.constants import FAR, PHASE_HG, TWO_PI
from warp_psdr.kernels.interior.factors.branch_point import CHOICE_SLOT, DIRECTION_SLOT, LIGHT_SLOT, SALT, VERTEX_SLOT
from warp_psdr.kernels.interior.resampled import TwoChosen, make_resampling, one_of
from warp_psdr.kernels.invalid import count_invalid, finite, inverse_pdf, vanishes
from warp_psdr.kernels.jobs import PixelJob, make_sample_weight, pixel_of
from warp_psdr.kernels.math import any_tangent, to_world
from warp_psdr.kernels.medium.passage import make_media_passage
from warp_psdr.kernels.modules import wide_vectors
from warp_psdr.kernels.path import make_camera_start
from warp_psdr.kernels.path_media import (
    MediaState,
    collision_point,
    make_media_step,
    media_path_from,
    radiance_of_step,
)
from warp_psdr.kernels.phase.hg import hg_cosine, hg_eval, hg_slope
from warp_psdr.kernels.phase.hg_lobes import hg_lobe_cosine, hg_lobe_mass
from warp_psdr.kernels.reading import load_float
from warp_psdr.kernels.rng import Sampler, hashed, make_sampler, salted, sampler_at, unit_float
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.scattering import make_light_sampler, shadow_ray
from warp_psdr.kernels.sink import make_sink
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.transmittance import transmittance_of
from warp_psdr.kernels.vertex import PathConfig, path_from


@wp.struct
class CollisionPoint:
    """The collision of a path that was chosen."""

    chosen: wp.bool
    x: wp.vec3
    before: MediaState  # before the flight that ends there
    throughput: wp.vec3
    weight: wp.float32  # inverse of the probability of the choice


@functools.cache
def make_phase_branch_kernel(config: PathConfig, role: str, candidates: int, decomposed: bool):
    """Return the kernel: the derivative by g of all media, complete.

    Arguments as ``make_media_replay_kernel``'s. ``candidates``: light points and, unless ``decomposed``, directions.
    """
    assert config.media is not None
    unlit = config.unlit()
    start = make_camera_start(config)
    walk_step = make_media_step(unlit, False)
    media_step = make_media_step(config, False)
    passage = make_media_passage(config, False)
    has_lights = bool(config.lights.area or config.lights.others)
    sample_light = make_light_sampler(config.lights) if has_lights else None
    resampling = make_resampling(candidates)
    numbers, choose_two = resampling.numbers, resampling.choose
    sample_4d = make_sampler(config.sampler).sample_4d
    sample_weight = make_sample_weight(role)
    sink = make_sink(role)
    channels = 3 if role == "forward" else 1

    @wp.func
    def collision_of(
        scene: Scene,
        sampler: Sampler,
        branch: Sampler,
        started: MediaState,
        delta: wp.vec3,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> CollisionPoint:
        """Draw a path, and choose one of its collisions by weighted reservoir sampling."""
        state = started
        point = CollisionPoint()
        total = wp.float32(0.0)
        own = wp.float32(1.0)
        while state.path.alive == 1:
            before = state
            vertex, state = walk_step(scene, sampler, state, max_depth, rr_depth)
            if not finite(vertex.surface.direct):
                count_invalid(scene, sampler)
            if vertex.collides:
                if scene.media.records[before.medium].phase == PHASE_HG:
                    weight = wp.dot(wp.abs(delta), wp.abs(vertex.surface.throughput))
                    total += weight
                    if unit_float(hashed(branch, VERTEX_SLOT + before.steps).x) * total < weight:
                        own = weight
                        point.chosen = True
                        point.x = collision_point(vertex)
                        point.before = before
                        point.throughput = vertex.surface.throughput
        point.weight = total / own
        return point

    @wp.func
    def radiance_from(
        scene: Scene,
        branch: Sampler,
        point: CollisionPoint,
        wo: wp.vec3,
        pdf: wp.float32,
        max_depth: wp.int32,
        rr_depth: wp.int32,
    ) -> wp.vec3:
        """What a path of the image finds from the collision in a direction, over its throughput up to there."""
        before = point.before
        path = path_from(point.x, wo, FAR, before.path.depth + 1)
        path.pdf = pdf
        path.eta = before.path.eta
        state = media_path_from(path, before.medium)
        state.steps = before.steps + 1
        state.crossings = before.crossings
        radiance = wp.vec3(0.0, 0.0, 0.0)
        while state.path.alive == 1:
            vertex, state = media_step(scene, branch, state, max_depth, rr_depth)
            radiance += radiance_of_step(vertex)
        return radiance

    @wp.func
    def directions(
        scene: Scene,
        branch: Sampler,
        point: CollisionPoint,
        g: wp.float32,
        u: wp.vec2,
        max_depth: wp.int32,
        rr_depth: wp.int32,
        t: wp.array(dtype=wp.float32),
    ) -> wp.vec3:
        """The derivative of what is scattered from other directions than those of light points."""
        r4 = sample_4d(branch, DIRECTION_SLOT)
        d = point.before.path.d
        s = any_tangent(d)
        chosen = TwoChosen()
        if wp.static(not decomposed):
            for k in range(t.shape[0]):  # a range that Warp does not unroll
                mu = hg_cosine(g, numbers(r4, k)[2])
                t[k] = hg_slope(g, mu) / hg_eval(g, mu)
            chosen = choose_two(t, u)
        found = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(not decomposed):
            if chosen.first < 0:
                found[0] = chosen.first_weight
        ray = wp.int32(0)
        while ray < 2:
            mu = wp.float32(0.0)
            phi = TWO_PI * r4[3]
            weight = wp.float32(0.0)
            if wp.static(decomposed):
                mu = hg_lobe_cosine(g, ray == 1, r4[2])
                weight = wp.where(ray == 1, 1.0, -1.0) * hg_lobe_mass(g)
            else:
                k, share = one_of(chosen, ray)
                if k >= 0:
                    n4 = numbers(r4, k)
                    mu = hg_cosine(g, n4[2])
                    phi = TWO_PI * n4[3]
                    weight = share * hg_slope(g, mu) / hg_eval(g, mu)
            ray += 1
            if weight != 0.0:
                sine = wp.sqrt(wp.max(0.0, 1.0 - mu * mu))
                wo = to_world(s, wp.cross(d, s), d, wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), mu))
                found += weight * radiance_from(scene, branch, point, wo, hg_eval(g, mu), max_depth, rr_depth)
        return found

    @wp.func
    def light_points(
        scene: Scene,
        branch: Sampler,
        point: CollisionPoint,
        g: wp.float32,
        a: wp.vec3,
        u: wp.vec2,
        max_depth: wp.int32,
        t: wp.array(dtype=wp.float32),
    ) -> wp.vec3:
        """The derivative of what is scattered from light points, two of many, drawn by what they would send."""
        found = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(has_lights):
            before = point.before
            r4 = sample_4d(branch, LIGHT_SLOT)
            d = before.path.d
            for k in range(t.shape[0]):  # a range that Warp does not unroll
                ls, _light, _probability = sample_light(scene, point.x, numbers(r4, k))
                pdf = ls.pdf * ls.probability
                mu = wp.dot(d, ls.wi)
                weight = inverse_pdf(pdf) * wp.where(ls.delta == 0, mis_weight(pdf, hg_eval(g, mu)), 1.0)
                t[k] = wp.where(pdf > 0.0, weight * hg_slope(g, mu) * wp.dot(wp.abs(a), ls.radiance), 0.0)
            chosen = choose_two(t, u)
            if chosen.first < 0:
                found[0] = chosen.first_weight
            draws = max_depth < 0 or before.path.depth + 2 < max_depth
            ray = wp.int32(0)
            while ray < 2:
                k, share = one_of(chosen, ray)
                ray += 1
                if k >= 0:
                    ls, _light, _probability = sample_light(scene, point.x, numbers(r4, k))
                    to_light, t_max = shadow_ray(point.x, ls)
                    passed, _first = passage(
                        scene, point.x, to_light, t_max, before.medium, draws, branch, before.steps
                    )
                    if passed.blocked == 0:
                        pdf = ls.pdf * ls.probability
                        mu = wp.dot(d, ls.wi)
                        weight = share * inverse_pdf(pdf) * hg_slope(g, mu)
                        if ls.delta == 0:
                            weight *= mis_weight(pdf, passed.probability * hg_eval(g, mu))
                        found += weight * wp.cw_mul(ls.radiance, transmittance_of(passed))
                    elif passed.blocked == 2:
                        count_invalid(scene, branch)
        return found

    @wp.kernel(module="unique", enable_backward=False, module_options=wide_vectors())
    def phase_branches(
        # Scene:
        scene: Scene,
        camera: Camera,
        # In:
        job: PixelJob,
        # Out:
        target: wp.array(dtype=wp.float32),
        image_out: wp.array2d(dtype=wp.vec3),
    ):
        pixel = pixel_of(job, camera, wp.tid())
        delta = sample_weight(job, pixel)
        if vanishes(delta):
            return
        derivative = wp.vec3d()  # in double precision, as the image
        t = wp.zeros(shape=(wp.static(candidates),), dtype=wp.float32)
        for i in range(job.samples):
            sampler = sampler_at(pixel.number, job.first_sample + i, job.seed)
            branch = salted(sampler, SALT, 0)
            started, _sample = start(scene, camera, pixel.px, pixel.py, sampler)
            first = media_path_from(started, camera.medium)
            point = collision_of(scene, sampler, branch, first, delta, job.max_depth, job.rr_depth)
            if point.chosen:
                place = scene.media.records[point.before.medium].g
                g = load_float(scene.values, place)
                u = sample_4d(branch, CHOICE_SLOT)
                a = point.weight * wp.cw_mul(delta, point.throughput)
                found = directions(
                    scene, branch, point, g, wp.vec2(u[0], u[1]), job.max_depth, job.rr_depth, t
                ) + light_points(scene, branch, point, g, a, wp.vec2(u[2], u[3]), job.max_depth, t)
                w = wp.cw_mul(a, found)
                valid = finite(w)
                if wp.static(channels == 1):
                    valid = valid and sink(target, place, w[0] + w[1] + w[2]) == 0.0
                elif valid:
                    along = sink(target, place, 1.0)
                    derivative += wp.vec3d(along * w)
                if not valid:
                    count_invalid(scene, sampler)
        if wp.static(channels == 3):
            image_out[pixel.py, pixel.px] = image_out[pixel.py, pixel.px] + wp.vec3(derivative)

    return phase_branches

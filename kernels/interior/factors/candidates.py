"""The candidates of branches and their targets, computed with SIMD where the scene's models do not branch.

Targets differ from candidate to candidate in the random numbers alone. On the CPU they are loops over rows of
``Scene.rows`` that the compiler can turn into SIMD (``lanes/lanes.py``); the light points are drawn one by one before.

Derivation: ``docs/theory/interior.md#resampled-branches``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.interior.factors.mixtures import mixed_values
from warp_psdr.kernels.interior.resampled import make_resampling
from warp_psdr.kernels.invalid import inverse_pdf
from warp_psdr.kernels.lanes.lanes import make_record, words
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.scattering import make_light_sampler, samples_lights
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import LightConfig, PathConfig

#: Share of a value in a target: 2 % of what a relative change by the step (``shape_parameters.py``) would be.
FLOOR = wp.constant(1.5e-4)


@wp.struct
class Target:
    """What a candidate is chosen by."""

    t: wp.float32


@wp.struct
class LightPoint:
    """What a target needs of a sampled light."""

    wi: wp.vec3
    radiance: wp.vec3
    pdf: wp.float32  # solid angle, with the probability of the light
    delta: wp.int32


class Candidates(NamedTuple):
    """Functions that fill an array ``t`` with the targets of all candidates.

    Attributes:
        directions: ``(scene, at, mixes, lower, upper, moved, r4, sizes, t)``: of the model's own directions. ``moved``
            are the values of a material a step along its direction, ``r4`` random numbers, ``sizes`` the weights of the
            colours. If it ``mixes``, half of them are those of ``lower`` and ``upper``, the ends of its mixture.
        lights: ``(scene, at, moved, r4, sizes, t)``: of light points; None: there is no next-event estimation.
        density: ``(at, material, lobe, wo) -> float32``: of a local direction, or the probability of a delta lobe.
    """

    directions: wp.Function
    lights: wp.Function | None
    density: wp.Function


@wp.func
def signed_target(moved: wp.vec3, value: wp.vec3, weights: wp.vec3) -> wp.float32:
    """The weighted absolute changes of a candidate's colours, with the sign of their sum.

    A difference stands for the derivative. A small share of the value keeps it from 0 where the derivative is not.
    """
    d = moved - value
    size = wp.dot(weights, wp.abs(d) + FLOOR * wp.abs(value))
    return wp.where(wp.dot(d, weights) < 0.0, -size, size)


@wp.func
def is_upper(n4: wp.vec4) -> wp.bool:
    """Whether a candidate is drawn at the upper end of a mixture."""
    return n4[1] >= 0.5


@functools.cache
def make_light_candidate(lights: LightConfig) -> wp.Function:
    """Return ``light_point(scene, x, n4) -> LightPoint``, as seen from x."""
    sample_light = make_light_sampler(lights)

    @wp.func
    def light_point(scene: Scene, x: wp.vec3, n4: wp.vec4) -> LightPoint:
        ls, _light, _probability = sample_light(scene, x, n4)
        point = LightPoint()
        point.wi = ls.wi
        point.radiance = ls.radiance
        point.pdf = ls.pdf * ls.probability
        point.delta = ls.delta
        return point

    return light_point


@functools.cache
def make_candidates(config: PathConfig, wanted: GradientRequest, candidates: int) -> Candidates:
    """Return the functions for a scene, the values that are branched and a number of candidates."""
    mixing = bool(mixed_values(config.surfaces, wanted))
    interaction = make_interaction(config.surfaces, config.lights, True)
    record, bsdf = interaction.record, interaction.bsdf
    material_record = bsdf.record
    numbers = make_resampling(candidates).numbers
    delta = bsdf.scatter is not None
    rows = config.rays.backend == "wide"
    get_target, put_target = make_record(Target, candidates) if rows else (None, None)
    get_point, put_point = make_record(LightPoint, candidates) if rows else (None, None)
    first_point = words(Target)

    @wp.func
    def density(at: record, material: material_record, lobe: wp.int32, wo: wp.vec3) -> wp.float32:
        p = bsdf.pdf(at.model, material, at.wi, wo)
        if wp.static(delta):
            if lobe > LOBE_SMOOTH:
                p = bsdf.probability(at.model, material, at.wi, lobe)
        return p

    @wp.func
    def direction_target(
        at: record,
        mixes: wp.bool,
        lower: material_record,
        upper: material_record,
        moved: material_record,
        n4: wp.vec4,
        sizes: wp.vec3,
    ) -> wp.float32:
        own = at.material
        other = moved
        if wp.static(mixing):
            if mixes:
                own = lower
                other = upper
                if is_upper(n4):
                    own = upper
                    other = lower
        bs = bsdf.sample(at.model, own, at.wi, n4[0], wp.vec2(n4[2], n4[3]))
        value = bsdf.eval(at.model, other, at.wi, bs.wo)
        if wp.static(delta):
            if bs.lobe > LOBE_SMOOTH:
                value = bsdf.scatter(at.model, other, at.wi, bs.lobe).value
        p = bs.pdf
        drawn = bs.pdf > 0.0
        t = signed_target(value, bs.value, sizes)
        if wp.static(mixing):
            if mixes:
                # What only the other end has counts, too.
                t += wp.where(t < 0.0, -FLOOR, FLOOR) * wp.dot(sizes, value)
                t = wp.where(is_upper(n4), -t, t)
                p = 0.5 * (p + density(at, other, bs.lobe, bs.wo))
        return wp.where(drawn, t / wp.where(drawn, p, 1.0), bs.pdf)  # a NaN stays

    @wp.func
    def light_target(at: record, moved: material_record, point: LightPoint, sizes: wp.vec3) -> wp.float32:
        wo = enter_frame(at.frame, point.wi)
        pdf_bsdf = bsdf.pdf(at.model, at.material, at.wi, wo)
        weight = inverse_pdf(point.pdf) * wp.where(point.delta == 0, mis_weight(point.pdf, pdf_bsdf), 1.0)
        value = wp.cw_mul(bsdf.eval(at.model, at.material, at.wi, wo), point.radiance)
        t = signed_target(wp.cw_mul(bsdf.eval(at.model, moved, at.wi, wo), point.radiance), value, sizes)
        return wp.where(point.pdf <= 0.0 or pdf_bsdf <= 0.0, 0.0, weight * t)

    @wp.func
    def fetch_targets(scene: Scene, t: wp.array(dtype=wp.float32)):
        for k in range(t.shape[0]):  # a range that Warp does not unroll
            t[k] = get_target(scene.rows, 0, k, Target()).t

    @wp.func
    def direction_targets(
        scene: Scene,
        at: record,
        mixes: wp.bool,
        lower: material_record,
        upper: material_record,
        moved: material_record,
        r4: wp.vec4,
        sizes: wp.vec3,
        t: wp.array(dtype=wp.float32),
    ):
        if wp.static(rows):
            k = wp.int32(0)
            while k < candidates:
                target = Target()
                target.t = direction_target(at, mixes, lower, upper, moved, numbers(r4, k), sizes)
                put_target(scene.rows, 0, k, target)
                k += 1
            fetch_targets(scene, t)
        else:
            for k in range(t.shape[0]):
                t[k] = direction_target(at, mixes, lower, upper, moved, numbers(r4, k), sizes)

    if not samples_lights(config.lights, config.surfaces.bsdfs):
        return Candidates(direction_targets, None, density)
    light_point = make_light_candidate(config.lights)

    @wp.func
    def light_targets(
        scene: Scene,
        at: record,
        moved: material_record,
        r4: wp.vec4,
        sizes: wp.vec3,
        t: wp.array(dtype=wp.float32),
    ):
        if wp.static(rows):
            for k in range(t.shape[0]):
                put_point(scene.rows, first_point, k, light_point(scene, at.x, numbers(r4, k)))
            k = wp.int32(0)
            while k < candidates:
                target = Target()
                target.t = light_target(at, moved, get_point(scene.rows, first_point, k, LightPoint()), sizes)
                put_target(scene.rows, 0, k, target)
                k += 1
            fetch_targets(scene, t)
        else:
            for k in range(t.shape[0]):
                t[k] = light_target(at, moved, light_point(scene, at.x, numbers(r4, k)), sizes)

    return Candidates(direction_targets, light_targets, density)

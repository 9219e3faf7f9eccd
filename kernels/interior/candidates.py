"""The candidates of branches: what each would be chosen by, computed as SIMD where the scene's models do not branch.

Targets differ from candidate to candidate in the random numbers alone. On the CPU they are loops over rows of
``Scene.rows`` that the compiler can turn into SIMD (``lanes/lanes.py``); the light points are drawn one by one before.

Derivation: ``docs/theory/interior.md#resampled-branches``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.resampled import make_resampling
from warp_psdr.kernels.invalid import inverse_pdf
from warp_psdr.kernels.lanes.lanes import make_record, words
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.scattering import make_light_sampler, samples_lights
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig

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
        directions: ``(scene, at, moved, r4, sizes, t)``: of the model's own directions. ``moved`` are the values of a
            material a step along its direction, ``r4`` random numbers, ``sizes`` the weights of the colours.
        lights: ``(scene, at, moved, r4, sizes, t)``: of light points; None: there is no next-event estimation.
    """

    directions: wp.Function
    lights: wp.Function | None


@wp.func
def signed_target(moved: wp.vec3, value: wp.vec3, weights: wp.vec3) -> wp.float32:
    """The weighted absolute changes of a candidate's colours, with the sign of their sum.

    A difference stands for the derivative. A small share of the value keeps it from 0 where the derivative is not.
    """
    d = moved - value
    size = wp.dot(weights, wp.abs(d) + FLOOR * wp.abs(value))
    return wp.where(wp.dot(d, weights) < 0.0, -size, size)


@functools.cache
def make_candidates(config: PathConfig, candidates: int) -> Candidates:
    """Return the functions for a scene and a number of candidates."""
    interaction = make_interaction(config, True)
    record, bsdf = interaction.record, interaction.bsdf
    material_record = bsdf.record
    numbers = make_resampling(candidates).numbers
    delta = bsdf.scatter is not None
    rows = config.ray_backend == "wide"
    get_target, put_target = make_record(Target, candidates) if rows else (None, None)
    get_point, put_point = make_record(LightPoint, candidates) if rows else (None, None)
    first_point = words(Target)

    @wp.func
    def direction_target(at: record, moved: material_record, n4: wp.vec4, sizes: wp.vec3) -> wp.float32:
        bs = bsdf.sample(at.model, at.material, at.wi, n4[0], wp.vec2(n4[2], n4[3]))
        value = bsdf.eval(at.model, moved, at.wi, bs.wo)
        if wp.static(delta):
            if bs.lobe > LOBE_SMOOTH:
                value = bsdf.scatter(at.model, moved, at.wi, bs.lobe).value
        drawn = bs.pdf > 0.0
        t = signed_target(value, bs.value, sizes) / wp.where(drawn, bs.pdf, 1.0)
        return wp.where(drawn, t, bs.pdf)  # a NaN stays

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
        moved: material_record,
        r4: wp.vec4,
        sizes: wp.vec3,
        t: wp.array(dtype=wp.float32),
    ):
        if wp.static(rows):
            k = wp.int32(0)
            while k < candidates:
                target = Target()
                target.t = direction_target(at, moved, numbers(r4, k), sizes)
                put_target(scene.rows, 0, k, target)
                k += 1
            fetch_targets(scene, t)
        else:
            for k in range(t.shape[0]):
                t[k] = direction_target(at, moved, numbers(r4, k), sizes)

    if not samples_lights(config):
        return Candidates(direction_targets, None)
    sample_light = make_light_sampler(config)

    @wp.func
    def light_point(scene: Scene, x: wp.vec3, n4: wp.vec4) -> LightPoint:
        ls, _light, _probability = sample_light(scene, x, n4)
        point = LightPoint()
        point.wi = ls.wi
        point.radiance = ls.radiance
        point.pdf = ls.pdf * ls.probability
        point.delta = ls.delta
        return point

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

    return Candidates(direction_targets, light_targets)

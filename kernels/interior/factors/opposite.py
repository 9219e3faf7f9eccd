"""Opposite candidates: two directions, or two light points, whose derivatives by a normal nearly cancel.

The derivative of a scattering value by the normal m has two numbers: along e_1 in the plane of incidence, and along e_2
across it. Both are computed for M candidates of the image's own samplers. One candidate is drawn from those with a
negative number along e_1, and one from the others (``resampled.py``). Each half is sorted by the line through the
origin that the two numbers lie on, and both candidates are drawn at the same quantile. The numbers along e_2 then
cancel as well, and one pair serves both tilts.

Derivation: ``docs/theory/interior.md#resampled-tilts``.
"""

import functools
import math
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import LOBE_SMOOTH
from warp_psdr.kernels.interaction import enter_frame, make_interaction
from warp_psdr.kernels.interior.factors.candidates import FLOOR, LightPoint, make_light_candidate
from warp_psdr.kernels.interior.factors.shape_parameters import LEAST_SCALE, STEP
from warp_psdr.kernels.interior.resampled import TwoChosen, make_resampling
from warp_psdr.kernels.invalid import inverse_pdf
from warp_psdr.kernels.lanes.lanes import make_record, words
from warp_psdr.kernels.math import any_tangent, unit_vector
from warp_psdr.kernels.sampling import mis_weight
from warp_psdr.kernels.scattering import samples_lights
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.vertex import PathConfig

#: Squared sine of the angle between the normal and the previous vertex below which the plane of incidence is any.
UPRIGHT = wp.constant(1.0e-8)
FOUR_PI = wp.constant(4.0 * math.pi)


@wp.struct
class Tilt:
    """The normal, the two directions in which it tilts, and how far it does for differences; local."""

    m: wp.vec3
    e_1: wp.vec3
    e_2: wp.vec3
    wi_1: wp.vec3  # towards the previous vertex, in the frame that is tilted towards e_1
    wi_2: wp.vec3
    step: wp.float32


@wp.struct
class TiltChange:
    """How a candidate's value changes by both tilts."""

    along_1: wp.float32
    along_2: wp.float32


class Opposite(NamedTuple):
    """Functions that choose two candidates; ``t``, ``key`` and ``order`` have room for all of them.

    Attributes:
        numbers: see ``Resampling``.
        directions: ``(scene, at, r4, sizes, u, t, key, order) -> TwoChosen``: of the model's own directions. ``r4`` are
            random numbers, ``sizes`` the weights of the colours, ``u`` the quantile.
        lights: the same, of light points; None: there is no next-event estimation.
    """

    numbers: wp.Function
    directions: wp.Function
    lights: wp.Function | None


@wp.func
def turned_against(w: wp.vec3, m: wp.vec3, e: wp.vec3, step: wp.float32) -> wp.vec3:
    """A direction as a frame has it whose normal m is tilted towards e."""
    return unit_vector(w + step * (wp.dot(w, e) * m - wp.dot(w, m) * e))


@wp.func
def sort_by(key: wp.array(dtype=wp.float32), t: wp.array(dtype=wp.float32), order: wp.array(dtype=wp.int32)):
    """Sort by insertion, equal keys by their numbers; ``order`` becomes the numbers."""
    for k in range(t.shape[0]):
        own_key = key[k]
        own_t = t[k]
        j = wp.int32(k)
        while j > 0 and key[wp.max(j - 1, 0)] > own_key:
            key[j] = key[j - 1]
            t[j] = t[j - 1]
            order[j] = order[j - 1]
            j -= 1
        key[j] = own_key
        t[j] = own_t
        order[j] = k


@functools.cache
def make_opposite(config: PathConfig, candidates: int) -> Opposite:
    """Return the functions for a scene and a number of candidates."""
    interaction = make_interaction(config.surfaces, config.lights, True)
    record, bsdf = interaction.record, interaction.bsdf
    normal = bsdf.normal
    numbers, choose_two = make_resampling(candidates)[1:]
    rows = config.rays.backend == "wide"
    get_change, put_change = make_record(TiltChange, candidates) if rows else (None, None)
    get_point, put_point = make_record(LightPoint, candidates) if rows else (None, None)
    first_point = words(TiltChange)

    @wp.func
    def tilt_of(at: record) -> Tilt:
        r = Tilt()
        r.m = wp.vec3(0.0, 0.0, 1.0)
        if wp.static(normal is not None):
            r.m = normal(at.model, at.material, at.wi)
        cosine = wp.dot(at.wi, r.m)
        across = at.wi - cosine * r.m
        r.e_1 = any_tangent(r.m)
        if wp.dot(across, across) > UPRIGHT:
            r.e_1 = unit_vector(across)
        r.e_2 = wp.cross(r.m, r.e_1)
        # A lobe of the roughness alpha has the density 1 / (4 pi alpha^2 cos) in the mirror direction.
        p = bsdf.pdf(at.model, at.material, at.wi, 2.0 * cosine * r.m - at.wi)
        alpha = 1.0 / wp.sqrt(wp.max(FOUR_PI * wp.abs(cosine) * p, 1.0))
        r.step = STEP * wp.max(wp.min(alpha, wp.abs(cosine)), LEAST_SCALE)
        r.wi_1 = turned_against(at.wi, r.m, r.e_1, r.step)
        r.wi_2 = turned_against(at.wi, r.m, r.e_2, r.step)
        return r

    @wp.func
    def change_of(at: record, tilt: Tilt, wo: wp.vec3, value: wp.vec3, sizes: wp.vec3) -> TiltChange:
        """Weighted absolute changes of the colours by both tilts, with the signs of their sums."""
        m = tilt.m
        d_1 = bsdf.eval(at.model, at.material, tilt.wi_1, turned_against(wo, m, tilt.e_1, tilt.step)) - value
        d_2 = bsdf.eval(at.model, at.material, tilt.wi_2, turned_against(wo, m, tilt.e_2, tilt.step)) - value
        size_1 = wp.dot(sizes, wp.abs(d_1) + FLOOR * wp.abs(value))
        size_2 = wp.dot(sizes, wp.abs(d_2))
        change = TiltChange()
        change.along_1 = wp.where(wp.dot(d_1, sizes) < 0.0, -size_1, size_1)
        change.along_2 = wp.where(wp.dot(d_2, sizes) < 0.0, -size_2, size_2)
        return change

    @wp.func
    def times(change: TiltChange, weight: wp.float32, counts: wp.bool) -> TiltChange:
        weighted = TiltChange()
        weighted.along_1 = wp.where(counts, weight * change.along_1, 0.0)
        weighted.along_2 = wp.where(counts, weight * change.along_2, 0.0)
        return weighted

    @wp.func
    def change_of_direction(at: record, tilt: Tilt, n4: wp.vec4, sizes: wp.vec3) -> TiltChange:
        bs = bsdf.sample(at.model, at.material, at.wi, n4[0], wp.vec2(n4[2], n4[3]))
        drawn = bs.pdf > 0.0 and bs.lobe == LOBE_SMOOTH
        return times(change_of(at, tilt, bs.wo, bs.value, sizes), 1.0 / wp.where(drawn, bs.pdf, 1.0), drawn)

    @wp.func
    def change_of_light(at: record, tilt: Tilt, point: LightPoint, sizes: wp.vec3) -> TiltChange:
        wo = enter_frame(at.frame, point.wi)
        pdf_bsdf = bsdf.pdf(at.model, at.material, at.wi, wo)
        weight = inverse_pdf(point.pdf) * wp.where(point.delta == 0, mis_weight(point.pdf, pdf_bsdf), 1.0)
        value = bsdf.eval(at.model, at.material, at.wi, wo)
        change = change_of(at, tilt, wo, value, wp.cw_mul(sizes, point.radiance))
        return times(change, weight, point.pdf > 0.0 and pdf_bsdf > 0.0)

    @wp.func
    def choose(
        u: wp.float32,
        t: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.float32),
        order: wp.array(dtype=wp.int32),
    ) -> TwoChosen:
        """Two of the candidates with the changes ``t`` along e_1 and ``key`` along e_2."""
        for k in range(t.shape[0]):
            size = wp.abs(t[k]) + wp.abs(key[k])
            key[k] = wp.where(size > 0.0, wp.where(t[k] < 0.0, -key[k], key[k]) / size, 0.0)
            t[k] = wp.where(t[k] < 0.0, -size, size)
        sort_by(key, t, order)
        chosen = choose_two(t, wp.vec2(u, u))
        if chosen.first >= 0:
            chosen.first = order[chosen.first]
            chosen.second = order[chosen.second]
        return chosen

    @wp.func
    def fetch_changes(scene: Scene, t: wp.array(dtype=wp.float32), key: wp.array(dtype=wp.float32)):
        for k in range(t.shape[0]):  # a range that Warp does not unroll
            change = get_change(scene.rows, 0, k, TiltChange())
            t[k] = change.along_1
            key[k] = change.along_2

    @wp.func
    def directions(
        scene: Scene,
        at: record,
        r4: wp.vec4,
        sizes: wp.vec3,
        u: wp.float32,
        t: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.float32),
        order: wp.array(dtype=wp.int32),
    ) -> TwoChosen:
        tilt = tilt_of(at)
        if wp.static(rows):
            k = wp.int32(0)
            while k < candidates:
                put_change(scene.rows, 0, k, change_of_direction(at, tilt, numbers(r4, k), sizes))
                k += 1
            fetch_changes(scene, t, key)
        else:
            for k in range(t.shape[0]):
                change = change_of_direction(at, tilt, numbers(r4, k), sizes)
                t[k] = change.along_1
                key[k] = change.along_2
        return choose(u, t, key, order)

    if not samples_lights(config.lights, config.surfaces.bsdfs):
        return Opposite(numbers, directions, None)
    light_point = make_light_candidate(config.lights)

    @wp.func
    def lights(
        scene: Scene,
        at: record,
        r4: wp.vec4,
        sizes: wp.vec3,
        u: wp.float32,
        t: wp.array(dtype=wp.float32),
        key: wp.array(dtype=wp.float32),
        order: wp.array(dtype=wp.int32),
    ) -> TwoChosen:
        tilt = tilt_of(at)
        if wp.static(rows):
            for k in range(t.shape[0]):
                put_point(scene.rows, first_point, k, light_point(scene, at.x, numbers(r4, k)))
            k = wp.int32(0)
            while k < candidates:
                point = get_point(scene.rows, first_point, k, LightPoint())
                put_change(scene.rows, 0, k, change_of_light(at, tilt, point, sizes))
                k += 1
            fetch_changes(scene, t, key)
        else:
            for k in range(t.shape[0]):
                change = change_of_light(at, tilt, light_point(scene, at.x, numbers(r4, k)), sizes)
                t[k] = change.along_1
                key[k] = change.along_2
        return choose(u, t, key, order)

    return Opposite(numbers, directions, lights)

"""Resampled branches: the derivative of a lobe's shape, split into its two signs by resampling [BXB*24, section 4].

Such a derivative has both signs, and most of the variance of its estimate is the sign. M stratified candidates are
drawn from the model's own sampler, and the signed number t = adjoint . derivative / p is computed for each. One
candidate is drawn by the positive parts and one by the negative parts. The light that the two find is weighted with the
sum of the parts over M t. No closed form is needed, so the method serves every model and every number.

Derivation: ``docs/theory/interior.md#resampled-branches``.
"""

import functools
import math
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.constants import ONE_MINUS_EPSILON
from warp_psdr.kernels.invalid import LARGEST

#: Where one sign has less than this share of the other, both rays are drawn from all of them.
LEAST_SHARE = 0.15
#: Irrational steps from one candidate's lobe, light or triangle to the next: 1 / g and 1 / g^2 with g^3 = g + 1.
STEP_1, STEP_2 = 0.7548776662466927, 0.5698402909980532


@wp.struct
class TwoChosen:
    """The numbers of two candidates, and the weights of what they find.

    -1: there is none; the first weight is then 0, or NaN if a target was not a number.
    """

    first: wp.int32
    second: wp.int32
    first_weight: wp.float32
    second_weight: wp.float32


@wp.func
def one_of(chosen: TwoChosen, which: wp.int32) -> tuple[wp.int32, wp.float32]:
    """Number and weight of the first (0) or the second (1)."""
    if which == 1:
        return chosen.second, chosen.second_weight
    return chosen.first, chosen.first_weight


class Resampling(NamedTuple):
    """Functions of a method with a number of candidates.

    Attributes:
        candidates: M.
        numbers: ``(r, k) -> vec4``: the numbers of candidate k from those of a sample: two that step from one candidate
            to the next, and two in its cell of the unit square.
        choose: ``(t, u) -> TwoChosen``: ``t`` the signed targets, M of them.
    """

    candidates: int
    numbers: wp.Function
    choose: wp.Function


@functools.cache
def make_resampling(candidates: int) -> Resampling:
    """Return the functions for M candidates, a square."""
    cells = math.isqrt(candidates)

    @wp.func
    def candidate_numbers(r: wp.vec4, k: wp.int32) -> wp.vec4:
        a = r[0] + wp.float32(k) * STEP_1
        b = r[1] + wp.float32(k) * STEP_2
        x = (wp.float32(k % wp.static(cells)) + r[2]) * wp.static(1.0 / cells)
        y = (wp.float32(k // wp.static(cells)) + r[3]) * wp.static(1.0 / cells)
        return wp.vec4(a - wp.floor(a), b - wp.floor(b), wp.min(x, ONE_MINUS_EPSILON), wp.min(y, ONE_MINUS_EPSILON))

    @wp.func
    def choose_two(t: wp.array(dtype=wp.float32), u: wp.vec2) -> TwoChosen:
        negative = wp.float32(0.0)
        positive = wp.float32(0.0)
        for k in range(t.shape[0]):  # a range that Warp does not unroll
            negative += wp.where(t[k] > 0.0, 0.0, -t[k])  # a NaN passes
            positive += wp.max(t[k], 0.0)
        total = negative + positive
        chosen = TwoChosen()
        chosen.first = -1
        chosen.second = -1
        if not total <= LARGEST:
            chosen.first_weight = wp.NAN
            return chosen
        # One ray for each sign; or, by a rule that looks at the candidates alone, systematic resampling of all, the
        # negative ones first.
        each = wp.min(negative, positive) >= LEAST_SHARE * wp.max(negative, positive)
        first_at = wp.where(each, u[0] * negative, 0.5 * u[0] * total)
        second_at = wp.where(each, negative + u[1] * positive, 0.5 * (u[0] + 1.0) * total)
        # The sign that each is drawn from: one that has a candidate.
        first_up = negative == 0.0 or (first_at >= negative and positive > 0.0)
        second_up = negative == 0.0 or (second_at >= negative and positive > 0.0)
        first_at -= wp.where(first_up, negative, 0.0)
        second_at -= wp.where(second_up, negative, 0.0)
        first_reached = wp.float32(0.0)
        second_reached = wp.float32(0.0)
        first_found = wp.int32(0)
        second_found = wp.int32(0)
        for k in range(t.shape[0]):  # selects, for branches on these numbers cannot be predicted
            first_size = wp.max(wp.where(first_up, t[k], -t[k]), 0.0)
            second_size = wp.max(wp.where(second_up, t[k], -t[k]), 0.0)
            # The last one that has a size and begins at the number or before.
            first_found = wp.where(first_size > 0.0 and first_reached <= first_at, k, first_found)
            second_found = wp.where(second_size > 0.0 and second_reached <= second_at, k, second_found)
            first_reached += first_size
            second_reached += second_size
        if total > 0.0:
            chosen.first = first_found
            chosen.second = second_found
            first_mass = wp.where(each, negative, 0.5 * total)
            second_mass = wp.where(each, positive, 0.5 * total)
            chosen.first_weight = first_mass / (wp.float32(candidates) * wp.abs(t[first_found]))
            chosen.second_weight = second_mass / (wp.float32(candidates) * wp.abs(t[second_found]))
        return chosen

    return Resampling(candidates, candidate_numbers, choose_two)

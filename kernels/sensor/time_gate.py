"""Bins of a transient film: the weight of light of one path length in each of them [WCRZ21, YKC*21].

Time is measured by optical path length ell in world units. A pulse p that leaves the light at 0 arrives spread around
ell. Bin b, from e_b to e_{b+1}, receives the share w_b(ell) = P(e_{b+1} - ell) - P(e_b - ell), with the integral P of
p. A box pulse makes w_b a trapezoid, or a tent if it is as wide as the bin. dw_b / dell = p(e_b - ell) - p(e_{b+1} -
ell). The bins of a pixel lie side by side in a row of the image, which has the shape (H, W T) and the type vec3.

Derivation: ``docs/theory/transient.md#time-gates``.
"""

import functools
from typing import NamedTuple

import warp as wp

#: Kinds of pulses; 0: the image has no bins.
PULSE_DELTA, PULSE_BOX, PULSE_GAUSSIAN = 1, 2, 3
#: Where a gaussian pulse ends, in standard deviations: beyond it are 6e-7 of it, the roundings of float32.
PULSE_CUT = 5.0
#: 1 / sqrt 2 and 1 / sqrt(2 pi).
SQRT_HALF, GAUSSIAN_PEAK = 0.70710678, 0.39894228


@wp.struct
class TimeGates:
    """The bins of a film; lengths are optical path lengths, world units."""

    bins: wp.int32
    start: wp.float32
    width: wp.float32  # of a bin
    pulse: wp.float32  # box: its width; gaussian: its standard deviation
    unwarp: wp.int32  # 1: lengths count from the first surface on, not from the camera


class TimeGate(NamedTuple):
    """Functions of a kind of pulse.

    Attributes:
        reached: ``(gates, length) -> (int, int)``: first and last bin that the pulse reaches; the last is less where it
            reaches none.
        weight: ``(gates, b, length) -> float``: w_b.
        add: ``(gates, length, value, row, column, film)`` adds light to a pixel's bins, film in double precision.
        add_moving: ``(gates, length, value, length_dot, value_dot, row, column, image)`` adds its derivative.
        read: ``(gates, length, row, column, adjoint) -> (vec3, vec3)``: the sums over the bins of their adjoints, times
            w_b and times dw_b / dell.
    """

    reached: wp.Function
    weight: wp.Function
    add: wp.Function
    add_moving: wp.Function
    read: wp.Function


@functools.cache
def make_time_gate(pulse: int) -> TimeGate:
    """Return the functions of a kind of pulse (PULSE_*)."""

    @wp.func
    def passed(gates: TimeGates, x: wp.float32) -> wp.float32:
        """Share of the pulse that has arrived by x behind its middle."""
        if wp.static(pulse == PULSE_BOX):
            return wp.clamp(x / gates.pulse + 0.5, 0.0, 1.0)
        elif wp.static(pulse == PULSE_GAUSSIAN):
            return 0.5 + 0.5 * wp.erf(SQRT_HALF * x / gates.pulse)
        else:
            return wp.where(x > 0.0, 1.0, 0.0)

    @wp.func
    def power(gates: TimeGates, x: wp.float32) -> wp.float32:
        """Density of the pulse at x behind its middle [1 / length]."""
        if wp.static(pulse == PULSE_BOX):
            return wp.where(wp.abs(x) < 0.5 * gates.pulse, 1.0 / gates.pulse, 0.0)
        elif wp.static(pulse == PULSE_GAUSSIAN):
            z = x / gates.pulse
            return GAUSSIAN_PEAK * wp.exp(-0.5 * z * z) / gates.pulse
        else:
            return 0.0

    @wp.func
    def edge(gates: TimeGates, b: wp.int32) -> wp.float32:
        return gates.start + wp.float32(b) * gates.width

    @wp.func
    def bin_at(gates: TimeGates, length: wp.float32) -> wp.int32:
        """Bin that a length lies in; -1 in front of all, ``bins`` behind all."""
        return wp.int32(wp.clamp(wp.floor((length - gates.start) / gates.width), -1.0, wp.float32(gates.bins)))

    @wp.func
    def reached(gates: TimeGates, length: wp.float32) -> tuple[wp.int32, wp.int32]:
        reach = wp.float32(0.0)
        if wp.static(pulse == PULSE_BOX):
            reach = 0.5 * gates.pulse
        if wp.static(pulse == PULSE_GAUSSIAN):
            reach = PULSE_CUT * gates.pulse
        return wp.max(bin_at(gates, length - reach), 0), wp.min(bin_at(gates, length + reach), gates.bins - 1)

    @wp.func
    def weight(gates: TimeGates, b: wp.int32, length: wp.float32) -> wp.float32:
        return passed(gates, edge(gates, b + 1) - length) - passed(gates, edge(gates, b) - length)

    @wp.func
    def slope(gates: TimeGates, b: wp.int32, length: wp.float32) -> wp.float32:
        return power(gates, edge(gates, b) - length) - power(gates, edge(gates, b + 1) - length)

    @wp.func
    def add(
        gates: TimeGates,
        length: wp.float32,
        value: wp.vec3,
        row: wp.int32,
        column: wp.int32,
        film: wp.array2d(dtype=wp.vec3d),
    ):
        first, last = reached(gates, length)
        for b in range(first, last + 1):
            k = column * gates.bins + b
            film[row, k] = film[row, k] + wp.vec3d(weight(gates, b, length) * value)

    @wp.func
    def add_moving(
        gates: TimeGates,
        length: wp.float32,
        value: wp.vec3,
        length_dot: wp.float32,
        value_dot: wp.vec3,
        row: wp.int32,
        column: wp.int32,
        image: wp.array2d(dtype=wp.vec3),
    ):
        first, last = reached(gates, length)
        for b in range(first, last + 1):
            k = column * gates.bins + b
            change = weight(gates, b, length) * value_dot + (slope(gates, b, length) * length_dot) * value
            image[row, k] = image[row, k] + change

    @wp.func
    def read(
        gates: TimeGates, length: wp.float32, row: wp.int32, column: wp.int32, adjoint: wp.array2d(dtype=wp.vec3)
    ) -> tuple[wp.vec3, wp.vec3]:
        of_value = wp.vec3(0.0, 0.0, 0.0)
        of_length = wp.vec3(0.0, 0.0, 0.0)
        first, last = reached(gates, length)
        for b in range(first, last + 1):
            a = adjoint[row, column * gates.bins + b]
            of_value += weight(gates, b, length) * a
            of_length += slope(gates, b, length) * a
        return of_value, of_length

    return TimeGate(reached, weight, add, add_moving, read)

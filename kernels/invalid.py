"""Samples that are not finite: dropped and counted, never added up and never masked in silence.

Every kernel that adds samples to an image or a gradient tests what it adds. The *sample* counts: a kernel calls
``count_invalid`` once for a contribution that it drops. Earlier tests must let NaN pass: ``x > 0`` is false for NaN,
and ``max`` of a vector skips it, so that an error would look like a legitimate zero; ``vanishes`` does not. An infinite
density makes a contribution zero, hence ``inverse_pdf``. The counter belongs to one launch and one lane
(``Scene.invalid``), because atomic additions on the CPU are not atomic between threads. The host knows which kind of
sample a launch draws (``warp_psdr/invalid.py``).
"""

import functools

import warp as wp

from warp_psdr.kernels.rng import Sampler
from warp_psdr.kernels.structs import Scene

#: What a lane's counter holds: the number of samples dropped, and the pixel and the index of the first of them.
COUNTER_SIZE = 3
#: The largest finite float32. Comparing with it costs nothing; ``wp.isfinite`` is a function call on the CPU.
LARGEST = wp.constant(3.4028234663852886e38)


@wp.func
def finite(v: wp.vec3) -> wp.bool:
    """Whether all components are finite; three of 1e38 and more, whose sum overflows, count as not."""
    return wp.abs(v[0] + v[1] + v[2]) <= LARGEST


@wp.func
def vanishes(v: wp.vec3) -> wp.bool:
    """Whether all components are exactly zero; NaN does not vanish."""
    return v[0] == 0.0 and v[1] == 0.0 and v[2] == 0.0


@wp.func
def inverse_pdf(pdf: wp.float32) -> wp.float32:
    """1 / pdf, and NaN for an infinite density, which would drop the sample's contribution without a word."""
    return wp.where(wp.abs(pdf) <= LARGEST, 1.0 / pdf, wp.NAN)


@wp.func
def count_invalid(scene: Scene, sampler: Sampler):
    """Count a dropped contribution of a sample, and remember the first."""
    if wp.atomic_add(scene.invalid, 0, wp.int64(1)) == wp.int64(0):
        scene.invalid[1] = wp.int64(sampler.pixel)
        scene.invalid[2] = wp.int64(sampler.index)


@functools.cache
def make_derivative_of_sample(role: str) -> wp.Function:
    """Return ``derivative_of_sample(scene, sampler, known, sums) -> vec3d``: what a sample adds to a derivative image.

    ``known``: whether its radiance is finite. ``sums``: in forward mode its derivative by channels, in reverse mode the
    number of derivatives that were dropped. A sample that is not finite, or has dropped any, is counted, and adds
    nothing; nor does one in reverse mode.
    """

    @wp.func
    def derivative_of_sample(scene: Scene, sampler: Sampler, known: wp.bool, sums: wp.vec3) -> wp.vec3d:
        valid = known and finite(sums)
        if wp.static(role == "reverse"):
            valid = valid and vanishes(sums)
        if not valid:
            count_invalid(scene, sampler)
        elif wp.static(role == "forward"):
            return wp.vec3d(sums)
        return wp.vec3d()

    return derivative_of_sample


@wp.func
def on_channel(channel: wp.int32, x: wp.float32) -> wp.vec3:
    """A colour with one channel."""
    return wp.vec3(wp.where(channel == 0, x, 0.0), wp.where(channel == 1, x, 0.0), wp.where(channel == 2, x, 0.0))

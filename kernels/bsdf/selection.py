"""One of two results of scattering functions, number by number: no branch in a loop over lanes (``lanes.py``)."""

import warp as wp

from warp_psdr.kernels.math import where3
from warp_psdr.kernels.structs import BsdfSample


@wp.func
def where_number(condition: wp.bool, a: wp.float32, b: wp.float32) -> wp.float32:
    return wp.where(condition, a, b)


@wp.func
def where_sample(condition: wp.bool, a: BsdfSample, b: BsdfSample) -> BsdfSample:
    """``a`` if the condition holds, else ``b``, member by member."""
    s = BsdfSample()
    s.wo = where3(condition, a.wo, b.wo)
    s.value = where3(condition, a.value, b.value)
    s.pdf = wp.where(condition, a.pdf, b.pdf)
    s.eta = wp.where(condition, a.eta, b.eta)
    s.lobe = wp.where(condition, a.lobe, b.lobe)
    return s

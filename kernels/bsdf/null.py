"""A surface that does not scatter (Mitsuba's ``null``): one null lobe of weight one.

Shells of media and helper shapes have this model. Light keeps its direction, and a path counts the crossing as a
vertex.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.model import Functions, Model
from warp_psdr.kernels.constants import LOBE_NULL
from warp_psdr.kernels.structs import BsdfSample, Scattered


@functools.cache
def make_null(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def null_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """The direction that goes straight on, and weight one."""
        return Scattered(-wi, wp.vec3(1.0, 1.0, 1.0))

    @wp.func
    def null_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Go straight on; ``u`` and ``v`` are not used."""
        s = BsdfSample()
        s.eta = 1.0
        s.wo = -wi
        s.value = wp.vec3(1.0, 1.0, 1.0)
        s.pdf = 1.0
        s.lobe = LOBE_NULL
        return s

    @wp.func
    def null_share(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        """There is no other lobe."""
        return 1.0

    return Functions(null_sample, scatter=null_scatter, probability=null_share)


NULL = Model("null", (), (LOBE_NULL,), make_null)

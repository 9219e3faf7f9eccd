"""Sampling of models whose smooth lobes lie on the side of the incoming direction, for any given draw."""

import warp as wp

from warp_psdr.kernels.bsdf.microfacet import MIN_COSINE, or_upright
from warp_psdr.kernels.constants import LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.structs import BsdfSample


def make_reflected_sample(record: type, draw: wp.Function, value: wp.Function, pdf: wp.Function) -> wp.Function:
    """Return ``sample(mat, wi, u, v) -> BsdfSample``; none in a direction without a density, as those below have it.

    Args:
        record: the struct of a scene's material values.
        draw: ``(mat, wi, u, v) -> vec3``: a direction, for ``wi`` above the surface.
        value: as ``Functions.eval``.
        pdf: as ``Functions.pdf``.
    """

    @wp.func
    def reflected_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        above = wi[2] > MIN_COSINE
        upright = or_upright(above, wi)
        wo = draw(mat, upright, u, v)
        s = BsdfSample()
        s.eta = 1.0
        s.wo = where3(above, wo, wp.vec3(0.0, 0.0, 0.0))
        s.pdf = wp.where(above, pdf(mat, upright, wo), 0.0)
        drawn = s.pdf > 0.0
        s.value = where3(drawn, value(mat, upright, wo), wp.vec3(0.0, 0.0, 0.0))
        s.lobe = wp.where(drawn, LOBE_SMOOTH, LOBE_NONE)
        return s

    return reflected_sample

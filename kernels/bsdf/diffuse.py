"""Lambertian reflection: f_s = reflectance / pi (Mitsuba's ``diffuse``)."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.model import Color, Functions, Model
from warp_psdr.kernels.constants import INV_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample


@wp.func
def diffuse_pdf(wi: wp.vec3, wo: wp.vec3) -> wp.float32:
    """Density of directions that are drawn proportional to their cosine, solid angle."""
    above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
    return wp.where(above, INV_PI * wo[2], 0.0)


@functools.cache
def make_diffuse(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def diffuse_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
        return where3(above, mat.reflectance * (INV_PI * wo[2]), wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def diffuse_pdf_of(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        return diffuse_pdf(wi, wo)

    @wp.func
    def diffuse_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Sample a direction proportional to its cosine; ``v`` is uniform in the unit square, ``u`` is not used."""
        s = BsdfSample()
        s.eta = 1.0
        s.wo = square_to_cosine_hemisphere(v)
        above = wi[2] > 0.0 and s.wo[2] > 0.0
        s.pdf = wp.where(above, INV_PI * s.wo[2], 0.0)
        s.value = where3(above, mat.reflectance * s.pdf, wp.vec3(0.0, 0.0, 0.0))
        s.lobe = wp.where(above, LOBE_SMOOTH, LOBE_NONE)
        return s

    return Functions(diffuse_sample, diffuse_eval, diffuse_pdf_of, branches=False)


DIFFUSE = Model("diffuse", (Color("reflectance", 0.5),), (LOBE_SMOOTH,), make_diffuse)

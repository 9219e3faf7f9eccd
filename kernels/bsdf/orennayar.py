"""Rough diffuse reflection by Oren and Nayar's qualitative model: V-shaped grooves of Lambertian facets.

sigma is the standard deviation of the facets' slope angle, radians. With A = 1 - sigma^2 / (2 (sigma^2 + 0.33)) and
B = 0.45 sigma^2 / (sigma^2 + 0.09) [Oren and Nayar 1994, eq. 30],

    f_s = reflectance / pi (A + B max(0, cos(phi_i - phi_o)) sin(alpha) tan(beta)),

alpha the greater and beta the lesser of the two angles from the normal. The sines and cosines of a pair of unit vectors
are (x_i x_o + y_i y_o) / max(cos(theta_i), cos(theta_o)): nothing is divided by a small number that stays.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.model import Color, Functions, Model, Number
from warp_psdr.kernels.constants import INV_PI, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.math import where3
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample

#: Greatest sigma, a right angle.
MAX_SIGMA = 1.5707963
#: Least cosine that is divided by; both directions lie in the surface there.
LEAST_COSINE = 1.0e-20


@functools.cache
def make_oren_nayar(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def oren_nayar_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s times the cosine of ``wo``, 1/sr."""
        above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
        # A tie of ``max`` leaves the derivative to its second argument: 1 at both ends of the range.
        sigma = wp.max(0.0, wp.min(MAX_SIGMA, mat.sigma))
        s2 = sigma * sigma
        a = 1.0 - s2 / (2.0 * (s2 + 0.33))
        b = 0.45 * s2 / (s2 + 0.09)
        across = wp.max(0.0, wi[0] * wo[0] + wi[1] * wo[1])
        # At most 1: the cosine of ``wo`` is taken in here.
        share = wo[2] / wp.max(LEAST_COSINE, wp.max(wi[2], wo[2]))
        return where3(above, (INV_PI * (a * wo[2] + b * across * share)) * mat.reflectance, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def oren_nayar_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the sampled directions, proportional to their cosine, solid angle."""
        return diffuse_pdf(wi, wo)

    @wp.func
    def oren_nayar_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Sample a direction proportional to its cosine; ``u`` is not used."""
        s = BsdfSample()
        s.eta = 1.0
        s.wo = square_to_cosine_hemisphere(v)
        above = wi[2] > 0.0 and s.wo[2] > 0.0
        s.pdf = wp.where(above, INV_PI * s.wo[2], 0.0)
        s.value = oren_nayar_eval(mat, wi, s.wo)
        s.lobe = wp.where(above, LOBE_SMOOTH, LOBE_NONE)
        return s

    return Functions(oren_nayar_sample, oren_nayar_eval, oren_nayar_pdf, branches=False)


OREN_NAYAR = Model(
    "orennayar",
    (Color("reflectance", 0.5), Number("sigma", 0.0, MAX_SIGMA, default=0.3)),
    (LOBE_SMOOTH,),
    make_oren_nayar,
)

"""A diffuse base under a smooth dielectric coat (Mitsuba's ``plastic``): a mirror reflection beside a smooth lobe.

With F the Fresnel reflectance of the coat, eta its index over that outside and F_dr the mean reflectance that light
from the base meets at the coat from below,

    f_s(wi, wo) = rho / (1 - rho F_dr) (1 - F(wi)) (1 - F(wo)) / (pi eta^2)        (nonlinear; else 1 - F_dr),

and the mirror reflection weighs specular_reflectance F(wi). F_dr is a fit in eta, Mitsuba's: d'Eon and Irving above 1,
Egan and Hilgeman below.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.diffuse import diffuse_pdf
from warp_psdr.kernels.bsdf.model import Color, Flag, Functions, Model, RelativeIndex
from warp_psdr.kernels.constants import INV_PI, LOBE_DELTA_REFLECTION, LOBE_NONE, LOBE_SMOOTH
from warp_psdr.kernels.fresnel import coat_reflectance, coat_transmittance
from warp_psdr.kernels.math import reflect_local, where3, where_number
from warp_psdr.kernels.sampling import square_to_cosine_hemisphere
from warp_psdr.kernels.structs import BsdfSample, Scattered

#: Ratios of indices for which the fit of F_dr keeps the base below 1 (by 2e-3 above 1.9, by 3e-2 above 2.4); beyond 3.8
#: it is no reflectance at all.
MIN_IOR, MAX_IOR = 0.5, 3.0
#: Least share of either lobe where a reflectance is 0: the lobe is still drawn, since its derivative is not 0.
MIN_SHARE = 0.02


@wp.func
def diffuse_fresnel(eta: wp.float32) -> wp.float32:
    """Mean reflectance of a smooth interface for diffuse light; ``eta``: the index behind it over that in front."""
    x = 1.0 / eta
    below = 0.0636 * x + eta * (eta * -1.4399 + 0.7099) + 0.6681
    above = 0.919317 + x * (-3.4793 + x * (6.75335 + x * (-7.80989 + x * (4.98554 + x * -1.36881))))
    return where_number(eta < 1.0, below, above)


@wp.func
def share_of_coat(specular: wp.vec3, diffuse: wp.vec3, reflectance: wp.float32) -> wp.float32:
    """Probability of the coat's lobe, whose share of the light is ``reflectance``, beside that of the base."""
    s = specular[0] + specular[1] + specular[2]
    d = diffuse[0] + diffuse[1] + diffuse[2]
    some = d + s > 0.0
    weight = where_number(some, wp.clamp(s / where_number(some, d + s, 1.0), MIN_SHARE, 1.0 - MIN_SHARE), 0.5)
    coat = reflectance * weight
    return coat / (coat + (1.0 - reflectance) * (1.0 - weight))


@functools.cache
def make_plastic(record: type, variant: str) -> Functions:
    """Return the model's functions; ``variant`` "nonlinear": light that meets the base again is tinted again."""
    nonlinear = variant == "nonlinear"

    @wp.func
    def specular_share(mat: record, wi: wp.vec3) -> wp.float32:
        """Probability of the mirror reflection."""
        c = where_number(wi[2] > 0.0, wi[2], 1.0)
        return share_of_coat(mat.specular_reflectance, mat.diffuse_reflectance, coat_reflectance(c, mat.ior))

    @wp.func
    def plastic_eval(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.vec3:
        """f_s of the base times the cosine of ``wo``, 1/sr."""
        above = not (wi[2] <= 0.0 or wo[2] <= 0.0)
        i = where_number(above, wi[2], 1.0)
        o = where_number(above, wo[2], 1.0)
        inside = diffuse_fresnel(1.0 / mat.ior)
        rho = mat.diffuse_reflectance
        through = coat_transmittance(i, mat.ior) * coat_transmittance(o, mat.ior) / (mat.ior * mat.ior)
        scale = INV_PI * o * through
        if wp.static(nonlinear):
            base = scale * wp.vec3(
                rho[0] / (1.0 - rho[0] * inside), rho[1] / (1.0 - rho[1] * inside), rho[2] / (1.0 - rho[2] * inside)
            )
        else:
            base = (scale / (1.0 - inside)) * rho
        return where3(above, base, wp.vec3(0.0, 0.0, 0.0))

    @wp.func
    def plastic_pdf(mat: record, wi: wp.vec3, wo: wp.vec3) -> wp.float32:
        """Density of the base's directions, solid angle."""
        return (1.0 - specular_share(mat, wi)) * diffuse_pdf(wi, wo)

    @wp.func
    def plastic_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Mirror direction and its weight; differentiable."""
        above = wi[2] > 0.0
        value = coat_reflectance(where_number(above, wi[2], 1.0), mat.ior) * mat.specular_reflectance
        return Scattered(reflect_local(wi), where3(above, value, wp.vec3(0.0, 0.0, 0.0)))

    @wp.func
    def plastic_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Choose the mirror reflection or the base by ``u``, and a direction of the latter by ``v``."""
        share = specular_share(mat, wi)
        coat = u < share
        mirror = plastic_scatter(mat, wi, LOBE_DELTA_REFLECTION)
        s = BsdfSample()
        s.eta = 1.0
        s.wo = where3(coat, mirror.wo, square_to_cosine_hemisphere(v))
        s.pdf = where_number(coat, share, plastic_pdf(mat, wi, s.wo))
        s.pdf = where_number(wi[2] > 0.0, s.pdf, 0.0)
        drawn = s.pdf > 0.0
        s.value = where3(drawn, where3(coat, mirror.value, plastic_eval(mat, wi, s.wo)), wp.vec3(0.0, 0.0, 0.0))
        s.lobe = wp.where(drawn, wp.where(coat, LOBE_DELTA_REFLECTION, LOBE_SMOOTH), LOBE_NONE)
        return s

    @wp.func
    def plastic_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        share = wp.float32(0.0)
        if wi[2] > 0.0:
            share = specular_share(mat, wi)
        return share

    return Functions(plastic_sample, plastic_eval, plastic_pdf, plastic_scatter, plastic_probability, branches=False)


PLASTIC = Model(
    "plastic",
    (
        Color("diffuse_reflectance", 0.5),
        Color("specular_reflectance"),
        RelativeIndex("polypropylene", low=MIN_IOR, high=MAX_IOR),
        Flag("nonlinear"),
    ),
    (LOBE_SMOOTH, LOBE_DELTA_REFLECTION),
    make_plastic,
)

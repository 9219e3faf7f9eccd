"""A smooth interface between two transparent media (Mitsuba's ``dielectric``): two delta lobes.

``ior`` is the index inside (z < 0) over the one outside. Radiance that crosses into the medium with index n1 from the
one with n2 is scaled by (n1 / n2)^2, since its solid angle changes [Veach 1997, section 5.2].
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.model import Color, Functions, Model, RelativeIndex
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION
from warp_psdr.kernels.fresnel import fresnel_dielectric, index_behind, refracted_cosine
from warp_psdr.kernels.math import reflect_local, refract_local
from warp_psdr.kernels.structs import BsdfSample, Scattered


@functools.cache
def make_dielectric(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def relative_eta(mat: record, wi: wp.vec3) -> wp.float32:
        """Index on the other side of the interface over the one on the side of ``wi``."""
        return index_behind(mat.ior, wi[2])

    @wp.func
    def dielectric_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Direction and weight of the reflected or the transmitted lobe; differentiable.

        Under total internal reflection the transmitted direction lies in the surface and its weight is 0.
        """
        eta = relative_eta(mat, wi)
        c = wp.abs(wi[2])
        g = refracted_cosine(c, eta)
        wo = reflect_local(wi)
        reflectance = fresnel_dielectric(c, g, eta)
        value = mat.specular_reflectance * reflectance
        if lobe == LOBE_DELTA_TRANSMISSION:
            wo = refract_local(wi, g, eta)
            value = mat.specular_transmittance * ((1.0 - reflectance) / (eta * eta))
        return Scattered(wo, value)

    @wp.func
    def dielectric_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect with the Fresnel reflectance as probability, else refract; ``v`` is not used."""
        s = BsdfSample()
        eta = relative_eta(mat, wi)
        c = wp.abs(wi[2])
        g = refracted_cosine(c, eta)
        reflectance = fresnel_dielectric(c, g, eta)
        if u < reflectance:
            s.eta = 1.0
            s.wo = reflect_local(wi)
            s.value = mat.specular_reflectance * reflectance
            s.pdf = reflectance
            s.lobe = LOBE_DELTA_REFLECTION
        else:
            s.eta = eta
            s.wo = refract_local(wi, g, eta)
            s.value = mat.specular_transmittance * ((1.0 - reflectance) / (eta * eta))
            s.pdf = 1.0 - reflectance
            s.lobe = LOBE_DELTA_TRANSMISSION
        return s

    @wp.func
    def dielectric_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        eta = relative_eta(mat, wi)
        c = wp.abs(wi[2])
        reflectance = fresnel_dielectric(c, refracted_cosine(c, eta), eta)
        return wp.where(lobe == LOBE_DELTA_REFLECTION, reflectance, 1.0 - reflectance)

    return Functions(
        dielectric_sample,
        scatter=dielectric_scatter,
        probability=dielectric_probability,
        relative_eta=relative_eta,
    )


DIELECTRIC = Model(
    "dielectric",
    (Color("specular_reflectance"), Color("specular_transmittance"), RelativeIndex("bk7")),
    (LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION),
    make_dielectric,
    turned_by=("ior",),
)

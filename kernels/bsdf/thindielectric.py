"""A thin plate of a dielectric (Mitsuba's ``thindielectric``): a mirror reflection and a null lobe.

Light that enters the plate is reflected to and fro between its two parallel interfaces, and leaves on both sides
without a change of direction. With R the Fresnel reflectance of one interface, and nothing absorbed, the plate reflects

    R' = R + (1 - R)^2 R (1 + R^2 + R^4 + ...) = 2 R / (1 + R)

and lets 1 - R' = (1 - R) / (1 + R) pass. Both sides are alike. Radiance is not scaled, because it ends in the medium it
came from.

Derivation: ``docs/theory/materials.md#thin-plates``.
"""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.model import Color, Functions, Model, RelativeIndex
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_NULL
from warp_psdr.kernels.fresnel import coat_reflectance, coat_transmittance
from warp_psdr.kernels.math import reflect_local
from warp_psdr.kernels.structs import BsdfSample, Scattered


@functools.cache
def make_thindielectric(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def plate_reflectance(mat: record, wi: wp.vec3) -> wp.float32:
        """R' at the angle of ``wi``."""
        reflectance = coat_reflectance(wp.abs(wi[2]), mat.ior)
        return 2.0 * reflectance / (1.0 + reflectance)

    @wp.func
    def plate_transmittance(mat: record, wi: wp.vec3) -> wp.float32:
        """1 - R', without the difference."""
        c = wp.abs(wi[2])
        return coat_transmittance(c, mat.ior) / (1.0 + coat_reflectance(c, mat.ior))

    @wp.func
    def thindielectric_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Direction and weight of the reflected or of the null lobe; differentiable."""
        wo = reflect_local(wi)
        value = plate_reflectance(mat, wi) * mat.specular_reflectance
        if lobe == LOBE_NULL:
            wo = -wi
            value = plate_transmittance(mat, wi) * mat.specular_transmittance
        return Scattered(wo, value)

    @wp.func
    def thindielectric_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """Reflect with R' as probability, else go straight on; ``v`` is not used."""
        s = BsdfSample()
        s.eta = 1.0
        reflectance = plate_reflectance(mat, wi)
        transmittance = plate_transmittance(mat, wi)
        if u < reflectance:
            s.lobe = LOBE_DELTA_REFLECTION
            s.pdf = reflectance
            s.wo = reflect_local(wi)
            s.value = reflectance * mat.specular_reflectance
        elif transmittance > 0.0:
            s.lobe = LOBE_NULL
            s.pdf = transmittance
            s.wo = -wi
            s.value = transmittance * mat.specular_transmittance
        return s

    @wp.func
    def plate_share(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        """Probability of a lobe."""
        return wp.where(lobe == LOBE_NULL, plate_transmittance(mat, wi), plate_reflectance(mat, wi))

    return Functions(thindielectric_sample, scatter=thindielectric_scatter, probability=plate_share)


THIN_DIELECTRIC = Model(
    "thindielectric",
    (Color("specular_reflectance"), Color("specular_transmittance"), RelativeIndex("bk7")),
    (LOBE_DELTA_REFLECTION, LOBE_NULL),
    make_thindielectric,
)

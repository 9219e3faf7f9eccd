"""A smooth mirror of metal (Mitsuba's ``conductor``): a delta lobe weighted with the Fresnel reflectance."""

import functools

import warp as wp

from warp_psdr.kernels.bsdf.model import Color, ComplexIndex, Functions, Model
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_NONE
from warp_psdr.kernels.fresnel import fresnel_conductor_rgb
from warp_psdr.kernels.math import reflect_local
from warp_psdr.kernels.structs import BsdfSample, Scattered


@functools.cache
def make_conductor(record: type, _variant: str) -> Functions:
    """Return the model's functions."""

    @wp.func
    def conductor_scatter(mat: record, wi: wp.vec3, lobe: wp.int32) -> Scattered:
        """Mirror direction and its weight; differentiable."""
        value = wp.vec3(0.0, 0.0, 0.0)
        if wi[2] > 0.0:
            value = wp.cw_mul(mat.specular_reflectance, fresnel_conductor_rgb(wi[2], mat.eta, mat.k))
        return Scattered(reflect_local(wi), value)

    @wp.func
    def conductor_sample(mat: record, wi: wp.vec3, u: wp.float32, v: wp.vec2) -> BsdfSample:
        """The mirror direction, with probability one; ``u`` and ``v`` are not used."""
        s = BsdfSample()
        s.eta = 1.0
        s.lobe = LOBE_NONE
        if wi[2] > 0.0:
            scattered = conductor_scatter(mat, wi, LOBE_DELTA_REFLECTION)
            s.wo = scattered.wo
            s.value = scattered.value
            s.pdf = 1.0
            s.lobe = LOBE_DELTA_REFLECTION
        return s

    @wp.func
    def conductor_probability(mat: record, wi: wp.vec3, lobe: wp.int32) -> wp.float32:
        return wp.where(wi[2] > 0.0, 1.0, 0.0)

    return Functions(conductor_sample, scatter=conductor_scatter, probability=conductor_probability)


CONDUCTOR = Model(
    "conductor", (Color("specular_reflectance"), ComplexIndex()), (LOBE_DELTA_REFLECTION,), make_conductor
)

"""Configurations of path kernels for tests that load no scene."""

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import models_of
from warp_psdr.kernels.bsdf.record import merge_values, slot_of
from warp_psdr.kernels.vertex import PathConfig


def materials(*models, kinds=(c.TEXTURE_CONSTANT,)):
    """What is compiled for scattering models, whose values are held by these kinds of textures; keys of a config."""
    values = merge_values(models_of(models))
    return {"bsdfs": models, "material": tuple(slot_of(value, kinds) for value in values)}


#: Diffuse walls under an area light.
SIMPLE = PathConfig(
    **materials("diffuse"),
    two_sided=False,
    smooth=False,
    flat=True,
    uv=False,
    tangent=False,
    area=(c.TEXTURE_CONSTANT,),
    lights=(),
    one_light=True,
    scatter=True,
    hide_emitters=False,
    sampler="sobol",
    filter=c.RFILTER_BOX,
    ray_backend="warp",
    ray_width=1,
)

"""Configurations of path kernels for tests that load no scene."""

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import VARIANTS, models_of
from warp_psdr.kernels.bsdf.record import merge_values, slot_of
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.vertex import PathConfig


def materials(*models, kinds=(c.TEXTURE_CONSTANT,)):
    """What is compiled for scattering models, whose values are held by these kinds of textures; keys of a config."""
    values = merge_values(models_of(models))
    return {"bsdfs": models, "material": tuple(slot_of(value, kinds) for value in values)}


def joined(connections, *configs):
    """The same with bidirectional paths."""
    return [PathConfig(**{**vars(config), "connections": connections, "most_vertices": 4}) for config in configs]


def wanted(config, *names, **others):
    """Derivatives by named values of the materials, and others."""
    return GradientRequest(material=tuple(slot.name in names for slot in config.material), **others)


def everything(config, **others):
    """Derivatives by all values of the materials, and others."""
    return wanted(config, *(slot.name for slot in config.material), **others)


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

TEXTURES = (c.TEXTURE_CONSTANT, c.TEXTURE_BITMAP, c.TEXTURE_VERTEX, c.TEXTURE_FACE, c.TEXTURE_CHECKERBOARD)
LIGHTS = (
    c.EMITTER_ENVMAP,
    c.EMITTER_POINT,
    c.EMITTER_SPOT,
    c.EMITTER_DIRECTIONAL,
    c.EMITTER_PROJECTOR,
    c.EMITTER_DIRECTIONAL_AREA,
)
#: All models, all texture kinds in every slot, all lights, smooth and flat shapes, anisotropy.
EVERYTHING = PathConfig(
    **materials(*VARIANTS, kinds=TEXTURES),
    two_sided=True,
    smooth=True,
    flat=True,
    uv=True,
    tangent=True,
    area=TEXTURES,
    lights=LIGHTS,
    one_light=False,
    scatter=True,
    hide_emitters=True,
    hidden=True,
    sampler="sobol",
    filter=c.RFILTER_GAUSSIAN,
    ray_backend="warp",
    ray_width=1,
)
#: What EVERYTHING excludes: the other light at infinity, the other sampler and filter, smooth shapes alone.
OTHERS = PathConfig(
    **materials("roughconductor (beckmann)"),
    two_sided=False,
    smooth=True,
    flat=False,
    uv=False,
    tangent=True,
    area=(),
    lights=(c.EMITTER_CONSTANT,),
    one_light=True,
    scatter=True,
    hide_emitters=False,
    sampler="independent",
    filter=c.RFILTER_TENT,
    ray_backend="warp",
    ray_width=1,
)

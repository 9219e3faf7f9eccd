"""Configurations of path kernels for tests that load no scene."""

from dataclasses import replace

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import VARIANTS, models_of
from warp_psdr.kernels.bsdf.record import merge_values, slot_of
from warp_psdr.kernels.interior.factors.gradient_request import GradientRequest
from warp_psdr.kernels.vertex import LightConfig, PathConfig, RayConfig, SurfaceConfig


def materials(*models, kinds=(c.TEXTURE_CONSTANT,)):
    """What is compiled for scattering models, whose values are held by these kinds of textures; keys of a config."""
    values = merge_values(models_of(models))
    return {"bsdfs": models, "material": tuple(slot_of(value, kinds) for value in values)}


def changed(config, **fields):
    """The same with other fields, those of its groups by their own names."""
    for group in ("surfaces", "lights", "rays"):
        held = getattr(config, group)
        own = {name: fields.pop(name) for name in vars(held) if name in fields}
        config = replace(config, **{group: replace(held, **own)})
    return replace(config, **fields)


def joined(connections, *configs):
    """The same with bidirectional paths."""
    return [changed(config, connections=connections, most_vertices=4) for config in configs]


def wanted(config, *names, **others):
    """Derivatives by named values of the materials, and others."""
    return GradientRequest(material=tuple(slot.name in names for slot in config.surfaces.material), **others)


def everything(config, **others):
    """Derivatives by all values of the materials, and others."""
    return wanted(config, *(slot.name for slot in config.surfaces.material), **others)


#: Diffuse walls under an area light.
SIMPLE = PathConfig(
    surfaces=SurfaceConfig(**materials("diffuse"), two_sided=False, smooth=False, flat=True, uv=False, tangent=False),
    lights=LightConfig(area=(c.TEXTURE_CONSTANT,), others=(), one_light=True, hide_emitters=False),
    rays=RayConfig("warp", 1),
    scatter=True,
    sampler="sobol",
    filter=c.RFILTER_BOX,
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
EVERYTHING = changed(
    SIMPLE,
    **materials(*VARIANTS, kinds=TEXTURES),
    two_sided=True,
    smooth=True,
    uv=True,
    tangent=True,
    area=TEXTURES,
    others=LIGHTS,
    one_light=False,
    hide_emitters=True,
    hidden=True,
    filter=c.RFILTER_GAUSSIAN,
)
#: What EVERYTHING excludes: the other light at infinity, the other sampler and filter, smooth shapes alone.
OTHERS = changed(
    SIMPLE,
    **materials("roughconductor (beckmann)"),
    smooth=True,
    flat=False,
    tangent=True,
    area=(),
    others=(c.EMITTER_CONSTANT,),
    sampler="independent",
    filter=c.RFILTER_TENT,
)

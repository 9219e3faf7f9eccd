"""Configurations of kernels that are compiled for CUDA (``test_cuda_compile.py``)."""

from dataclasses import replace

from tests.config_helpers import LIGHTS, SIMPLE, TEXTURES, joined, materials, wanted
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import VARIANTS
from warp_psdr.kernels.primitive import table as K
from warp_psdr.kernels.sensor.time_gate import PULSE_BOX, PULSE_GAUSSIAN
from warp_psdr.kernels.vertex import MediaConfig, PathConfig

EMISSION = PathConfig(**{**vars(SIMPLE), "scatter": False, "material": ()})
SPLAT = PathConfig(**{**vars(SIMPLE), "filter": c.RFILTER_TENT})
SPLAT_GAUSSIAN = PathConfig(**{**vars(SIMPLE), "filter": c.RFILTER_GAUSSIAN})
# The compiler needs over ten minutes for the derivatives of EVERYTHING at once; in these thirds, seconds each.
MATERIALS = PathConfig(
    **{
        **vars(SIMPLE),
        **materials(*VARIANTS),
        "two_sided": True,
        "smooth": True,
        "tangent": True,
    }
)
TEXTURED = PathConfig(
    **{
        **vars(SIMPLE),
        **materials("diffuse", kinds=(*TEXTURES, c.TEXTURE_GRID, c.TEXTURE_SCALED)),
        "area": (*TEXTURES, c.TEXTURE_SCALED),
        "uv": True,
        "smooth": True,
        "flat": False,
        "hide_emitters": True,
        "hidden": True,
    }
)
ALL_LIGHTS = PathConfig(**{**vars(SIMPLE), "lights": LIGHTS, "one_light": False, "filter": c.RFILTER_GAUSSIAN})
ORTHOGRAPHIC = PathConfig(**{**vars(SIMPLE), "camera": c.CAMERA_ORTHOGRAPHIC})
SHOWN_DEPTH, SHOWN_NORMAL = (PathConfig(**{**vars(SIMPLE), "shown": aov}) for aov in ("depth", "sh_normal"))
IRRADIANCE = PathConfig(**{**vars(SIMPLE), "camera": c.CAMERA_IRRADIANCEMETER})
THIN_LENS = PathConfig(**{**vars(SIMPLE), "camera": c.CAMERA_THINLENS})
THIN_LENS_SMOOTH = PathConfig(**{**vars(THIN_LENS), "smooth": True})
ORTHOGRAPHIC_SMOOTH = PathConfig(**{**vars(ORTHOGRAPHIC), "smooth": True})
GLOSSY = PathConfig(**{**vars(SIMPLE), **materials("roughconductor (ggx)", "blendbsdf(diffuse, conductor)")})
MIRROR_LIGHTS = PathConfig(
    **{
        **vars(SIMPLE),
        **materials("diffuse", "conductor"),
        "lights": LIGHTS,
        "one_light": False,
    }
)
CAUSTICS = PathConfig(**{**vars(MIRROR_LIGHTS), "caustics": True})
#: Shapes without triangles beside those with.
KINDS = (K.SPHERE.number, K.DISK.number, K.CYLINDER.number)
EXACT = PathConfig(**{**vars(SIMPLE), "uv": True, "tangent": True, "primitives": KINDS, "shining": KINDS})
#: A sphere beside triangles, whose silhouettes rays move with.
SPHERE = PathConfig(**{**vars(SIMPLE), "primitives": (K.SPHERE.number,)})
SPLINE = PathConfig(**{**vars(SIMPLE), "primitives": (K.CUBIC_GRID.number,)})
EXACT_MIRRORS = PathConfig(**{**vars(MIRROR_LIGHTS), "primitives": KINDS})
NETWORK = PathConfig(**{**vars(SIMPLE), "primitives": (K.NETWORK.number,)})
EXACT_LIGHTS = PathConfig(**{**vars(ALL_LIGHTS), "primitives": (K.SPHERE.number,)})
DISTANCES = PathConfig(**{**vars(SIMPLE), "tangent": True, "primitives": (K.SPHERE.number, K.LINEAR_GRID.number)})
DISTANCES_LIGHTS = PathConfig(**{**vars(ALL_LIGHTS), "primitives": (K.LINEAR_GRID.number,)})
CUBIC = PathConfig(**{**vars(SIMPLE), "primitives": (K.CUBIC_GRID.number, K.NETWORK.number)})
FLOW = PathConfig(**{**vars(CUBIC), "primitives": (*CUBIC.primitives, c.NORMAL_FLOW)})
CURVES = PathConfig(**{**vars(SIMPLE), "tangent": True, "primitives": (K.CONES.number, K.TUBES.number)})
#: Grids and curves, and networks, that mirrors show.
SLIDING = (K.LINEAR_GRID.number, K.CUBIC_GRID.number, *CURVES.primitives)
SLIDING_MIRRORS = PathConfig(**{**vars(MIRROR_LIGHTS), "primitives": SLIDING})
NEURAL_MIRRORS = PathConfig(**{**vars(MIRROR_LIGHTS), "primitives": CUBIC.primitives})
MIRRORS = PathConfig(**{**vars(SIMPLE), **materials("conductor", "dielectric")})
MIRRORS_PARALLEL = PathConfig(**{**vars(MIRRORS), "camera": c.CAMERA_ORTHOGRAPHIC})
MIRRORS_LENS = PathConfig(**{**vars(MIRRORS), "camera": c.CAMERA_THINLENS})
#: Light passes masks and thin glass.
THROUGH = PathConfig(
    **{
        **vars(SIMPLE),
        **materials("diffuse", "thindielectric", "mask(plastic) (explored)"),
        "lights": (c.EMITTER_CONSTANT, c.EMITTER_POINT),
        "one_light": False,
        "through": True,
    }
)
#: Bidirectional paths, joined to the camera alone, and to its paths.
LIT_GLASS = PathConfig(**{**vars(ALL_LIGHTS), **materials("diffuse", "dielectric")})
JOINED, JOINED_LIGHTS, JOINED_THROUGH = joined("light", SIMPLE, LIT_GLASS, THROUGH)
CONNECTED, CONNECTED_LIGHTS, CONNECTED_THROUGH = joined("all", SIMPLE, LIT_GLASS, THROUGH)
#: Media behind surfaces that are not there.
MEDIA = PathConfig(
    **{
        **vars(THROUGH),
        **materials("diffuse", "null"),
        "media": MediaConfig((c.PHASE_ISOTROPIC, c.PHASE_HG), True),
    }
)
#: The same with grids.
GRIDS = PathConfig(
    **{
        **vars(MEDIA),
        "media": MediaConfig(
            (c.PHASE_ISOTROPIC, c.PHASE_HG, c.PHASE_RAYLEIGH, c.PHASE_TABLE, c.PHASE_BLEND, c.PHASE_BLEND_GRID),
            True,
            True,
        ),
    }
)
#: Grids that emit light, beside microflakes.
GLOWING = PathConfig(**{**vars(GRIDS), "media": MediaConfig((c.PHASE_HG, c.PHASE_SGGX), True, True, True)})
#: Microflakes of grids and of one matrix, in grids that emit light.
FLAKY = PathConfig(**{**vars(GRIDS), "media": MediaConfig((c.PHASE_SGGX, c.PHASE_SGGX_GRID), True, True, True)})
#: What is traced again for ``psdr.trace_sample``.
NOTED = PathConfig(**{**vars(SIMPLE), "noted": True})
NOTED_MATERIALS = PathConfig(**{**vars(MATERIALS), "noted": True})
ALBEDO = wanted(SIMPLE, "reflectance")
#: Before a transient film.
TIMED = PathConfig(
    **{**vars(SIMPLE), "lights": (c.EMITTER_POINT, c.EMITTER_SPOT), "one_light": False, "pulse": PULSE_BOX}
)
TIMED_GAUSSIAN = replace(TIMED, pulse=PULSE_GAUSSIAN)
GEOMETRY = wanted(SIMPLE, "reflectance", shapes=True)
MAPPED = PathConfig(**{**vars(SIMPLE), **materials("normalmap(roughconductor (ggx))"), "tangent": True})

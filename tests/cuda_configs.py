"""Configurations of kernels that are compiled for CUDA (``test_cuda_compile.py``)."""

from dataclasses import replace

from tests.config_helpers import LIGHTS, SIMPLE, TEXTURES, changed, everything, joined, materials, wanted
from warp_psdr.kernels import constants as c
from warp_psdr.kernels.bsdf.dispatch import VARIANTS
from warp_psdr.kernels.primitive import table as K
from warp_psdr.kernels.sensor.time_gate import PULSE_BOX, PULSE_GAUSSIAN
from warp_psdr.kernels.vertex import MediaConfig

EMISSION = changed(SIMPLE, scatter=False, material=())
SPLAT = changed(SIMPLE, filter=c.RFILTER_TENT)
SPLAT_GAUSSIAN = changed(SIMPLE, filter=c.RFILTER_GAUSSIAN)
# The compiler needs over ten minutes for the derivatives of EVERYTHING at once; in these thirds, seconds each.
MATERIALS = changed(SIMPLE, **materials(*VARIANTS), two_sided=True, smooth=True, tangent=True)
TEXTURED = changed(
    SIMPLE,
    **materials("diffuse", kinds=(*TEXTURES, c.TEXTURE_GRID, c.TEXTURE_SCALED)),
    area=(*TEXTURES, c.TEXTURE_SCALED),
    uv=True,
    smooth=True,
    flat=False,
    hide_emitters=True,
    hidden=True,
)
STEPPED = changed(TEXTURED, steps=True)
ALL_LIGHTS = changed(SIMPLE, others=LIGHTS, one_light=False, filter=c.RFILTER_GAUSSIAN)
ORTHOGRAPHIC = changed(SIMPLE, camera=c.CAMERA_ORTHOGRAPHIC)
SHOWN_DEPTH, SHOWN_NORMAL = (changed(SIMPLE, shown=aov) for aov in ("depth", "sh_normal"))
IRRADIANCE = changed(SIMPLE, camera=c.CAMERA_IRRADIANCEMETER)
THIN_LENS = changed(SIMPLE, camera=c.CAMERA_THINLENS)
CAMERAS = {
    "orthographic": ORTHOGRAPHIC,
    "thin lens": THIN_LENS,
    "distortion": changed(SIMPLE, camera=c.CAMERA_PERSPECTIVE_OPENCV),
    "distortion, thin lens": changed(SIMPLE, camera=c.CAMERA_THINLENS_OPENCV),
    "fisheye": changed(SIMPLE, camera=c.CAMERA_PERSPECTIVE_FISHEYE),
    "fisheye, thin lens": changed(SIMPLE, camera=c.CAMERA_THINLENS_FISHEYE),
}
THIN_LENS_SMOOTH = changed(THIN_LENS, smooth=True)
ORTHOGRAPHIC_SMOOTH = changed(ORTHOGRAPHIC, smooth=True)
GLOSSY = changed(SIMPLE, **materials("roughconductor (ggx)", "blendbsdf(diffuse, conductor)"))
MIRROR_LIGHTS = changed(SIMPLE, **materials("diffuse", "conductor"), others=LIGHTS, one_light=False)
CAUSTICS = changed(MIRROR_LIGHTS, caustics=True)
#: Shapes without triangles beside those with.
KINDS = (K.SPHERE.number, K.DISK.number, K.CYLINDER.number)
EXACT = changed(SIMPLE, uv=True, tangent=True, primitives=KINDS, shining=KINDS)
#: A sphere beside triangles, whose silhouettes rays move with.
SPHERE = changed(SIMPLE, primitives=(K.SPHERE.number,))
SPLINE = changed(SIMPLE, primitives=(K.CUBIC_GRID.number,))
EXACT_MIRRORS = changed(MIRROR_LIGHTS, primitives=KINDS)
NETWORK = changed(SIMPLE, primitives=(K.NETWORK.number,))
EXACT_LIGHTS = changed(ALL_LIGHTS, primitives=(K.SPHERE.number,))
DISTANCES = changed(SIMPLE, tangent=True, primitives=(K.SPHERE.number, K.LINEAR_GRID.number))
DISTANCES_LIGHTS = changed(ALL_LIGHTS, primitives=(K.LINEAR_GRID.number,))
CUBIC = changed(SIMPLE, primitives=(K.CUBIC_GRID.number, K.NETWORK.number))
FLOW = changed(CUBIC, primitives=(*CUBIC.surfaces.primitives, c.NORMAL_FLOW))
CURVES = changed(SIMPLE, tangent=True, primitives=(K.CONES.number, K.TUBES.number))
#: Grids and curves, and networks, that mirrors show.
SLIDING = (K.LINEAR_GRID.number, K.CUBIC_GRID.number, *CURVES.surfaces.primitives)
SLIDING_MIRRORS = changed(MIRROR_LIGHTS, primitives=SLIDING)
NEURAL_MIRRORS = changed(MIRROR_LIGHTS, primitives=CUBIC.surfaces.primitives)
MIRRORS = changed(SIMPLE, **materials("conductor", "dielectric"))
MIRRORS_PARALLEL = changed(MIRRORS, camera=c.CAMERA_ORTHOGRAPHIC)
MIRRORS_LENS = changed(MIRRORS, camera=c.CAMERA_THINLENS)
MIRRORS_DISTORTED = changed(MIRRORS, camera=c.CAMERA_THINLENS_OPENCV)
MIRRORS_DISTORTED = changed(MIRRORS, camera=c.CAMERA_THINLENS_OPENCV)
#: Light passes masks and thin glass.
THROUGH = changed(
    SIMPLE,
    **materials("diffuse", "thindielectric", "mask(plastic) (explored)"),
    others=(c.EMITTER_CONSTANT, c.EMITTER_POINT),
    one_light=False,
    through=True,
)
#: Only that of lights of no area does, while vertices move.
POINTS_PASS = replace(THROUGH, through=False, points_pass=True)
#: Bidirectional paths, joined to the camera alone, and to its paths.
LIT_GLASS = changed(ALL_LIGHTS, **materials("diffuse", "dielectric"))
JOINED, JOINED_LIGHTS, JOINED_THROUGH = joined("light", SIMPLE, LIT_GLASS, THROUGH)
CONNECTED, CONNECTED_LIGHTS, CONNECTED_THROUGH = joined("all", SIMPLE, LIT_GLASS, THROUGH)
#: Media behind surfaces that are not there.
MEDIA = changed(THROUGH, **materials("diffuse", "null"), media=MediaConfig((c.PHASE_ISOTROPIC, c.PHASE_HG), True))
#: The same with grids.
EXACT_MEDIA = changed(MEDIA, primitives=KINDS, shining=KINDS)
GRIDS = changed(
    MEDIA,
    media=MediaConfig(
        (c.PHASE_ISOTROPIC, c.PHASE_HG, c.PHASE_RAYLEIGH, c.PHASE_TABLE, c.PHASE_BLEND, c.PHASE_BLEND_GRID),
        True,
        True,
    ),
)
#: Mirrors, glass and masks beside media, and in grids.
MEDIA_MIRRORS = changed(MEDIA, **materials("dielectric", "diffuse", "mask(diffuse)", "null"), others=(), through=False)
GRID_MIRRORS = changed(MEDIA_MIRRORS, media=GRIDS.media)
#: Grids that emit light, beside microflakes.
GLOWING = changed(GRIDS, media=MediaConfig((c.PHASE_HG, c.PHASE_SGGX), True, True, True))
#: Microflakes of grids and of one matrix, in grids that emit light.
FLAKY = changed(GRIDS, media=MediaConfig((c.PHASE_SGGX, c.PHASE_SGGX_GRID), True, True, True))
#: What is traced again for ``psdr.trace_sample``.
NOTED = changed(SIMPLE, noted=True)
NOTED_MATERIALS = changed(MATERIALS, noted=True)
ALBEDO = wanted(SIMPLE, "reflectance")
#: Before a transient film.
TIMED = changed(SIMPLE, others=(c.EMITTER_POINT, c.EMITTER_SPOT), one_light=False, pulse=PULSE_BOX)
TIMED_GAUSSIAN = replace(TIMED, pulse=PULSE_GAUSSIAN)
GEOMETRY = wanted(SIMPLE, "reflectance", shapes=True)
MAPPED = changed(SIMPLE, **materials("normalmap(roughconductor (ggx))"), tangent=True)


def all_of(config):
    return everything(
        config,
        to_uv=True,
        shapes=True,
        texcoords=True,
        radiance=True,
        lights=("radiance", "pose"),
        camera=True,
        bends=True,
    )


def still(config):
    """Textbook replay takes no moving vertices behind delta lobes."""
    return everything(config, radiance=True, lights=("radiance", "pose"))


def media(config):
    """All of media, and what does not move beside them."""
    everywhere = ("sigma_t", "albedo", "scale", "emission", "phase")
    return everything(config, to_uv=True, radiance=True, lights=("radiance",), media=everywhere)


def moving_among_media(config):
    return wanted(config, shapes=True, texcoords=True, lights=("pose",), camera=True)

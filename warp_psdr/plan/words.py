"""The plan's names for kinds of lights, cameras and textures."""

from __future__ import annotations

from warp_psdr.kernels import constants as c

EMITTER_NAMES = {
    c.EMITTER_AREA: "area",
    c.EMITTER_DIRECTIONAL_AREA: "directionalarea",
    c.EMITTER_CONSTANT: "constant",
    c.EMITTER_ENVMAP: "envmap",
    c.EMITTER_POINT: "point",
    c.EMITTER_SPOT: "spot",
    c.EMITTER_TEXTURED_SPOT: "spot with a texture",
    c.EMITTER_PROJECTOR: "projector",
    c.EMITTER_DIRECTIONAL: "directional",
}
CAMERA_NAMES = {
    **dict.fromkeys((c.CAMERA_PERSPECTIVE, *sorted(c.DISTORTED_CAMERAS - c.THIN_LENSES)), "perspective"),
    c.CAMERA_ORTHOGRAPHIC: "orthographic",
    **dict.fromkeys(sorted(c.THIN_LENSES), "thinlens"),
    c.CAMERA_RADIANCEMETER: "radiancemeter",
    c.CAMERA_IRRADIANCEMETER: "irradiancemeter",
}
TEXTURE_NAMES = {
    c.TEXTURE_CONSTANT: "constant",
    c.TEXTURE_BITMAP: "bitmap",
    c.TEXTURE_VERTEX: "vertex attribute",
    c.TEXTURE_FACE: "face attribute",
    c.TEXTURE_CHECKERBOARD: "checkerboard",
    c.TEXTURE_GRID: "volume",
    c.TEXTURE_SCALED: "scaled",
}

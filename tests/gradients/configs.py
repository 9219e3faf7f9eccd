"""The gradient table as data: scene, parameter, direction, step. Crossed with ``METHODS`` in ``test_table.py``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

#: Method -> (mode, K of interior.Replay; 0: interior.Textbook).
METHODS = {
    "forward": ("forward", 8),
    "reverse": ("reverse", 8),
    "forward in blocks": ("forward", 2),
    "reverse in blocks": ("reverse", 2),
    "forward textbook": ("forward", 0),
    "reverse textbook": ("reverse", 0),
}
#: Scenes whose moving vertices textbook replay does not claim: it raises (chains through smooth mirrors and glass).
TEXTBOOK_REFUSES = ("plastic", "gilded", "mirror", "glass")
#: What is requested together in a scene, so that its cases share kernels.
TOGETHER = {
    "plane": ("*",),
    "plane, parallel": ("sensor.*", "floor.to_world"),
    "plane, lens": ("sensor.*", "floor.to_world"),
    "projected": ("lamp.*", "floor.to_world"),
    "dome": ("floor.face_color", "sky.radiance.value"),
    "gap": ("*",),
    "rough": ("*",),
    "brushed": ("*",),
    "beckmann": ("floor.bsdf.*.value",),
    "brushed ggx": ("floor.bsdf.*.value",),
    "plastic": ("*",),
    "rough plastic": ("floor.bsdf.*",),
    "rough plastic ggx": ("floor.bsdf.*", "floor.vertex_positions"),
    "checkered": ("*.color?.value", "*.color?.data"),
    "carved": ("*",),
    "sunny": ("sky.*",),
    "checkered metal": ("floor.bsdf.alpha.color?.value",),
    "blend": ("floor.bsdf.*",),
    "gilded": ("*",),
    "rough glass": ("ball.bsdf.*",),
    "rough window": ("floor.bsdf.*",),
    "grooves": ("floor.bsdf.*",),
    "phong": ("floor.bsdf.*",),
    "abc": ("floor.bsdf.*",),
    "principled": ("floor.bsdf.*",),
    "principled glass": ("ball.bsdf.*",),
    "sheet": ("floor.bsdf.*",),
    "mapped": ("*",),
    "bumped": ("floor.bsdf.nested_texture.data", "floor.bsdf.scale", "floor.bsdf.nested_bsdf.*", "ceiling.to_world"),
    "instanced": ("group.sheet.vertex_positions", "floor.to_world"),
    "mirror": ("*",),
    "glass": ("*",),
    "leaf": ("leaf.bsdf.*",),
    "plate": ("plate.bsdf.*", "room.vertex_radiance", "lamp.intensity.value"),
}


@dataclass(frozen=True)
class Case:
    """One row.

    Attributes:
        scene: key of ``scenes.SCENES``.
        parameter: name of the parameter.
        tangent: values -> direction, in the shape of the values.
        step: of the central difference; half of it is tried, and used, too.
        what: tells rows of one parameter apart.
        depth: most path vertices.
        spp: of each of the batches.
        slow: left out of the fast subset.
    """

    scene: str
    parameter: str
    tangent: Callable[[np.ndarray], np.ndarray]
    step: float
    what: str = ""
    depth: int = 3
    spp: int = 16
    slow: bool = False

    def __str__(self) -> str:
        return "-".join(filter(None, (self.scene, self.parameter, self.what, str(self.depth))))


def ones(values):
    return np.ones(values.shape)


def same(values):
    """Along the values themselves: a change of scale."""
    return values.astype(np.float64)


def mixed(values):
    """A random direction, the same in every run."""
    return np.random.default_rng(values.size).uniform(-1.0, 1.0, values.shape)


def shift(*v):
    """Move a pose or vertices by v."""

    def tangent(values):
        if values.shape == (4, 4):
            m = np.zeros((4, 4))
            m[:3, 3] = v
            return m
        return np.broadcast_to(np.asarray(v, float)[: values.shape[-1]], values.shape)

    return tangent


def cross_matrix(axis):
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def turn(*axis):
    """Rotate a pose, or vertices or normals, about the world's origin; one unit is a radian."""

    def tangent(values):
        k = cross_matrix(axis)
        if values.shape == (4, 4):
            m = np.zeros((4, 4))
            m[:3] = k @ values[:3]
            return m
        return values.astype(np.float64) @ k.T

    return tangent


def aim(*axis):
    """Rotate a pose about its own position."""

    def tangent(values):
        m = np.zeros((4, 4))
        m[:3, :3] = cross_matrix(axis) @ values[:3, :3]
        return m

    return tangent


def widen(values):
    """Scale about the shape's own position."""
    m = np.zeros((4, 4))
    m[:3, :3] = values[:3, :3]
    return m


def slide(values):
    """A translation, and a little of everything else, of a 3 x 3 map of texture coordinates."""
    return np.array([[0.1, -0.2, 0.5], [0.15, 0.1, 0.3], [0.0, 0.0, 0.0]])


def texel_wave(values):
    h, w, _ = values.shape
    return np.sin(np.arange(h))[:, None, None] * np.cos(2.0 * np.arange(w))[None, :, None] + 0.3 * np.ones(values.shape)


def bend(values):
    """Move the vertices of a sheet along z, smoothly; convexity survives small steps."""
    x, y = values[:, 0], values[:, 1]
    return np.stack([0.03 * y, 0.02 * x, 0.5 + 0.2 * x + 0.1 * y - 0.05 * x * x], axis=1)


def ripple(values):
    """A smooth motion of the vertices of a ball."""
    return 0.3 * np.sin(values @ np.array([[1.0, 0.5, -0.3], [0.2, -0.8, 0.6], [0.4, 0.3, 0.9]]))


PLANE = [
    Case("plane", "floor.bsdf.reflectance.data", texel_wave, 2e-2),
    Case("plane", "floor.bsdf.reflectance.to_uv", slide, 4e-3, spp=128),
    Case("plane", "floor.vertex_texcoords", mixed, 4e-3, spp=128),
    Case("plane", "env.data", texel_wave, 2e-2),
    Case("plane", "env.scale", ones, 5e-2),
    Case("plane", "env.to_world", turn(0.3, 1.0, 0.5), 5e-2, spp=512),
    Case("plane", "point.intensity.value", mixed, 5e-2),
    Case("plane", "point.position", mixed, 1e-2),
    Case("plane", "spot.intensity.value", mixed, 5e-2),
    Case("plane", "spot.to_world", aim(0.3, 0.8, 0.2), 5e-3, "aim", spp=64),
    Case("plane", "spot.to_world", shift(0.5, -0.3, 0.4), 5e-3, "shift", spp=64),
    Case("plane", "spot.cutoff_angle", ones, 0.2, spp=64),
    Case("plane", "spot.beam_width", ones, 0.2, spp=64),
    Case("plane", "sun.irradiance.value", mixed, 5e-2),
    Case("plane", "sun.to_world", turn(0.3, 0.8, 0.2), 1e-2),
    Case("plane", "sensor.to_world", shift(0.3, -0.5, 0.4), 4e-3, "shift", spp=128),
    Case("plane", "sensor.to_world", aim(0.3, 0.8, 0.4), 4e-3, "aim", spp=128),
    Case("plane", "sensor.x_fov", ones, 0.2, spp=128),
    Case("plane", "sensor.principal_point_offset_x", ones, 4e-3, spp=128),
    Case("plane", "sensor.principal_point_offset_y", ones, 4e-3, spp=128),
    Case("plane", "floor.to_world", shift(0.0, 0.0, 1.0), 4e-3, "along the normal", spp=128),
    Case("plane", "floor.to_world", shift(1.0, 0.5, 0.0), 4e-3, "in plane", spp=128),
    Case("plane", "floor.to_world", turn(0.5, 0.8, 0.2), 2e-2, "turn", spp=256),
    Case("plane", "floor.to_world", same, 4e-3, "scale", spp=128),
    Case("plane", "floor.vertex_normals", turn(0.5, 0.8, 0.2), 2e-2, spp=2048, slow=True),
    Case("plane", "floor.vertex_positions", shift(0.5, 0.3, 0.8), 4e-3, spp=128),
]
PARALLEL = [
    Case("plane, parallel", "sensor.to_world", shift(0.3, -0.5, 0.4), 4e-3, "shift", spp=128),
    Case("plane, parallel", "sensor.to_world", aim(0.3, 0.8, 0.4), 4e-3, "aim", spp=128),
    Case("plane, parallel", "sensor.to_world", widen, 4e-3, "widen", spp=128),
    Case("plane, parallel", "floor.to_world", turn(0.5, 0.8, 0.2), 2e-2, "turn", spp=512, slow=True),
]
LENS = [
    Case("plane, lens", "sensor.to_world", shift(0.3, -0.5, 0.4), 4e-3, "shift", spp=128),
    Case("plane, lens", "sensor.to_world", aim(0.3, 0.8, 0.4), 4e-3, "aim", spp=128, slow=True),
    Case("plane, lens", "sensor.x_fov", ones, 0.2, spp=128),
    Case("plane, lens", "sensor.aperture_radius", ones, 4e-3, spp=512),
    Case("plane, lens", "sensor.focus_distance", ones, 1e-2, spp=512),
    Case("plane, lens", "floor.to_world", turn(0.5, 0.8, 0.2), 2e-2, "turn", spp=256, slow=True),
]
#: Steps of a twentieth of a pixel at the film's border.
BENDING = {"k1": 0.01, "k2": 0.02, "p1": 3e-3, "p2": 3e-3, "k3": 0.04, "k4": 0.01, "k5": 0.02, "k6": 0.04}
BENDING |= {"pixel_aspect": 5e-3, "skew": 5e-3, "x_fov": 0.2}
BENDING |= {"principal_point_offset_x": 4e-3, "principal_point_offset_y": 4e-3}
DISTORTED = [
    *(
        Case("plane, distorted", f"sensor.{name}", ones, step, spp=128, slow=name not in ("k1", "p2", "skew"))
        for name, step in BENDING.items()
    ),
    *(
        Case("plane, fisheye", f"sensor.{name}", ones, step, spp=128, slow=True)
        for name, step in BENDING.items()
        if name not in ("p1", "p2", "k5", "k6")
    ),
    Case("plane, distorted", "sensor.to_world", aim(0.3, 0.8, 0.4), 4e-3, "aim", spp=128, slow=True),
    Case("plane, fisheye", "sensor.to_world", aim(0.3, 0.8, 0.4), 4e-3, "aim", spp=128, slow=True),
]
PROJECTED = [
    Case("projected", "lamp.irradiance.data", texel_wave, 2e-2, depth=2),
    Case("projected", "lamp.scale", ones, 5e-2, depth=2),
    Case("projected", "lamp.x_fov", ones, 0.2, depth=2, spp=64),
    Case("projected", "lamp.to_world", aim(0.3, 0.8, 0.2), 5e-3, "aim", depth=2, spp=64),
    Case("projected", "lamp.to_world", shift(0.5, -0.3, 0.4), 5e-3, "shift", depth=2, spp=64),
    Case("projected", "floor.to_world", turn(0.5, 0.8, 0.2), 1e-2, "turn", depth=2, spp=256, slow=True),
]
DOME = [
    Case("dome", "floor.face_color", mixed, 5e-2),
    Case("dome", "sky.radiance.value", mixed, 5e-2),
]
GAP = [
    Case("gap", "floor.vertex_color", mixed, 2e-2, depth=4),
    Case("gap", "floor.vertex_color", mixed, 2e-2, depth=6, slow=True),
    Case("gap", "ceiling.bsdf.reflectance.value", mixed, 2e-2, depth=4),
    Case("gap", "ceiling.emitter.radiance.data", texel_wave, 5e-2, depth=4),
    Case("gap", "ceiling.emitter.radiance.to_uv", slide, 1e-2, depth=4, spp=128),
    Case("gap", "ceiling.to_world", shift(0.0, 0.0, 1.0), 4e-2, "along the normal", depth=4, spp=256),
    Case("gap", "ceiling.to_world", widen, 4e-2, "widen", depth=4, spp=1024, slow=True),
    Case("gap", "ceiling.to_world", turn(0.5, 0.8, 0.2), 8e-2, "turn", depth=4, spp=1024, slow=True),
    Case("gap", "ceiling.vertex_positions", mixed, 4e-2, depth=4, spp=2048, slow=True),
    Case("gap", "floor.vertex_positions", shift(0.0, 0.0, 1.0), 4e-2, "along the normal", depth=4, spp=256),
    Case("gap", "floor.vertex_positions", bend, 8e-2, "bend", depth=4, spp=512),
    Case("gap", "floor.vertex_positions", bend, 8e-2, "bend", depth=2, spp=512, slow=True),
    Case("gap", "floor.vertex_positions", bend, 8e-2, "bend", depth=6, spp=1024, slow=True),
    Case("gap", "sensor.to_world", aim(0.3, 0.8, 0.4), 1e-2, "aim", depth=4, spp=2048, slow=True),
]
ROUGH = [
    Case("rough", "floor.bsdf.alpha.value", ones, 1e-2, depth=2, spp=256),
    Case("rough", "floor.bsdf.alpha.value", ones, 1e-2, depth=5, spp=1024, slow=True),
    Case("rough", "floor.bsdf.eta.value", mixed, 2e-2, depth=2),
    Case("rough", "floor.bsdf.k.value", mixed, 2e-2, depth=2),
    Case("rough", "floor.bsdf.specular_reflectance.value", ones, 2e-2, depth=2),
    Case("rough", "floor.vertex_normals", turn(0.5, 0.8, 0.2), 2e-2, depth=2, spp=1536, slow=True),
    Case("rough", "floor.vertex_normals", mixed, 2e-2, "mixed", depth=2, spp=4096, slow=True),
    Case("rough", "floor.vertex_positions", bend, 4e-2, "bend", depth=2, spp=4096, slow=True),
    Case("rough", "sensor.to_world", shift(0.0, 1.0, 0.0), 4e-2, "shift", depth=2, spp=8192, slow=True),
    Case("beckmann", "floor.bsdf.alpha.value", ones, 1e-2, spp=512, slow=True),
    Case("brushed", "floor.bsdf.alpha_u.value", ones, 2e-2, depth=2, spp=512),
    Case("brushed", "floor.bsdf.alpha_v.value", ones, 2e-2, depth=2, spp=1536, slow=True),
    Case("brushed", "floor.bsdf.eta.value", mixed, 2e-2, depth=2),
    Case("brushed", "floor.bsdf.k.value", mixed, 2e-2, depth=2),
    Case("brushed", "floor.bsdf.specular_reflectance.value", mixed, 2e-2, depth=2),
    Case("brushed", "floor.vertex_texcoords", mixed, 2e-2, "tangents turn", depth=2, spp=16384, slow=True),
    Case("brushed", "floor.vertex_positions", bend, 4e-2, "bend", depth=2, spp=6144, slow=True),
    Case("brushed ggx", "floor.bsdf.alpha_u.value", ones, 2e-2, depth=2, spp=512, slow=True),
    Case("brushed ggx", "floor.bsdf.alpha_v.value", ones, 2e-2, depth=2, spp=512, slow=True),
]
PLASTIC = [
    Case("plastic", "floor.bsdf.diffuse_reflectance.value", mixed, 2e-2),
    Case("plastic", "floor.bsdf.specular_reflectance.value", mixed, 2e-2, depth=2, spp=2048, slow=True),
    Case("plastic", "floor.bsdf.eta", ones, 6e-2, depth=2, spp=2048, slow=True),
    Case("plastic", "floor.vertex_positions", bend, 4e-2, "bend", spp=1024, slow=True),
    Case("plastic", "floor.vertex_normals", turn(0.5, 0.8, 0.2), 2e-2, spp=512, slow=True),
]
ROUGH_PLASTIC = [
    Case("rough plastic", "floor.bsdf.alpha", ones, 2e-2, depth=2, spp=512),
    Case("rough plastic", "floor.bsdf.eta", ones, 6e-2, depth=2, spp=4096, slow=True),
    Case("rough plastic", "floor.bsdf.diffuse_reflectance.value", mixed, 2e-2, depth=2, spp=512, slow=True),
    Case("rough plastic", "floor.bsdf.specular_reflectance.value", mixed, 2e-2, depth=2, spp=2048, slow=True),
    Case("rough plastic ggx", "floor.bsdf.alpha", ones, 2e-2, depth=2, spp=2048, slow=True),
    Case("rough plastic ggx", "floor.bsdf.eta", ones, 6e-2, depth=2, spp=4096, slow=True),
    Case("rough plastic ggx", "floor.vertex_positions", bend, 4e-2, "bend", spp=1024, slow=True),
]
CHECKERED = [
    Case("checkered", "floor.bsdf.reflectance.color0.value", mixed, 2e-2, depth=4),
    Case("checkered", "floor.bsdf.reflectance.color1.data", texel_wave, 2e-2, depth=4),
    Case("checkered", "ceiling.emitter.radiance.color1.value", mixed, 5e-2, depth=4),
    Case("checkered metal", "floor.bsdf.alpha.color0.value", ones, 2e-2, depth=2, spp=2048, slow=True),
    Case("checkered metal", "floor.bsdf.alpha.color1.value", ones, 2e-2, depth=2, spp=2048, slow=True),
]
CARVED = [
    Case("carved", "floor.bsdf.reflectance.volume.data", mixed, 2e-2, depth=4),
    Case(
        "carved",
        "floor.bsdf.reflectance.volume.to_world",
        shift(0.3, -0.4, 0.5),
        2e-2,
        "shift",
        depth=4,
        spp=64,
        slow=True,
    ),
    Case(
        "carved",
        "floor.bsdf.reflectance.volume.to_world",
        turn(0.5, 0.8, 0.2),
        2e-2,
        "turn",
        depth=4,
        spp=64,
        slow=True,
    ),
    Case("carved", "floor.vertex_positions", bend, 8e-2, "bend", depth=4, spp=512),
    Case("carved", "sensor.to_world", shift(0.3, -0.5, 0.4), 1e-2, "shift", depth=2, spp=1024, slow=True),
    Case("carved", "ceiling.emitter.radiance.scale", ones, 5e-2, depth=4),
    Case("carved", "ceiling.vertex_glow", mixed, 5e-2, depth=4, slow=True),
]
SUNNY = [
    Case("sunny", "sky.turbidity", ones, 5e-2, depth=2),
    Case("sunny", "sky.albedo.value", mixed, 5e-2, depth=2),
    Case("sunny", "sky.sun_direction", mixed, 2e-2, depth=2),
    Case("sunny", "sky.to_world", turn(0.3, 1.0, 0.5), 2e-2, depth=2, spp=4096, slow=True),
    Case("sunny", "sky.sky_scale", ones, 5e-2, depth=2),
    Case("sunny", "sky.sun_scale", ones, 5e-2, depth=2),
]
BLEND = [
    Case("blend", "floor.bsdf.weight.value", ones, 2e-2, depth=2, spp=1024),
    Case("blend", "floor.bsdf.bsdf_0.reflectance.value", mixed, 2e-2, depth=2),
    Case("blend", "floor.bsdf.bsdf_1.alpha.value", ones, 1e-2, depth=2, spp=1024, slow=True),
    Case("gilded", "floor.vertex_gilt", mixed, 2e-2, spp=1024, slow=True),
    Case("gilded", "floor.bsdf.bsdf_1.k.value", mixed, 2e-2, spp=1024, slow=True),
]
ROUGH_GLASS = [
    Case("rough glass", "ball.bsdf.specular_reflectance.value", mixed, 2e-2, depth=4, spp=64),
    Case("rough glass", "ball.bsdf.specular_transmittance.value", mixed, 2e-2, depth=4, spp=64),
    Case("rough window", "floor.bsdf.alpha.value", ones, 2e-2, depth=2, spp=2560, slow=True),
    Case("rough glass", "ball.bsdf.eta", ones, 2e-2, depth=4, spp=1024, slow=True),
]
TURNED = [
    Case("mapped", "floor.bsdf.normalmap.data", texel_wave, 4e-2, depth=2, spp=1024),
    Case("mapped", "floor.bsdf.nested_bsdf.alpha_u.value", ones, 2e-2, depth=2, spp=1024, slow=True),
    Case("mapped", "floor.bsdf.normalmap.to_uv", slide, 4e-3, depth=2, spp=2048, slow=True),
    Case("mapped", "floor.vertex_positions", bend, 4e-2, "bend", depth=2, spp=6144, slow=True),
    Case("bumped", "floor.bsdf.nested_texture.data", texel_wave, 2e-2, depth=2, spp=8192, slow=True),
    Case("bumped", "ceiling.to_world", shift(0.0, 0.0, 1.0), 4e-2, "along the normal", depth=2, spp=1024, slow=True),
]
INSTANCED = [
    Case("instanced", "group.sheet.vertex_positions", bend, 8e-2, "bend", depth=4, spp=1024, slow=True),
    Case("instanced", "floor.to_world", shift(0.0, 0.0, 1.0), 4e-2, "along the normal", depth=4, spp=1024, slow=True),
]
GROOVES = [
    Case("phong", "floor.bsdf.reflectance.value", mixed, 2e-2, depth=2, spp=256, slow=True),
    Case("phong", "floor.bsdf.specular_reflectance.value", mixed, 2e-2, depth=2, spp=1024, slow=True),
    Case("phong", "floor.bsdf.nu.value", ones, 1.0, depth=2, spp=1024, slow=True),
    Case("phong", "floor.bsdf.nv.value", ones, 0.5, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.specular_reflectance.value", mixed, 2e-2, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.eta.value", mixed, 2e-2, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.k.value", mixed, 2e-2, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.A.value", ones, 2e-2, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.B.value", ones, 1.0, depth=2, spp=1024, slow=True),
    Case("abc", "floor.bsdf.C.value", ones, 5e-2, depth=2, spp=1024, slow=True),
    Case("grooves", "floor.bsdf.reflectance.value", mixed, 2e-2, slow=True),
    Case("grooves", "floor.bsdf.sigma.value", ones, 4e-2, depth=2, spp=64, slow=True),
]
PRINCIPLED = [
    Case("principled", "floor.bsdf.base_color.value", mixed, 2e-2, depth=2, spp=256),
    Case("principled", "floor.bsdf.roughness.value", ones, 2e-2, depth=2, spp=512),
    Case("principled", "floor.bsdf.metallic.value", ones, 0.2, depth=2, spp=256),
    Case("principled", "floor.bsdf.clearcoat.value", ones, 0.2, depth=2, spp=256),
    Case("principled", "floor.bsdf.anisotropic.value", ones, 4e-2, depth=2, spp=10240, slow=True),
    Case("principled", "floor.bsdf.clearcoat_gloss.value", ones, 4e-2, depth=2, spp=2048, slow=True),
    Case("principled", "floor.bsdf.specular", ones, 5e-2, depth=2, spp=1024, slow=True),
    *(
        Case("principled", f"floor.bsdf.{name}.value", ones, 0.25, depth=2, spp=512, slow=True)
        for name in ("spec_tint", "sheen", "sheen_tint", "flatness")
    ),
    *(
        Case("sheet", f"floor.bsdf.{name}.value", ones, 4e-2, depth=3, spp=1024, slow=True)
        for name in ("roughness", "anisotropic", "eta", "spec_trans", "spec_tint", "sheen", "sheen_tint")
    ),
    Case("sheet", "floor.bsdf.diff_trans.value", ones, 0.4, depth=3, spp=2048, slow=True),
    Case("sheet", "floor.bsdf.flatness.value", ones, 0.2, depth=3, spp=1024, slow=True),
    Case("sheet", "floor.bsdf.base_color.value", mixed, 2e-2, depth=3, spp=256, slow=True),
    Case("principled glass", "ball.bsdf.base_color.value", mixed, 2e-2, depth=4, spp=512, slow=True),
    Case("principled glass", "ball.bsdf.spec_trans.value", ones, 0.3, depth=4, spp=512, slow=True),
    Case("principled glass", "ball.bsdf.roughness.value", ones, 1e-2, depth=4, spp=3072, slow=True),
    Case("principled glass", "ball.bsdf.eta", ones, 2e-2, depth=4, spp=1024, slow=True),
]
DELTA = [
    Case("mirror", "room.bsdf.specular_reflectance.value", ones, 1e-2, depth=4),
    Case("mirror", "room.bsdf.eta.value", mixed, 1e-2, depth=4),
    Case("mirror", "room.bsdf.k.value", mixed, 1e-2, depth=4),
    Case("mirror", "room.vertex_radiance", mixed, 5e-2, depth=4),
    Case("mirror", "room.vertex_positions", ripple, 2e-3, depth=4, spp=64),
    Case("mirror", "room.vertex_normals", turn(0.5, 0.8, 0.2), 1e-3, depth=4, spp=64),
    Case("mirror", "sensor.to_world", shift(0.3, -0.5, 0.4), 2e-3, "shift", depth=4, spp=64),
    Case("mirror", "sensor.to_world", aim(0.3, 0.8, 0.4), 2e-3, "aim", depth=4, spp=64, slow=True),
    Case("glass", "ball.bsdf.eta", ones, 8e-3, depth=4, spp=512),
    Case("glass", "ball.bsdf.specular_reflectance.value", mixed, 2e-2, depth=4, spp=64),
    Case("glass", "ball.bsdf.specular_transmittance.value", mixed, 2e-2, depth=4),
    Case("glass", "ball.vertex_positions", ripple, 2e-3, depth=4, spp=128),
    # Near normal incidence, differences see the slope of the reflectance by rare changes of the lobe alone: the step
    # and the samples are such that there are some tens of them in a batch. (With equal odds for the lobes, and so
    # without such changes, the slope is 1.0000 at steps of 2e-3 and 5e-4.)
    Case("glass", "ball.vertex_positions", shift(0.5, 0.3, 0.8), 4e-2, "shift", depth=4, spp=4096, slow=True),
    Case("glass", "env.to_world", turn(0.3, 1.0, 0.5), 4e-3, depth=4, spp=256, slow=True),
    Case("glass", "env.data", texel_wave, 2e-2, depth=4),
    Case("glass", "sensor.to_world", aim(0.3, 0.8, 0.4), 2e-3, "aim", depth=4, spp=64),
    Case("glass", "sensor.x_fov", ones, 0.1, depth=4, spp=128, slow=True),
    Case("plate", "plate.bsdf.eta", ones, 6e-2, depth=3, spp=1024),
    Case("plate", "plate.bsdf.specular_reflectance.value", mixed, 2e-2, depth=5, spp=64),
    Case("plate", "plate.bsdf.specular_transmittance.value", mixed, 2e-2, depth=5, spp=64),
    Case("plate", "room.vertex_radiance", mixed, 5e-2, depth=5),
    Case("plate", "lamp.intensity.value", mixed, 5e-2, depth=5),
    Case("leaf", "leaf.bsdf.opacity.data", ones, 8e-2, depth=4, spp=2048),
    Case("leaf", "leaf.bsdf.opacity.to_uv", slide, 2e-2, depth=4, spp=8192, slow=True),
    Case("leaf", "leaf.bsdf.nested_bsdf.brdf_0.reflectance.value", mixed, 5e-2, depth=4, spp=64),
]
CASES = [
    *(*PLANE, *PARALLEL, *LENS, *DISTORTED, *PROJECTED, *DOME, *GAP),
    *(
        *ROUGH,
        *PLASTIC,
        *ROUGH_PLASTIC,
        *ROUGH_GLASS,
        *PRINCIPLED,
        *GROOVES,
        *CHECKERED,
        *CARVED,
        *SUNNY,
        *BLEND,
        *TURNED,
        *INSTANCED,
        *DELTA,
    ),
]

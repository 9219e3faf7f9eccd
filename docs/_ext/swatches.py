"""Small pictures of every material, texture and light, which the tables of ``docs/reference/scene.md`` show.

    python docs/_ext/swatches.py            # all of them
    python docs/_ext/swatches.py bsdf       # those of one kind

They are committed (``docs/swatches``, 256 colours, some 15 kB each): the documentation is built without rendering.
What a plugin needs to be loaded is that of ``plugin_parameters.py``, and ``LOOKS`` where it shows little. Plugins whose
kernels are large are rendered a few at a time.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import plugin_parameters
import warp as wp
from PIL import Image as Picture

import warp_psdr as psdr
from warp_psdr import image_io
from warp_psdr.scene.plugins import PLUGINS

FOLDER = Path(__file__).resolve().parents[1] / "swatches"
#: Width and height of a picture, samples a pixel, plugins of one scene, and their distance in it.
SIZE, SPP, TOGETHER, APART = 160, 256, 4, 12.0
#: Colours of a picture, which keep its file small.
COLORS = 256
T = psdr.Transform
INTEGRATOR = psdr.PathIntegrator(max_depth=8)
KINDS = ("bsdf", "texture", "emitter")


def _rgb(*values: float) -> dict:
    return {"type": "rgb", "value": list(values)}


def _grid(*shape: int) -> np.ndarray:
    return np.indices(shape).sum(axis=0)[..., None] % 2 * np.array([0.5, 0.3, 0.1], np.float32) + np.float32(0.2)


RED, BLUE = (
    {"type": "diffuse", "reflectance": _rgb(0.7, 0.2, 0.1)},
    {"type": "diffuse", "reflectance": _rgb(0.1, 0.2, 0.7)},
)
TWOSIDED = {"type": "twosided", "bsdf": RED}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
_WAVES = np.sin(np.linspace(0.0, 24.0 * np.pi, 96, endpoint=False))
#: What a plugin's picture has beside, or in place of, what it needs.
LOOKS: dict[str, dict] = {
    "diffuse": RED,
    "plastic": {"diffuse_reflectance": _rgb(0.7, 0.2, 0.1)},
    "roughplastic": {"diffuse_reflectance": _rgb(0.7, 0.2, 0.1), "alpha": 0.2},
    "conductor": {"material": "Au"},
    "roughconductor": {"material": "Au", "alpha": 0.25},
    "roughdielectric": {"alpha": 0.2},
    "principled": {"base_color": _rgb(0.2, 0.4, 0.7), "roughness": 0.3, "metallic": 0.3, "clearcoat": 1.0},
    "principledthin": {"base_color": _rgb(0.2, 0.6, 0.3), "diff_trans": 1.0, "roughness": 0.3},
    "orennayar": {"reflectance": _rgb(0.7, 0.2, 0.1), "sigma": 0.6},
    "ashikhminshirley": {"reflectance": _rgb(0.6, 0.2, 0.1)},
    "twosided": {"bsdf": RED},
    "mask": {
        "opacity": {"type": "checkerboard", "color0": 1.0, "color1": 0.0, "to_uv": T.scale([8, 4, 1])},
        "a": TWOSIDED,
    },
    "blendbsdf": {"weight": 0.5, "a": RED, "b": GOLD},
    "normalmap": {
        "normalmap": {
            "type": "bitmap",
            "raw": True,
            "bitmap": np.stack(np.broadcast_arrays(0.5 + 0.2 * _WAVES, 0.5, np.ones((48, 1))), axis=-1),
        },
        "a": RED,
    },
    "bumpmap": {"heights": {"type": "bitmap", "raw": True, "bitmap": np.full((48, 1), 0.03) * _WAVES}, "a": RED},
    "bitmap": {"bitmap": _grid(6, 12).astype(np.float32), "filter_type": "nearest"},
    "checkerboard": {"color0": _rgb(0.7, 0.2, 0.1), "color1": 0.8, "to_uv": T.scale([4, 2, 1])},
    "mesh_attribute": {"name": "vertex_color"},
    "volume": {
        "volume": {
            "type": "gridvolume",
            "data": _grid(6, 6, 6),
            "filter_type": "nearest",
            "to_world": T.translate([-1.5, -1.5, -1.5]) @ T.scale(3),
        }
    },
    "area": {"radiance": 6.0},
    "directionalarea": {"radiance": 3.0},
    "constant": {"radiance": _rgb(0.7, 0.8, 1.0)},
    "point": {"position": [1.5, -2.0, 2.5], "intensity": 14.0},
    "spot": {
        "to_world": T.look_at([1.0, -2.0, 3.0], [0, 0, -0.5], [0, 0, 1]),
        "intensity": 20.0,
        "cutoff_angle": 14.0,
        "beam_width": 12.0,
    },
    "projector": {
        "to_world": T.look_at([1.0, -2.5, 3.0], [0, 0, -0.4], [0, 0, 1]),
        "irradiance": {"type": "bitmap", "bitmap": _grid(6, 6).astype(np.float32), "filter_type": "nearest"},
        "fov": 40.0,
        "scale": 30.0,
    },
    "directional": {"direction": [-0.4, 0.6, -1.0], "irradiance": 2.5},
    "sunsky": {"sun_direction": [0.6, -0.5, 0.5], "turbidity": 3.0, "sky_scale": 3.5, "sun_scale": 2.0},
}


def names_of(kind: str) -> list[str]:
    """Return the plugins of a kind that have a picture: all but spectra, which are colours."""
    return [name for name in PLUGINS[kind] if name not in plugin_parameters.VALUES]


def _sky() -> dict:
    """Return a dim sky with a bright and a warm window, which glossy surfaces mirror."""
    texels = np.full((64, 128, 3), 0.2, np.float32)
    texels[:32] += np.linspace(0.3, 0.1, 32)[:, None, None]
    texels[11:24, 12:25], texels[17:29, 98:118] = 8.0, [4.5, 3.4, 2.2]
    return {"type": "envmap", "bitmap": texels, "to_world": T.rotate([1, 0, 0], 90)}


def _landscape() -> dict:
    """Return a sky that shows what a map of the surroundings is: blue above, a low sun, hills and a green ground."""
    v, u = np.meshgrid((np.arange(96) + 0.5) / 96, (np.arange(192) + 0.5) / 192, indexing="ij")
    up = np.cos(np.pi * v)[..., None]
    texels = np.array([0.9, 0.6, 0.35]) + (np.array([0.1, 0.3, 0.9]) - [0.9, 0.6, 0.35]) * np.clip(2.5 * up, 0.0, 1.0)
    hills = (0.10 + 0.05 * np.sin(14.0 * np.pi * u) + 0.04 * np.sin(6.0 * np.pi * u + 1.0))[..., None]
    texels = np.where(up < hills, [0.12, 0.16, 0.3], texels)
    texels = np.where(up < 0.0, [0.1, 0.3, 0.08], texels)
    sun = np.exp(-(((u - 0.12) * 2.0) ** 2 + (v - 0.33) ** 2) / 0.0012)[..., None]
    bitmap = (texels + sun * [40.0, 32.0, 20.0]).astype(np.float32)
    return {"type": "envmap", "bitmap": bitmap, "to_world": T.rotate([1, 0, 0], 90)}


def _ball(x: float, bsdf: dict) -> dict:
    """Return a ball with colours at its vertices, and the tile below it."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4)
    vertices = np.asarray(mesh.vertices, np.float32)
    u = np.arctan2(vertices[:, 1], vertices[:, 0]) / (2 * np.pi) + 0.5
    bumpy = any(name in str(bsdf.get("type")) for name in ("map", "mask"))
    needs_uv = bumpy or any(isinstance(v, dict) and v.get("type") in ("bitmap", "checkerboard") for v in bsdf.values())
    if needs_uv:
        shape: dict = {"type": "sphere", "to_world": T.translate([x, 0, 0])}
    else:
        color = 0.5 + 0.4 * np.sin(np.stack([5 * vertices[:, 0], 4 * vertices[:, 2], 12 * u], axis=1))
        normals = {"vertices": vertices + np.float32([x, 0, 0]), "faces": np.asarray(mesh.faces), "vertex_color": color}
        shape = {"type": "mesh", **normals}
    tile = {"type": "checkerboard", "color0": 0.5, "color1": 0.25, "to_uv": T.scale([4, 4, 1])}
    floor = {"type": "rectangle", "to_world": T.translate([x, 0, -1.02]) @ T.scale(3)}
    return {"ball": {**shape, "bsdf": bsdf}, "tile": {**floor, "bsdf": {"type": "diffuse", "reflectance": tile}}}


def _camera(x: float) -> dict:
    return {
        "type": "perspective",
        "fov": 34.0,
        "to_world": T.look_at([x, -4.2, 1.5], [x, 0, -0.1], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
    }


def _plugin(name: str) -> dict:
    needed = {k: v for k, v in plugin_parameters.NEEDED.get(name, {}).items() if v != "FILE.png"}
    return {**needed, **LOOKS.get(name, {}), "type": name}


def _cell(kind: str, name: str, x: float) -> dict:
    """Return what a scene holds of one plugin, at a place along x."""
    plugin = _plugin(name)
    if kind == "bsdf":
        return _ball(x, plugin)
    if kind == "texture":
        if name == "volume":
            plugin["volume"] = {**plugin["volume"], "to_world": T.translate([x, 0, 0]) @ plugin["volume"]["to_world"]}
        return _ball(x, {"type": "diffuse", "reflectance": plugin})
    skies = ("envmap", "sunsky")  # which a mirror shows
    grey = {"type": "plastic", "diffuse_reflectance": _rgb(0.5, 0.5, 0.5)}
    cell = _ball(x, {"type": "conductor"} if name in skies else grey)
    if name in ("area", "directionalarea"):
        pose = T.translate([x, 0, 2.2]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.9)
        return {**cell, "lamp": {"type": "rectangle", "to_world": pose, "emitter": plugin}}
    for key in ("to_world", "position"):
        if key in plugin:
            plugin[key] = (
                T.translate([x, 0, 0]) @ plugin[key] if key == "to_world" else np.add(plugin[key], [x, 0, 0]).tolist()
            )
    return {**cell, "light": _landscape() if name == "envmap" else plugin}


def render(kind: str, names: list[str]) -> Iterable[tuple[str, np.ndarray]]:
    """Return the pictures of some plugins, linear (SIZE, SIZE, 3), from one scene."""
    scene: dict = {"type": "scene"}
    for i, name in enumerate(names):
        x = APART * i
        scene[f"camera_{name}"] = _camera(x)
        scene |= {f"{key}_{name}": part for key, part in _cell(kind, name, x).items()}
    if kind != "emitter":
        scene["sky"] = _sky()
    with warnings.catch_warnings(action="ignore", category=psdr.SceneWarning):
        loaded = psdr.load_dict(scene)
    for name in names:
        yield name, psdr.render(loaded, sensor=f"camera_{name}", integrator=INTEGRATOR, spp=SPP).numpy()


def write(file: Path, image: np.ndarray) -> None:
    """Write a linear image as a PNG of few colours."""
    picture = Picture.fromarray(np.round(255.0 * image_io.linear_to_srgb(image)).astype(np.uint8))
    colors = picture.quantize(COLORS)
    picture.quantize(palette=colors, dither=Picture.Dither.FLOYDSTEINBERG).save(file, optimize=True)


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", default=KINDS, help=f"of {', '.join(KINDS)}")
    parser.add_argument("--only", nargs="*", help="plugins")
    arguments = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    for kind in arguments.kinds:
        names = [name for name in names_of(kind) if not arguments.only or name in arguments.only]
        together = 1 if kind == "emitter" else TOGETHER  # lights shine on their neighbours
        for group in [names[i : i + together] for i in range(0, len(names), together)]:
            for name, image in render(kind, group):
                write(FOLDER / f"{kind}_{name}.png", image)
                print(f"{kind} {name}", flush=True)


if __name__ == "__main__":
    with wp.ScopedLogLevel(wp.LOG_WARNING):
        main()

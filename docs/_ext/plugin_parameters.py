"""What the scene loader reads of each plugin, found by loading a scene with it and listening.

The loader has no list of parameters: a reader asks for each. So every plugin is put in a small scene, and what is asked
for is written down, with the values that ``psdr.traverse`` then lists. Parameters that exclude the default ones
(``alpha_u`` beside ``alpha``) need an example of their own, in ``MORE``.
"""

from __future__ import annotations

import functools
import struct
import tempfile
import warnings
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

import warp_psdr as psdr
from warp_psdr import image_io
from warp_psdr.scene import plugins as loader

#: A network of two layers, whose surface is next to a corner of its box.
NETWORK = {
    "layer0.weight": np.eye(3),
    "layer0.bias": np.zeros(3),
    "layer1.weight": np.ones((1, 3)),
    "layer1.bias": np.array([-2.5]),
}
#: Parameters without which a plugin cannot be loaded; "FILE.obj" and the like stand for files that are made.
NEEDED: dict[str, dict] = {
    "twosided": {"bsdf": {"type": "diffuse"}},
    "normalmap": {"normalmap": {"type": "bitmap", "bitmap": np.ones((2, 2, 3))}, "a": {"type": "diffuse"}},
    "bumpmap": {"heights": {"type": "bitmap", "bitmap": np.ones((2, 2, 1))}, "a": {"type": "diffuse"}},
    "abc": {"A": 0.5, "B": 100.0, "C": 1.5},
    "mask": {"a": {"type": "diffuse"}},
    "blendbsdf": {"weight": 0.5, "a": {"type": "diffuse"}, "b": {"type": "diffuse"}},
    "bitmap": {"filename": "FILE.png"},
    "mesh_attribute": {"name": "vertex_color"},
    "volume": {"volume": {"type": "gridvolume", "data": np.full((2, 2, 2), 0.5)}},
    "envmap": {"filename": "FILE.png"},
    "thinlens": {"aperture_radius": 0.1},
    "transient_hdr_film": {"width": 4, "height": 4, "temporal_bins": 4},
    "batch": {"left": {"type": "perspective"}, "right": {"type": "orthographic"}},
    "aov": {"aovs": "d:depth"},
    "moment": {"integrator": {"type": "path"}},
    "shapegroup": {"cube": {"type": "cube"}},
    "instance": {"shapegroup": {"type": "shapegroup", "cube": {"type": "cube"}}},
    "gridvolume": {"data": np.ones((2, 2, 2))},
    "blendphase": {"weight": 0.5, "a": {"type": "hg"}, "b": {"type": "isotropic"}},
    "tabphase": {"values": [0.5, 1.0, 2.0]},
    "sggx": {"S": [1.0, 1.0, 0.2, 0.0, 0.0, 0.1]},
    "sdfgrid": {"grid": np.arange(8.0).reshape(2, 2, 2) - 3.5},
    "neuralsdf": NETWORK,
    "linearcurve": {"control_points": np.eye(2, 4)},
    "bsplinecurve": {"control_points": np.eye(4)},
    "merge": {"shape": {"type": "cube"}},
    "mesh": {"vertices": np.eye(3), "faces": [[0, 1, 2]]},
    **{kind: {"filename": f"FILE.{kind}"} for kind in ("obj", "ply", "serialized", "gltf", "glb", "stl", "off")},
}
#: Further examples, whose parameters join those of the first.
MORE: dict[str, tuple[dict, ...]] = {
    "roughconductor": ({"alpha_u": 0.1, "alpha_v": 0.2}, {"eta": 1.0, "k": 2.0}),
    "roughdielectric": ({"alpha_u": 0.1, "alpha_v": 0.2},),
    "mesh_attribute": ({"name": "vertex_color", "scale": 0.5},),
    "neuralsdf": (
        {"activation": "softplus", "beta": 1.0, **NETWORK},
        {"activation": "sine", "omega": 1.0, **NETWORK},
    ),
    "conductor": ({"eta": 1.0, "k": 2.0},),
    "abc": ({"A": 0.5, "B": 100.0, "C": 1.5, "eta": 1.0, "k": 2.0},),
    "principled": ({"eta": 1.5, "spec_trans": 0.5},),
    "perspective": ({"fov": 40.0}, {"distortion": "opencv", "k6": 0.0}),
    "sunsky": ({"sun_direction": [0.0, 0.0, 1.0]},),
    "thinlens": (
        {"aperture_radius": 0.1, "fov": 40.0},
        {"aperture_radius": 0.1, "distortion": "opencv", "k6": 0.0},
    ),
    "transient_hdr_film": ({"width": 4, "height": 4, "temporal_bins": 4, "pulse": "gaussian"},),
    "radiancemeter": ({"origin": [0.0, 0.0, 1.0], "direction": [0.0, 0.0, -1.0]},),
    "directional": ({"direction": [0.0, 0.0, 1.0]},),
    "spot": ({"texture": {"type": "bitmap", "bitmap": np.full((2, 2, 3), 0.5)}},),
    "projector": ({"fov": 40.0}, {"irradiance": {"type": "bitmap", "bitmap": np.full((2, 2, 3), 0.5)}}),
    "point": ({"position": [0.0, 0.0, 1.0]},),
    "sggx": ({"S": {"type": "gridvolume", "data": np.ones((2, 1, 1, 6)) * [1.0, 1.0, 0.2, 0.0, 0.0, 0.1]}},),
}
#: Where a medium holds what belongs to it.
NESTED = {"phase": "phase_function", "volume": "sigma_t"}
#: Plugins that stand for values (spectra) take different forms; they are listed by name alone.
VALUES = ("rgb", "srgb", "spectrum", "uniform", "rawconstant", "d65", "blackbody", "regular", "irregular")


class Plugin(NamedTuple):
    """A plugin, the parameters that are read of it, and the names of its values in ``psdr.traverse``."""

    name: str
    read: list[str]
    values: list[str]


@functools.cache
def plugins(category: str) -> list[Plugin]:
    """Return the supported plugins of a kind.

    Raises:
        ValueError: one of them cannot be loaded; its example has to be mended.
    """
    with tempfile.TemporaryDirectory() as folder:
        return [_listen(category, name, Path(folder)) for name in loader.PLUGINS[category]]


def _listen(category: str, name: str, folder: Path) -> Plugin:
    read: dict[str, None] = {}
    values: dict[str, None] = {}
    if name in VALUES:
        return Plugin(name, [], [])
    for parameters in (NEEDED.get(name, {}), *MORE.get(name, ())):
        asked, found = _load(category, name, {k: _file(v, folder) for k, v in parameters.items()})
        read.update(dict.fromkeys(asked))
        values.update(dict.fromkeys(found))
    return Plugin(name, sorted(read), list(values))


def _load(category: str, name: str, parameters: dict) -> tuple[list[str], list[str]]:
    """Return the parameters that loading a scene with the plugin asked it for, and the names of its values."""
    asked: list[str] = []
    take = loader.Properties.take

    def listening(self: loader.Properties, parameter: str, default=None):
        if self.type == name:
            asked.append(parameter)
        return take(self, parameter, default)

    loader.Properties.take = listening  # type: ignore[method-assign]
    try:
        with warnings.catch_warnings(action="ignore", category=psdr.SceneWarning):
            scene = psdr.load_dict(_scene(category, {"type": name, **parameters}))
    finally:
        loader.Properties.take = take  # type: ignore[method-assign]
    found = [n.removeprefix("probe.") for n in psdr.traverse(scene) if n.startswith("probe.")]
    inner = {"texture": "bsdf.reflectance.", "bsdf": "bsdf.", "medium": "interior_medium."}
    inner |= {kind: f"interior_medium.{key}." for kind, key in NESTED.items()}
    inner = inner.get(category, "emitter." if name in ("area", "directionalarea") else "")
    found = [n.removeprefix(inner) for n in found if n.startswith(inner)]
    if name == "irradiancemeter":  # it has no values; those of its shape are not its own
        found = []
    if category == "shape":
        found = [n for n in found if "bsdf." not in n]
    elif category not in ("texture", "bsdf", "emitter", "sensor", "medium", "phase", "volume"):
        found = []
    return [a for a in asked if not a.startswith("_arg_")], found


def _scene(category: str, plugin: dict) -> dict:
    """Return a scene that holds the plugin where it belongs; what is looked at is called ``probe``."""
    film: dict = {"type": "hdrfilm", "width": 4, "height": 4}
    camera: dict = {"type": "perspective", "fov": 40.0, "film": film}
    shape = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "texcoords": np.eye(3)[:, :2]}
    shape["vertex_color"] = np.full((3, 3), 0.5)
    scene: dict = {"type": "scene", "sensor": camera, "probe": shape, "integrator": {"type": "path"}}
    if category == "sensor":
        del scene["sensor"]
        meter = {**plugin, "film": {**film, "width": 1, "height": 1}}
        scene["body"], scene["probe"] = shape, meter if plugin["type"].endswith("meter") else {**plugin, "film": film}
        if plugin["type"] == "irradiancemeter":
            del scene["body"]
            scene["probe"] = {**shape, "sensor": meter}
    elif category == "film":
        camera["film"] = plugin
    elif category in ("rfilter", "sampler"):
        (film if category == "rfilter" else camera)[category] = plugin
    elif category == "integrator":
        scene["integrator"] = plugin
    elif category == "bsdf":
        shape["bsdf"] = plugin
    elif category == "texture":
        shape["bsdf"] = {"type": "diffuse", "reflectance": plugin}
    elif category in ("medium", "phase", "volume"):
        medium = plugin if category == "medium" else {"type": "heterogeneous", NESTED[category]: plugin}
        shape |= {"bsdf": {"type": "null"}, "interior": medium}
    elif plugin["type"] in ("area", "directionalarea"):
        shape["emitter"] = plugin
    elif category == "emitter":
        scene["body"], scene["probe"] = shape, plugin
    elif category == "shape":
        scene["probe"] = plugin
        if plugin["type"] == "shapegroup":  # which is not there until an instance is
            scene["instance"] = {"type": "instance", "shapegroup": {"type": "ref", "id": "probe"}}
    return scene


def _file(value, folder: Path):
    """Return the name of a small file where ``value`` asks for one."""
    if not isinstance(value, str) or not value.startswith("FILE."):
        return value
    file = folder / value
    if file.suffix == ".png":
        image_io.write_image(file, np.full((4, 8, 3), 0.5, np.float32))
    elif file.suffix == ".serialized":
        triangle = np.eye(3, dtype="<f4").tobytes() + np.arange(3, dtype="<u4").tobytes()
        body = struct.pack("<IQQ", 0x1000, 3, 1) + triangle
        file.write_bytes(struct.pack("<HH", 0x041C, 3) + zlib.compress(body))
    else:
        import trimesh

        made = trimesh.creation.box().export(file_type=file.suffix[1:])
        # A glTF file has its buffers beside it.
        parts = made if isinstance(made, dict) else {file.name: made}
        for name, content in parts.items():
            (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        file = folder / next(name for name in parts if name.endswith(file.suffix))
    return str(file)

"""Whole files of every kind that the library reads: what the fuzzers damage."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from tests.fit import scenes as fit_scenes
from warp_psdr import image_io
from warp_psdr.fit import checkpoint

ROOT = Path(__file__).resolve().parents[2]
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
FACES = np.array([[0, 1, 2], [2, 3, 0]], np.int32)

OBJ = """# a square
mtllib none.mtl
v -1 -1 0 1 0 0
v 1 -1 0 0 1 0
v 1 1 0 0 0 1
v -1 1 0 1 1 1
vt 0 0
vt 1 0.5
vn 0 0 1
g part
usemtl paint
f 1/1/1 2/2/1 3/2/1 4/1/1
f -4//1 -3//1 -2//1
f 1 2 3
"""
PLY_HEAD = """ply
format {} 1.0
comment made by hand
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
property float face_w_0
end_header
"""
OFF = "OFF\n4 2 0\n" + "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS) + "3 0 1 2\n3 2 3 0\n"
STL = "solid a\n" + "".join(
    "facet normal 0 0 1\nouter loop\n"
    + "".join("vertex {} {} {}\n".format(*CORNERS[i]) for i in face)
    + "endloop\nendfacet\n"
    for face in FACES
)
STL += "endsolid a\n"
SCENE = """<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
<default name="size" value="8"/> <default name="model" value="diffuse"/>
<integrator type="path"><integer name="max_depth" value="3"/><boolean name="hide_emitters" value="false"/></integrator>
<sensor type="thinlens" id="cam"><float name="fov" value="40"/><string name="fov_axis" value="x"/>
<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="$size"/>
<rfilter type="gaussian"><float name="stddev" value="0.5"/></rfilter></film>
<sampler type="independent"><integer name="sample_count" value="4"/></sampler></sensor>
<bsdf type="twosided" id="paint"><bsdf type="$model"><texture type="bitmap" name="reflectance">
<string name="filename" value="a.png"/><string name="wrap_mode" value="mirror"/>
<transform name="to_uv"><scale x="2" y="2"/></transform></texture></bsdf></bsdf>
<bsdf type="roughconductor" id="metal"><string name="material" value="Au"/><float name="alpha" value="0.2"/></bsdf>
<bsdf type="dielectric" id="glass"><float name="int_ior" value="1.5"/></bsdf>
<shape type="ply" id="a"><string name="filename" value="a.ply"/><ref id="paint"/></shape>
<shape type="obj"><string name="filename" value="a.obj"/><ref id="metal"/>
<boolean name="face_normals" value="true"/></shape>
<shape type="sphere"><point name="center" x="0" y="1" z="2"/><float name="radius" value="0.5"/>
<integer name="resolution" value="8"/><ref id="glass"/></shape>
<shape type="cylinder"><point name="p0" value="0 0 0"/><point name="p1" value="0 0 1"/>
<float name="radius" value="0.2"/></shape>
<shape type="cube"><transform name="to_world"><scale value="0.3"/><rotate y="1" angle="30"/>
<matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform>
<emitter type="area"><spectrum name="radiance" value="400:1, 500:2, 700:1.5"/></emitter></shape>
<emitter type="envmap"><string name="filename" value="a.exr"/><float name="scale" value="2"/></emitter>
<emitter type="spot"><rgb name="intensity" value="#ff8000"/><float name="cutoff_angle" value="20"/></emitter>
<emitter type="point"><point name="position" value="0, 2, 0"/><rgb name="intensity" value="1 2 3"/></emitter>
<alias id="metal" as="gold"/>
<include filename="part.xml"/>
</scene>
"""
PART = '<scene version="3.0.0"><shape type="disk" id="disk"><ref id="gold"/></shape></scene>'
TOML = """scene = "scene.xml"
targets = ["target.exr", "target.exr"]
output = "out"
sensors = [0, 1]
iterations = 10
views_per_step = 1
spp = 4
seed = 3
lr_half_life = 20.5
device = "cpu"
betas = [0.9, 0.99]
mask_updates = true
[parameters."wall.bsdf.reflectance.data"]
lr = 0.05
initial = 0.5
[parameters."sky.radiance.value"]
lr = 1e-3
initial = [1, 2, 3]
[integrator]
max_depth = 4
boundary = "none"
"""
JSON = json.dumps(
    {
        "scene": "scene.xml",
        "targets": ["target.exr"],
        "output": "out",
        "iterations": 3,
        "lr_half_life": 2.5,
        "parameters": {"sky.radiance.value": {"lr": 0.1, "initial": [0.5, 1, 2]}},
        "integrator": {"max_depth": 3},
    }
)


def binary_ply(order: str = "<") -> bytes:
    """Return a square with normals, colours and an attribute of the faces."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    rows = b"".join(struct.pack(f"{order}6f3B", *v, 0, 0, 1, 255, 128, 0) for v in CORNERS)
    faces = b"".join(struct.pack(f"{order}B3if", 3, *f, 0.5) for f in FACES)
    return PLY_HEAD.format(name).encode() + rows + faces


def ascii_ply() -> bytes:
    """Return the same as text, with a polygon."""
    rows = "".join("{} {} {} 0 0 1 255 128 0\n".format(*v) for v in CORNERS)
    return (PLY_HEAD.format("ascii") + rows + "4 0 1 2 3 0.5\n3 0 1 2 0.25\n").encode()


def binary_stl() -> bytes:
    """Return two triangles."""
    rows = b"".join(struct.pack("<12fH", 0, 0, 1, *CORNERS[f].reshape(-1), 0) for f in FACES)
    return b"\0" * 80 + struct.pack("<I", len(FACES)) + rows


def gltf(*, binary: bool) -> bytes:
    """Return a node with a mesh; its buffer is part of the file, or the file square.bin beside it."""
    data = CORNERS.tobytes() + FACES.astype(np.uint16).tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "children": [1], "translation": [0, 0, 1]}, {"mesh": 0, "scale": [1, -1, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
        "buffers": [{"byteLength": len(data)} | ({} if binary else {"uri": "square.bin"})],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [-1, -1, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }
    text = json.dumps(tree).encode()
    if not binary:
        return text
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def exr(
    folder: Path, compression: int, *, channels: str = "RGB", dtype: type = np.float32, tiled: bool = False
) -> bytes:
    """Return an image of 9 x 6 pixels."""
    values = np.random.default_rng(1).random((6, 9)).astype(dtype)
    header = {"compression": compression, "type": OpenEXR.tiledimage if tiled else OpenEXR.scanlineimage}
    if tiled:
        header["tiles"] = OpenEXR.TileDescription()
    with OpenEXR.File(header, dict.fromkeys(channels, values)) as file:
        file.write(str(folder / "made.exr"))
    return (folder / "made.exr").read_bytes()


def picture(kind: str, mode: str) -> bytes:
    """Return an image of 7 x 5 pixels."""
    stream = io.BytesIO()
    size = (7, 5)
    values = np.random.default_rng(2).integers(0, 255, (5, 7, 4), dtype=np.uint8)
    image = Image.fromarray(values).convert(mode) if mode != "I;16" else Image.new(mode, size, 40000)
    image.save(stream, kind)
    return stream.getvalue()


def saved(folder: Path) -> bytes:
    """Return a checkpoint."""
    arrays = {"a.b/c": np.arange(12, dtype=np.float32).reshape(2, 2, 3), "steps": np.array(3), "losses": np.ones(3)}
    checkpoint.save(folder / "made.npz", arrays, {"run": {"spp": 4, "list": [1, 2]}})
    return (folder / "made.npz").read_bytes()


def array() -> bytes:
    """Return a NumPy file."""
    stream = io.BytesIO()
    np.save(stream, np.arange(12, dtype=np.float32).reshape(4, 3))
    return stream.getvalue()


def files(folder: Path) -> dict[str, list[bytes]]:
    """Return whole files of every kind by suffix; ``folder`` is for files on the way."""
    compressions = (
        OpenEXR.NO_COMPRESSION,
        OpenEXR.RLE_COMPRESSION,
        OpenEXR.ZIP_COMPRESSION,
        OpenEXR.PIZ_COMPRESSION,
        OpenEXR.PXR24_COMPRESSION,
        OpenEXR.B44_COMPRESSION,
        OpenEXR.DWAA_COMPRESSION,
    )
    images = [exr(folder, c, dtype=np.float16 if i % 2 else np.float32) for i, c in enumerate(compressions)]
    images += [exr(folder, OpenEXR.ZIP_COMPRESSION, channels="Y"), exr(folder, OpenEXR.ZIPS_COMPRESSION, tiled=True)]
    scenes = [(ROOT / "scenes" / name).read_bytes() for name in ("cornell_box.xml", "tests/spot_falloff.xml")]
    return {
        "xml": [SCENE.encode(), SCENE.encode(), *scenes],
        "ply": [binary_ply(), binary_ply(">"), ascii_ply()],
        "obj": [OBJ.encode()],
        "off": [OFF.encode()],
        "stl": [STL.encode(), binary_stl()],
        "glb": [gltf(binary=True)],
        "gltf": [gltf(binary=False)],
        "exr": images,
        "png": [picture("PNG", mode) for mode in ("RGB", "RGBA", "L", "P", "1", "I;16")],
        "jpg": [picture("JPEG", mode) for mode in ("RGB", "L", "CMYK")],
        "toml": [TOML.encode()],
        "json": [JSON.encode()],
        "npz": [saved(folder)],
        "npy": [array()],
        "neuralsdf": [network(np.savez), network(np.savez_compressed)],
    }


def network(save: Callable[..., None]) -> bytes:
    """Return the layers of a network, as NumPy saves them."""
    rng = np.random.default_rng(3)
    layers = {"layer0.weight": (4, 3), "layer0.bias": (4,), "layer1.weight": (1, 4), "layer1.bias": (1,)}
    stream = io.BytesIO()
    save(stream, **{name: rng.standard_normal(shape) for name, shape in layers.items()})
    return stream.getvalue()


def write_beside(folder: Path, whole: dict[str, list[bytes]]) -> None:
    """Write the files that the damaged ones refer to."""
    for suffix in ("ply", "obj", "exr", "png"):
        (folder / f"a.{suffix}").write_bytes(whole[suffix][0])
    (folder / "part.xml").write_text(PART)
    fit_scenes.write_scene(folder)
    image_io.write_image(folder / "target.exr", np.zeros((10, 12, 3)))
    (folder / "square.bin").write_bytes(CORNERS.tobytes() + FACES.astype(np.uint16).tobytes())

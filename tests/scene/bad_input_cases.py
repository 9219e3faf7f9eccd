"""Malformed scenes as data: what is wrong, which error it raises, and words that its message must hold."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

HEAD = '<scene version="3.0.0">\n<sensor type="perspective" id="cam"/>\n<emitter type="constant" id="sky"/>\n'


@dataclass(frozen=True)
class Case:
    """One malformed scene.

    Args:
        name: What is wrong.
        words: Texts in the message: the place, then the remedy.
        xml: The scene as text; "{}" between the usual head and end when it starts with no "<scene" or "<?".
        plugins: Or: plugins that join a dictionary with sensor and sky; a None removes one.
        files: Files beside the scene: name -> content.
        error: The type of the exception.
    """

    name: str
    words: tuple[str, ...]
    xml: str = ""
    plugins: dict[str, Any] = field(default_factory=dict)
    files: dict[str, str | bytes] = field(default_factory=dict)
    error: type[Exception] = ValueError

    def text(self) -> str:
        """Return the scene file."""
        return self.xml if self.xml.startswith(("<scene", "<?", "<!", " ")) else f"{HEAD}{self.xml}</scene>"


def mesh(**changes):
    """Return a triangle in place."""
    return {"x": {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], **changes}}


def model(**parameters):
    """Return a cube with a scattering model."""
    return {"x": {"type": "cube", "bsdf": parameters}}


def camera(**parameters):
    """Return a sensor."""
    return {"sensor": {"type": "perspective", **parameters}}


def film(**parameters):
    """Return a sensor with a film."""
    return camera(film={"type": "hdrfilm", **parameters})


def file_shape(kind: str, name: str) -> dict:
    """Return a shape that is read from a file."""
    return {"x": {"type": kind, "filename": name}}


def itself() -> dict:
    """Return a two-sided model that contains itself."""
    outer: dict[str, Any] = {"type": "twosided"}
    outer["inner"] = outer
    return {"x": {"type": "cube", "bsdf": outer}}


def deep() -> str:
    """Return elements nested beyond any use."""
    return '<bsdf type="twosided">' * 5000 + "</bsdf>" * 5000


_PLY_HEAD = (
    "ply\nformat {} 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
_PLY_BODY = "0 0 0\n1 0 0\n0 1 0\n"
_PLY = _PLY_HEAD.format("ascii") + _PLY_BODY
_BINARY_PLY = _PLY_HEAD.format("binary_little_endian").encode() + struct.pack("<9fB3i", *range(9), 3, 0, 1, 2)
_LAUGHS = '<?xml version="1.0"?><!DOCTYPE lolz [<!ENTITY a "lol">{}]><scene version="3.0.0">&j;</scene>'.format(
    "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
)
_CUBE = '<shape type="cube" id="box">{}</shape>'
_POSE = _CUBE.format('<transform name="to_world">{}</transform>')

CASES = [
    # The file itself.
    Case("unclosed element", ("scene.xml:", "malformed XML", "close every element"), xml="<shape>"),
    Case("attribute without quotes", ("scene.xml:4", "quote every attribute"), xml="<shape type=cube/>"),
    Case("empty file", ("scene.xml", "malformed XML"), xml=" "),
    Case("no XML at all", ("scene.xml:1", "malformed XML"), xml=" v 0 0 0"),
    Case("billion laughs", ("scene.xml:1", "declares entities", "remove them"), xml=_LAUGHS),
    Case(
        "external entity",
        ("scene.xml:1", "declares entities", "remove them"),
        xml='<!DOCTYPE s [<!ENTITY x SYSTEM "file:///etc/passwd">]><scene version="3.0.0">&x;</scene>',
    ),
    Case("very deep nesting", ("scene.xml:4", "nested more than", "flatten"), xml=deep()),
    Case("no version", ("scene.xml:1 <scene>", "no version", 'write version="3.0.0"'), xml="<scene/>"),
    Case("version to come", ("version '4.0.0'", 'write version="3.0.0"'), xml='<scene version="4.0.0"/>'),
    Case(
        "another root", ("scene.xml:", "no <scene>"), xml='<scenes version="3.0.0"/>'.replace("<scenes", "<?x?><scenes")
    ),
    Case("unknown element", ("scene.xml:4 <shap", "did you mean 'shape'"), xml='<shap type="cube"/>'),
    Case("unsupported element", ("<subsurface", "not supported", "supported:"), xml='<subsurface type="dipole"/>'),
    Case("missing type", ("scene.xml:4 <shape", "'type' is missing", 'write type="..."'), xml='<shape id="x"/>'),
    Case("unknown attribute", ("<shape", "no attribute 'tpye'", "did you mean 'type'"), xml='<shape tpye="cube"/>'),
    Case(
        "duplicate id",
        ("scene.xml:5", "'box' is taken by scene.xml:4", "an id of its own"),
        xml=_CUBE.format("") + "\n" + _CUBE.format(""),
    ),
    Case(
        "parameter given twice",
        ("scene.xml:4", "'radius' is given twice", "remove one"),
        xml='<shape type="sphere"><float name="radius" value="1"/><float name="radius" value="2"/></shape>',
    ),
    Case("undefined $parameter", ("scene.xml:4", "$kind", "<default"), xml='<shape type="$kind"/>'),
    Case("unknown reference", ("scene.xml:4", "'wal'", "known ids: 'cam'"), xml=_CUBE.format('<ref id="wal"/>')),
    Case(
        "circular reference",
        ("scene.xml:4 <bsdf", "contains itself", "break the cycle"),
        xml='<bsdf type="twosided" id="a"><ref id="a"/></bsdf><shape type="cube"><ref id="a"/></shape>',
    ),
    Case("alias of nothing", ("scene.xml:4 <alias", "unknown id 'b'", "ids:"), xml='<alias id="b" as="c"/>'),
    Case(
        "circular include",
        ("b.xml:1", "circular <include>", "remove one"),
        xml='<include filename="b.xml"/>',
        files={"b.xml": '<scene version="3.0.0"><include filename="scene.xml"/></scene>'},
    ),
    Case(
        "missing include",
        ("scene.xml:4", "'b.xml'", "check the name"),
        xml='<include filename="b.xml"/>',
        error=FileNotFoundError,
    ),
    Case(
        "missing path",
        ("scene.xml:4 <path", "'nowhere'", "check the name"),
        xml='<path value="nowhere"/>',
        error=FileNotFoundError,
    ),
    Case(
        "path out of the scene's folder",
        ("scene.xml:4", "leaves the scene's folder", "allow_outside=True"),
        xml='<include filename="../../../../etc/passwd"/>',
    ),
    # Values in files.
    Case(
        "bad number",
        ("scene.xml:4 <float", "'1,5' is no number", "write a number"),
        xml='<shape type="sphere"><float name="radius" value="1,5"/></shape>',
    ),
    Case(
        "bad integer",
        ("<integer", "'4.5'", "whole number"),
        xml='<shape type="sphere"><integer name="resolution" value="4.5"/></shape>',
    ),
    Case(
        "bad boolean",
        ("<boolean", "'yes'", '"true" or "false"'),
        xml=_CUBE.format('<boolean name="flip_normals" value="yes"/>'),
    ),
    Case(
        "bad rgb text",
        ("scene.xml:4 <rgb", "'red'", "'r g b'"),
        xml='<bsdf type="diffuse"><rgb name="reflectance" value="red"/></bsdf>',
    ),
    Case(
        "two rgb numbers",
        ("scene.xml:4 <rgb", "'0.1 0.2'", "'r g b'"),
        xml='<bsdf type="diffuse"><rgb name="reflectance" value="0.1 0.2"/></bsdf>',
    ),
    Case(
        "bad hex colour",
        ("<rgb", "'#12345'", "#rrggbb"),
        xml='<bsdf type="diffuse"><rgb name="reflectance" value="#12345"/></bsdf>',
    ),
    Case(
        "descending spectrum",
        ("<spectrum", "increasing wavelengths"),
        xml='<bsdf type="diffuse"><spectrum name="reflectance" value="500:1, 400:0"/></bsdf>',
    ),
    Case(
        "vector of two",
        ("<vector", "2 numbers", "write 1 or 3"),
        xml='<emitter type="directional"><vector name="direction" value="1 2"/></emitter>',
    ),
    Case("unknown transform step", ("scene.xml:4 <rotat", "did you mean 'rotate'"), xml=_POSE.format('<rotat x="1"/>')),
    Case("matrix of 15", ("<matrix", "15 numbers", "9 or 16"), xml=_POSE.format(f'<matrix value="{"1 " * 15}"/>')),
    Case("rotation about nothing", ("scene.xml:4 <rotate", "non-zero axis"), xml=_POSE.format('<rotate angle="3"/>')),
    Case(
        "look_at itself",
        ("<lookat", "coincide", "move one"),
        xml=_POSE.format('<lookat origin="1 1 1" target="1 1 1" up="0 1 0"/>'),
    ),
    # Plugins and parameters.
    Case("unknown plugin", ("scene['x']", "'cubee'", "did you mean 'cube'"), plugins={"x": {"type": "cubee"}}),
    Case("unsupported bsdf", ("scene.xml:4 <bsdf", "'pplastic'", "roughconductor"), xml='<bsdf type="pplastic"/>'),
    Case(
        "plugin under a wrong tag", ("scene.xml:4 <shape", "unsupported shape 'diffuse'"), xml='<shape type="diffuse"/>'
    ),
    Case(
        "unknown parameter",
        ("scene['x']", "did you mean 'flip_normals'"),
        plugins={"x": {"type": "cube", "flip_normal": True}},
    ),
    Case(
        "unknown colour",
        ("scene['x']['bsdf']", "no parameter 'reflectence'", "did you mean 'reflectance'"),
        plugins=model(type="diffuse", reflectence={"type": "rgb", "value": [0.5, 0.5, 0.5]}),
    ),
    Case(
        "texture without a name",
        ("scene.xml:4 <texture", "takes no texture plugin here (got 'bitmap' without a name)"),
        xml='<bsdf type="diffuse"><texture type="bitmap"/></bsdf>',
    ),
    Case("no type", ("scene['x']", "'type' is None", "name the plugin"), plugins={"x": {}}),
    Case("a number in the scene", ("scene['x']", "a scene holds plugins"), plugins={"x": 5}),
    Case(
        "wrong kind of value",
        ("scene['x'], parameter 'radius'", "give one number"),
        plugins={"x": {"type": "sphere", "radius": "big"}},
    ),
    Case(
        "light inside a model",
        ("scene['x']['bsdf']", "takes no emitter"),
        plugins=model(type="diffuse", l={"type": "area"}),
    ),
    Case(
        "two models on a shape",
        ("scene['x']", "2 bsdf plugins", "at most 1"),
        plugins={"x": {"type": "cube", "a": {"type": "diffuse"}, "b": {"type": "diffuse"}}},
    ),
    Case(
        "area light of two shapes",
        ("scene['b']['light']", "'b' is that of 'a'", "an emitter of its own"),
        plugins={
            "x": {"type": "area"},
            "a": {"type": "cube", "light": {"type": "ref", "id": "x"}},
            "b": {"type": "cube", "light": {"type": "ref", "id": "x"}},
        },
    ),
    Case("two environments", ("'sky'", "'x'", "keep one"), plugins={"x": {"type": "constant"}}),
    Case("nothing to see", ("scene", "no shapes", "add a shape"), plugins={"sky": None}),
    Case("dictionary inside itself", ("contains itself", "break the cycle"), plugins=itself()),
    # Meshes.
    Case(
        "missing mesh",
        ("scene['x'], parameter 'filename'", "'a.obj'", "check the name"),
        plugins=file_shape("obj", "a.obj"),
        error=FileNotFoundError,
    ),
    Case("no file name", ("scene['x']", "without 'filename'", "name the mesh file"), plugins={"x": {"type": "ply"}}),
    Case(
        "truncated ASCII PLY",
        ("a.ply", "ends early", "export the mesh again"),
        plugins=file_shape("ply", "a.ply"),
        files={"a.ply": _PLY.replace("0 1 0\n", "")},
    ),
    Case(
        "truncated binary PLY",
        ("a.ply", "damaged", "export the mesh again"),
        plugins=file_shape("ply", "a.ply"),
        files={"a.ply": _BINARY_PLY[:-9]},
    ),
    Case(
        "PLY that is no PLY",
        ("a.ply", "damaged", "export the mesh again"),
        plugins=file_shape("ply", "a.ply"),
        files={"a.ply": "v 0 0 0"},
    ),
    Case(
        "PLY index out of range",
        ("a.ply", "out of range", "0 to 2"),
        plugins=file_shape("ply", "a.ply"),
        files={"a.ply": _PLY + "3 0 1 7\n"},
    ),
    Case(
        "OBJ index out of range",
        ("a.obj", "line 4", "'9'", "3 v"),
        plugins=file_shape("obj", "a.obj"),
        files={"a.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"},
    ),
    Case(
        "OBJ with words for numbers",
        ("a.obj", "not made of numbers", "export the mesh again"),
        plugins=file_shape("obj", "a.obj"),
        files={"a.obj": "v 0 0 x\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"},
    ),
    Case(
        "OBJ without faces",
        ("scene['x']", "empty", "one face"),
        plugins=file_shape("obj", "a.obj"),
        files={"a.obj": "v 0 0 0\n"},
    ),
    Case(
        "OFF with an infinite vertex",
        ("scene['x'], file", "a.off", "NaN or infinity", "repair the mesh"),
        plugins=file_shape("off", "a.off"),
        files={"a.off": "OFF\n3 1 0\n0 0 0\n1e999 0 0\n0 1 0\n3 0 1 2\n"},
    ),
    Case(
        "STL that is no STL",
        ("scene['x'], file", "a.stl", "empty", "one face"),
        plugins=file_shape("stl", "a.stl"),
        files={"a.stl": "hello"},
    ),
    Case(
        "PLY with a list for a colour",
        ("a.ply", "'red'", "is a list", "only vertex_indices"),
        plugins=file_shape("ply", "a.ply"),
        files={
            "a.ply": _PLY.replace("float z\n", "float z\nproperty list uchar float red\n")
            .replace("0 0 0\n", "0 0 0 1 5\n")
            .replace("1 0 0\n", "1 0 0 2 5 6\n")
            .replace("0 1 0\n", "0 1 0 1 5\n3 0 1 2\n")
        },
    ),
    Case(
        "glb that is no glb",
        ("a.glb", "damaged", "export the mesh again"),
        plugins=file_shape("glb", "a.glb"),
        files={"a.glb": b"\0" * 64},
    ),
    Case(
        "NaN vertex",
        ("scene['x']", "vertex positions", "index 1", "repair the mesh"),
        plugins=mesh(vertices=[[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]]),
    ),
    Case(
        "infinite vertex",
        ("scene['x']", "vertex positions", "repair the mesh"),
        plugins=mesh(vertices=[[0, 0, 0], [np.inf, 0, 0], [0, 1, 0]]),
    ),
    Case(
        "NaN texture coordinate",
        ("scene['x']", "texcoords", "repair the mesh"),
        plugins=mesh(texcoords=np.full((3, 2), np.nan)),
    ),
    Case("index out of range", ("scene['x']", "face 0", "0 to 2"), plugins=mesh(faces=[[0, 1, 3]])),
    Case("negative index", ("scene['x']", "face 0", "0 to 2"), plugins=mesh(faces=[[0, 1, -1]])),
    Case("fractional index", ("parameter 'faces'", "whole numbers"), plugins=mesh(faces=[[0.0, 1.0, 2.5]])),
    Case("quadrilaterals in place", ("parameter 'faces'", "(1, 4)", "triangles"), plugins=mesh(faces=[[0, 1, 2, 0]])),
    Case("empty mesh", ("scene['x']", "empty", "remove the shape"), plugins=mesh(faces=[], vertices=[])),
    Case("no area at all", ("scene['x']", "zero area", "check the vertices"), plugins=mesh(vertices=np.zeros((3, 3)))),
    Case(
        "normals of another count", ("parameter 'normals'", "(2, 3)", "(3, 3)"), plugins=mesh(normals=np.ones((2, 3)))
    ),
    Case("coordinates too large", ("scene['x']", "1e+30", "scale it"), plugins=mesh(vertices=1e30 * np.eye(3))),
    Case(
        "singular pose of a shape",
        ("parameter 'to_world'", "singular", "no zero scale"),
        plugins={"x": {"type": "cube", "to_world": np.diag([1.0, 0.0, 1.0, 1.0])}},
    ),
    Case(
        "pose that is no matrix",
        ("parameter 'to_world'", "(2, 2)", "4x4"),
        plugins={"x": {"type": "cube", "to_world": np.eye(2)}},
    ),
    Case(
        "projective pose",
        ("parameter 'to_world'", "last row", "[0, 0, 0, 1]"),
        plugins={"x": {"type": "cube", "to_world": np.ones((4, 4))}},
    ),
    Case("sphere without radius", ("parameter 'radius'", "above 0"), plugins={"x": {"type": "sphere", "radius": 0.0}}),
    Case(
        "cylinder without length",
        ("scene['x']", "p0 and p1", "two ends"),
        plugins={"x": {"type": "cylinder", "p1": [0, 0, 0]}},
    ),
    Case(
        "resolution of 2", ("parameter 'resolution'", "at least 3"), plugins={"x": {"type": "sphere", "resolution": 2}}
    ),
    # Cameras.
    Case(
        "singular camera", ("parameter 'to_world'", "singular"), plugins=camera(to_world=np.diag([1.0, 1.0, 0.0, 1.0]))
    ),
    Case(
        "stretched camera",
        ("scene['sensor'], parameter 'to_world'", "stretches", "look_at"),
        plugins=camera(to_world=np.diag([1.0, 2.0, 1.0, 1.0])),
    ),
    Case("film of width 0", ("scene['sensor']['film'], parameter 'width'", "at least 1"), plugins=film(width=0)),
    Case("film beyond reason", ("scene['sensor']['film']", "at most 65536"), plugins=film(width=10**9)),
    Case(
        "crop out of the film",
        ("scene['sensor']['film']", "leaves the film", "must not exceed"),
        plugins=film(width=8, height=8, crop_width=9),
    ),
    Case(
        "negative samples",
        ("parameter 'sample_count'", "at least 1"),
        plugins=camera(s={"type": "independent", "sample_count": -4}),
    ),
    Case("fov of 0", ("parameter 'fov'", "between 0 and 180"), plugins=camera(fov=0.0)),
    Case("fov of 180", ("parameter 'fov'", "between 0 and 180"), plugins=camera(fov=180.0)),
    Case(
        "angle and focal length",
        ("scene['sensor']", "both 'fov' and 'focal_length'", "give one of them"),
        plugins=camera(fov=40.0, focal_length="50mm"),
    ),
    Case("unknown fov axis", ("parameter 'fov_axis'", "smaller, larger"), plugins=camera(fov=40.0, fov_axis="z")),
    Case("near behind far", ("scene['sensor']", "near_clip", "smaller"), plugins=camera(near_clip=2.0, far_clip=1.0)),
    Case("unknown filter", ("'lanczos'", "supported"), plugins=film(rfilter={"type": "lanczos"})),
    Case("unsupported camera", ("scene['sensor']", "'distant'", "supported"), plugins={"sensor": {"type": "distant"}}),
]

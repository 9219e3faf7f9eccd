"""Well-formed files that say strange things: scenes, meshes, images, configurations, checkpoints from their grammar."""

import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.stability import corpus
from warp_psdr import image_io
from warp_psdr.arrays import parse_array
from warp_psdr.fit import checkpoint
from warp_psdr.fit.config import FitConfig
from warp_psdr.scene import describe_dict, describe_string
from warp_psdr.scene.errors import SceneError
from warp_psdr.scene.plugins import PLUGINS

#: Examples of a property.
FEW, MANY = 15, 1500
EDGES = (0, 1, 2, 3, 4, 7, 8, 255, 256, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**40, 2**63, 10**40)
INTEGERS = st.one_of(st.sampled_from(EDGES), st.sampled_from(EDGES).map(lambda i: -i), st.integers(-5, 300))
NUMBERS = st.one_of(INTEGERS, st.floats(allow_nan=True), st.sampled_from([1e-45, 1e38, 3.5e38, 1e308, -0.0, 0.5]))
TEXTS = st.one_of(
    NUMBERS.map(str),
    st.lists(NUMBERS, max_size=17).map(lambda values: " ".join(map(str, values))),
    st.sampled_from(["", "true", "false", "a.ply", "a.exr", "a.png", "part.xml", "..", ".", "/", "#ff00ff", "$x",
                     "paint", "400:1, 700:2", "larger", "repeat", "nearest", "Au", "bk7", "9" * 5000]),
    st.text(max_size=12),
)  # fmt: skip
NAMES = st.sampled_from(
    ["radius", "center", "p0", "p1", "to_world", "resolution", "filename", "reflectance", "alpha", "eta", "int_ior",
     "material", "fov", "width", "height", "near_clip", "far_clip", "max_depth", "radiance", "intensity", "scale",
     "cutoff_angle", "position", "sample_count", "stddev", "raw", "to_uv", "wrap_mode", "value", "paint", "crop_width",
     "aperture_radius", "focus_distance", "face_normals", "flip_normals", "irradiance", "direction", "distribution"]
)  # fmt: skip
VALUES = ("float", "integer", "boolean", "string", "rgb", "spectrum", "point", "vector", "transform", "ref", "default",
          "include", "path", "alias", "scale", "rotate", "translate", "lookat", "matrix")  # fmt: skip


def examples(count: int):
    return settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def few_and_many(check, **strategies):
    """Make a fast and a slow test of a property."""
    return examples(FEW)(given(**strategies)(check)), pytest.mark.slow(examples(MANY)(given(**strategies)(check)))


@st.composite
def elements(draw, depth: int = 0) -> str:
    """Draw an XML element: a plugin with children, or a property."""
    quoted = lambda text: "".join(c for c in text if c >= " ").translate(str.maketrans('<>&"', "...."))  # noqa: E731
    if depth < 3 and draw(st.booleans()):
        tag = draw(st.sampled_from([name for name in PLUGINS if name != "scene"]))
        kind = draw(st.sampled_from(PLUGINS[tag]))
        inner = "".join(draw(st.lists(elements(depth=depth + 1), max_size=4)))
        name = f' name="{draw(NAMES)}"' if draw(st.booleans()) else ""
        return f'<{tag} type="{kind}"{name}>{inner}</{tag}>'
    tag = draw(st.sampled_from(VALUES))
    keys = {"ref": ("id",), "include": ("filename",), "path": ("value",), "alias": ("id", "as"),
            "scale": ("x", "y"), "rotate": ("x", "angle"), "translate": ("x", "z"),
            "lookat": ("origin", "target", "up"), "transform": ("name",)}.get(tag, ("name", "value"))  # fmt: skip
    values = {key: draw(NAMES) if key in ("name", "id") else quoted(draw(TEXTS)) for key in keys}
    text = " ".join(f'{key}="{value}"' for key, value in values.items())
    inner = "".join(draw(st.lists(elements(depth=3), max_size=2))) if tag == "transform" else ""
    return f"<{tag} {text}>{inner}</{tag}>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the files that scenes refer to lie."""
    path = tmp_path_factory.mktemp("files")
    corpus.write_beside(path, corpus.files(path))
    return path


def _scenes(folder: Path, inner: list[str]) -> None:
    head = '<sensor type="perspective"/><bsdf type="diffuse" id="paint"/>'
    try:
        describe_string(f'<scene version="3.0.0">{head}{"".join(inner)}</scene>', base=folder)
    except (SceneError, FileNotFoundError):
        pass


test_scenes, test_many_scenes = few_and_many(_scenes, inner=st.lists(elements(), max_size=6))

TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
PROPERTIES = st.one_of(
    st.tuples(st.sampled_from(TYPES), st.sampled_from(["x", "y", "z", "nx", "u", "v", "red", "a_0"])).map(" ".join),
    st.tuples(st.just("list"), st.sampled_from(TYPES), st.sampled_from(TYPES), st.just("vertex_indices")).map(" ".join),
)
ELEMENTS = st.tuples(
    st.sampled_from(["vertex", "face", "edge"]), INTEGERS, st.lists(PROPERTIES, max_size=5, unique=True)
)


def _meshes(folder: Path, kind: str, parts: list, body: bytes) -> None:
    head = "".join(
        f"element {name} {count}\n" + "".join(f"property {p}\n" for p in properties)
        for name, count, properties in parts
    )
    text = body if kind != "ascii" else " ".join(map(str, body)).replace(" 7 ", "\n").encode()
    (folder / "m.ply").write_bytes(f"ply\nformat {kind} 1.0\n{head}end_header\n".encode() + text)
    shape = {"type": "ply", "filename": "m.ply"}
    try:
        describe_dict({"type": "scene", "a": shape, "cam": {"type": "perspective"}}, base=folder)
    except SceneError:
        pass


test_meshes, test_many_meshes = few_and_many(
    _meshes,
    kind=st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    parts=st.lists(ELEMENTS, max_size=4),
    body=st.binary(max_size=200),
)

SIGNED = INTEGERS.map(lambda i: (i + 2**31) % 2**32 - 2**31)


def _images(folder: Path, window: list[int], counts: list[str], compression: int, flags: int, rest: bytes) -> None:
    attribute = lambda name, kind, data: f"{name}\0{kind}\0".encode() + struct.pack("<i", len(data)) + data  # noqa: E731
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iBBBBii", 2, 0, 0, 0, 0, 1, 1) for name in counts) + b"\0"
    head = [
        attribute("channels", "chlist", channels),
        attribute("compression", "compression", bytes([compression])),
        attribute("dataWindow", "box2i", struct.pack("<4i", *window)),
        attribute("displayWindow", "box2i", struct.pack("<4i", *window)),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    file = folder / "m.exr"
    file.write_bytes(b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | flags) + b"".join(head) + b"\0" + rest)
    try:
        image_io.read_image(file)
    except ValueError as problem:
        assert "m.exr" in str(problem)


test_images, test_many_images = few_and_many(
    _images,
    window=st.lists(SIGNED, min_size=4, max_size=4),
    counts=st.lists(st.sampled_from(["R", "G", "B", "A", "Y", "Z"]), max_size=6),
    compression=st.integers(0, 12),
    flags=st.sampled_from([0, 0, 0, 0x200, 0x400, 0x800, 0x1000]),
    rest=st.binary(max_size=300),
)

ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=4)),
    max_leaves=8,
)
FIELDS = st.sampled_from(
    ["scene", "targets", "output", "sensors", "iterations", "views_per_step", "spp", "spp_grad", "final_spp", "seed",
     "loss", "lr_half_life", "betas", "mask_updates", "checkpoint_every", "integrator", "defaults", "allow_outside",
     "parameters", "device", "other"]
)  # fmt: skip


def _configurations(changes: dict, unknown: object) -> None:
    values = {"scene": "a.xml", "targets": ["a.exr"], "output": "out", "parameters": {"a": unknown}} | changes
    try:
        FitConfig.from_mapping(values)
    except (ValueError, TypeError) as problem:
        assert str(problem).startswith("fit config")


test_configurations, test_many_configurations = few_and_many(
    _configurations,
    changes=st.dictionaries(FIELDS, ANYTHING, max_size=3),
    unknown=st.one_of(ANYTHING, st.fixed_dictionaries({"lr": NUMBERS}, optional={"initial": ANYTHING})),
)

DTYPES = st.sampled_from(["<f4", ">f8", "|b1", "<i8", "|O", "<U3", "|V8", "<c8", "<M8[s]", "f4,f4", "(9999999,)<f8"])


def npy(dtype: str, shape: tuple[int, ...], fortran: bool, data: bytes) -> bytes:
    """Return an array's file with a header that says anything."""
    text = f"{{'descr': {dtype!r}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + data


def _checkpoints(folder: Path, entries: list, header: object) -> None:
    head = {"format": "warp_psdr checkpoint", "version": 1, "values": {}}
    text = json.dumps(head | header if isinstance(header, dict) else header).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("__header__.npy", npy("|u1", (len(text),), False, text))
        for i, (name, *array) in enumerate(entries):
            archive.writestr(f"{i}{name}", npy(*array))
    (folder / "m.npz").write_bytes(stream.getvalue())
    try:
        arrays, _ = checkpoint.load(folder / "m.npz")
    except ValueError as problem:
        assert "m.npz" in str(problem)
    else:
        assert all(array.dtype.kind in "biuf" for array in arrays.values())


ARRAYS = st.tuples(
    st.sampled_from(["a.npy", "../a.npy", "b"]),
    DTYPES,
    st.lists(INTEGERS, max_size=3).map(tuple),
    st.booleans(),
    st.binary(max_size=64),
)
test_checkpoints, test_many_checkpoints = few_and_many(
    _checkpoints, entries=st.lists(ARRAYS, max_size=2), header=ANYTHING
)


@examples(FEW)
@given(
    shape=st.lists(st.integers(0, 5), max_size=3).map(tuple),
    dtype=st.sampled_from(["<f4", ">f8", "<i2", "|b1"]),
    fortran=st.booleans(),
)
def test_arrays_come_back(shape: tuple[int, ...], dtype: str, fortran: bool) -> None:
    array = np.arange(np.prod(shape)).astype(dtype).reshape(shape, order="F" if fortran else "C")
    stream = io.BytesIO()
    np.save(stream, array)
    read = parse_array(stream.getvalue())
    assert read.dtype == array.dtype
    np.testing.assert_array_equal(read, array)

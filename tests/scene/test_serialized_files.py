"""Serialized meshes: every version and flag, equal to Mitsuba's and to the same mesh as PLY; files that lie."""

import struct
import zlib

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import describe_dict
from warp_psdr.scene.files.serialized_files import _EXPANSION

VERTICES = np.array([[0, 0, 0], [1, 0, 0.1], [1, 1, 0.5], [0, 1, 0.3]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
NORMALS = np.array([[0, 0, 1], [0, 0.6, 0.8], [0.6, 0, 0.8], [0, 0, 1.0]])
TEXCOORDS = VERTICES[:, :2] * 0.5
COLORS = np.arange(12).reshape(4, 3) / 12.0
SINGLE, DOUBLE = 0x1000, 0x2000
PARTS = {"normals": (1, NORMALS), "uv": (2, TEXCOORDS), "colours": (8, COLORS)}


def stream(version=4, parts=(), double=False, *, vertices=VERTICES, flags=0, name=b"shape\0", counts=None):
    """Return one mesh of versions 3 or 4, its header first."""
    flags |= (DOUBLE if double else SINGLE) | sum(PARTS[p][0] for p in parts)
    body = struct.pack("<I", flags) + (name if version == 4 else b"")
    body += struct.pack("<QQ", *(counts or (len(vertices), len(FACES))))
    for array in (vertices, *(PARTS[p][1] for p in PARTS if p in parts)):
        body += array.astype("<f8" if double else "<f4").tobytes()
    return struct.pack("<HH", 0x041C, version) + zlib.compress(body + FACES.astype("<u4").tobytes())


def stream_5(layout=0, attributes=(), flags=0, points=0, materials=(0, 0)):
    """Return one mesh of version 5."""
    body = struct.pack("<II", SINGLE | layout | flags, 5) + b"shape" + struct.pack("<QQQQ", 4, 2, points, 0)
    body += np.hstack([VERTICES, NORMALS, TEXCOORDS]).astype("<f4").tobytes()
    body += np.hstack([FACES, np.reshape(materials, (2, 1))]).astype("<u4").tobytes()
    body += np.arange(4, dtype="<u4").tobytes() if points else b""
    body += struct.pack("<I", len(attributes))
    for name, values, coded in attributes:
        body += struct.pack("<I", len(name)) + name + struct.pack("<BI", coded, values.shape[1])
        body += values.astype("<f4").tobytes()
    return struct.pack("<HH", 0x041C, 5) + zlib.compress(body)


def file_of(*streams, version=4):
    """Return a file of several meshes with the table at its end."""
    starts = np.cumsum([0, *(len(s) for s in streams[:-1])])
    return (
        b"".join(streams) + starts.astype("<u4" if version == 3 else "<u8").tobytes() + struct.pack("<I", len(starts))
    )


def shape(tmp_path, data, **parameters):
    file = tmp_path / "a.serialized"
    file.write_bytes(data)
    return {"type": "serialized", "filename": str(file), **parameters}


def load(tmp_path, data, **parameters):
    scene = {"type": "scene", "x": shape(tmp_path, data, **parameters), "sky": {"type": "constant"}}
    return describe_dict(scene, base=tmp_path)


@pytest.mark.parametrize("double", [False, True], ids=["single", "double"])
@pytest.mark.parametrize("parts", [(), ("normals",), ("uv",), ("colours",), ("normals", "uv", "colours")], ids=str)
@pytest.mark.parametrize("version", [3, 4])
def test_meshes_equal_mitsubas(tmp_path, version, parts, double):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    moved = stream(version, parts, double, vertices=VERTICES + 1.0)
    data = file_of(moved, stream(version, parts, double), moved, version=version)
    for index in (0, 1):
        ours = load(tmp_path, data, shape_index=index, to_world=psdr.Transform.scale([2, 1, 3])).shapes[0]
        scale = mi.ScalarTransform4f().scale([2, 1, 3])
        theirs = mi.traverse(mi.load_dict(shape(tmp_path, data, shape_index=index, to_world=scale)))
        for name, values in (("positions", ours.vertices), ("normals", ours.normals), ("texcoords", ours.texcoords)):
            expected = np.array(theirs[f"vertex_{name}"])
            found = np.zeros(0) if values is None else values.reshape(-1)
            np.testing.assert_allclose(found, expected, atol=2e-6, err_msg=name)
        np.testing.assert_array_equal(ours.faces.reshape(-1), np.array(theirs["faces"]))
        assert ours.normals_computed == ("normals" not in parts)
    # Mitsuba leaves the colours out.
    expected = {"vertex_color": COLORS.astype(np.float32)} if "colours" in parts else {}
    assert ours.attributes.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(ours.attributes[name], values)


@pytest.mark.parametrize("face_normals", [False, True])
def test_scenes_equal_those_of_the_same_mesh_as_ply_to_the_bit(tmp_path, face_normals):
    names = "x y z nx ny nz u v red green blue".split()
    head = "".join(f"property float {n}\n" for n in names)
    rows = np.hstack([VERTICES, NORMALS, TEXCOORDS, COLORS]).astype(np.float32)
    body = "\n".join(" ".join(map(repr, row)) for row in rows.tolist()) + "\n3 0 1 2\n3 0 2 3\n"
    text = f"ply\nformat ascii 1.0\nelement vertex 4\n{head}element face 2\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_text(f"{text}end_header\n{body}")
    options = {"flip_normals": True, "face_normals": face_normals, "to_world": psdr.Transform.scale([1, -2, 1])}
    ours = load(tmp_path, file_of(stream(4, tuple(PARTS))), **options).shapes[0]
    ply = {"type": "ply", "filename": str(tmp_path / "a.ply"), **options}
    theirs = describe_dict({"type": "scene", "x": ply, "sky": {"type": "constant"}}, base=tmp_path).shapes[0]
    for name in ("vertices", "faces", "normals", "texcoords"):
        a, b = getattr(ours, name), getattr(theirs, name)
        assert (a is None) == (b is None) == (face_normals and name == "normals")
        if a is not None:
            np.testing.assert_array_equal(a, b)
    assert ours.flip_normals and theirs.flip_normals
    np.testing.assert_array_equal(ours.attributes["vertex_color"], theirs.attributes["vertex_color"])


def test_version_5_as_its_description_says(tmp_path):
    attributes = [(b"vertex_color", COLORS, 0), (b"face_id", np.array([[1.0], [2.0]]), 0)]
    attributes += [(b"vertex_pair", TEXCOORDS, 0), (b"face_spectrum", np.eye(3)[:2], 1)]
    scene = load(tmp_path, file_of(stream_5(), stream_5(1 | 4, attributes, points=4, materials=(0, 1))), shape_index=1)
    found = scene.shapes[0]
    np.testing.assert_array_equal(found.vertices, VERTICES.astype(np.float32))
    np.testing.assert_array_equal(found.texcoords, TEXCOORDS.astype(np.float32))
    np.testing.assert_allclose(found.normals, NORMALS, atol=1e-7)
    np.testing.assert_array_equal(found.attributes["face_id"], [[1.0], [2.0]])
    assert set(found.attributes) == {"vertex_color", "face_id"}
    notes = "\n".join(scene.notes)
    assert "own materials are ignored" in notes and "'vertex_pair' is ignored: it has 2 components" in notes
    assert "'face_spectrum' is ignored: it holds coefficients" in notes
    plain = load(tmp_path, file_of(stream_5(1, flags=0x10))).shapes[0]
    assert plain.normals is None and plain.texcoords is None
    assert load(tmp_path, file_of(stream_5(1, flags=0x10)), face_normals=False).shapes[0].normals is not None


def test_a_file_without_its_table_has_a_first_mesh_and_the_flag_of_faces_is_told(tmp_path):
    scene = load(tmp_path, stream(flags=0x10))
    assert scene.shapes[0].normals is not None and "'face_normals' asks for them" in scene.notes[0]


GOOD = stream()
LIES = {
    "empty": (b"", {}, "does not start with 0x041C"),
    "another format": (b"ply\nformat ascii 1.0\n", {}, "does not start with 0x041C"),
    "version 2": (struct.pack("<HH", 0x041C, 2) + GOOD[4:], {}, "version 2 of the format; versions 3, 4 and 5"),
    "cut off": (GOOD[:-30], {}, "ends early, in the "),
    "only a head": (GOOD[:4], {}, "too short for the header"),
    "damaged": (GOOD[:4] + b"\xff" + GOOD[5:], {}, "cannot be unpacked"),
    "2^63 vertices": (stream(counts=(2**63, 2)), {}, "too short for the vertex positions"),
    "2^62 faces": (stream(counts=(4, 2**62)), {}, "too short for the faces"),
    "more than it holds": (stream(counts=(5, 2)), {}, "ends early, in the faces"),
    "a name without an end": (stream(name=b"x" * 5000), {}, "more than 4096 letters"),
    "no table": (GOOD, {"shape_index": 1}, "for which it is too short"),
    "2^32 meshes": (GOOD + b"\xff" * 4, {"shape_index": 1}, "names 4294967295 meshes, for which it is too short"),
    "no such mesh": (file_of(GOOD, GOOD), {"shape_index": 2}, "the file holds meshes 0 to 1"),
    "negative": (file_of(GOOD, GOOD), {"shape_index": -1}, "give a whole number of at least 0"),
    "offset at the end": (GOOD + struct.pack("<QQI", 0, 2**40, 2), {"shape_index": 1}, "starts at byte 1099511627776"),
    "offset into a mesh": (GOOD + struct.pack("<QQI", 0, 9, 2), {"shape_index": 1}, "does not start with 0x041C"),
    "tangents": (stream_5(2), {}, "holds tangents; write it without them"),
    "points": (stream_5(points=9), {}, "4 vertices are said to be 9 points"),
    "an index": (stream(counts=(3, 2)), {}, "vertex index out of range"),
    "NaN": (stream(vertices=VERTICES * [[np.nan, 1, 1]]), {}, "hold NaN or infinity"),
}


@pytest.mark.parametrize("name", LIES)
def test_files_that_lie_are_named_with_their_place(tmp_path, name):
    data, parameters, words = LIES[name]
    with pytest.raises(ValueError) as caught:
        load(tmp_path, data, **parameters)
    assert "scene['x']" in str(caught.value) and words in str(caught.value)


def test_no_memory_is_taken_for_what_a_file_cannot_hold(tmp_path, monkeypatch):
    """A bomb: zeros, a thousand to a byte, of which a header announces few; only those are unpacked."""
    import tracemalloc

    head = struct.pack("<I", SINGLE) + b"\0" + struct.pack("<QQ", 4, 2)
    data = struct.pack("<HH", 0x041C, 4) + zlib.compress(head + bytes(1 << 26))
    assert len(data) * _EXPANSION > 1 << 26
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match="zero area"):
            load(tmp_path, data)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()

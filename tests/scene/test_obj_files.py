"""OBJ files in all their spellings, and without a step of Python for each of their lines."""

import sys

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import describe_dict
from warp_psdr.scene.files.obj_files import read_obj

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nvn 1 0 0\n"


def read(tmp_path, text):
    file = tmp_path / "a.obj"
    file.write_bytes(text.encode())
    return read_obj(file, "a.obj", None)


def plain(data):
    fields = (data.vertices, data.faces, data.normals, data.texcoords)
    return [None if values is None else np.asarray(values).tolist() for values in fields]


@pytest.mark.parametrize(
    ("spelling", "change"),
    [
        ("CRLF", lambda text: text.replace("\n", "\r\n")),
        ("CR", lambda text: text.replace("\n", "\r")),
        ("tabs", lambda text: text.replace(" ", "\t")),
        ("wide spaces", lambda text: text.replace(" ", "   ").replace("\n", "  \n ")),
        ("no end of the last line", lambda text: text.rstrip("\n")),
        ("blank lines", lambda text: text.replace("\n", "\n\n \n")),
        ("comments and groups", lambda text: "# v 1\no x\ng y\nusemtl v\ns 1\n" + text.replace("vt", "#vt 9 9\nvt")),
    ],
)
def test_spellings(tmp_path, spelling, change):
    text = SQUARE + "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4//2\n"
    assert plain(read(tmp_path, change(text))) == plain(read(tmp_path, text))


def test_corners_of_every_form_in_one_file(tmp_path):
    text = SQUARE + "f 1 2/1 3//1 4/3/2\nf -4/ -3/-1 -2/-1/-2\nf 1/ 2/\t3/\n"
    data = read(tmp_path, text)
    found = data.vertices[data.faces].tolist()
    a, b, c, d = [0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]
    assert found == [[a, b, c], [a, c, d], [a, b, c], [a, b, c]]
    # First uses: 1, 2/1, 3//1, 4/3/2, 2/3, 3/3/1, then 2 and 3.
    assert data.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 6, 7]]
    assert data.texcoords.tolist() == [[0, 0], [0, 0], [0, 0], [1, 1], [1, 1], [1, 1], [0, 0], [0, 0]]
    assert data.normals.tolist()[2:6] == [[0, 0, 1], [1, 0, 0], [0, 0, 0], [0, 0, 1]]


def test_negative_indices_count_from_their_line(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 6 1 0\nf -3 -2 -1\n"
    data = read(tmp_path, text)
    assert data.vertices[data.faces[1]].tolist() == [[5, 0, 0], [6, 0, 0], [6, 1, 0]]


def test_numbers_in_all_forms_and_lines_of_different_lengths(tmp_path):
    text = "v 1e-3 -.5 +2 1\nv 1 0 0 0.5 0.25 0.125\nv 0 1E0 0 7 8 9 1\nf 1 2 3\n"
    data = read(tmp_path, text)
    assert data.vertices.tolist() == [[0.001, -0.5, 2.0], [1, 0, 0], [0, 1, 0]] and not data.attributes


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("f 1 2 x", "line 10.*cannot read the corner 'x'"),
        ("f 1 2 3.5", "line 10.*cannot read the corner '3.5'"),
        ("f 1 2 3\nf 1 2 5", "line 11.*corner '5' refers to a missing vertex.*4 v, 3 vt and 2 vn"),
        ("f 1 2 0", "corner '0' refers"),
        ("f 1 2 -5", "corner '-5' refers"),
        ("f 1/1 2/4 3/1", "corner '2/4' refers"),
        ("f 1//1 2//1 3//3", "corner '3//3' refers"),
        ("f 1 2 99999999999999999999", "corner"),
        ("f /1 /2 /3", "cannot be read|refers"),
        ("f 1 2", "line 10.*a face with 2 corners"),
        ("f", "a face with 0 corners"),
        ("v 1 v2 3\nf 1 2 3", "not made of numbers"),
        ("v 1 2\nf 1 2 3", "line 10.*'v 1 2' has 2 numbers"),
        ("vt 1 nothing\nf 1 2 3", "'vt' line is not made of numbers"),
    ],
)
def test_lines_that_cannot_be_read_are_named(tmp_path, line, words):
    with pytest.raises(ValueError, match=words):
        read(tmp_path, SQUARE + line + "\n")


def test_files_without_faces_are_empty_meshes(tmp_path):
    for text in ("", "\n", SQUARE, "# nothing"):
        assert len(read(tmp_path, text).faces) == 0


def test_no_step_of_python_for_each_line(tmp_path):
    def calls(n):
        lines = [f"v {i} 0 {i % 7}" for i in range(n)] + [f"vn 0 {i} 1" for i in range(n)]
        lines += [f"f {i + 1}//{n - i} {i + 2}//{i + 1} {i + 3}//1" for i in range(n - 2)]
        count = 0

        def count_call(frame, event, argument):
            nonlocal count
            count += 1

        sys.setprofile(count_call)
        try:
            read(tmp_path, "\n".join(lines))
        finally:
            sys.setprofile(None)
        return count

    calls(10)
    assert calls(2000) <= calls(20) + 20


PAINT = "newmtl paint\nKd 1 0 0\n\tmap_Kd -s 1 1 1 wood.png\nmap_kd wood.png\nnewmtl other\nmap_Kd {}.png\n"
GREY = {"type": "diffuse", "reflectance": 0.5}
PICTURE = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": np.ones((2, 2, 3), np.float32)}}


def notes(folder, library, **shape):
    (folder / "a.obj").write_text(f"mtllib {library}\n{SQUARE}usemtl paint\nf 1/1/1 2/2/1 3/3/1\n")
    scene = {"type": "scene", "s": {"type": "obj", "filename": "a.obj", **shape}, "camera": {"type": "perspective"}}
    return [
        note for note in describe_dict({**scene, "sky": {"type": "constant"}}, base=folder).notes if "map_Kd" in note
    ]


@pytest.mark.parametrize("library", ["paint.mtl", "my paint.mtl", "none.mtl paint.mtl"])
def test_pictures_of_materials_are_noted_where_the_shape_has_none(tmp_path, library):
    name = library if library != "none.mtl paint.mtl" else "paint.mtl"
    (tmp_path / name).write_text(PAINT.format("stone"))
    for shape in ({}, {"bsdf": GREY}):
        (note,) = notes(tmp_path, library, **shape)
        assert (
            "and with them pictures such as 'wood.png' (map_Kd); name it in the shape's bsdf, {'type': 'diffuse'"
            in note
        )
        assert "'filename': 'wood.png'" in note and "psdr.load_mesh" in note
    assert not notes(tmp_path, library, bsdf=PICTURE)
    assert not notes(tmp_path, library, bsdf={"type": "twosided", "bsdf": PICTURE})


def test_materials_without_pictures_and_files_that_may_not_be_read_are_no_matter(tmp_path):
    inside = tmp_path / "scene"
    inside.mkdir()
    (inside / "paint.mtl").write_text("newmtl paint\nKd 1 0 0\nmap_Ka a.png\nmap_Kd\n")
    (tmp_path / "paint.mtl").write_text(PAINT)
    for library in ("paint.mtl", "none.mtl", "../paint.mtl", ""):
        assert not notes(inside, library)


def test_a_mesh_is_no_scene(tmp_path):
    (tmp_path / "vase.OBJ").write_text(SQUARE)
    with pytest.raises(
        ValueError, match=r"vase.OBJ': it is a mesh, and no scene; put it in one: .*psdr.load_mesh\('vase"
    ):
        psdr.load_file(tmp_path / "vase.OBJ")

"""Text PLY files are read as arrays, with trimesh's values, where all their faces have equally many corners."""

import io

import numpy as np
import pytest

from warp_psdr.scene.files.mesh_files import read_mesh
from warp_psdr.scene.files.ply_files import read_text_ply

HEAD = (
    "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 4\nproperty float x\nproperty float y\n"
    "property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    "element face 2\nproperty list uchar int vertex_indices\nproperty float id_0\nend_header\n"
)
VERTICES = "0 0 0 255 0 0\n1 0 1e-3 0 255 0\n1 1 0 0 0 255\n0 1 0 1 2 3\n"
TRIANGLES = "3 0 1 2 7\n3 0 2 3 8\n"


def written(tmp_path, text):
    file = tmp_path / "a.ply"
    file.write_bytes(text.encode())
    return file


@pytest.mark.parametrize("faces", [TRIANGLES, "4 0 1 2 3 7\n4 3 2 1 0 8\n"], ids=["triangles", "quads"])
def test_values_equal_those_of_trimesh(tmp_path, faces):
    from trimesh.exchange import ply

    file = written(tmp_path, HEAD + VERTICES + faces)
    theirs = ply.load_ply(io.BytesIO(file.read_bytes()), fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]
    ours = read_text_ply(file)
    for element in ("vertex", "face"):
        assert ours[element]["length"] == theirs[element]["length"]
        for name in theirs[element]["properties"]:
            expected = np.asarray(theirs[element]["data"][name])
            np.testing.assert_array_equal(ours[element]["data"][name].ravel(), expected.ravel(), err_msg=name)
    mesh = read_mesh("ply", file, "here", lambda text: None)
    np.testing.assert_array_equal(mesh.attributes["vertex_color"][:3], np.eye(3))
    assert mesh.faces.shape == (2 if faces == TRIANGLES else 4, 3) and mesh.faces.dtype.kind == "i"


@pytest.mark.parametrize(
    "text",
    [
        HEAD + VERTICES + "3 0 1 2 7\n4 0 1 2 3 8\n",  # faces that differ
        HEAD + VERTICES + "3 0 1 2 7\n3 0 2 3\n",  # cut off
        HEAD + VERTICES + TRIANGLES + "9\n",  # too long
        HEAD + VERTICES.replace("255 0 0", "300 0 0") + TRIANGLES,  # a byte of 300
        HEAD + VERTICES.replace("1e-3", "much") + TRIANGLES,
        HEAD + VERTICES + TRIANGLES.replace("3 0 1 2 7", "-3 0 1 2 7"),
        HEAD + VERTICES + TRIANGLES.replace("3 0 1 2 7", "nan 0 1 2 7"),
        HEAD.replace("list uchar int vertex_indices", "list uchar int other") + VERTICES + TRIANGLES,
        HEAD.replace("ascii", "binary_little_endian") + VERTICES + TRIANGLES,
        HEAD.replace("element face 2", "element face 0") + VERTICES,
        HEAD.replace("property double z", "property real z") + VERTICES + TRIANGLES,
        "ply\n",
        "",
    ],
)
def test_all_else_is_left_to_trimesh(tmp_path, text):
    assert read_text_ply(written(tmp_path, text)) is None

"""Mesh files and meshes in place: nothing is merged or reordered; normals, attributes and repairs."""

import struct

import numpy as np
import pytest
import trimesh

from warp_psdr.scene import Transform, describe_dict, describe_string
from warp_psdr.scene.shapes.meshes import vertex_normals

FOLDED = """
v 0 0 0
v 0 1 0
v 2 0 0
v 0 0 3
vt 0 0
vt 1 0
vt 1 1
vt .5 .25
f 1/1 3/2 2/3
f 1/4 2/2 4/1
"""
POLYGONS = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv -1 .5 0\nv 9 9 9\nf 2 3 4 5 1\nf -6 -5 -4\n"
NORMALS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 2\nvn 1 0 1\nusemtl a\nf 1//1 2//1 3//1\nusemtl b\nf 1//2 2//2 3//2\n"
PLY = """ply
format ascii 1.0
element vertex 5
property float x
property float y
property float z
property float u
property float v
property uchar red
property uchar green
property uchar blue
property float albedo_x
property float albedo_y
property float albedo_z
property float rough_0
property float lonely
element face 2
property list uchar int vertex_indices
property float glow_r
property float glow_g
property float glow_b
end_header
0 0 0 0 .25 255 0 0 .1 .2 .3 .4 7
0 1 0 0 0 0 255 0 .1 .2 .3 .4 7
2 0 0 0 0 0 255 0 .1 .2 .3 .4 7
0 0 3 0 0 0 0 255 .1 .2 .3 .4 7
9 9 9 1 0 0 0 255 .1 .2 .3 .4 7
4 0 2 1 3 1 2 3
3 0 1 3 4 5 6
"""


def shape(kind, **parameters):
    return describe({"type": kind, **parameters}).shapes[0]


def describe(x, **options):
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, "x": x}
    return describe_dict(scene, **options)


def written(tmp_path, name, text):
    file = tmp_path / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return str(file)


def test_obj_keeps_seams_and_the_order_of_first_use(tmp_path):
    x = shape("obj", filename=written(tmp_path, "a.obj", FOLDED))
    np.testing.assert_array_equal(x.vertices, [[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 0], [0, 1, 0], [0, 0, 3]])
    np.testing.assert_array_equal(x.faces, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(x.texcoords, [[0, 1], [1, 1], [1, 0], [0.5, 0.75], [1, 1], [0, 1]])
    assert x.normals_computed
    np.testing.assert_allclose(x.normals, [[0, 0, 1]] * 3 + [[1, 0, 0]] * 3, atol=1e-7)


def test_obj_polygons_negative_indices_and_unused_vertices(tmp_path):
    x = shape("obj", filename=written(tmp_path, "a.obj", POLYGONS))
    np.testing.assert_array_equal(x.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [4, 0, 1]])
    np.testing.assert_array_equal(x.vertices, [[1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 0.5, 0], [0, 0, 0]])
    assert x.texcoords is None


def test_obj_normals_split_vertices_and_become_unit(tmp_path):
    file = written(tmp_path, "a.obj", NORMALS)
    x = shape("obj", filename=file)
    assert len(x.vertices) == 6 and not x.normals_computed
    np.testing.assert_allclose(x.normals[0], [0, 0, 1])
    np.testing.assert_allclose(x.normals[5], [0.5**0.5, 0, 0.5**0.5], rtol=1e-6)
    flat = shape("obj", filename=file, face_normals=True)
    assert flat.normals is None and not flat.normals_computed


def test_obj_vertex_colours(tmp_path):
    x = shape("obj", filename=written(tmp_path, "a.obj", "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n"))
    np.testing.assert_array_equal(x.attributes["vertex_color"], np.eye(3))


def test_flip_tex_coords_overrides_the_default_of_the_format(tmp_path):
    x = shape("obj", filename=written(tmp_path, "a.obj", FOLDED), flip_tex_coords=False)
    np.testing.assert_array_equal(x.texcoords[0], [0, 0])
    y = shape("ply", filename=written(tmp_path, "a.ply", PLY), flip_tex_coords=True)
    np.testing.assert_array_equal(y.texcoords[0], [0, 0.75])


def test_ply_keeps_isolated_vertices_and_groups_attributes(tmp_path):
    result = describe({"type": "ply", "filename": written(tmp_path, "a.ply", PLY)})
    x = result.shapes[0]
    np.testing.assert_array_equal(x.vertices[4], [9, 9, 9])
    np.testing.assert_array_equal(x.faces, [[0, 2, 1], [0, 1, 3], [0, 1, 3]])
    np.testing.assert_array_equal(x.texcoords[0], [0, 0.25])
    assert set(x.attributes) == {"vertex_color", "vertex_albedo", "vertex_rough", "face_glow_color"}
    np.testing.assert_array_equal(x.attributes["vertex_color"][:2], [[1, 0, 0], [0, 1, 0]])
    assert x.attributes["vertex_rough"].shape == (5, 1)
    # Both triangles of the quadrilateral carry its values.
    np.testing.assert_array_equal(x.attributes["face_glow_color"], [[1, 2, 3], [1, 2, 3], [4, 5, 6]])
    assert any("'lonely' is ignored" in note for note in result.notes)


@pytest.mark.parametrize("count", [3, 1 << 62])
def test_ply_elements_without_properties_hold_nothing(tmp_path, count):
    text = PLY.replace("end_header", f"element empty {count}\nend_header")
    assert len(shape("ply", filename=written(tmp_path, "a.ply", text)).faces) == 3


def binary_ply(order):
    header = (
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\nelement vertex 4\nproperty float x\n"
        "property float y\nproperty float z\nproperty float nx\nproperty float ny\nproperty float nz\n"
        "element face 2\nproperty list uchar int vertex_indices\nproperty float id_0\nend_header\n"
    )
    vertices = np.array([[0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1], [1, 1, 0, 0, 0, 1], [0, 1, 0, 0, 0, 1]], order + "f4")
    faces = [struct.pack(order + "B3if", 3, *f, i) for i, f in enumerate([(0, 1, 2), (0, 2, 3)])]
    return header.encode() + vertices.tobytes() + b"".join(faces)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply(tmp_path, order):
    x = shape("ply", filename=written(tmp_path, "a.ply", binary_ply(order)))
    np.testing.assert_array_equal(x.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    np.testing.assert_array_equal(x.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(x.attributes["face_id"], [[0], [1]])
    assert not x.normals_computed and x.vertices.dtype == np.float32 and x.faces.dtype == np.int32


@pytest.mark.parametrize("kind", ["stl", "off", "glb"])
def test_other_formats(tmp_path, kind):
    box = trimesh.creation.box()
    box.export(tmp_path / f"a.{kind}")
    x = shape(kind, filename=str(tmp_path / f"a.{kind}"))
    assert len(x.faces) == 12 and x.normals_computed
    # STL stores every corner for itself; nothing is merged.
    assert len(x.vertices) == (36 if kind == "stl" else 8)
    np.testing.assert_allclose(np.sort(x.vertices[x.faces].mean(axis=1), axis=0), np.sort(box.triangles_center, axis=0))


@pytest.mark.parametrize("solids", [1, 2])
def test_text_stl(tmp_path, solids):
    text = trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box())
    text += "\n" + text.replace("solid", "solid second", 1) if solids == 2 else ""
    x = shape("stl", filename=written(tmp_path, "a.stl", text))
    assert x.vertices.shape == (36 * solids, 3) and x.faces.shape == (12 * solids, 3)


def test_gltf_places_its_nodes_and_turns_texture_coordinates(tmp_path):
    box = trimesh.creation.box()
    uv = np.random.default_rng(0).random((8, 2))
    box.visual = trimesh.visual.TextureVisuals(uv=uv)
    scene = trimesh.Scene([box])
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([10, 0, 0]))
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(data)
    result = describe({"type": "gltf", "filename": "model.gltf"}, base=tmp_path)
    x = result.shapes[0]
    assert x.vertices.shape == (16, 3) and x.faces.shape == (24, 3) and x.faces.max() == 15
    assert np.count_nonzero(x.vertices[:, 0] > 5) == 8
    # Top row first, v = 0 at the top, as glTF has it: the opposite of what trimesh was given.
    np.testing.assert_allclose(x.texcoords[:8], np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1), atol=1e-6)
    assert any("materials of glTF" in note for note in result.notes)


def test_meshes_in_place():
    triangle = {"vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]]}
    plain = shape("mesh", **triangle)
    assert plain.normals_computed
    np.testing.assert_array_equal(plain.normals, [[0, 0, 1]] * 3)
    flat = shape("mesh", **triangle, face_normals=True)
    assert flat.normals is None
    full = shape(
        "mesh",
        vertices=np.ravel(triangle["vertices"]).astype(np.float64),
        faces=np.array([0, 1, 2], dtype=np.uint64),
        normals=[[0, 0, 5.0]] * 3,
        texcoords=[[0, 0], [1, 0], [0, 1]],
        vertex_color=np.eye(3),
        face_heat=[[7.0]],
        to_world=Transform.rotate([1, 0, 0], 90) @ Transform.scale([1, 1, 2]),
    )
    assert not full.normals_computed
    np.testing.assert_allclose(full.normals, [[0, -1, 0]] * 3, atol=1e-7)
    np.testing.assert_array_equal(full.texcoords, [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(full.attributes["vertex_color"], np.eye(3))
    assert full.attributes["face_heat"].tolist() == [[7.0]]


def test_normals_follow_non_uniform_scaling():
    x = shape(
        "mesh",
        vertices=[[0, 0, 0], [1, 0, -1], [0, 1, 0]],
        faces=[[0, 1, 2]],
        normals=[[1, 0, 1]] * 3,
        to_world=Transform.scale([2, 1, 1]),
    )
    # Stays perpendicular to the surface x + 2 z = 0.
    np.testing.assert_allclose(x.normals, np.tile(np.array([1, 0, 2]) / 5**0.5, (3, 1)), rtol=1e-6)


def test_vertex_normals_are_weighted_by_angle():
    # Three faces of a cube meet at the origin; one of them is cut in two, which must not matter.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], dtype=np.float64)
    faces = np.array([[0, 4, 1], [0, 2, 4], [0, 3, 2], [0, 1, 3]])
    np.testing.assert_allclose(vertex_normals(vertices, faces)[0], -np.ones(3) / 3**0.5, rtol=1e-12)


def test_isolated_vertices_have_a_normal():
    x = shape("mesh", vertices=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], faces=[[0, 1, 2]])
    np.testing.assert_array_equal(x.normals[3], [1, 0, 0])


def test_flat_triangles_are_dropped_and_counted():
    result = describe(
        {
            "type": "mesh",
            "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]],
            "faces": [[0, 1, 3], [0, 1, 2], [1, 1, 2], [0, 1, 2]],
            "face_id": [[0.0], [1.0], [2.0], [3.0]],
        }
    )
    x = result.shapes[0]
    # Duplicates stay; vertices keep their numbers.
    np.testing.assert_array_equal(x.faces, [[0, 1, 2], [0, 1, 2]])
    assert len(x.vertices) == 4 and x.attributes["face_id"].tolist() == [[1.0], [3.0]]
    assert x.repairs == {"zero-area triangles dropped": 2}
    assert any("2 zero-area triangles dropped" in note for note in result.notes)


def test_thin_but_real_triangles_stay():
    x = shape("mesh", vertices=[[0, 0, 0], [1, 0, 0], [0.5, 1e-6, 0]], faces=[[0, 1, 2]])
    assert len(x.faces) == 1 and x.repairs == {}


def test_zero_normals_are_replaced_and_counted():
    x = shape("mesh", vertices=np.eye(3), faces=[[0, 1, 2]], normals=[[0, 0, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_allclose(x.normals[0], np.ones(3) / 3**0.5, rtol=1e-6)
    np.testing.assert_allclose(x.normals[1], [0, 0, 1])
    assert x.repairs == {"vertex normals of length zero replaced": 1} and not x.normals_computed


def test_mesh_attribute_needs_the_attribute():
    texture = {"type": "mesh_attribute", "name": "vertex_colour"}
    mesh = {"type": "mesh", "vertices": np.eye(3), "faces": [[0, 1, 2]], "vertex_color": np.eye(3)}
    with pytest.raises(ValueError, match=r"no attribute 'vertex_colour'.*vertex_color"):
        describe({**mesh, "bsdf": {"type": "diffuse", "reflectance": texture}})


def test_relative_names_start_from_the_scene(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "scenes").mkdir()
    written(tmp_path / "meshes", "a.obj", FOLDED)
    x = '<shape type="obj"><string name="filename" value="{}"/></shape>'
    xml = '<scene version="3.0.0"><sensor type="perspective"/>{}' + x + "</scene>"
    assert describe_string(xml.format("", "meshes/a.obj"), base=tmp_path).shapes
    assert describe_string(xml.format('<path value="meshes"/>', "a.obj"), base=tmp_path).shapes
    with pytest.raises(ValueError, match="allow_outside=True"):
        describe_string(xml.format("", "../meshes/a.obj"), base=tmp_path / "scenes")
    assert describe_string(xml.format("", "../meshes/a.obj"), base=tmp_path / "scenes", allow_outside=True).shapes
    absolute = xml.format("", tmp_path / "meshes" / "a.obj")
    assert describe_string(absolute, base=tmp_path).shapes
    with pytest.raises(ValueError, match="leaves the scene's folder"):
        describe_string(absolute, base=tmp_path / "scenes")
    assert describe_string(absolute, base=tmp_path / "scenes", allow_outside=tmp_path).shapes


@pytest.mark.parametrize("text", [FOLDED, NORMALS])
def test_obj_equals_mitsubas_vertex_by_vertex(tmp_path, text):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    file = written(tmp_path, "a.obj", text)
    theirs, x = mi.traverse(mi.load_dict({"type": "obj", "filename": file})), shape("obj", filename=file)
    np.testing.assert_array_equal(np.array(theirs["faces"]).reshape(-1, 3), x.faces)
    np.testing.assert_array_equal(np.array(theirs["vertex_positions"]).reshape(-1, 3), x.vertices)
    their_normals = np.array(theirs["vertex_normals"]).reshape(-1, 3)
    # Mitsuba leaves the normals of a file at their length.
    np.testing.assert_allclose(
        their_normals / np.linalg.norm(their_normals, axis=1, keepdims=True), x.normals, atol=1e-6
    )
    if x.texcoords is not None:
        np.testing.assert_allclose(np.array(theirs["vertex_texcoords"]).reshape(-1, 2), x.texcoords, atol=1e-7)


def test_ply_equals_mitsubas(tmp_path):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    # Mitsuba reads triangles and floating-point colours only.
    text = PLY.replace("4 0 2 1 3 1 2 3", "3 0 2 1 1 2 3").replace("property float lonely\n", "").replace(" 7\n", "\n")
    file = written(
        tmp_path,
        "a.ply",
        text.replace("uchar red", "float r")
        .replace("uchar green", "float g")
        .replace("uchar blue", "float b")
        .replace("255", "1"),
    )
    theirs, x = mi.traverse(mi.load_dict({"type": "ply", "filename": file})), shape("ply", filename=file)
    names = {name for name in theirs.properties if name.startswith(("vertex_", "face_"))}
    assert names - {"vertex_positions", "vertex_normals", "vertex_texcoords"} == set(x.attributes)
    for name, values in x.attributes.items():
        np.testing.assert_allclose(np.array(theirs[name]), values.ravel(), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(np.array(theirs["vertex_normals"]).reshape(-1, 3), x.normals, atol=1e-6)
    np.testing.assert_allclose(np.array(theirs["vertex_texcoords"]).reshape(-1, 2), x.texcoords, atol=1e-7)

"""``load_mesh`` and ``preview_scene``: files with their materials as parts of a scene."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

import warp_psdr as psdr
from warp_psdr.image_io import srgb_to_linear
from warp_psdr.scene.files.dictionary import describe_dict

#: A square of two triangles with texture coordinates, then a triangle of another material.
OBJ = """mtllib vase.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 5 0 0
v 6 0 0
v 5 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl leaf green
f 1/1 2/2 3/3 4/4
usemtl foot
f 5 6 7
"""
MTL = """# made by hand
newmtl leaf green
Kd 0.1 0.2 0.3
map_Kd -s 2 3 1 -o 0.5 0.25 tex\\a b.png
Ks 0.5 0.5 0.5
Ns 198
norm n.png
newmtl foot
Kd 0.7 0.2 0.1
d 0.25
Ke 3 2 1
"""
PIXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [64, 128, 192]]], dtype=np.uint8)


@pytest.fixture
def vase(tmp_path):
    (tmp_path / "vase.obj").write_text(OBJ)
    (tmp_path / "vase.mtl").write_text(MTL)
    (tmp_path / "tex").mkdir()
    Image.fromarray(PIXELS).save(tmp_path / "tex" / "a b.png")
    Image.fromarray(PIXELS).save(tmp_path / "n.png")
    return tmp_path / "vase.obj"


def described(mesh):
    return describe_dict({"type": "scene", "vase": mesh, "sky": {"type": "constant"}})


def test_materials_of_an_obj_become_shapes(vase) -> None:
    mesh = psdr.load_mesh(vase)
    assert mesh["type"] == "merge" and list(mesh) == ["type", "vase-leaf_green", "vase-foot"]
    scene = described(mesh)
    leaf, foot = scene.shapes
    assert (leaf.path, foot.path) == ("vase-leaf_green", "vase-foot")
    assert len(leaf.faces) == 2 and len(foot.faces) == 1 and foot.vertices[:, 0].min() == 5.0
    # v is counted from the bottom in the file, from the picture's first row here.
    np.testing.assert_allclose(leaf.texcoords[:3], [[0, 1], [1, 1], [1, 0]])
    assert leaf.bsdf.two_sided and leaf.bsdf.model == "normalmap" and leaf.bsdf.children == ("principled",)
    color = next(t for name, t in leaf.bsdf.textures.items() if name.endswith("base_color"))
    np.testing.assert_allclose(color.value, srgb_to_linear(PIXELS / 255.0), rtol=1e-6)
    # The file's (2 u + 0.5, 3 v + 0.25), where v is 1 minus ours.
    u, v = 0.3, 0.4
    np.testing.assert_allclose(color.to_uv @ [u, 1 - v, 1], [2 * u + 0.5, 1 - (3 * v + 0.25), 1], rtol=1e-6)
    rough = next(t for name, t in leaf.bsdf.textures.items() if name.endswith("roughness"))
    assert rough.value.item() == pytest.approx(0.01**0.25)  # alpha = sqrt(2 / 200)
    normals = leaf.bsdf.textures["normalmap"]
    np.testing.assert_allclose(normals.value, PIXELS / 255.0, rtol=1e-6)
    assert foot.bsdf.model == "mask" and foot.bsdf.textures["opacity"].value.item() == 0.25
    np.testing.assert_allclose(foot.emitter.radiance.value, [3, 2, 1])
    assert foot.texcoords is None


def test_a_bsdf_of_ones_own_and_a_pose_replace_the_files(vase) -> None:
    bsdf = {"type": "diffuse", "reflectance": 0.25}
    mesh = psdr.load_mesh(vase, bsdf, to_world=psdr.Transform.translate([0, 0, 2]))
    assert mesh["type"] == "mesh"
    (shape,) = described(mesh).shapes
    assert shape.path == "vase" and len(shape.faces) == 3 and (shape.vertices[:, 2] == 2).all()
    assert shape.bsdf.path == "vase.bsdf" and shape.bsdf.textures["reflectance"].value.item() == 0.25
    assert list(psdr.load_mesh(vase, name="other"))[1:] == ["other-leaf_green", "other-foot"]


def test_what_a_mesh_file_lacks_is_warned_of(vase) -> None:
    (vase.parent / "n.png").unlink()
    (vase.parent / "vase.mtl").write_text(MTL + "map_Bump bump.png\n")
    with pytest.warns(psdr.SceneWarning) as warned:
        mesh = psdr.load_mesh(vase)
    texts = [str(warning.message) for warning in warned]
    assert any("there is no picture 'n.png'" in text for text in texts)
    assert any("'map_Bump' is ignored" in text for text in texts)
    assert mesh["vase-leaf_green"]["bsdf"]["nested"]["type"] == "principled"
    (vase.parent / "vase.mtl").unlink()
    with pytest.warns(psdr.SceneWarning, match=r"no file of materials 'vase\.mtl'"):
        assert psdr.load_mesh(vase)["vase-foot"]["bsdf"]["nested"] == {"type": "diffuse"}


@pytest.mark.parametrize("line", ["map_Kd ../secret.png", "map_Kd /etc/hostname.png"])
def test_pictures_outside_of_the_meshs_folder_are_refused(vase, line) -> None:
    inner = vase.parent / "inner"
    inner.mkdir()
    (inner / "vase.obj").write_text(OBJ)
    (inner / "vase.mtl").write_text(f"newmtl foot\n{line}\n")
    Image.fromarray(PIXELS).save(vase.parent / "secret.png")
    with pytest.raises(ValueError, match=r"leaves the scene's folder.*allow_outside"):
        psdr.load_mesh(inner / "vase.obj")
    if ".." in line:
        with pytest.warns(psdr.SceneWarning, match="leaf green"):
            mesh = psdr.load_mesh(inner / "vase.obj", allow_outside=vase.parent)
        assert mesh["vase-foot"]["bsdf"]["nested"]["reflectance"]["type"] == "bitmap"


def test_unreadable_values_name_their_line(vase) -> None:
    (vase.parent / "vase.mtl").write_text("newmtl foot\nKd red\n")
    with pytest.raises(ValueError, match="line 2: got 'red'; write one number"):
        psdr.load_mesh(vase)
    with pytest.raises(ValueError, match="is no mesh file"):
        psdr.load_mesh(vase.parent / "vase.mtl")
    with pytest.raises(FileNotFoundError, match="no such mesh"):
        psdr.load_mesh(vase.parent / "other.obj")


def gltf_tree(buffer: bytes) -> dict:
    """Two triangles of two materials; the second is named by a node that moves it."""
    views = [(0, 36), (36, 24), (60, 6)]
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1, "COLOR_0": 0}, "indices": 2}
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 3]}],
        "meshes": [{"primitives": [{**primitive, "material": 1}]}, {"primitives": [{**primitive, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            *({"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in views),
            {"buffer": 0, "byteOffset": 68, "byteLength": len(buffer) - 68},
        ],
        "buffers": [{"byteLength": len(buffer)}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}, {"uri": "out%20side.png"}],
        "samplers": [{"wrapS": 33071, "wrapT": 33071}],
        "textures": [{"source": 0, "sampler": 0}, {"source": 1}],
        "materials": [
            {
                "name": "gold.leaf",
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [0.5, 1, 1, 1],
                    "baseColorTexture": {
                        "index": 0,
                        "extensions": {"KHR_texture_transform": {"scale": [2, 3], "offset": [0.5, 0.25]}},
                    },
                    "metallicRoughnessTexture": {"index": 1},
                    "roughnessFactor": 0.5,
                },
                "normalTexture": {"index": 0, "scale": 0.5},
            },
            {
                "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5], "metallicFactor": 0},
                "alphaMode": "BLEND",
                "emissiveFactor": [1, 0, 0],
                "extensions": {"KHR_materials_ior": {"ior": 1.4}, "KHR_materials_sheen": {}},
            },
        ],
    }


@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_materials_of_gltf_are_principled(tmp_path, kind) -> None:
    Image.fromarray(PIXELS).save(tmp_path / "out side.png")
    picture = (tmp_path / "out side.png").read_bytes()
    buffer = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<6f", 0, 0, 1, 0, 0, 1)
    buffer += struct.pack("<3H2x", 0, 1, 2) + picture
    buffer += b"\0" * (-len(buffer) % 4)
    tree = gltf_tree(buffer)
    if kind == "gltf":
        tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(buffer), len(text), b"JSON")
    binary = head + text + struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    file = tmp_path / f"vase.{kind}"
    file.write_bytes(binary if kind == "glb" else text)
    with pytest.warns(psdr.SceneWarning) as warned:
        mesh = psdr.load_mesh(file)
    texts = [str(warning.message) for warning in warned]
    assert sum("KHR_materials_sheen" in text or "colours of vertices" in text for text in texts) == len(texts) == 2
    gold, plain = described(mesh).shapes
    assert (gold.path, plain.path) == ("vase-gold_leaf", "vase-material1")
    assert (gold.vertices[:, 2] == 3).all() and (plain.vertices[:, 2] == 0).all()
    np.testing.assert_allclose(gold.texcoords, [[0, 0], [1, 0], [0, 1]])  # as the file has them: v from the top
    assert gold.bsdf.two_sided and not plain.bsdf.two_sided
    values = {name.removeprefix("nested_"): t for name, t in gold.bsdf.textures.items()}
    color, rough, metal = (
        next(t for name, t in values.items() if name.endswith(end)) for end in ("base_color", "roughness", "metallic")
    )
    np.testing.assert_allclose(color.value, srgb_to_linear(PIXELS / 255.0) * [0.5, 1, 1], rtol=1e-6)
    assert color.wrap == "clamp"
    np.testing.assert_allclose(color.to_uv, [[2, 0, 0.5], [0, 3, 0.25], [0, 0, 1]])
    np.testing.assert_allclose(rough.value[..., 0], 0.5 * PIXELS[..., 1] / 255.0, rtol=1e-6)
    np.testing.assert_allclose(metal.value[..., 0], PIXELS[..., 2] / 255.0, rtol=1e-6)
    n = (2.0 * PIXELS / 255.0 - 1.0) * [0.5, 0.5, 1.0]
    expected = 0.5 * n / np.linalg.norm(n, axis=2, keepdims=True) + 0.5
    np.testing.assert_allclose(values["normalmap"].value, expected, atol=1e-6)
    assert plain.bsdf.model == "mask" and plain.bsdf.textures["opacity"].value.item() == 0.5
    np.testing.assert_allclose(plain.emitter.radiance.value, [1, 0, 0])


@pytest.mark.parametrize("kind", ["ply", "stl", "off", "glb"])
def test_a_mesh_without_materials_is_grey_on_both_sides(tmp_path, kind) -> None:
    trimesh.creation.box().export(tmp_path / f"box.{kind}")
    mesh = psdr.load_mesh(str(tmp_path / f"box.{kind}"))
    (shape,) = described(mesh).shapes
    assert shape.path == "vase" and len(shape.faces) == 12
    if kind != "glb":  # which has a material, of trimesh
        assert shape.bsdf.two_sided and shape.bsdf.textures["reflectance"].value.item() == 0.5


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_preview_shows_the_mesh_above_its_floor(vase, up) -> None:
    mesh = psdr.load_mesh(vase, {"type": "diffuse"})
    scene = psdr.preview_scene(mesh, resolution=8, spp=1, up=up)
    params = psdr.traverse(scene)
    assert "mesh.vertex_positions" in params and "mesh.bsdf.reflectance.value" in params
    axis = "xyz".index(up)
    low = params["mesh.vertex_positions"].numpy()[:, axis].min()
    floor = next(shape for shape in scene.description.shapes if shape.path == "floor")
    np.testing.assert_allclose(floor.vertices[:, axis], low, atol=0.02)
    assert (floor.vertices[:, axis] < low).all() and floor.normals[:, axis].min() > 0.99
    pose = params["camera.to_world"].numpy()
    assert pose[axis, 2] < 0 < pose[axis, 3]  # it looks down from above


def test_a_preview_needs_a_shape() -> None:
    with pytest.raises(ValueError, match="got a scene"):
        psdr.preview_scene({"type": "scene"})
    with pytest.raises(ValueError, match="expected 'y' or 'z'"):
        psdr.preview_scene({"type": "cube"}, up="x")
    with pytest.raises(ValueError, match="is no shape"):
        psdr.preview_scene({"type": "point", "position": [0, 0, 1]})

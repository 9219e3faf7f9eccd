"""Scene files: the same description as the dictionary form, and the same values as Mitsuba where it is installed."""

import re
from pathlib import Path

import numpy as np
import pytest

from warp_psdr.image_io import write_image
from warp_psdr.scene import Transform, describe_dict, describe_file, describe_string

CORNELL_BOX = Path(__file__).parents[2] / "scenes" / "cornell_box.xml"
HEAD = '<scene version="3.0.0"><sensor type="perspective" id="cam"/><emitter type="constant" id="sky"/>'


def read(body, **options):
    return describe_string(f"{HEAD}{body}</scene>", **options)


def to_world(steps):
    x = read(f'<shape type="cube"><transform name="to_world">{steps}</transform></shape>').shapes[0]
    return x.to_world


def test_xml_and_dictionary_give_the_same_scene():
    body = """
    <integrator type="path">
        <integer name="max_depth" value="7"/> <boolean name="hide_emitters" value="true"/>
    </integrator>
    <bsdf type="twosided" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2 0.3"/></bsdf></bsdf>
    <shape type="sphere" id="ball">
        <point name="center" x="1" y="2" z="3"/> <float name="radius" value=" 2.5"/>
        <integer name="resolution" value="8"/>
        <boolean name="flip_normals" value="True"/> <ref id="wall"/>
        <emitter type="area"><spectrum name="radiance" value="2"/></emitter>
    </shape>
    <shape type="cylinder" id="tube">
        <point name="p1" value="0 1 2"/>
        <bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.3"/></bsdf>
    </shape>"""
    dictionary = {
        "type": "scene",
        "cam": {"type": "perspective"},
        "sky": {"type": "constant"},
        "integrator": {"type": "path", "max_depth": 7, "hide_emitters": True},
        "wall": {
            "type": "twosided",
            "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
        },
        "ball": {
            "type": "sphere",
            "center": [1, 2, 3],
            "radius": 2.5,
            "resolution": 8,
            "flip_normals": True,
            "bsdf": {"type": "ref", "id": "wall"},
            "light": {"type": "area", "radiance": {"type": "spectrum", "value": 2.0}},
        },
        "tube": {
            "type": "cylinder",
            "p1": [0, 1, 2],
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.3},
        },
    }
    ours, theirs = plain(read(body)), plain(describe_dict(dictionary))
    assert ours.pop("source") == "string" and theirs.pop("source") == "dict"
    assert ours == theirs


def plain(value):
    """Return a description as nested lists and dictionaries."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def test_transform_steps_apply_in_the_order_of_the_file():
    ours = to_world('<scale value="2"/><rotate z="1" angle="90"/><translate x="1" y="2"/>')
    expected = Transform.translate([1, 2, 0]) @ Transform.rotate([0, 0, 1], 90) @ Transform.scale(2)
    np.testing.assert_allclose(ours, expected.matrix, atol=1e-6)
    np.testing.assert_allclose(to_world('<scale x="2"/>'), np.diag([2, 1, 1, 1]))
    matrix = "1 0 0 5  0 1 0 6  0 0 1 7  0 0 0 1"
    np.testing.assert_allclose(to_world(f'<matrix value="{matrix}"/>')[:3, 3], [5, 6, 7])
    np.testing.assert_allclose(
        to_world('<matrix value="0 1 0 1 0 0 0 0 2"/>')[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, 2]]
    )


def test_lookat_has_z_to_the_target_and_x_to_the_left():
    pose = to_world('<lookat origin="0 0 4" target="0, 0, 0" up="0 1 0"/>')
    np.testing.assert_allclose(pose, [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]], atol=1e-7)
    free = to_world('<lookat origin="1 1 1" target="0 0 0"/>')
    np.testing.assert_allclose(free[:3, :3] @ free[:3, :3].T, np.eye(3), atol=1e-6)


def test_defaults_parameters_and_escapes():
    body = """<default name="r" value="0.25"/><default name="radius" value="3"/><default name="kind" value="sphere"/>
    <shape type="$kind" id="a$r"><float name="radius" value="$radius"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="$r 0 0"/></bsdf></shape>"""
    x = read(body).shapes[0]
    assert (x.kind, x.path, x.to_world[0, 0]) == ("sphere", "a0.25", 3.0)
    assert x.bsdf.textures["reflectance"].value.tolist() == [0.25, 0.0, 0.0]
    assert read(body, radius=5).shapes[0].to_world[0, 0] == 5.0
    escaped = '<shape type="cube" id="\\$5"/>'
    assert read(escaped).shapes[0].path == "$5"


def test_defaults_reach_included_files(tmp_path):
    (tmp_path / "parts").mkdir()
    write_image(tmp_path / "parts" / "a.png", np.full((2, 2, 3), 0.5))
    (tmp_path / "parts" / "materials.xml").write_text(
        '<scene version="3.0.0"><default name="k" value="9"/><bsdf type="diffuse" id="inc">'
        '<texture type="bitmap" name="reflectance"><string name="filename" value="a.png"/></texture></bsdf>'
        '<shape type="sphere" id="s"><float name="radius" value="$k"/></shape></scene>'
    )
    (tmp_path / "parts" / "one.xml").write_text('<bsdf version="3.0.0" type="conductor" id="one"/>')
    (tmp_path / "main.xml").write_text(
        f'{HEAD}<default name="k" value="2"/><include filename="parts/materials.xml"/>'
        '<include filename="parts/one.xml"/>'
        '<shape type="cube" id="c"><ref id="inc"/></shape><shape type="cube" id="d"><ref id="one"/></shape></scene>'
    )
    s, c, d = describe_file(tmp_path / "main.xml").shapes
    assert s.to_world[0, 0] == 2.0
    assert c.bsdf.textures["reflectance"].path == "inc.reflectance"
    assert c.bsdf.textures["reflectance"].value.shape == (2, 2, 3)
    assert d.bsdf.model == "conductor"


def test_references_and_aliases():
    body = """<bsdf type="conductor" id="steel"/><alias id="steel" as="metal"/>
    <shape type="cube" id="a"><ref id="metal"/></shape>
    <shape type="cube" id="b"><bsdf type="diffuse" id="inner"/></shape>
    <shape type="cube" id="c"><ref id="inner"/></shape>"""
    a, b, c = read(body).shapes
    assert a.bsdf.textures["k"].path == "steel.k"
    assert b.bsdf is c.bsdf and c.bsdf.textures["reflectance"].path == "b.bsdf.reflectance"


def test_unnamed_plugins_get_stable_names():
    body = '<shape type="cube"/><shape type="cube" id="shape_1"/><shape type="sphere"/><emitter type="point"/>'
    first, second = read(body), read(body)
    assert [x.path for x in first.shapes] == [x.path for x in second.shapes] == ["shape_0", "shape_1", "shape_2"]
    assert first.emitters[1].path == "emitter_0"


def test_referenced_texture_and_mesh_attribute():
    body = """<texture type="mesh_attribute" id="att"><string name="name" value="vertex_color"/></texture>
    <bsdf type="diffuse" id="m"><ref name="reflectance" id="att"/></bsdf>"""
    # Nothing with that attribute uses it: a texture alone is no error.
    assert read(body).shapes == []


def test_comments_declaration_and_white_space_are_allowed():
    xml = f'<?xml version="1.0" encoding="utf-8"?>\n<!-- ä -->\n{HEAD}\n<!-- b --> text <shape type="cube"/></scene>'
    assert len(describe_string(xml).shapes) == 1


def test_errors_name_file_and_line(tmp_path):
    file = tmp_path / "broken.xml"
    file.write_text(f'{HEAD}\n\n<shape type="cube" id="box">\n  <float name="radius" value="x"/></shape></scene>')
    with pytest.raises(ValueError, match=r"broken\.xml:4 <float name=\"radius\">.*'x' is no number"):
        describe_file(file)
    file.write_text(f'{HEAD}\n\n<shape type="cube" id="box">\n  <float name="radius" value="1"/></shape></scene>')
    with pytest.raises(ValueError, match=r"broken\.xml:3 <shape type=\"cube\" id=\"box\">.*no parameter 'radius'"):
        describe_file(file)


def test_cornell_box():
    result = describe_file(CORNELL_BOX)
    assert result.notes == [] and result.integrator["max_depth"] == 6
    sensor = result.sensors[0]
    assert (sensor.film.width, sensor.film.height, sensor.sample_count, sensor.sampler) == (256, 256, 16, "independent")
    models = {shape.bsdf.textures["reflectance"].path for shape in result.shapes}
    assert models == {"white.reflectance", "green.reflectance", "red.reflectance"}
    assert describe_file(CORNELL_BOX, spp=4, resolution=32).sensors[0].film.width == 32


# -- the same as Mitsuba -----------------------------------------------------------------------------------------------


@pytest.fixture
def mi():
    module = pytest.importorskip("mitsuba")
    module.set_variant("scalar_rgb")
    return module


def values_of(result):
    textures = [t for shape in result.shapes for t in shape.bsdf.textures.values()]
    return {t.path + ".value": t.value for t in textures + [e.radiance for e in result.emitters]}


def compare(mi, theirs, ours):
    """Compare all constant textures and the vertices of all meshes; Mitsuba names unnamed objects by address."""
    parameters, values = mi.traverse(theirs), values_of(ours)
    names = [name for name in parameters.properties if name.endswith(".value") and not name.startswith("object_")]
    names = [name for name in names if ".texture." not in name]
    assert names
    for name in names:
        np.testing.assert_allclose(np.ravel(parameters[name]), values[name], rtol=1e-5, err_msg=name)
    shapes = {shape.path: shape for shape in ours.shapes}
    for name in parameters.properties:
        if (match := re.fullmatch(r"(\w+)\.vertex_positions", name)) and match[1] in shapes:
            np.testing.assert_allclose(np.array(parameters[name]), shapes[match[1]].vertices.ravel(), atol=1e-6)
    for shape in ours.shapes:
        if f"{shape.path}.to_world" in parameters.properties:
            their_pose = np.array(parameters[f"{shape.path}.to_world"].matrix)
            np.testing.assert_allclose(their_pose, shape.to_world, atol=1e-5)


SCENES = [
    """<default name="gain" value="3"/><bsdf type="diffuse" id="w"><spectrum name="reflectance" value="0.4"/></bsdf>
    <shape type="cube" id="c"><ref id="w"/><transform name="to_world"><rotate x="0.6" y="0" z="0.8" angle="40"/>
    <scale x="1" y="2" z="3"/><translate value="1 2 3"/></transform></shape>
    <shape type="rectangle" id="l"><emitter type="area"><rgb name="radiance" value="$gain 2 1"/></emitter></shape>""",
    """<shape type="sphere" id="s"><point name="center" x="1" y="0" z="2"/><float name="radius" value="0.5"/>
    <bsdf type="twosided" id="t"><bsdf type="roughconductor"><rgb name="eta" value="1 2 3"/><rgb name="k" value="4"/>
    <float name="alpha" value="0.2"/></bsdf></bsdf></shape><shape type="disk" id="d"><ref id="t"/></shape>""",
    """<shape type="cube" id="late"><ref id="m"/></shape><bsdf type="diffuse" id="m"/>
    <emitter type="spot" id="spot"><spectrum name="intensity" value="2"/></emitter>
    <emitter type="directional" id="sun"><vector name="direction" value="0 -1 0"/><rgb name="irradiance" value="2"/>
    </emitter><emitter type="point" id="p"><float name="intensity" value="2"/></emitter>""",
]


@pytest.mark.parametrize("body", SCENES)
def test_values_names_and_poses_equal_mitsubas(mi, body):
    compare(mi, mi.load_string(f"{HEAD}{body}</scene>", optimize=False), read(body))


def test_cornell_box_is_mitsubas(mi):
    ours = describe_file(CORNELL_BOX)
    compare(mi, mi.load_file(str(CORNELL_BOX), optimize=False), ours)
    built_in = describe_dict({**mi.cornell_box(), "integrator": {"type": "path", "max_depth": 6}})
    assert [shape.path for shape in built_in.shapes] == [shape.path for shape in ours.shapes]
    for a, b in zip(built_in.shapes, ours.shapes, strict=True):
        np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-6)
        np.testing.assert_array_equal(a.bsdf.textures["reflectance"].value, b.bsdf.textures["reflectance"].value)
    np.testing.assert_allclose(built_in.sensors[0].to_world, ours.sensors[0].to_world, atol=1e-6)
    assert built_in.sensors[0].x_fov == pytest.approx(ours.sensors[0].x_fov)

"""Scene files as others write them: older versions, references to anything, no camera, axes of any length."""

import numpy as np
import pytest

from warp_psdr.scene import Transform, describe_dict, describe_string

OLD = """<scene version="{version}"><integrator type="path"><integer name="maxDepth" value="3"/></integrator>
<sensor type="perspective" id="cam"><float name="nearClip" value="0.1"/><string name="fovAxis" value="x"/>
<float name="fov" value="40"/><transform name="toWorld"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<sampler type="independent"><integer name="sampleCount" value="7"/></sampler><film type="hdrfilm">
<integer name="width" value="32"/><integer name="height" value="24"/><string name="pixelFormat" value="RGB"/>
<boolean name="banner" value="false"/></film></sensor>
<bsdf type="diffuse" id="aB"><rgb name="diffuseReflectance" value="0.1 0.2 0.3"/></bsdf>
<shape type="sphere" id="s"><transform name="toWorld"><translate x="1"/></transform><ref id="aB"/>
<emitter type="area"><rgb name="radiance" value="2"/><float name="samplingWeight" value="1"/></emitter></shape>
</scene>"""


@pytest.fixture
def mi():
    module = pytest.importorskip("mitsuba")
    module.set_variant("scalar_rgb")
    return module


@pytest.mark.parametrize("version", ["0.6.0", "1.0.0"])
def test_older_versions_are_read_as_mitsuba_does(mi, version):
    text = OLD.format(version=version)
    ours, theirs = describe_string(text), mi.traverse(mi.load_string(text, optimize=False))
    shape, sensor = ours.shapes[0], ours.sensors[0]
    np.testing.assert_allclose(shape.bsdf.textures["reflectance"].value, np.ravel(theirs["aB.reflectance.value"]))
    np.testing.assert_allclose(shape.to_world, np.array(theirs["s.to_world"].matrix))
    np.testing.assert_allclose(sensor.to_world, np.array(theirs["cam.to_world"].matrix), atol=1e-6)
    assert (sensor.near_clip, sensor.sample_count) == (pytest.approx(theirs["cam.near_clip"]), 7)
    assert ours.integrator["max_depth"] == 3 and (sensor.film.width, sensor.film.height) == (32, 24)


def test_camel_case_is_that_of_older_versions_only():
    with pytest.raises(ValueError, match="no parameter 'toWorld'"):
        describe_string(OLD.format(version="2.0.0"))


def test_texture_coordinates_were_scaled_by_parameters(mi, tmp_path):
    mi.Bitmap(np.zeros((2, 2, 3), np.float32)).write(str(tmp_path / "a.exr"))
    text = f"""<scene version="0.5.0"><shape type="sphere" id="s"><bsdf type="diffuse" id="b"><texture type="bitmap"
    name="reflectance"><float name="uscale" value="2"/><float name="voffset" value="0.25"/><string name="filename"
    value="{tmp_path}/a.exr"/></texture></bsdf></shape></scene>"""
    ours = describe_string(text, base=tmp_path).shapes[0].bsdf.textures["reflectance"].to_uv
    theirs = mi.traverse(mi.load_string(text, optimize=False))
    name = next(name for name in theirs.keys() if name.endswith("to_uv"))
    np.testing.assert_allclose(ours, np.array(theirs[name].matrix))


def test_tags_of_older_versions():
    text = """<scene version="0.5.0"><sensor type="perspective"><transform name="toWorld">
    <lookAt origin="0,0,4" target="0,0,0" up="0,1,0"/></transform></sensor>
    <emitter type="point"><blackbody name="intensity" temperature="3000K"/></emitter>
    <shape type="cube"><bsdf type="diffuse"><srgb name="reflectance" value="0.5 0.5 1"/></bsdf></shape></scene>"""
    result = describe_string(text)
    assert result.sensors[0].to_world[2, 3] == 4.0
    assert result.emitters[0].radiance.value[0] > result.emitters[0].radiance.value[2] > 0.0
    np.testing.assert_allclose(result.shapes[0].bsdf.textures["reflectance"].value, [0.2140411, 0.2140411, 1.0], 1e-5)


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("phong", "ashikhminshirley"),
        ("ward", "roughconductor"),
        ("coating", "plastic"),
        ("roughcoating", "roughplastic"),
        ("roughdiffuse", "orennayar"),
        ("difftrans", "principledthin"),
        ("mixturebsdf", "blendbsdf"),
    ],
)
def test_models_of_older_versions_are_refused_with_what_comes_near(name, instead):
    text = f'<scene version="0.6.0"><shape type="cube"><bsdf type="{name}"/></shape></scene>'
    with pytest.raises(ValueError, match=f"unsupported bsdf '{name}'; it is of Mitsuba 0.x; give '{instead}'"):
        describe_string(text)


@pytest.mark.parametrize("axis", [[1.0, 1.0, 1.0], [0.0, 3.0, 4.0], [0.6, 0.0, 0.8]])
def test_rotations_equal_mitsubas_whatever_the_length_of_the_axis(mi, axis):
    theirs = np.array(mi.ScalarTransform4f().rotate(axis, 60).matrix)
    np.testing.assert_allclose(Transform.rotate(axis, 60).matrix, theirs, atol=1e-5)
    x, y, z = axis
    text = f"""<scene version="3.0.0"><shape type="cube" id="a"><transform name="to_world">
    <rotate x="{x}" y="{y}" z="{z}" angle="60"/></transform></shape></scene>"""
    result = describe_string(text)
    np.testing.assert_allclose(result.shapes[0].to_world, theirs, atol=1e-5)
    assert any("no unit vector" in note for note in result.notes) == (axis != [0.6, 0.0, 0.8])


REFERRED = """<scene version="3.0.0"><emitter type="area" id="lamp"><rgb name="radiance" value="3"/></emitter>
<sampler type="independent" id="few"><integer name="sample_count" value="5"/></sampler>
<film type="hdrfilm" id="small"><integer name="width" value="9"/><ref id="sharp"/></film>
<rfilter type="box" id="sharp"/>
<sensor type="perspective" id="cam"><ref id="few"/><ref id="small"/></sensor>
<emitter type="area" id="spare"/>
<shape type="rectangle" id="a"><ref id="lamp"/></shape><shape type="rectangle" id="b"/></scene>"""


def test_references_to_emitters_samplers_films_and_filters(mi):
    result = describe_string(REFERRED)
    assert [light.radiance.parameter for light in result.emitters] == ["lamp.radiance.value"]
    assert "lamp.radiance.value" in mi.traverse(mi.load_string(REFERRED, optimize=False)).keys()
    assert result.shapes[0].emitter is result.emitters[0] and result.shapes[1].emitter is None
    sensor = result.sensors[0]
    assert (sensor.sample_count, sensor.film.width, sensor.film.filter) == (5, 9, "box")
    assert [note for note in result.notes if "does not shine" in note and "spare" in note]


def test_a_scene_without_a_sensor_is_seen_as_a_whole():
    result = describe_dict({"type": "scene", "ball": {"type": "sphere", "center": [3.0, 1.0, 2.0], "radius": 2.0}})
    sensor = result.sensors[0]
    distance = 2.0 / np.tan(np.radians(22.5))
    np.testing.assert_allclose(sensor.to_world[:3, 3], [3.0, 1.0, -distance], atol=1e-5)
    np.testing.assert_allclose([sensor.near_clip, sensor.far_clip], [distance / 100, 20.0 + distance], rtol=1e-6)
    assert sensor.x_fov == pytest.approx(45.0) and any("no sensor" in note for note in result.notes)
    assert describe_dict({"type": "scene", "sky": {"type": "constant"}}).sensors[0].path == "sensor"


FILMS = [
    {"banner": True},
    {"compensate": True},
    {"sample_border": False},
    {"file_format": "OpenEXR", "component_format": "FLOAT32", "pixel_format": "XYZA"},
    {"file_format": "exr"},
    {"file_format": "jpeg"},
    {"component_format": "float64"},
    {"pixel_format": "multichannel"},
    {"size": 3},
]


@pytest.mark.parametrize("parameters", FILMS)
def test_films_are_accepted_and_refused_as_in_mitsuba(mi, parameters):
    try:
        mi.load_dict({"type": "hdrfilm", **parameters})
    except RuntimeError:
        with pytest.raises(ValueError, match=next(iter(parameters))):
            describe_dict({"type": "scene", "s": {"type": "perspective", "f": {"type": "hdrfilm", **parameters}}})
    else:
        scene = {"type": "scene", "sky": {"type": "constant"}}
        describe_dict({**scene, "s": {"type": "perspective", "f": {"type": "hdrfilm", **parameters}}})

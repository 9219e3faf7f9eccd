"""Media in scene files: names, references, defaults, values after edits, and what is wrong."""

import warnings

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import describe_dict, describe_string

T = psdr.Transform
SKY = {"type": "constant"}
SENSOR = {"type": "perspective", "to_world": T.translate([0, 0, -9])}
HG = {"type": "hg"}
WEIGHTS = {"type": "gridvolume", "data": np.full((2, 2, 2, 3), 0.5)}
CUBE = {"type": "cube", "bsdf": {"type": "null"}}


def describe(**parts):
    return describe_dict({"type": "scene", "sensor": SENSOR, "sky": SKY, **parts})


def inside(**medium):
    return describe(cube={**CUBE, "interior": {"type": "homogeneous", **medium}}).shapes[0].interior


@pytest.mark.filterwarnings("ignore:'sensor' names")
def test_names_are_mitsubas():
    fog = {"type": "homogeneous", "sigma_t": {"type": "rgb", "value": [0.1, 0.2, 3.0]}, "phase": {"type": "hg"}}
    scene = {"type": "scene", "sensor": {"type": "perspective", "medium": fog}, "sky": SKY}
    found = dict(psdr.traverse(psdr.load_dict(scene | {"cube": {**CUBE, "exterior": {"type": "homogeneous"}}})))
    expected = {
        **{f"sensor.medium.{name}": (1,) for name in ("albedo.value.value", "scale", "phase_function.g")},
        "sensor.medium.sigma_t.value.value": (3,),
        **{f"cube.exterior_medium.{name}": (1,) for name in ("sigma_t.value.value", "albedo.value.value", "scale")},
    }
    assert {name: found[name].shape for name in found if "medium" in name} == expected
    assert found["sensor.medium.phase_function.g"].numpy() == pytest.approx(0.8)


@pytest.mark.filterwarnings("ignore:'sensor' names")
def test_mitsuba_lists_the_same_names():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    fog = {"type": "homogeneous", "sigma_t": {"type": "constvolume", "value": 2.0}, "phase": {"type": "hg", "g": 0.3}}
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "cube": {**CUBE, "interior": fog}}
    theirs = {name for name in mi.traverse(mi.load_dict(scene)).keys() if "medium" in name}
    assert theirs == {name for name in psdr.traverse(psdr.load_dict(scene | {"sky": SKY})) if "medium" in name}


def test_files_references_and_defaults():
    text = """<scene version="3.0.0"><sensor type="perspective" id="sensor"><transform name="to_world">
    <translate z="-9"/></transform><ref id="fog" name="medium"/></sensor>
    <medium type="homogeneous" id="fog"><rgb name="albedo" value="0.1, 0.2, 0.3"/><float name="scale" value="2"/>
    <volume type="constvolume" name="sigma_t"><float name="value" value="7"/></volume>
    <phase type="hg"><float name="g" value="-0.3"/></phase></medium>
    <shape type="cube"><bsdf type="null"/><ref id="fog" name="exterior"/><medium type="homogeneous" name="interior"/>
    </shape><emitter type="constant"/><integrator type="prbvolpath"/></scene>"""
    found = describe_string(text)
    fog, plain = found.sensors[0].medium, found.shapes[0].interior
    assert found.shapes[0].exterior is fog and fog.path == "sensor.medium" and fog.scale == 2.0
    assert fog.sigma_t.value == 7.0 and fog.phase.kind == "hg" and fog.phase.g == -0.3
    np.testing.assert_allclose(fog.albedo.value, [0.1, 0.2, 0.3])
    assert (plain.sigma_t.value, plain.albedo.value, plain.scale, plain.phase.kind) == (1.0, 0.75, 1.0, "isotropic")
    assert found.integrator["max_depth"] == 6
    assert psdr.load_string(text).builder.media_config.phases == (0, 1)


def test_phase_functions():
    assert inside(phase={"type": "rayleigh"}).phase.kind == "rayleigh"
    for values in ("0.5, 1 2", [0.5, 1.0, 2.0], np.array([0.5, 1.0, 2.0])):
        assert inside(phase={"type": "tabphase", "values": values}).phase.values.tolist() == [0.5, 1.0, 2.0]
    table = {"type": "homogeneous", "phase": {"type": "tabphase", "values": [0.5, 0.0, 2.0]}}
    scene = psdr.load_dict({"type": "scene", "sensor": SENSOR, "sky": SKY, "cube": {**CUBE, "interior": table}})
    params, name = psdr.traverse(scene), "cube.interior_medium.phase_function.values"
    assert "tabphase" in str(psdr.plan(scene, names=[name]))
    params[name] = np.zeros(3)
    with pytest.raises(ValueError, match="zeros alone after an edit"):
        params.update()


def test_numbers_colours_and_volumes():
    assert inside(sigma_t=3.0).sigma_t.value.tolist() == [3.0]
    assert inside(sigma_t=[1.0, 2.0, 3.0]).sigma_t.value.tolist() == [1.0, 2.0, 3.0]
    volume = {"type": "constvolume", "value": {"type": "rgb", "value": [1.0, 2.0, 30.0]}}
    assert inside(sigma_t=volume).sigma_t.value.tolist() == [1.0, 2.0, 30.0]


@pytest.mark.parametrize(
    ("medium", "words"),
    [
        ({"sigma_t": -1.0}, "values out of range.*at least 0"),
        ({"sigma_t": float("nan")}, "not finite"),
        ({"sigma_t": {"type": "diffuse"}}, "unsupported volume|takes no"),
        ({"sigma_t": {"type": "constvolume", "value": {"type": "checkerboard"}}}, "give a number or a colour"),
        ({"albedo": 1.5}, "between 0 and 1"),
        ({"scale": -1.0}, "of at least 0"),
        ({"phase": {"type": "hg", "g": 1.0}}, "between -0.99 and 0.99"),
        ({"phase": {"type": "mie"}}, "unsupported plugin 'mie'.*isotropic, hg, rayleigh, tabphase, blendphase, sggx"),
        (
            {"phase": {"type": "blendphase", "weight": 0.5, "a": HG, "b": {"type": "sggx"}}},
            "sggx inside a blendphase",
        ),
        ({"phase": {"type": "blendphase", "a": HG, "b": HG}}, "no 'weight'.*from 0 to 1"),
        ({"phase": {"type": "blendphase", "weight": 1.5, "a": HG, "b": HG}}, "'weight'.*between 0 and 1|range"),
        ({"phase": {"type": "blendphase", "weight": 0.5, "a": HG}}, "1 phase functions.*nest two"),
        ({"phase": {"type": "blendphase", "weight": WEIGHTS, "a": HG, "b": HG}}, "a grid of 3 channels.*has one"),
        (
            {"phase": {"type": "blendphase", "weight": 0.5, "a": HG, "b": {"type": "blendphase"}}},
            "blendphase inside a blendphase",
        ),
        ({"phase": {"type": "tabphase"}}, "give from 2 to 4096 numbers"),
        ({"phase": {"type": "tabphase", "values": "1, two"}}, "give from 2 to 4096 numbers"),
        ({"phase": {"type": "tabphase", "values": [1.0]}}, "give from 2 to 4096 numbers"),
        ({"phase": {"type": "tabphase", "values": [1.0, -1.0]}}, "values out of range"),
        ({"phase": {"type": "tabphase", "values": [0.0, 0.0]}}, "all values are 0"),
        ({"phase": {"type": "rayleigh", "g": 0.5}}, "no parameter 'g'"),
        ({"phase": {"type": "hg"}, "other": {"type": "isotropic"}}, "2 phase plugins"),
        ({"phase": {"type": "hg", "emission": 1.0}}, "no parameter 'emission'"),
    ],
)
def test_what_is_wrong_is_named(medium, words):
    with pytest.raises(ValueError, match=words):
        inside(**medium)


@pytest.mark.parametrize("named", [False, True])
def test_exact_shapes_shine_beside_media(named):
    other = {"type": "homogeneous", "id": "other"}
    light = {"type": "area", **({"medium": other} if named else {})}
    ball = {"type": "sphere", "exact": True, "radius": 0.1, "emitter": light}
    notes = describe(cube={**CUBE, "interior": {"type": "homogeneous"}}, ball=ball).notes
    about = [note for note in notes if "'ball.emitter' names 'ball.emitter.medium', but where it is 'cube' has" in note]
    assert len(about) == named


def test_media_stand_in_their_places():
    with pytest.raises(ValueError, match="a medium as 'inside'; name it 'interior' or 'exterior'"):
        describe(cube={**CUBE, "inside": {"type": "homogeneous"}})
    with pytest.raises(ValueError, match="takes no medium plugin here"):
        describe(cube={**CUBE, "bsdf": {"type": "null", "medium": {"type": "homogeneous"}}})
    for sides in ("interior", "exterior"):
        text = f'<shape type="cube"><medium type="homogeneous" name="{sides}"/><ref id="fog" name="{sides}"/></shape>'
        with pytest.raises(ValueError, match=f"'{sides}' is given twice"):
            describe_string(f'<scene version="3.0.0"><medium type="homogeneous" id="fog"/>{text}</scene>')
    notes = describe(cube={"type": "cube", "interior": {"type": "homogeneous"}}).notes
    assert any("lets no light through" in note and "name the medium 'exterior'" in note for note in notes)
    fog = {"type": "homogeneous", "id": "fog"}
    within = {"type": "ref", "id": "fog"}
    for sides in ({"exterior": within}, {"exterior": within, "interior": within}):  # a stone, and a wall, in fog
        notes = describe(cube={**CUBE, "interior": fog}, stone={"type": "sphere", **sides}).notes
        assert not any("lets no light through" in note for note in notes)
    hints = describe(cube={**CUBE, "interior": {"type": "homogeneous", "sample_emitters": False}}).notes
    assert any("'sample_emitters' is ignored" in note for note in hints)


def camera(*position, **more):
    return {**SENSOR, "to_world": T.translate(position), **more}


def notes_of(**parts):
    return [note for note in describe(**parts).notes if "'sampler'" not in note]


def test_sensors_and_lights_name_the_medium_that_they_are_in():
    fog, cube = {"type": "homogeneous", "id": "fog"}, {**CUBE, "to_world": T.scale(3.0)}
    ref = {"type": "ref", "id": "fog"}
    cube["interior"] = ref
    for named, right in (({}, False), ({"medium": ref}, True)):
        found = notes_of(fog=fog, cube=cube, sensor=camera(0.3, 0.2, 0.1, **named))
        words = "'sensor' names no medium, but where it stands 'cube' has 'cube.interior_medium'"
        assert [words in note for note in found] == ([] if right else [True])
    found = notes_of(fog=fog, cube=cube, sensor=camera(0, 0, -9.0, medium=ref))
    assert len(found) == 1 and "'cube' has no medium" in found[0]
    assert not notes_of(fog=fog, cube=cube, sensor=camera(0, 0, -9.0), bulb={"type": "point", "medium": ref})
    shining = {"type": "rectangle", "to_world": T.translate([0, 0, 5]), "emitter": {"type": "area", "medium": ref}}
    far = {"type": "spot", "to_world": T.translate([0, 0, 9]), "medium": ref}
    found = notes_of(fog=fog, cube=cube, sensor=camera(0, 0, -9.0), far=far, lamp=shining)
    assert sorted(note.split("'")[1] for note in found) == ["far", "lamp.emitter"]
    for light in ("constant", "directional"):
        with pytest.raises(ValueError, match=f"a medium of a '{light}' light, which is around the scene"):
            describe_dict({"type": "scene", "sensor": SENSOR, "sky": {"type": light, "medium": fog}})


def test_shapes_name_the_media_around_them():
    thin, thick = ({"type": "homogeneous", "id": name} for name in ("thin", "thick"))
    ref = {"type": "ref", "id": "thin"}
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": thick, "to_world": T.scale(0.3)}
    sensor = camera(0, 0, -9.0)
    found = notes_of(thin=thin, sensor=sensor, cube={**CUBE, "interior": ref}, ball=ball)
    assert len(found) == 1
    assert "'ball' has no medium for its exterior, where 'cube' has 'cube.interior_medium'" in found[0]
    assert not notes_of(thin=thin, sensor=sensor, cube={**CUBE, "interior": ref}, ball={**ball, "exterior": ref})
    # What abuts names nothing, and neither does what turns its back.
    beside = {**CUBE, "interior": thick, "to_world": T.translate([2, 0, 0])}
    assert not notes_of(thin=thin, sensor=sensor, cube={**CUBE, "interior": ref}, other=beside)
    inside_out = {**CUBE, "exterior": ref, "flip_normals": True}
    assert len(notes_of(thin=thin, sensor=camera(0, 0, 0.1), cube=inside_out)) == 1
    assert not notes_of(thin=thin, sensor=camera(0, 0, 0.1, medium=ref), cube=inside_out)


def test_boxes_of_grids_that_end_inside_of_their_shape():
    smoke, box = np.zeros((3, 3, 3), np.float32), T.translate([-1, -1, -1]) @ T.scale(2.0)
    smoke[1, 1, 1] = 1.0
    words = "'cube.interior_medium.sigma_t.data' is not 0 at the border of its box, which lies inside of 'cube'"
    for values, pose, right in (
        (smoke, np.eye(4), True),
        (smoke + 1.0, box, True),
        (smoke + 1.0, np.eye(4), False),
        (smoke + np.array([1.0, 0.0, 0.0]), T.translate([-1, -1, -1]) @ T.scale([1.9, 2.0, 2.0]), True),
        (smoke + np.array([0.0, 0.0, 1.0]), T.translate([-1, -1, -1]) @ T.scale([1.9, 2.0, 2.0]), False),
    ):
        grid = {"type": "gridvolume", "data": values, "to_world": pose}
        cube = {**CUBE, "interior": {"type": "heterogeneous", "sigma_t": grid}}
        found = notes_of(sensor=camera(0, 0, -9.0), cube=cube)
        assert [words in note for note in found] == ([] if right else [True])


def test_what_is_opaque_is_noted():
    opaque = {**CUBE, "interior": {"type": "homogeneous", "sigma_t": 1e4, "scale": 1e3}}
    found = notes_of(sensor=camera(0, 0, -9.0), cube=opaque)
    assert len(found) == 1 and "optical thickness of 3e+07" in found[0]


def test_edits_stay_in_range():
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": SENSOR,
            "sky": SKY,
            "cube": {**CUBE, "interior": {"type": "homogeneous"}},
        }
    )
    params = psdr.traverse(scene)
    params["cube.interior_medium.sigma_t.value.value"].assign(np.array([-0.5], np.float32))
    with pytest.raises(ValueError, match=r"sigma_t.value.value is \[-0.5\] after an edit; write finite values of at l"):
        params.update()
    params["cube.interior_medium.sigma_t.value.value"] = 0.0
    params.update()
    params["cube.interior_medium.albedo.value.value"].assign(np.array([2.0], np.float32))
    with pytest.raises(ValueError, match="between 0 and 1"):
        params.update()
    assert params.bounds("cube.interior_medium.albedo.value.value") == (0.0, 1.0)


def test_copies_of_a_group_have_its_media():
    group = {"type": "shapegroup", "cube": {**CUBE, "interior": {"type": "homogeneous", "sigma_t": 2.0}}}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = describe(
            group={**group, "id": "g"},
            a={"type": "instance", "group": {"type": "ref", "id": "g"}},
            b={"type": "instance", "group": {"type": "ref", "id": "g"}},
        )
    assert len(found.shapes) == 2 and found.shapes[0].interior is found.shapes[1].interior is not None

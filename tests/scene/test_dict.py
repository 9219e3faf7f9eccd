"""Scene dictionaries: values, defaults, parameter paths, and the same figures as Mitsuba's where it is installed."""

import re

import numpy as np
import pytest

from warp_psdr.image_io import srgb_to_linear, write_image
from warp_psdr.scene import Transform, describe_dict
from warp_psdr.scene.materials.bsdfs import IORS
from warp_psdr.scene.materials.conductors import CONDUCTORS


def describe(**plugins):
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}, **plugins}
    return describe_dict(scene)


def bsdf(**parameters):
    return describe(x={"type": "cube", "bsdf": parameters}).shapes[0].bsdf


def texture(**parameters):
    return bsdf(type="diffuse", reflectance=parameters).textures["reflectance"]


def textures_of(description):
    """Return the paths of all textures with the suffix of their values, as psdr.traverse lists them."""
    found = {}
    models = [shape.bsdf for shape in description.shapes]
    models += [model.back for model in models if model.back is not None]
    for t in [t for model in models for t in model.textures.values()] + [e.radiance for e in description.emitters]:
        found[t.parameter] = t.value
    return found


# -- paths and sharing -------------------------------------------------------------------------------------------------


def test_references_share_one_model_under_the_name_of_its_first_use():
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [1.0, 0.0, 0.0]}}
    ref = {"type": "ref", "id": "red"}
    early = describe(red=red, a={"type": "cube", "bsdf": ref}, b={"type": "cube", "bsdf": ref})
    assert early.shapes[0].bsdf is early.shapes[1].bsdf
    assert early.shapes[0].bsdf.textures["reflectance"].path == "red.reflectance"
    late = describe(a={"type": "cube", "bsdf": ref}, b={"type": "cube", "bsdf": ref}, red=red)
    assert late.shapes[0].bsdf is late.shapes[1].bsdf
    assert late.shapes[1].bsdf.textures["reflectance"].path == "a.bsdf.reflectance"


def test_a_dictionary_used_twice_gives_two_models():
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.3}}
    a, b = describe(a={"type": "cube", "bsdf": grey}, b={"type": "cube", "bsdf": grey}).shapes
    assert a.bsdf is not b.bsdf
    assert b.bsdf.textures["reflectance"].path == "b.bsdf.reflectance"


def test_an_id_wins_over_the_key():
    model = {"type": "diffuse", "id": "other"}
    x = describe(white=model, a={"type": "cube", "bsdf": {"type": "ref", "id": "other"}}).shapes[0]
    assert x.bsdf.textures["reflectance"].path == "other.reflectance"


def test_shared_textures_are_one_object():
    image = {"type": "bitmap", "bitmap": np.ones((2, 2, 3), dtype=np.float32)}
    model = {"type": "diffuse", "reflectance": {"type": "ref", "id": "image"}}
    a, b = describe(image=image, a={"type": "cube", "bsdf": model}, b={"type": "cube", "bsdf": model}).shapes
    assert a.bsdf.textures["reflectance"] is b.bsdf.textures["reflectance"]
    assert a.bsdf.textures["reflectance"].path == "image"


def test_two_sided_models():
    one = bsdf(type="twosided", inner={"type": "diffuse"})
    assert one.two_sided and one.back is None and one.textures["reflectance"].path == "x.bsdf.brdf_0.reflectance"
    two = bsdf(type="twosided", a={"type": "diffuse"}, b={"type": "conductor"})
    assert (two.model, two.back.model, two.back.textures["k"].path) == ("diffuse", "conductor", "x.bsdf.brdf_1.k")


def test_two_sided_shares_textures_with_the_plain_model():
    ref = {"type": "ref", "id": "plain"}
    a, b = describe(
        plain={"type": "diffuse"},
        a={"type": "cube", "bsdf": ref},
        b={"type": "cube", "bsdf": {"type": "twosided", "inner": ref}},
    ).shapes
    assert (a.bsdf.two_sided, b.bsdf.two_sided) == (False, True)
    assert a.bsdf.textures["reflectance"] is b.bsdf.textures["reflectance"]


# -- scattering models -------------------------------------------------------------------------------------------------


def test_model_defaults():
    x = describe(x={"type": "cube"}).shapes[0]
    assert (x.bsdf.model, x.bsdf.textures["reflectance"].path) == ("diffuse", "x.bsdf.reflectance")
    assert x.bsdf.textures["reflectance"].value == 0.5
    rough = bsdf(type="roughconductor")
    assert rough.variant == "beckmann"
    values = {name: t.value.tolist() for name, t in rough.textures.items()}
    assert values.pop("alpha_u") == values.pop("alpha_v") == [np.float32(0.1)]
    assert values == {"specular_reflectance": [1.0], "eta": [0.0], "k": [1.0]}
    assert rough.textures["alpha_u"] is rough.textures["alpha_v"]
    assert rough.textures["alpha_u"].path == "x.bsdf.alpha"
    glass = bsdf(type="dielectric")
    assert glass.textures["ior"].value == np.float32(1.5046 / 1.000277)
    assert set(glass.textures) == {"specular_reflectance", "specular_transmittance", "ior"}


def test_anisotropic_roughness_has_two_textures():
    rough = bsdf(type="roughconductor", alpha_u=0.2, alpha_v=0.3, distribution="ggx")
    assert rough.variant == "ggx"
    assert [rough.textures[n].path for n in ("alpha_u", "alpha_v")] == ["x.bsdf.alpha_u", "x.bsdf.alpha_v"]


def test_materials_and_indices_of_refraction():
    gold = bsdf(type="conductor", material="Au")
    np.testing.assert_allclose(gold.textures["eta"].value, CONDUCTORS["Au"][0], rtol=1e-6)
    water = bsdf(type="dielectric", int_ior="water", ext_ior=1.0)
    assert water.textures["ior"].value == np.float32(1.333)
    own = bsdf(type="conductor", eta={"type": "rgb", "value": [1.0, 2.0, 3.0]}, k=4.0)
    assert own.textures["eta"].value.tolist() == [1.0, 2.0, 3.0] and own.textures["k"].value.tolist() == [4.0]


# -- textures ----------------------------------------------------------------------------------------------------------


def test_bitmaps_decode_srgb_unless_raw_and_drop_alpha():
    pixels = np.full((2, 3, 4), 128, dtype=np.uint8)
    plain, raw = texture(type="bitmap", bitmap=pixels), texture(type="bitmap", bitmap=pixels, raw=True)
    assert plain.value.shape == (2, 3, 3)
    np.testing.assert_allclose(plain.value, srgb_to_linear(128 / 255), rtol=1e-6)
    np.testing.assert_allclose(raw.value, 128 / 255, rtol=1e-6)
    floats = texture(type="bitmap", data=np.full((2, 3), 0.5, dtype=np.float32))
    assert floats.value.shape == (2, 3, 1) and floats.value.max() == 0.5


def test_bitmap_rows_keep_their_order(tmp_path):
    image = np.zeros((4, 2, 3), dtype=np.float32)
    image[0] = 1.0
    write_image(tmp_path / "a.exr", image)
    value = texture(type="bitmap", filename=str(tmp_path / "a.exr")).value
    np.testing.assert_array_equal(value, image)


def test_bitmap_options():
    t = texture(
        type="bitmap",
        bitmap=np.ones((2, 2, 3)),
        filter_type="nearest",
        wrap_mode="mirror",
        to_uv=Transform.translate([0.5, 0.25, 9.0]).scale([2.0, 3.0, 1.0]),
    )
    assert (t.filter, t.wrap) == ("nearest", "mirror")
    np.testing.assert_allclose(t.to_uv, [[2.0, 0.0, 0.5], [0.0, 3.0, 0.25], [0.0, 0.0, 1.0]])


def test_a_colour_bitmap_as_roughness_is_its_luminance():
    image = np.zeros((1, 1, 3), dtype=np.float32)
    image[..., 1] = 0.5
    alpha = bsdf(type="roughconductor", alpha={"type": "bitmap", "bitmap": image}).textures["alpha_u"]
    np.testing.assert_allclose(alpha.value, [[[0.5 * 0.71516]]], rtol=1e-5)


def test_zeros_of_a_textured_roughness_are_raised():
    board = {"type": "checkerboard", "color0": 0.0, "color1": 0.4}
    scene = describe(x={"type": "cube", "bsdf": {"type": "roughconductor", "alpha": board}})
    assert any("1 of 1 values of 'alpha' are below 1e-05, and raised to it" in note for note in scene.notes)
    alpha = scene.shapes[0].bsdf.textures["alpha_u"]
    assert sorted(leaf.value[0] for leaf in alpha.leaves) == [np.float32(1e-5), np.float32(0.4)]


def test_colours_in_all_forms():
    assert texture(type="rgb", value=0.25).value.tolist() == [0.25] * 3
    assert texture(type="uniform", value=0.25).value.tolist() == [0.25]
    assert texture(type="spectrum", value=0.25).value.tolist() == [0.25]
    np.testing.assert_allclose(texture(type="rgb", value="#ff8000").value, [1.0, 0.2158605, 0.0], rtol=1e-5)


def test_spectra_integrate_white_to_one_and_red_to_red():
    white = texture(type="spectrum", value=[(300.0, 0.8), (900.0, 0.8)]).value
    # The matrix is rounded to six digits and D65 sampled every 5 nm.
    np.testing.assert_allclose(white, 0.8, rtol=2e-3)
    red = texture(type="spectrum", value="600:0, 620:0.2, 700:0.2").value
    assert red[0] > 10 * red[1] and red[2] == 0.0
    grey = describe(p={"type": "point", "intensity": {"type": "spectrum", "value": 1.0}}).emitters[1]
    # Equal energy is reddish under sRGB's white point.
    np.testing.assert_allclose(grey.radiance.value, [1.20479, 0.94829, 0.90892], atol=1e-5)


# -- lights ------------------------------------------------------------------------------------------------------------


AREA = {"type": "rectangle", "emitter": {"type": "area"}}


def test_lights():
    lights = {
        light.path: light
        for light in describe(
            area={"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}},
            point={"type": "point", "to_world": Transform.translate([1, 2, 3])},
            spot={"type": "spot", "cutoff_angle": 40.0, "intensity": 2.0},
            sun={"type": "directional", "direction": [0.0, -2.0, 0.0]},
        ).emitters
    }
    assert lights["area.emitter"].radiance.path == "area.emitter.radiance"
    assert lights["area.emitter"].radiance.value.tolist() == [1.0, 2.0, 3.0]
    assert lights["point"].position.tolist() == [1.0, 2.0, 3.0]
    assert (lights["spot"].cutoff_angle, lights["spot"].beam_width) == (40.0, 30.0)
    assert lights["spot"].radiance.value.tolist() == [2.0] * 3
    np.testing.assert_allclose(lights["sun"].to_world[:3, 2], [0.0, -1.0, 0.0])
    # As in Mitsuba, a shape may have a light that is not its surface: it stays in its place, and the shape is black.
    spot = {"type": "spot", "to_world": Transform.translate([0, 0, 5]), "intensity": 3.0}
    found = describe(ball={"type": "sphere", "center": [1, 0, 0], "light": spot}, area=AREA)
    assert [(light.path, light.kind) for light in found.emitters[1:]] == [
        ("ball.emitter", "spot"),
        ("area.emitter", "area"),
    ]
    assert found.emitters[1].to_world[:3, 3].tolist() == [0.0, 0.0, 5.0] and found.shapes[0].emitter is None
    assert found.shapes[0].bsdf.textures["reflectance"].value.tolist() == [0.0]
    for light in ({"type": "constant"}, {"type": "ref", "id": "there"}):
        with pytest.raises(
            ValueError, match=r"emitter inside a shape; shapes take 'area', .*'spot'.*; move it to the sc"
        ):
            describe(there={"type": "spot"}, ball={"type": "sphere", "light": light})
    np.testing.assert_allclose(np.linalg.det(lights["sun"].to_world), 1.0, rtol=1e-6)


def test_environment_map_clamps_negative_values_and_says_so():
    image = np.ones((4, 8, 3), dtype=np.float32)
    image[1, 2] = -1.0
    pose = Transform.rotate([0, 1, 0], 90)
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "shape": {"type": "cube"}}
    result = describe_dict({**scene, "sky": {"type": "envmap", "bitmap": image, "scale": 2.0, "to_world": pose}})
    sky = result.emitters[0]
    assert (sky.kind, sky.radiance.path, sky.scale) == ("envmap", "sky", 2.0)
    assert sky.radiance.value.min() == 0.0 and sky.radiance.value.shape == (4, 8, 3)
    np.testing.assert_allclose(sky.to_world, pose.matrix, atol=1e-7)
    assert any("3 negative values" in note for note in result.notes)


def test_textured_area_light_reads_an_attribute_of_its_shape():
    light = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "face_glow"}}
    triangle = {"vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "faces": [[0, 1, 2]], "face_glow": [[5.0]]}
    shape = describe(x={"type": "mesh", **triangle, "emitter": light}).shapes[0]
    assert shape.emitter.radiance.attribute == "face_glow" and shape.attributes["face_glow"].tolist() == [[5.0]]


# -- cameras -----------------------------------------------------------------------------------------------------------

CAMERAS = [
    {},
    {"fov": 40.0},
    *({"fov": 40.0, "fov_axis": axis} for axis in ("x", "y", "diagonal", "smaller", "larger")),
    {"focal_length": "85mm"},
]


def camera(width=640, height=480, **parameters):
    film = {"type": "hdrfilm", "width": width, "height": height}
    return describe(sensor={"type": "perspective", "film": film, **parameters}).sensors[0]


@pytest.mark.parametrize("parameters", CAMERAS)
@pytest.mark.parametrize("size", [(640, 480), (480, 640), (64, 64)])
def test_field_of_view_equals_mitsubas(parameters, size):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    theirs = mi.traverse(mi.load_dict({"type": "perspective", "film": film, **parameters}))["x_fov"]
    assert camera(*size, **parameters).x_fov == pytest.approx(theirs, rel=1e-5)


def test_field_of_view_by_hand():
    tangent = np.tan(np.radians(20.0))
    expected = {"x": tangent, "y": tangent * 4 / 3, "diagonal": tangent * 0.8, "larger": tangent}
    for axis, value in expected.items():
        assert np.tan(np.radians(0.5 * camera(fov=40.0, fov_axis=axis).x_fov)) == pytest.approx(value)


def test_camera_pose_drops_a_uniform_scale():
    pose = Transform.look_at([1, 2, 3], [0, 0, 0], [0, 1, 0])
    result = describe(sensor={"type": "perspective", "to_world": pose @ Transform.scale(3.0)})
    np.testing.assert_allclose(result.sensors[0].to_world, pose.matrix, atol=1e-6)
    assert any("scale 3 " in note for note in result.notes)


def test_film_filter_and_sampler():
    film = {"type": "hdrfilm", "width": 8, "height": 6, "crop_width": 4, "crop_offset_x": 2, "crop_height": 3}
    tent = {**film, "pixel_format": "rgba", "rfilter": {"type": "tent", "radius": 1.5}}
    result = describe(sensor={"type": "perspective", "film": tent, "sampler": {"type": "ldsampler", "sample_count": 9}})
    sensor = result.sensors[0]
    assert (sensor.film.crop_offset_x, sensor.film.crop_width, sensor.film.crop_height) == (2, 4, 3)
    assert (sensor.film.filter, sensor.film.filter_radius) == ("tent", 1.5)
    assert (sensor.sampler, sensor.sample_count) == ("sobol", 9)
    assert any("rgba" in note for note in result.notes) and any("ldsampler" in note for note in result.notes)
    plain = describe().sensors[0]
    assert (plain.film.width, plain.film.height, plain.film.filter, plain.sampler) == (768, 576, "gaussian", "default")
    box = {**film, "rfilter": {"type": "box"}}
    assert describe(sensor={"type": "perspective", "film": box}).sensors[0].film.filter_radius == 0.5
    wide = {**film, "rfilter": {"type": "gaussian", "stddev": 1.0}}
    assert describe(sensor={"type": "perspective", "film": wide}).sensors[0].film.filter_radius == 4.0


def test_integrators():
    assert describe().integrator == {}
    path = describe(i={"type": "path", "max_depth": 8, "hide_emitters": True}).integrator
    assert path == {"type": "path", "max_depth": 8, "rr_depth": 5, "hide_emitters": True}
    assert describe(i={"type": "direct"}).integrator["max_depth"] == 2
    assert describe(i={"type": "prb"}).integrator["max_depth"] == 6
    assert describe(i={"type": "prb", "max_depth": -1}).integrator["max_depth"] == -1
    nested = describe(i={"type": "aov", "aovs": "d:depth", "inner": {"type": "path", "max_depth": 3}})
    assert nested.integrator["type"] == "path" and nested.integrator["max_depth"] == 3
    assert nested.integrator["aovs"] == {"d": "depth"}


def test_a_moment_is_the_integrator_nested_in_it():
    assert describe(i={"type": "moment", "inner": {"type": "path", "max_depth": 3}}).integrator["max_depth"] == 3
    with pytest.raises(ValueError, match="0 integrators in 'moment'; nest one"):
        describe(i={"type": "moment"})


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("depth", r"psdr.render_aov\(scene, \['depth'\]\)"),
    ],
)
def test_integrators_that_compute_something_else_are_refused(name, remedy):
    with pytest.raises(ValueError, match=f"unsupported integrator '{name}'.*{remedy}"):
        describe(i={"type": name})


def test_transforms_compose_on_the_class_and_in_chains():
    a = Transform.translate([1, 2, 3]) @ Transform.rotate([0, 0, 1], 90) @ Transform.scale([2, 1, 1])
    b = Transform().translate([1, 2, 3]).rotate([0, 0, 1], 90).scale([2, 1, 1])
    np.testing.assert_array_equal(np.asarray(a), b.matrix)
    np.testing.assert_allclose(a.matrix @ [1, 0, 0, 1], [1, 4, 3, 1], atol=1e-12)
    np.testing.assert_allclose((a.inverse() @ a).matrix, np.eye(4), atol=1e-12)
    x = describe(x={"type": "cube", "to_world": b}, y={"type": "cube", "to_world": b.matrix.tolist()}).shapes
    np.testing.assert_array_equal(x[0].vertices, x[1].vertices)


def test_rotation_without_an_axis():
    with pytest.raises(ValueError, match="non-zero axis"):
        Transform.rotate([0.0, 0.0, 0.0], 30)


# -- the same as Mitsuba -----------------------------------------------------------------------------------------------


@pytest.fixture
def mi():
    module = pytest.importorskip("mitsuba")
    module.set_variant("scalar_rgb")
    return module


def test_conductors_and_iors_equal_mitsubas(mi):
    for name in (*("Cu", "Au", "Ag", "Al", "Cr"), "none", "W", "TiN"):
        theirs, ours = (
            mi.traverse(mi.load_dict({"type": "conductor", "material": name})),
            bsdf(type="conductor", material=name),
        )
        for slot in ("eta", "k"):
            np.testing.assert_allclose(
                np.ravel(theirs[f"{slot}.value"]), ours.textures[slot].value, rtol=1e-5, err_msg=name
            )
    for name, value in IORS.items():
        theirs = mi.traverse(mi.load_dict({"type": "dielectric", "int_ior": name, "ext_ior": 1.0}))["eta"]
        assert theirs == pytest.approx(value, rel=1e-6)


def test_first_row_of_a_bitmap_is_at_v_zero_in_mitsuba(mi):
    image = np.zeros((4, 1, 3), dtype=np.float32)
    image[0] = 1.0
    plugin = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"})
    at = mi.SurfaceInteraction3f()
    at.uv = (0.5, 0.1)
    assert np.array(plugin.eval(at)).tolist() == [1.0, 1.0, 1.0]


def scene_with_everything(bitmap):
    """Return a scene of most plugins; ``bitmap`` wraps an array for the library that reads it."""
    image = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 32, "height": 16}},
        "wall": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
        "picture": {"type": "bitmap", "bitmap": bitmap(image), "raw": True},
        "two": {"type": "twosided", "a": {"type": "ref", "id": "wall"}, "b": {"type": "diffuse", "reflectance": 0.4}},
        "cube": {"type": "cube", "bsdf": {"type": "ref", "id": "wall"}},
        "box": {"type": "cube", "my": {"type": "diffuse", "reflectance": {"type": "ref", "id": "picture"}}},
        "ball": {"type": "sphere", "my": {"type": "roughconductor", "material": "Cu", "alpha": 0.2}},
        "metal": {
            "type": "disk",
            "my": {"type": "roughconductor", "alpha_u": 0.2, "alpha_v": 0.3, "specular_reflectance": 0.9},
        },
        "mirror": {
            "type": "cylinder",
            "my": {"type": "conductor", "eta": {"type": "rgb", "value": [1, 2, 3]}, "k": 3.0},
        },
        "glass": {"type": "sphere", "my": {"type": "dielectric"}},
        "both": {"type": "rectangle", "my": {"type": "ref", "id": "two"}},
        "lamp": {"type": "rectangle", "shine": {"type": "area", "radiance": {"type": "rgb", "value": [4, 5, 6]}}},
        "point": {"type": "point", "intensity": 2.0},
        "spot": {"type": "spot", "intensity": {"type": "rgb", "value": 3.0}},
        "sun": {"type": "directional", "irradiance": {"type": "spectrum", "value": 0.5}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}},
    }


def test_parameter_names_and_values_equal_mitsubas(mi):
    theirs = mi.traverse(mi.load_dict(scene_with_everything(mi.Bitmap), optimize=False))
    ours = textures_of(describe_dict(scene_with_everything(np.asarray)))
    names = {name for name in theirs.properties if name.endswith((".value", ".data")) and ".texture." not in name}
    names.add("glass.bsdf.eta")  # kept as a number, not as a texture
    # Mitsuba 3.9 loses the id of a bitmap that is named in the scene, and lists it by its memory address.
    wanted = {re.sub(r"^object_\d+", "picture", name): name for name in names}
    # Mitsuba leaves optional slots out when they are 1, and we always have them.
    optional = {n for n in ours if n.rsplit(".", 2)[-2].startswith("specular_") and np.all(ours[n] == 1.0)}
    assert set(wanted) - set(ours) == set()
    assert set(ours) - set(wanted) - optional == set()
    for name, their_name in wanted.items():
        np.testing.assert_allclose(np.ravel(theirs[their_name]), np.ravel(ours[name]), rtol=1e-5, err_msg=name)


def test_mitsubas_own_cornell_box_loads(mi):
    result = describe_dict(mi.cornell_box())
    assert [shape.path for shape in result.shapes][-2:] == ["small-box", "large-box"]


@pytest.mark.parametrize("values", ["400:0.1, 500:0.5, 700:0.9", "300:1, 900:1", "450:0.2, 460:0.9, 640:0.3"])
def test_spectra_equal_mitsubas(mi, values):
    reflectance = f'<bsdf type="diffuse"><spectrum name="reflectance" value="{values}"/></bsdf>'
    theirs = mi.traverse(mi.load_string(reflectance.replace("<bsdf", '<bsdf version="3.0.0"')))["reflectance.value"]
    ours = texture(type="spectrum", value=values).value
    np.testing.assert_allclose(ours, np.array(theirs), rtol=1e-5, atol=1e-6)

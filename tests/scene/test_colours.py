"""Spectra become the colours of Mitsuba's RGB variants, as reflectances and as emissions."""

import numpy as np
import pytest

from warp_psdr.scene import describe_dict, describe_string

PAIRS = [(400.0, 0.2), (500.0, 0.9), (600.0, 0.5), (700.0, 0.3)]
REGULAR = {"type": "regular", "wavelength_min": 400.0, "wavelength_max": 700.0, "values": "0.2, 0.9 0.5 0.3"}
IRREGULAR = {"type": "irregular", "wavelengths": "400, 500, 600, 700", "values": "0.2, 0.9, 0.5, 0.3"}
#: Colours that Mitsuba's RGB variants evaluate.
COLOURS = {
    "number": 0.5,
    "grey": {"type": "rgb", "value": 0.5},
    "rgb": {"type": "rgb", "value": [0.1, 0.5, 0.9]},
    "srgb": {"type": "srgb", "color": [0.1, 0.5, 0.9]},
    "nested srgb": {"type": "srgb", "color": {"type": "rgb", "value": [0.1, 0.5, 0.9]}},
    "uniform spectrum": {"type": "spectrum", "value": 0.5},
    "pairs": {"type": "spectrum", "value": PAIRS},
    "saturated": {"type": "spectrum", "value": [(500.0, 1.0), (520.0, 1.0)]},
    "file": {"type": "spectrum", "filename": "green.spd"},
    "uniform": {"type": "uniform", "value": 0.5, "wavelength_min": 400.0},
    "d65": {"type": "d65"},
    "dim d65": {"type": "d65", "scale": 0.25},
    "d65 with a colour": {"type": "d65", "color": [0.1, 0.5, 0.25], "scale": 2.0},
    "d65 with a texture": {"type": "d65", "inner": {"type": "uniform", "value": 0.4}},
    "rawconstant": {"type": "rawconstant", "value": [0.5, 1.0, 0.3]},
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "green.spd").write_text("# nm value\n400 0.2\n500 0.9\n\n600 0.5\n700 0.3\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def load(value, emissive):
    """Return the colour of a reflectance or of an emission."""
    shape = {"type": "cube", "bsdf": {"type": "diffuse"}}
    slot = {"type": "constant", "radiance": value} if emissive else {"type": "constant"}
    if not emissive:
        shape["bsdf"]["reflectance"] = value
    result = describe_dict({"type": "scene", "camera": {"type": "perspective"}, "box": shape, "sky": slot})
    return (result.emitters[0].radiance if emissive else result.shapes[0].bsdf.textures["reflectance"]).value


@pytest.mark.parametrize("emissive", [False, True], ids=["reflectance", "emission"])
@pytest.mark.parametrize("name", COLOURS)
def test_colours_equal_mitsubas(folder, name, emissive):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    slot, plugin = ("radiance", "constant") if emissive else ("reflectance", "diffuse")
    theirs = mi.traverse(mi.load_dict({"type": plugin, slot: COLOURS[name]}))[f"{slot}.value"]
    np.testing.assert_allclose(load(COLOURS[name], emissive), np.ravel(theirs), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("emissive", [False, True], ids=["reflectance", "emission"])
def test_lists_of_wavelengths_in_all_forms_are_one_colour(folder, emissive):
    expected = load(COLOURS["pairs"], emissive)
    forms = ["400:0.2, 500:0.9 600:0.5, 700:0.3", PAIRS]
    plugins = [{"type": "spectrum", "value": form} for form in forms] + [COLOURS["file"], REGULAR, IRREGULAR]
    for plugin in plugins:
        np.testing.assert_array_equal(load(plugin, emissive), expected)


@pytest.mark.parametrize("kelvin", [1500.0, 6500.0])
def test_black_bodies_have_the_colour_of_mitsubas_spectral_variants(kelvin):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_spectral")
    plugin = mi.load_dict({"type": "blackbody", "temperature": kelvin})
    at, total = mi.SurfaceInteraction3f(), np.zeros(3)
    wavelengths = np.linspace(360.0, 830.0, 400)
    for four in wavelengths.reshape(-1, 4).tolist():
        at.wavelengths = four
        total += np.array(mi.spectrum_to_srgb(plugin.eval(at), four)) * (470.0 / 100.0)
    theirs = np.maximum(total, 0.0)
    ours = load({"type": "blackbody", "temperature": kelvin}, True)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2, atol=1e-3 * theirs.max())


def test_white_is_white():
    np.testing.assert_allclose(load({"type": "spectrum", "value": [(300.0, 0.8), (900.0, 0.8)]}, False), 0.8, rtol=2e-3)
    assert load({"type": "d65"}, True).tolist() == [1.0]


def test_spectra_of_files_lie_in_the_scenes_folder(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "red.spd").write_text("600 0\n620 1\n")
    (tmp_path / "scene" / "red.spd").write_text("600 0\n620 1\n700 1\n")
    body = """<scene version="3.0.0"><emitter type="constant"><spectrum name="radiance" filename="{}"/></emitter>
    <emitter type="point"><spectrum name="intensity" type="blackbody">
    <float name="temperature" value="3000"/></spectrum></emitter></scene>"""
    lights = describe_string(body.format("red.spd"), base=tmp_path / "scene").emitters
    red, warm = lights[0].radiance.value, lights[1].radiance.value
    assert red[0] > 10 * red[1] and red[2] == 0.0 and warm[0] > warm[1] > warm[2] > 0.0
    with pytest.raises(ValueError, match="leaves the scene's folder"):
        describe_string(body.format("../red.spd"), base=tmp_path / "scene")


@pytest.mark.parametrize(
    ("plugin", "words"),
    [
        ({"type": "regular", "values": "1"}, "parameter 'values'.*give 2 to"),
        ({"type": "irregular", "wavelengths": "400, 500", "values": "1, 2, 3"}, "2 wavelengths and 3 values"),
        ({"type": "irregular", "wavelengths": "500, 400", "values": "1, 2"}, "increasing wavelengths"),
        ({"type": "blackbody"}, "parameter 'temperature'.*give one number"),
        ({"type": "blackbody", "temperature": -1.0}, "above 0"),
        ({"type": "uniform", "value": 1.0, "wavelength_min": 900.0}, "wavelength_min must be the smaller"),
        ({"type": "spectrum", "value": 1.0, "filename": "x.spd"}, "both 'value' and 'filename'"),
        ({"type": "spectrum", "filename": "words.spd"}, "line 2: '500 many' is no pair"),
        ({"type": "srgb", "value": 1.0}, "'srgb' without 'color'"),
        ({"type": "d65", "colour": 1.0}, "no parameter 'colour' .did you mean 'color'"),
    ],
)
def test_colours_that_cannot_be_read(folder, plugin, words):
    (folder / "words.spd").write_text("400 1\n500 many\n")
    with pytest.raises(ValueError, match=words):
        load(plugin, True)


def test_spectra_beyond_reason_are_not_read(folder):
    (folder / "vast.spd").write_bytes(b"#" * ((1 << 20) + 1))
    with pytest.raises(ValueError, match="at most 1048576"):
        load({"type": "spectrum", "filename": "vast.spd"}, True)


def test_bitmaps_above_one_are_accepted_with_a_remark():
    image = np.array([[[0.5, 1.0, 1.5]]], dtype=np.float32)
    bitmap = {"type": "bitmap", "bitmap": image, "raw": True}
    scene = {"type": "scene", "box": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": bitmap}}}
    result = describe_dict(scene)
    np.testing.assert_array_equal(result.shapes[0].bsdf.textures["reflectance"].value, image)
    assert any("1 of 3 values of 'reflectance' exceed 1" in note for note in result.notes)
    bitmap["bitmap"] = -image
    with pytest.raises(ValueError, match="out of range"):
        describe_dict(scene)

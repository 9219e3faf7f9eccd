"""Loading: what the public functions return and warn of; the Cornell box that comes with the library."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.scene import load
from warp_psdr.scene.files.dictionary import describe_dict

SCENES = Path(__file__).resolve().parents[2] / "scenes"
#: Rounding of a shape's pose, float32 in Mitsuba and float64 here.
POSE_ROUNDING = 2e-6


def dark() -> dict:
    """A scene with a note: there is no light."""
    film = {"type": "hdrfilm", "width": 4, "height": 3}
    return {"type": "scene", "eye": {"type": "perspective", "film": film}, "card": {"type": "rectangle"}}


def test_notes_are_warned_of_where_the_scene_is_loaded(tmp_path: Path) -> None:
    with pytest.warns(psdr.SceneWarning, match="there is no light") as found:
        scene = psdr.load_dict(dark())
    assert [str(w.message) for w in found] == scene.description.notes and len(found) == 1
    assert Path(found[0].filename) == Path(__file__)
    xml = '<scene version="3.0.0"><sensor type="perspective"/><shape type="rectangle"/></scene>'
    (tmp_path / "dark.xml").write_text(xml)
    for loaded in (lambda: psdr.load_string(xml), lambda: psdr.load_file(tmp_path / "dark.xml")):
        with pytest.warns(psdr.SceneWarning, match="there is no light") as found:
            loaded()
        assert len(found) == 1 and Path(found[0].filename) == Path(__file__)


def test_of_many_notes_the_first_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "MOST_WARNINGS", 2)
    lights = {f"light{i}": {"type": "point", "unknown_here": 1.0} for i in range(5)}
    description = describe_dict(dark())
    description.notes.extend(lights)
    with pytest.warns(psdr.SceneWarning) as found:
        load._load(description, "cpu")
    assert len(found) == 3 and "4 more remarks" in str(found[-1].message)


@pytest.mark.smoke
def test_a_sound_scene_warns_of_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        psdr.load_dict(psdr.cornell_box())
        psdr.load_file(SCENES / "cornell_box.xml")


def test_scenes_lie_on_warps_current_device_and_say_so() -> None:
    scene = psdr.load_dict(psdr.cornell_box())
    assert scene.device == wp.get_device()
    text = repr(scene)
    assert text == (
        f"<psdr.Scene 'dict': 8 shapes, 36 triangles, 1 light, 1 sensor of 256 x 256 pixels, on {wp.get_device()}>"
    )
    assert repr(psdr.load_file(SCENES / "cornell_box.xml", device="cpu", resolution=8)).startswith(
        "<psdr.Scene 'cornell_box.xml': 8 shapes"
    )


def test_the_cornell_box_is_the_file() -> None:
    box, file = psdr.load_dict(psdr.cornell_box()), psdr.load_file(SCENES / "cornell_box.xml")
    ours, theirs = psdr.traverse(box), psdr.traverse(file)
    assert list(ours) == list(theirs)
    for name in set(ours) - {"light.to_world"}:  # of a rectangle's pose the third column is free
        np.testing.assert_allclose(ours[name].numpy(), theirs[name].numpy(), atol=POSE_ROUNDING, err_msg=name)
    changed = psdr.cornell_box()
    changed["white"]["reflectance"]["value"][0] = 0.0
    assert psdr.cornell_box()["white"]["reflectance"]["value"][0] > 0.0, "a dictionary is shared"


def test_the_cornell_box_is_mitsubas() -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    ours, theirs = psdr.cornell_box(), mi.cornell_box()
    assert list(ours) == list(theirs)
    assert_same(ours, theirs, "scene")


def assert_same(ours, theirs, where: str) -> None:
    if isinstance(theirs, dict):
        # Without a lens nothing is out of focus, and the component format is one of files.
        assert ours.keys() == theirs.keys() - {"focus_distance", "component_format"}, where
        for key in ours:
            assert_same(ours[key], theirs[key], f"{where}[{key!r}]")
    elif isinstance(ours, psdr.Transform):
        np.testing.assert_allclose(ours.matrix, np.array(theirs.matrix), atol=POSE_ROUNDING, err_msg=where)
    else:
        assert np.array_equal(ours, theirs), where


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "roughdielectric", "int_ior": 1.001, "ext_ior": 1.0},
        {"type": "roughdielectric", "int_ior": 0.999, "ext_ior": 1.0},
        {"type": "principled", "eta": 1.001, "spec_trans": 1.0},
    ],
)
def test_an_index_as_near_to_one_as_the_message_allows(bsdf: dict) -> None:
    scene = {"type": "scene", "s": {"type": "sphere", "bsdf": bsdf}, "camera": {"type": "perspective"}}
    assert describe_dict(scene).shapes

"""Orthographic and thin-lens cameras: rays and images against Mitsuba, values, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean, batches, blocks
from tests.peer import MITSUBA_ROUNDING

T = psdr.Transform
POSE = T.look_at([0.3, -4.0, 2.5], [0.0, 0.0, 0.4], [0.0, 0.0, 1.0])
LOOK = '<lookat origin="0.3, -4, 2.5" target="0, 0, 0.4" up="0, 0, 1"/>'
CROP = """<integer name="crop_width" value="18"/><integer name="crop_height" value="12"/>
    <integer name="crop_offset_x" value="5"/><integer name="crop_offset_y" value="2"/>"""
SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="{kind}">{parameters}<transform name="to_world">{pose}</transform>
    <film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/>
    {crop}<rfilter type="box"/></film></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.5, 0.3"/></bsdf></shape>
<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.5" z="0.8"/><rotate z="1" angle="30"/>
    <translate x="-0.5" y="0.2" z="0.8"/></transform></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.4"/><rotate x="1" angle="150"/>
    <translate x="0.5" y="-0.5" z="2"/></transform><emitter type="area"><rgb name="radiance" value="9, 8, 7"/></emitter>
    </shape><emitter type="constant"><rgb name="radiance" value="0.2, 0.3, 0.4"/></emitter></scene>"""
LENS = '<float name="aperture_radius" value="0.3"/>'
FOCUS = '<float name="focus_distance" value="3.2"/>'


def text(kind, parameters="", pose=LOOK, width=24, height=18, crop=""):
    return SCENE.format(kind=kind, parameters=parameters, pose=pose, width=width, height=height, crop=crop)


CASES = {
    "orthographic": text("orthographic", pose='<scale value="1.6"/>' + LOOK),
    "orthographic, cropped": text("orthographic", pose='<scale value="1.6"/>' + LOOK, height=16, crop=CROP),
    "orthographic, stretched": text(
        "orthographic",
        '<float name="near_clip" value="1.5"/><float name="far_clip" value="3.2"/>',
        '<scale x="1.3" y="1.8" z="2"/>' + LOOK,
        width=18,
        height=24,
    ),
    "thin lens": text("thinlens", LENS + FOCUS + '<float name="fov" value="45"/>'),
    "thin lens, cropped": text("thinlens", LENS + FOCUS + '<string name="focal_length" value="50mm"/>', crop=CROP),
    "thin lens, tall, clipped": text(
        "thinlens",
        LENS + FOCUS + '<float name="near_clip" value="3.5"/><float name="far_clip" value="5"/>'
        '<float name="fov" value="35"/><string name="fov_axis" value="y"/>',
        width=18,
        height=24,
    ),
    "thin lens, focused far away": text("thinlens", LENS + '<float name="fov" value="45"/>'),
}


@pytest.mark.slow_rows("orthographic")
@pytest.mark.parametrize("name", CASES)
def test_equals_mitsuba(name):
    """Blocks of 6 x 6 pixels have the mean of Mitsuba's ``path``."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    ours = batches(psdr.load_string(CASES[name]), spp=16)
    scene = mitsuba.load_string(CASES[name])
    theirs = np.stack([np.array(mitsuba.render(scene, spp=16, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 6), blocks(theirs, 6), name, MITSUBA_ROUNDING)


def load(kind, **parameters):
    film = {"type": "hdrfilm", "width": 8, "height": 6}
    sensor = {"type": kind, "to_world": POSE, "film": film, **parameters}
    scene = psdr.load_dict({"type": "scene", "sensor": sensor, "sky": {"type": "constant"}})
    return scene, psdr.traverse(scene)


@pytest.mark.parametrize(
    ("kind", "parameters"), [("orthographic", {}), ("thinlens", {"aperture_radius": 0.2, "focus_distance": 3.0})]
)
def test_values_have_mitsubas_names(kind, parameters):
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    pose = mitsuba.ScalarTransform4f(POSE.matrix)
    film = {"type": "hdrfilm", "width": 8, "height": 6}
    theirs = mitsuba.traverse(mitsuba.load_dict({"type": kind, "to_world": pose, "film": film, **parameters}))
    _scene, ours = load(kind, **parameters)
    names = [n.removeprefix("sensor.") for n in ours if n.startswith("sensor.")]
    assert {"to_world", *parameters} <= set(names)
    # Mitsuba's thin lens has no principal point.
    for name in (n for n in names if not n.startswith("principal_point")):
        expected = np.array(theirs[name].matrix if name == "to_world" else theirs[name])
        np.testing.assert_allclose(ours[f"sensor.{name}"].numpy().reshape(expected.shape), expected, rtol=1e-6)


def test_a_lens_focuses_far_away_unless_told():
    scene, params = load("thinlens", aperture_radius=0.2, far_clip=500.0)
    assert params["sensor.focus_distance"].numpy() == pytest.approx(500.0)
    assert "camera" in {line[0] for line in psdr.plan(scene).lines}


def test_an_orthographic_camera_keeps_its_scale():
    _scene, params = load("orthographic", to_world=POSE @ T.scale([2.0, 3.0, 1.0]))
    axes = np.linalg.norm(params["sensor.to_world"].numpy()[:3, :3], axis=0)
    np.testing.assert_allclose(axes, [2.0, 3.0, 1.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "parameters", "message"),
    [
        ("thinlens", {}, "aperture_radius"),
        ("thinlens", {"aperture_radius": -0.1}, "aperture_radius"),
        ("thinlens", {"aperture_radius": 0.1, "focus_distance": 0.0}, "focus_distance"),
        ("thinlens", {"aperture_radius": 0.1, "to_world": T.scale([1.0, 2.0, 1.0])}, "stretches"),
        ("orthographic", {"fov": 40.0}, "fov"),
        ("orthographic", {"aperture_radius": 0.1}, "aperture_radius"),
        ("orthographic", {"near_clip": 2.0, "far_clip": 1.0}, "near_clip"),
        ("orthographic", {"to_world": np.diag([1.0, 1.0, 0.0, 1.0])}, "singular"),
    ],
)
def test_wrong_parameters_are_refused(kind, parameters, message):
    with pytest.raises(ValueError, match=message):
        load(kind, **parameters)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*far from the origin:warp_psdr.SceneWarning")
def test_a_point_in_focus_is_sharp_and_others_spread_as_derived():
    """A small lamp: one pixel in focus; out of focus a disk of the radius a |1/f - 1/z| of the image."""
    distance, radius, size, fov = 3.0, 0.4, 48, 40.0
    lamp = {
        "type": "rectangle",
        "to_world": T.translate([0.0, 0.0, distance]) @ T.rotate([0.0, 1.0, 0.0], 180.0) @ T.scale(0.01),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    spread = []
    for focus in (distance, 2.0):
        sensor = {"type": "thinlens", "aperture_radius": radius, "focus_distance": focus, "fov": fov, "film": film}
        scene = psdr.load_dict({"type": "scene", "sensor": sensor, "lamp": lamp})
        image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=1), spp=1024, seed=1).numpy()[..., 0]
        y, x = np.indices(image.shape) + 0.5 - 0.5 * size
        spread.append(np.sqrt((image * (x**2 + y**2)).sum() / image.sum()))
    assert spread[0] < 1.0
    # Root mean square radius of a disk; the lamp itself and the pixels add half a pixel.
    pixels = 0.5 * size / np.tan(np.radians(0.5 * fov))
    assert spread[1] == pytest.approx(pixels * radius * (1 / 2.0 - 1 / distance) / np.sqrt(2.0), rel=0.05)

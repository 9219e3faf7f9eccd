"""What belongs to the sensor and to the counting of path vertices: crop, filters, clipping, principal point, depth."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import CLOSED_FORM, ROUNDING, assert_mean, assert_same_mean, batches, blocks

#: Reflectances of ``furnace_inside``.
ALBEDO = np.array([0.2, 0.5, 0.9])
#: Absorbs float32 rounding of sums over a few thousand samples, relative.
SUM_ROUNDING = 2e-5


def room(film="", sensor="", rfilter='<rfilter type="box"/>', size=16):
    """A lit corner with edges everywhere, seen by a camera that the arguments complete."""
    return psdr.load_string(f"""
    <scene version="3.0.0">
        <integrator type="path"><integer name="max_depth" value="3"/></integrator>
        <sensor type="perspective">
            <float name="fov" value="40"/>
            <transform name="to_world"><lookat origin="0.5, 0.4, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
            {sensor}
            <film type="hdrfilm">
                <integer name="width" value="{size}"/><integer name="height" value="{size}"/>{film}{rfilter}
            </film>
        </sensor>
        <shape type="rectangle"><transform name="to_world"><translate z="-1"/></transform>
            <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.5, 0.2"/></bsdf></shape>
        <shape type="cube"><transform name="to_world"><scale value=".4"/><rotate x=".6" y=".8" angle="30"/></transform>
            <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf></shape>
        <shape type="rectangle"><transform name="to_world"><scale value="0.3"/><rotate y="1" angle="180"/>
            <translate x="-0.6" y="0.6" z="1.2"/></transform>
            <emitter type="area"><rgb name="radiance" value="20, 20, 20"/></emitter></shape>
        <emitter type="constant"><rgb name="radiance" value="0.3, 0.2, 0.1"/></emitter>
    </scene>""")


@pytest.mark.parametrize("depth", [1, 2, 3, 6])
@pytest.mark.parametrize("rr_depth", [2, 1000])
def test_depth_counts_vertices(depth, rr_depth):
    """Inside a furnace every vertex adds the next term of a geometric series, with and without Russian roulette."""
    scene = psdr.load_file(CLOSED_FORM / "furnace_inside.xml")
    images = batches(scene, count=8, spp=16, max_depth=depth, rr_depth=rr_depth)
    expected = (ALBEDO[None, :] ** np.arange(depth)[:, None]).sum(axis=0)
    assert_mean(images.reshape(-1, 3), expected, f"depth {depth}")


def test_unbounded_depth():
    """Without a limit the series sums to 1 / (1 - albedo)."""
    scene = psdr.load_file(CLOSED_FORM / "furnace_inside.xml")
    images = batches(scene, count=8, spp=16, max_depth=-1)
    assert_mean(images.reshape(-1, 3), 1.0 / (1.0 - ALBEDO), "unbounded depth")


def test_mitsuba_counts_alike():
    """Mitsuba's path integrator gives the same sums for the same ``max_depth``."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    for depth in (1, 2, 3):
        scene = mitsuba.load_file(str(CLOSED_FORM / "furnace_inside.xml"), max_depth=depth)
        images = np.stack([np.array(mitsuba.render(scene, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
        expected = (ALBEDO[None, :] ** np.arange(depth)[:, None]).sum(axis=0)
        assert_mean(images.reshape(-1, 3), expected, f"Mitsuba, depth {depth}")


@pytest.mark.slow
def test_hidden_emitters_still_light():
    """Hiding the lights takes away what the camera sees of them and nothing else."""
    scene = room()
    shown, hidden = (batches(scene, spp=16, max_depth=3, hide_emitters=h) for h in (False, True))
    sky = np.isclose(shown, [0.3, 0.2, 0.1], rtol=ROUNDING).all(axis=(0, -1))
    surface = batches(scene, spp=64, max_depth=1, seed=100).max(axis=(0, -1)) == 0.0
    surface[:, :8] = False  # the lamp, whose dark back vanishes with it
    assert sky.sum() > 10 and surface.sum() > 30
    np.testing.assert_array_equal(hidden[:, sky], 0.0)
    means = [images[:, surface].mean(axis=1) for images in (shown, hidden)]
    assert_same_mean(*means, "surfaces under hidden lights", rounding=2e-3)  # pixels that hold a sliver of the sky


def test_crop_is_a_part_of_the_film():
    """A crop window shows the pixels of the full film at its place."""
    crop = '<integer name="crop_offset_x" value="4"/><integer name="crop_offset_y" value="2"/>'
    crop += '<integer name="crop_width" value="8"/><integer name="crop_height" value="12"/>'
    cropped, full = batches(room(crop), spp=16), batches(room(), spp=32, seed=100)
    assert cropped.shape[1:3] == (12, 8)
    assert_same_mean(cropped, full[:, 2:14, 4:12], "crop", rounding=1e-2)
    with pytest.raises(AssertionError, match="crop"):
        assert_same_mean(cropped, full[:, 3:15, 4:12], "crop", rounding=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("rfilter", ["tent", "gaussian"])
def test_filters_conserve_energy(rfilter):
    """A filter moves light between neighbouring pixels; it makes none. Sums over the film, whose border is flat."""
    box, other = room(size=32), room(rfilter=f'<rfilter type="{rfilter}"/>', size=32)
    a, b = batches(box, spp=16), batches(other, spp=16, seed=100)
    sums = [images[:, 2:-2, 2:-2].mean(axis=(1, 2)) for images in (a, b)]
    assert_same_mean(sums[1], sums[0], rfilter, rounding=5e-3)  # what crosses the border of the inner film
    # A filter that is wider than a pixel blurs: the image differs although its sum does not.
    assert np.abs(a.mean(axis=0) - b.mean(axis=0)).max() > 0.02


@pytest.mark.slow
def test_filters_keep_a_constant_image():
    """Under any filter a film that sees one radiance shows that radiance: the weights sum to 1."""
    narrow = '<float name="{}" value="{}"/>'
    filters = {
        "box": "",
        "tent": "",
        "gaussian": "",
        "narrow tent": narrow.format("radius", 0.1),
        "narrow gaussian": narrow.format("stddev", 0.05),
    }
    for name, options in filters.items():
        rfilter = name.split()[-1]
        scene = psdr.load_string(f"""
        <scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>
        <integer name="height" value="3"/><rfilter type="{rfilter}">{options}</rfilter></film></sensor>
        <emitter type="constant"><rgb name="radiance" value="1, 2, 3"/></emitter></scene>""")
        image = psdr.render(scene, spp=8, integrator=psdr.PathIntegrator(max_depth=1)).numpy()
        np.testing.assert_allclose(image, np.broadcast_to([1.0, 2.0, 3.0], (3, 4, 3)), rtol=SUM_ROUNDING)


@pytest.mark.parametrize(
    ("clip", "visible"),
    [
        ("", "near sheet"),
        ('<float name="near_clip" value="2.01"/>', "far sheet"),
        ('<float name="near_clip" value="1.99"/>', "near sheet"),
        ('<float name="near_clip" value="4.5"/>', "nothing"),
        ('<float name="far_clip" value="1.99"/>', "nothing"),
        ('<float name="near_clip" value="2.5"/><float name="far_clip" value="3.99"/>', "nothing"),
        ('<float name="near_clip" value="2.5"/><float name="far_clip" value="4.01"/>', "far sheet"),
    ],
)
def test_clip_planes(clip, visible):
    """Planes at depth 2 and 4: clip distances count along the viewing axis, also at the corners of a wide image."""
    scene = psdr.load_string(f"""
    <scene version="3.0.0"><sensor type="perspective"><float name="fov" value="100"/>{clip}
        <transform name="to_world"><lookat origin="0, 0, 0" target="0, 0, -1" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="20"/><translate z="-2"/></transform>
        <emitter type="area"><rgb name="radiance" value="2, 2, 2"/></emitter></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="20"/><translate z="-4"/></transform>
        <emitter type="area"><rgb name="radiance" value="4, 4, 4"/></emitter></shape></scene>""")
    image = psdr.render(scene, spp=4, integrator=psdr.PathIntegrator(max_depth=1)).numpy()
    expected = {"near sheet": 2.0, "far sheet": 4.0, "nothing": 0.0}[visible]
    np.testing.assert_allclose(image, expected, rtol=SUM_ROUNDING)


@pytest.mark.parametrize(("axis", "pixels"), [("x", 4), ("y", -3)])
def test_principal_point_shifts_the_film(axis, pixels):
    """An offset of k / width shows what stood k pixels further, Mitsuba's sign."""
    shifted = room(sensor=f'<float name="principal_point_offset_{axis}" value="{pixels / 16}"/>')
    a, b = batches(shifted, spp=16), batches(room(), spp=32, seed=100)
    dimension = 2 if axis == "x" else 1
    moved = np.roll(b, -pixels, axis=dimension)
    inside = [slice(None)] * 4
    inside[dimension] = slice(0, 16 - pixels) if pixels > 0 else slice(-pixels, 16)
    assert_same_mean(a[tuple(inside)], moved[tuple(inside)], "principal point", rounding=1e-2)
    with pytest.raises(AssertionError, match="unshifted"):
        assert_same_mean(a, b, "unshifted", rounding=1e-2)


@pytest.mark.slow
def test_mitsuba_sees_the_same_film():
    """Crop, principal point, fov axis and clip planes against Mitsuba, in 4 x 4 blocks."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    text = """
    <scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective"><float name="fov" value="50"/><string name="fov_axis" value="{axis}"/>
        <float name="principal_point_offset_x" value="0.2"/><float name="principal_point_offset_y" value="-0.1"/>
        <float name="near_clip" value="3.2"/><float name="far_clip" value="4.6"/>
        <transform name="to_world"><lookat origin="0.5, 0.4, 4" target="0, 0, 0" up="0.2, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/>
            <integer name="crop_offset_x" value="3"/><integer name="crop_offset_y" value="2"/>
            <integer name="crop_width" value="20"/><integer name="crop_height" value="12"/><rfilter type="box"/></film>
    </sensor>
    <shape type="cube"><bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.8"/></bsdf></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="3"/><rotate y="1" angle="60"/></transform></shape>
    <emitter type="point"><point name="position" x="1" y="2" z="3"/></emitter>
    <emitter type="constant"><float name="radiance" value="0.1"/></emitter></scene>"""
    for axis in ("x", "y", "diagonal", "smaller", "larger"):
        ours = batches(psdr.load_string(text.format(axis=axis)), spp=64)
        scene = mitsuba.load_string(text.format(axis=axis))
        theirs = np.stack([np.array(mitsuba.render(scene, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
        assert_same_mean(blocks(ours, 4), blocks(theirs, 4), f"fov_axis {axis}")


@pytest.mark.parametrize("border", [None, "false", "true"])
@pytest.mark.parametrize("rfilter", [pytest.param("tent", marks=pytest.mark.slow), "gaussian"])
@pytest.mark.parametrize("cropped", [False, True])
def test_mitsuba_ends_filters_alike(rfilter, border, cropped):
    """At the border of the film and of a crop window, with samples beyond it and without."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    value = "" if border is None else f'<boolean name="sample_border" value="{border}"/>'
    window = {"crop_offset_x": 2, "crop_offset_y": 3, "crop_width": 6, "crop_height": 5} if cropped else {}
    crop = "".join(f'<integer name="{name}" value="{number}"/>' for name, number in window.items())
    text = f"""
    <scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="1"/></integrator>
    <sensor type="orthographic">
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="10"/><integer name="height" value="10"/>{crop}{value}
            <rfilter type="{rfilter}"/></film></sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="0.8"/><rotate z="1" angle="10"/></transform>
        <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter></shape>
    <emitter type="constant"><float name="radiance" value="0.1"/></emitter></scene>"""
    ours = batches(psdr.load_string(text), spp=64, count=8)
    scene = mitsuba.load_string(text)
    theirs = np.stack([np.array(mitsuba.render(scene, spp=64, seed=i)) for i in range(8)]).astype(np.float64)
    assert_same_mean(ours, theirs, f"{rfilter}, {border}", rounding=5e-3)  # Mitsuba's Gaussian is a polynomial


@pytest.mark.slow
@pytest.mark.slow_rows("to_world0")
@pytest.mark.parametrize("to_world", [np.diag([2.0, 1.0, 1.0, 1.0]), np.diag([1.0, -3.0, 0.5, 1.0])])
def test_a_stretched_environment_lights_a_floor_as_one_that_is_not(to_world) -> None:
    """Of one radiance all around, whichever way its map is stretched."""
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    pose = psdr.Transform.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0))
    scene = psdr.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 20, "to_world": pose, "film": film},
            "floor": {"type": "rectangle", "to_world": psdr.Transform.scale(5), "bsdf": {"type": "diffuse"}},
            "sky": {"type": "envmap", "bitmap": np.ones((8, 16, 3), np.float32), "to_world": psdr.Transform(to_world)},
        }
    )
    images = batches(scene, spp=256, max_depth=2)
    assert_mean(images, np.full((4, 4, 3), 0.5), "floor")

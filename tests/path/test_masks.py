"""Masks against formulas, images and derivatives, whose opacity may be 0 or 1, and against Mitsuba."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import ROUNDING, assert_mean, assert_same_mean, batches, blocks
from tests.path.test_null import T, camera, light, load, rgb, sheet

#: What the sheets reflect of the light from below them: none.
BLACK = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}}
GLOW = np.array([1.0, 2.0, 3.0])


def masked(opacity, bsdf=BLACK):
    return {"type": "mask", "opacity": opacity, "bsdf": bsdf}


def stacked(*opacities):
    """The camera looks through black sheets at a light, 2 by 2 pixels of one colour."""
    sheets = {f"s{i}": sheet(0.5 - 0.1 * i, masked(o)) for i, o in enumerate(opacities)}
    return load(sensor=camera([0, 0, 1], [0, 0, 0], size=2), light=light(-1.0, GLOW), **sheets)


def lit(*opacities, area=False):
    """The camera looks at a floor that a light reaches through black sheets beside its line of sight."""
    sheets = {
        f"s{i}": {**sheet(0.0, masked(o)), "to_world": T.translate([3, 0, 1.0 + 0.2 * i]) @ T.scale(2.0)}
        for i, o in enumerate(opacities)
    }
    lamp = {"type": "point", "position": [4.0, 0.0, 3.0], "intensity": rgb(*(25.0 * GLOW))}
    if area:
        pose = T.look_at([4, 0, 3], [0, 0, 0], [0, 1, 0]) @ T.scale(0.2)
        lamp = {**light(0.0, 25.0 * GLOW / 0.16), "to_world": pose}
    floor = sheet(0.0, {"type": "diffuse", "reflectance": 0.6})
    return load(sensor=camera([0, 0, 5], [0, 0, 0], 0.05, 2), floor=floor, lamp=lamp, **sheets)


FLOOR = GLOW * 0.6 * 0.6 / np.pi


@pytest.mark.parametrize("opacities", [(0.3,), (0.3, 0.6), (0.0, 0.5), (1.0, 0.5)], ids=str)
def test_transmittance_of_stacked_masks(opacities):
    passed = np.prod(1.0 - np.array(opacities))
    assert_mean(batches(stacked(*opacities), spp=256, max_depth=4).reshape(-1, 3), GLOW * passed, "seen", 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("opacities", [(0.3,), (0.3, 0.6), (0.0, 0.5), (1.0, 0.5)], ids=str)
def test_a_point_light_shines_through_stacked_masks(opacities):
    passed = np.prod(1.0 - np.array(opacities))
    image = psdr.render(lit(*opacities), integrator=psdr.PathIntegrator(max_depth=4), spp=4).numpy()
    np.testing.assert_allclose(image.mean(axis=(0, 1)), FLOOR * passed, rtol=ROUNDING)


@pytest.mark.parametrize("opacities", [(), (0.3,)], ids=str)
def test_without_caustics_masks_hide_a_point_light(opacities):
    """As in Mitsuba's ``path``."""
    integrator = psdr.PathIntegrator(max_depth=4, caustics=False)
    image = psdr.render(lit(*opacities), integrator=integrator, spp=4).numpy()
    np.testing.assert_allclose(image.mean(axis=(0, 1)), 0.0 * FLOOR if opacities else FLOOR, rtol=ROUNDING)


@pytest.mark.slow
def test_an_area_light_shines_through_masks():
    plain, through = (batches(lit(*o, area=True), spp=64, max_depth=4).mean(axis=(1, 2)) for o in ((), (0.3, 0.6)))
    assert_same_mean(through, plain * 0.28, "area light", 1e-3)


def derivative(scene, name, spp, depth=4):
    """Of the mean image, as independent samples, in forward and in reverse mode."""
    params = psdr.traverse(scene)
    params.requires_grad_only(name)
    options = {"integrator": psdr.PathIntegrator(max_depth=depth), "spp": spp}
    forward = np.stack([
        psdr.render_forward(scene, params, {name: 1.0}, seed=i, **options).numpy().mean(axis=(0, 1)) for i in range(16)
    ])  # fmt: skip
    reverse = []
    for i in range(16):
        params.zero_grad()
        psdr.render_backward(scene, params, np.full((2, 2, 3), 0.25, np.float32), seed=100 + i, **options)
        reverse.append(params[name].grad.numpy().sum())
    return forward, np.array(reverse)


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("scene", [stacked, lit], ids=["seen", "lit"])
def test_derivative_by_an_opacity(scene, opacity):
    """The second of two sheets, at the ends of its range too: minus the light that the first one lets pass."""
    expected = -0.7 * (GLOW if scene is stacked else FLOOR)
    forward, reverse = derivative(scene(0.3, opacity), "s1.bsdf.opacity.value", 256)
    assert np.all(forward.mean(axis=0) < 0.5 * expected)
    assert_mean(forward, expected, "forward", 1e-3)
    assert_mean(reverse[:, None], np.array([expected.sum()]), "reverse", 1e-3)


@pytest.mark.slow
def test_derivative_by_what_an_opacity_of_zero_hides():
    """Nothing of a transparent mirror is seen; its opacity brings it in."""
    mirror = {"type": "conductor", "material": "none"}
    front = light(2.0, 2.0 * GLOW)
    front["to_world"] = T.translate([0, 0, 2]) @ T.rotate([1, 0, 0], 180) @ T.scale(50)
    scene = load(
        sensor=camera([0, 0, 1], [0, 0, 0], size=2),
        sheet=sheet(0.0, masked(0.0, mirror)),
        above=front,
        below=light(-1.0, GLOW),
    )
    forward, _reverse = derivative(scene, "sheet.bsdf.opacity.value", 256, depth=3)
    assert_mean(forward, GLOW, "mirror less what is behind", 1e-3)


@pytest.mark.slow
def test_derivative_by_texels_of_an_opacity():
    """Texels of 0, of 1, and between: each has minus the light of its share of the view."""
    values = np.array([[[0.0], [1.0]], [[0.5], [0.25]]], np.float32)
    opacity = {"type": "bitmap", "bitmap": values, "filter_type": "nearest", "raw": True}
    view = camera([0, 0, 1], [0, 0, 0], 30.0, 2)
    scene = load(sensor=view, s0=sheet(0.0, masked(opacity), 4.0), light=light(-1.0, GLOW))
    params = psdr.traverse(scene)
    name = "s0.bsdf.opacity.data"
    params.requires_grad_only(name)
    found = []
    for i in range(16):
        params.zero_grad()
        ones = np.ones((2, 2, 3), np.float32)
        psdr.render_backward(scene, params, ones, integrator=psdr.PathIntegrator(max_depth=3), spp=256, seed=i)
        found.append(params[name].grad.numpy().reshape(-1).copy())
    assert_mean(np.array(found), np.full(4, -GLOW.sum()), "texels", 1e-3)


@pytest.mark.slow
def test_a_mask_around_two_sides():
    """As in Mitsuba, whose ``path`` finds nothing of what shadow rays do here, and has the same mean."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    red, blue = ({"type": "diffuse", "reflectance": rgb(*c)} for c in ((0.8, 0.2, 0.1), (0.1, 0.3, 0.9)))
    leaf = {"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "front": red, "back": blue}}
    lamp = T.translate([0, 0, 2]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.6)

    def scene(transform):
        film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}}
        pose = transform.look_at([0.0, -3.0, 1.5], [0.0, 0.0, 0.5], [0, 0, 1])
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 6},
            "sensor": {"type": "perspective", "fov": 40.0, "to_world": pose, "film": film},
            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 0.6}},
            "leaf": {
                "type": "rectangle",
                "to_world": transform.translate([0, 0, 0.8]) @ transform.rotate([1, 0, 0], 20) @ transform.scale(0.6),
                "bsdf": leaf,
            },
            "lamp": {
                "type": "rectangle",
                "to_world": transform(lamp.matrix),
                "emitter": {"type": "area", "radiance": rgb(5.0, 4.0, 3.0)},
            },
            "sky": {"type": "constant", "radiance": 0.2},
        }

    ours = batches(psdr.load_dict(scene(psdr.Transform)), spp=64)
    theirs = mi.load_dict(scene(mi.ScalarTransform4f))
    images = np.stack([np.array(mi.render(theirs, spp=64, seed=i)) for i in range(len(ours))]).astype(np.float64)
    assert_same_mean(blocks(ours, 4), blocks(images, 4), "leaf", 1e-3)


def test_a_colour_of_opacity_is_its_luminance():
    with pytest.warns(psdr.SceneWarning, match="luminance"):
        scene = stacked(rgb(1.0, 0.5, 0.0))
    np.testing.assert_allclose(psdr.traverse(scene)["s0.bsdf.opacity.value"].numpy(), 0.2126 + 0.3576, atol=1e-4)

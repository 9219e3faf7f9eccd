"""Light that passes surfaces without being turned: nothing, and thin glass, against formulas."""

import sys

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import ROUNDING, assert_mean, assert_same_mean, batches, blocks

T = psdr.Transform
NOTHING = {"type": "null"}


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def camera(origin, target, fov=1.0, size=4):
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": fov, "to_world": T.look_at(origin, target, [0, 1, 0]), "film": film}


def sheet(z, bsdf, half=50.0):
    """A square that faces +z."""
    return {"type": "rectangle", "to_world": T.translate([0, 0, z]) @ T.scale(half), "bsdf": bsdf}


def light(z, radiance, half=50.0):
    return {
        **sheet(z, {"type": "diffuse", "reflectance": 0.0}, half),
        "emitter": {"type": "area", "radiance": rgb(*radiance)},
    }


def load(**parts):
    return psdr.load_dict({"type": "scene", **parts})


def fresnel(cosine, eta):
    """Reflectance of an interface, unpolarised."""
    behind = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    s = (cosine - eta * behind) / (cosine + eta * behind)
    p = (eta * cosine - behind) / (eta * cosine + behind)
    return 0.5 * (s**2 + p**2)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "tilt"), [(1, 0.0), (3, 0.0), (2, 60.0)])
def test_a_stack_of_plates(count, tilt):
    """N plates of reflectance r and transmittance 1 - r let (1 - r) / (1 + (N - 1) r) pass."""
    glass = {"type": "thindielectric", "int_ior": 1.8, "ext_ior": 1.0}
    plates = {f"plate_{i}": sheet(0.2 * i, glass) for i in range(count)}
    origin = [np.tan(np.radians(tilt)), 0.0, 1.0]
    scene = load(sensor=camera(origin, [0.0, 0.0, 0.0]), light=light(-1.0, (1.0, 2.0, 3.0)), **plates)
    r = fresnel(np.cos(np.radians(tilt)), 1.8)
    r = 2.0 * r / (1.0 + r)
    images = batches(scene, spp=64, max_depth=-1)
    assert_mean(images.reshape(-1, 3), np.array([1.0, 2.0, 3.0]) * (1.0 - r) / (1.0 + (count - 1) * r), "stack", 1e-3)


@pytest.mark.slow
def test_each_crossing_is_tinted_and_counts_as_a_vertex():
    tinted = {"type": "thindielectric", "int_ior": 1.3, "ext_ior": 1.3, "specular_transmittance": rgb(0.5, 0.7, 1.0)}
    sheets = {"a": sheet(0.5, tinted), "b": sheet(0.0, NOTHING), "c": sheet(-0.5, tinted)}
    scene = load(sensor=camera([0, 0, 1], [0, 0, 0]), light=light(-1.0, (1.0, 1.0, 1.0)), **sheets)
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=4), spp=1).numpy()
    np.testing.assert_allclose(image, np.broadcast_to([0.25, 0.49, 1.0], image.shape), rtol=1e-6)
    assert not psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=3), spp=1).numpy().any()


@pytest.mark.parametrize("depth", [4, 3])
def test_a_point_light_shines_through_tinted_sheets(depth):
    """Each tints it; with one vertex less than there are crossings, floor and light, it is dark."""
    tints = [(0.5, 0.7, 1.0), (0.8, 0.0, 0.25)]
    plain = {"type": "thindielectric", "int_ior": 1.3, "ext_ior": 1.3}
    # Beside the line of sight.
    above = [
        {
            **sheet(0.0, {**plain, "specular_transmittance": rgb(*tint)}),
            "to_world": T.translate([3, 0, z]) @ T.scale(2.0),
        }
        for z, tint in enumerate(tints, 1)
    ]
    scene = load(
        sensor=camera([0, 0, 5], [0, 0, 0]),
        floor=sheet(0.0, {"type": "diffuse", "reflectance": 0.6}),
        first=above[0],
        second=above[1],
        lamp={"type": "point", "position": [4.0, 0.0, 3.0], "intensity": rgb(10.0, 20.0, 30.0)},
    )
    image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=depth), spp=4).numpy()
    radiance = np.array([10.0, 20.0, 30.0]) * np.prod(tints, axis=0) / 25.0 * 0.6 * 0.6 / np.pi
    np.testing.assert_allclose(image.mean(axis=(0, 1)), radiance * (depth == 4), rtol=ROUNDING)


def under_a_plate(half):
    """A floor under a plate of tinted glass, below a lamp."""
    glass = {"type": "thindielectric", "specular_transmittance": rgb(0.5, 0.7, 0.9)}
    lamp = T.translate([0, 0, 2]) @ T.rotate([1, 0, 0], 180) @ T.scale(half)
    return load(
        sensor=camera([0.0, -3.0, 0.5], [0.0, 0.0, 0.0], 20.0, 12),
        floor=sheet(0.0, {"type": "diffuse", "reflectance": 0.6}),
        plate=sheet(1.0, glass, 1.0),
        lamp={**light(0.0, (5.0, 4.0, 3.0)), "to_world": lamp},
    )


@pytest.mark.slow
@pytest.mark.parametrize("half", [0.2, 1.5])
def test_shadow_rays_through_a_plate_keep_the_mean(half, monkeypatch):
    """Beside paths that cross the plate by its null lobe alone, which find little of a small lamp."""
    scene = under_a_plate(half=half)
    by_both = blocks(batches(scene, spp=64, max_depth=4), 6)
    monkeypatch.setattr(sys.modules["warp_psdr.plan.plan"], "has_null_lobes", lambda keys: False)
    by_paths = blocks(batches(scene, spp=64, max_depth=4, seed=100), 6)
    assert_same_mean(by_both, by_paths, "two techniques", 1e-3)
    assert by_both.var(axis=0).mean() < (0.1 if half < 1.0 else 0.9) * by_paths.var(axis=0).mean()


@pytest.mark.slow
@pytest.mark.parametrize("count", [32, 33])
def test_light_behind_too_many_surfaces_is_dark_and_counted(count):
    sheets = {
        f"sheet_{i}": {**sheet(0.0, NOTHING), "to_world": T.translate([3, 0, 1.0 + 0.02 * i]) @ T.scale(2.0)}
        for i in range(count)
    }
    scene = load(
        sensor=camera([0, 0, 5], [0, 0, 0]),
        floor=sheet(0.0, {"type": "diffuse"}),
        lamp={"type": "point", "position": [4.0, 0.0, 3.0], "intensity": 10.0},
        **sheets,
    )
    if count == 33:
        with pytest.warns(RuntimeWarning, match="dropped"):
            image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=-1), spp=1).numpy()
    else:
        image = psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=-1), spp=1).numpy()
    assert image.any() == (count == 32)
    assert psdr.invalid_samples(scene)["image"] == (0 if count == 32 else image.shape[0] * image.shape[1])


def room(**more):
    """A box on a floor under a lamp and a sky."""
    above = T.translate([1, 0, 2]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.4)
    return load(
        sensor=camera([0.0, -3.0, 2.0], [0.0, 0.0, 0.3], 45.0, 24),
        floor=sheet(0.0, {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)}, 2.0),
        box={"type": "cube", "to_world": T.translate([0, 0, 0.4]) @ T.scale(0.4), "bsdf": {"type": "diffuse"}},
        lamp={**light(0.0, (5.0, 4.0, 3.0)), "to_world": above},
        sky={"type": "constant", "radiance": 0.3},
        **more,
    )


@pytest.mark.slow
def test_nothing_changes_nothing():
    shell = {"type": "cube", "to_world": T.translate([0, 0, 0.8]) @ T.scale(0.9), "bsdf": NOTHING}
    # Deep enough that no path is cut short by what it crosses.
    inside = batches(room(shell=shell), max_depth=9)
    direct = batches(room(), max_depth=9)
    assert_same_mean(blocks(inside, 6), blocks(direct, 6), "a shell of nothing", 1e-2)


@pytest.mark.slow
def test_a_scene_of_nothing_alone():
    sky = {"type": "constant", "radiance": 0.7}
    scene = load(sensor=camera([0, 0, 1], [0, 0, 0]), sheet=sheet(0.0, NOTHING), sky=sky)
    np.testing.assert_allclose(psdr.render(scene, spp=4).numpy(), 0.7, rtol=ROUNDING)


def test_nothing_has_two_sides_already():
    with pytest.raises(ValueError, match="reflects only"):
        load(sheet=sheet(0.0, {"type": "twosided", "bsdf": NOTHING}))

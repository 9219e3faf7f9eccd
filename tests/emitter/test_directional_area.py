"""Directional area lights: closed forms, Mitsuba's image from the lights, derivatives, and what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.emitter.helpers import random_map
from tests.peer import for_mitsuba

T = psdr.Transform
RADIANCE = np.array([8.0, 6.0, 4.0])
#: Faces down, 1 wide, above the middle of the floor.
ABOVE = T.translate([0.0, 0.0, 1.5]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.5)


def scene_of(shape="rectangle", to_world=ABOVE, size=16, emitter=(), **objects):
    light = {"type": "directionalarea", "radiance": {"type": "rgb", "value": RADIANCE.tolist()}, **dict(emitter)}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "camera": {
            "type": "perspective",
            "fov": 40.0,
            "to_world": T.look_at([0.0, -3.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": T.scale(3.0), "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "lamp": {"type": shape, "to_world": to_world, "emitter": light},
        **objects,
    }


@pytest.mark.parametrize("tilt", [0.0, 30.0])
def test_irradiance_is_the_radiance_wherever_the_light_falls(tilt):
    """Rho L cos / pi on the floor below the shape, at any distance, and nothing beside it; a card hides it."""
    to_world = T.rotate([0.0, 1.0, 0.0], tilt) @ ABOVE
    card = {"type": "rectangle", "to_world": T.translate([0.0, 0.8, 0.5]) @ T.scale(0.6)}
    found = psdr.render(psdr.load_dict(scene_of(to_world=to_world, card=card)), spp=64).numpy()
    lit = 0.5 * RADIANCE * np.cos(np.radians(tilt)) / np.pi
    share = found / lit
    assert np.abs(share - share[..., :1]).max() < 1e-4
    assert share.max() == pytest.approx(1.0, rel=1e-5) and (np.abs(share[..., 0] - 1.0) < 1e-4).sum() > 3
    np.testing.assert_array_equal(found[0], 0.0)
    assert (share[..., 0] == 0.0).sum() > 100


@pytest.mark.slow
@pytest.mark.slow_rows("rectangle")
@pytest.mark.parametrize("shape", ["rectangle", "disk"])
def test_the_lit_area_is_that_of_the_shape(shape):
    """Seen from straight above by an orthographic camera, the mean tells the area."""
    described = scene_of(shape, T.translate([0.0, 0.0, 1.5]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.5))
    below = T.look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    described["camera"] = {**described["camera"], "type": "orthographic", "to_world": below}
    described["camera"].pop("fov")
    found = psdr.render(psdr.load_dict(described), spp=256).numpy().mean(axis=(0, 1))
    area = 1.0 if shape == "rectangle" else 0.25 * np.pi
    # The film is 2 wide; 1 %: the tessellation of the disk and the noise.
    np.testing.assert_allclose(found, 0.5 * RADIANCE / np.pi * area / 4.0, rtol=1e-2)


@pytest.mark.slow
def test_image_equals_the_one_that_mitsuba_traces_from_the_lights():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    described = scene_of(size=8, to_world=T.rotate([0.0, 1.0, 0.0], 20.0) @ ABOVE)
    integrator = mi.load_dict({"type": "ptracer", "max_depth": 2})
    theirs = mi.load_dict(for_mitsuba(mi, described))
    images = np.array([np.array(mi.render(theirs, integrator=integrator, spp=512, seed=i)) for i in range(8)])
    ours = psdr.render(psdr.load_dict(described), spp=1024).numpy()
    error = images.std(axis=0, ddof=1) / np.sqrt(8)
    # Samples from the lights are splatted; 1 %: what the two filters make of the outline in one pixel.
    assert (np.abs(images.mean(axis=0) - ours) < 5.4 * error + 1e-2 * ours.max()).all()
    np.testing.assert_allclose(images.mean(), ours.mean(), rtol=2e-2)


@pytest.mark.slow
def test_the_derivative_by_the_radiance_is_exact_in_both_modes():
    scene = psdr.load_dict(scene_of(size=8))
    params = psdr.traverse(scene)
    name = "lamp.emitter.radiance.value"
    params.requires_grad(name)
    options = {"spp": 4096, "seed": 3}
    direction = np.array([1.0, -2.0, 0.5], np.float32)
    forward = psdr.render_forward(scene, params, {name: direction}, **options).numpy().astype(np.float64)
    lit = forward[..., 0] > 0.0
    assert lit.sum() > 4
    np.testing.assert_allclose(
        forward[lit] / direction, np.broadcast_to(forward[lit][:, :1], (lit.sum(), 3)), rtol=1e-4
    )
    adjoint = np.random.default_rng(2).normal(size=(8, 8, 3)).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, **options)
    reverse = (params[name].grad.numpy().astype(np.float64) * direction).sum()
    assert reverse == pytest.approx((forward * adjoint).sum(), rel=1e-4)
    params[name] = RADIANCE + 1.0
    params.update()
    ahead = psdr.render(scene, **options).numpy()
    params[name] = RADIANCE - 1.0
    params.update()
    slope = (ahead - psdr.render(scene, **options).numpy()).sum() / (2.0 * (forward / direction).sum())
    assert slope == pytest.approx(1.0, abs=0.02)


def test_what_moves_its_edge_is_refused_by_name():
    scene = psdr.load_dict(scene_of(size=4))
    with pytest.raises(ValueError, match=r"lamp\.to_world moves the shape of the directional area light"):
        psdr.plan(scene, names=["lamp.to_world"], integrator=psdr.PathIntegrator(boundary=None))
    for name in ("floor.to_world", "camera.to_world"):
        with pytest.raises(ValueError, match="light of a directionalarea ends in a hard edge"):
            psdr.plan(scene, names=[name])


@pytest.mark.parametrize(
    ("shape", "emitter", "words"),
    [
        ("sphere", {}, "not flat.*orthogonal projection.*a rectangle or a disk|triangles.*orthogonal projection"),
        ("cube", {}, "not flat.*a rectangle or a disk"),
        ("rectangle", {"radiance": {"type": "bitmap", "bitmap": random_map()}}, "a texture.*one radiance"),
        ("rectangle", {"irradiance": 1.0}, "no parameter 'irradiance'"),
    ],
)
def test_bad_input_is_refused_with_a_remedy(shape, emitter, words):
    with pytest.raises(ValueError, match=words) as caught:
        psdr.load_dict(scene_of(shape, size=4, emitter=emitter))
    assert "problems" not in str(caught.value)


def test_one_that_no_shape_refers_to_is_noted() -> None:
    with pytest.warns(psdr.SceneWarning, match="no shape refers to this emitter, so it does not shine"):
        psdr.load_dict(scene_of(size=4) | {"spare": {"type": "directionalarea"}})

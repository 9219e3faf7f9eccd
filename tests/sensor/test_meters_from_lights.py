"""Light paths that are joined to an irradiance meter: closed forms, the path tracer's numbers, derivatives."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.helpers import assert_same_mean, batches
from tests.sensor.test_meters import FILM, T, scene_of

LIGHTS, BOTH = psdr.interior.LightTracing(), psdr.interior.Bidirectional()
CONNECTED = psdr.interior.Bidirectional(connections="all")
METHODS = pytest.mark.parametrize(
    "method",
    [LIGHTS, BOTH, pytest.param(CONNECTED, marks=pytest.mark.slow)],
    ids=["light tracing", "bidirectional", "connected"],
)
FLOOR, LAMP = "floor.bsdf.reflectance.data", "lamp.emitter.radiance.value"


@pytest.mark.slow_rows("light tracing", "bidirectional")
@METHODS
def test_one_reflection_is_what_a_quadrature_says(method):
    """A point light below a small meter, both above a floor.

    With a and h their heights a floor element at the distance s from below them has the irradiance I a / r_a^3, and
    sends rho / pi of it, h^2 / r_h^4 of which counts.
    """
    h, a, reflectance, intensity = 2.0, 1.5, 0.6, 3.0
    card = T.translate([0.0, 0.0, h]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(0.01)
    scene = psdr.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": T.scale(60.0),
                "bsdf": {"type": "diffuse", "reflectance": reflectance},
            },
            "light": {"type": "point", "position": [0.0, 0.0, a], "intensity": intensity},
            "card": {"type": "rectangle", "to_world": card, "sensor": {"type": "irradiancemeter", "film": FILM}},
        }
    )
    found = batches(scene, count=8, spp=1 << 14, max_depth=3, interior=method)
    s = np.linspace(0.0, 60.0, 600_001)
    per_distance = s / ((a * a + s * s) ** 1.5 * (h * h + s * s) ** 2)
    expected = 2.0 * reflectance * intensity * a * h * h * np.trapezoid(per_distance, s)
    mean, error = found.mean(), found.mean(axis=(1, 2, 3)).std(ddof=1) / np.sqrt(len(found))
    assert error < 0.005 * expected
    assert abs(mean - expected) < 4.0 * error + 1e-3 * expected


@pytest.mark.slow
@METHODS
def test_a_square_lamp_above_a_small_meter_has_a_closed_form(method):
    """With a the half side, c the height and r^2 = a^2 + c^2 the irradiance is L times 4 a / r atan(a / r)."""
    a, c, radiance = 0.5, 1.2, 3.0
    above = T.translate([0.0, 0.0, c]) @ T.rotate([1.0, 0.0, 0.0], 180.0) @ T.scale(a)
    black = {"type": "diffuse", "reflectance": 0.0}
    scene = psdr.load_dict(
        {
            "type": "scene",
            "lamp": {
                "type": "rectangle",
                "to_world": above,
                "bsdf": black,
                "emitter": {"type": "area", "radiance": radiance},
            },
            "meter": {
                "type": "rectangle",
                "to_world": T.scale(0.01),
                "bsdf": black,
                "sensor": {"type": "irradiancemeter", "film": FILM},
            },
        }
    )
    found = batches(scene, count=8, spp=1 << 14, max_depth=3, interior=method)
    r = np.hypot(a, c)
    np.testing.assert_allclose(found.mean(axis=0), radiance * 4.0 * a / r * np.arctan(a / r), rtol=2e-3)


@pytest.mark.slow
@METHODS
def test_numbers_and_derivatives_are_those_of_paths_from_the_meter(method):
    scene = psdr.load_dict(scene_of("irradiance"))
    params = psdr.traverse(scene)
    both = [psdr.PathIntegrator(max_depth=3, interior=m) for m in (method, psdr.interior.Replay())]
    images = [batches(scene, count=8, spp=1 << 13, max_depth=3, interior=integrator.interior) for integrator in both]
    assert_same_mean(*images, "a meter")
    params.requires_grad_only(FLOOR, LAMP)
    found = []
    for integrator in both:
        sums = []
        for seed in range(8):
            params.zero_grad()
            psdr.render_backward(
                scene, params, np.ones((1, 1, 3), np.float32), integrator=integrator, spp=1 << 13, seed=seed
            )
            sums.append([params[n].grad.numpy().astype(np.float64).sum() for n in (FLOOR, LAMP)])
        found.append(np.array(sums))
    for ours, theirs in zip(found[0].T, found[1].T, strict=True):
        error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / len(ours))
        assert 0.0 < error < 0.01 * theirs.mean()
        assert abs(ours.mean() - theirs.mean()) < 4.0 * error
    tangent = {FLOOR: np.ones(params[FLOOR].shape, np.float32), LAMP: np.zeros(3, np.float32)}
    image = psdr.render_forward(scene, params, tangent, integrator=both[0], spp=1 << 13, seed=0).numpy()
    assert image.sum() == pytest.approx(found[0][0, 0], rel=1e-4)

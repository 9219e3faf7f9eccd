"""Derivatives of media against formulas, at zero density and zero albedo as well; what is refused."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media import scenes
from tests.media.scenes import BLACK, camera, cube, medium, point, sky, square, whole
from tests.path.helpers import assert_mean

#: Absorbs the width of the camera, relative.
WIDTH = 1e-3
FOG, SLAB = "sensor.medium.", "slab.interior_medium."
BATCHES = 8
REPLAY, TEXTBOOK = psdr.interior.Replay(), psdr.interior.Textbook()
#: sigma_t, sigma_s, D, gamma, g; L and its derivatives by sigma_s, by sigma_t at fixed sigma_s, and by g
#: (``docs/theory/media.md#closed-forms``).
AIRLIGHT = [
    (0.5, 0.4, 2.0, 30.0, 0.0, 0.01647667, 0.04119168, -0.04570147, 0.00817961),
    (1.0, 1.0, 1.0, 90.0, 0.0, 0.01538272, 0.01538272, -0.02404012, -0.01570437),
    (0.5, 0.4, 2.0, 30.0, 0.6, 0.01568030, 0.03920075, -0.03625042, -0.02219025),
]


def derivatives(scene, params, names, *, spp, depth, weight=1.0, method=REPLAY):
    """Return derivatives of the mean of the image, times a weight, by the names: (BATCHES, len(names)), summed."""
    params.requires_grad_only(*names)
    camera_record = scene.camera(0)
    size = (camera_record.crop_height, camera_record.crop_width, 3)
    adjoint = np.full(size, weight / np.prod(size), np.float32)
    found = []
    for seed in range(BATCHES):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=depth, interior=method)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=seed)
        found.append([params[name].grad.numpy().astype(np.float64).sum() for name in names])
    return np.array(found)


@pytest.fixture(scope="module")
def airlight():
    scene = psdr.load_dict(
        whole(
            sensor=camera([0, 0, 0], [0, 0, 1], 0.05, up=(0, 1, 0), near_clip=1e-5, medium=medium(1.0, 1.0, 0.0)),
            behind=square(-4.0, 0.5, BLACK),
            light=point([0.0, 0.0, 1.0]),
        )
    )
    return scene, psdr.traverse(scene)


def place(airlight, sigma_t, albedo, distance, angle, g):
    scene, params = airlight
    gamma = np.radians(angle)
    params["light.position"] = distance * np.array([np.sin(gamma), 0.0, np.cos(gamma)])
    params[FOG + "sigma_t.value.value"] = sigma_t
    params[FOG + "albedo.value.value"] = albedo
    params[FOG + "phase_function.g"] = g
    params.update()
    return scene, params


NAMES = [FOG + name for name in ("sigma_t.value.value", "scale", "albedo.value.value", "phase_function.g")]
NAMES += ["light.intensity.value"]


@pytest.mark.parametrize("case", AIRLIGHT, ids=str)
def test_light_scattered_once(airlight, case):
    sigma, sigma_s, distance, angle, g, value, by_sigma_s, by_sigma_t, by_g = case
    albedo = sigma_s / sigma
    scene, params = place(airlight, sigma, albedo, distance, angle, g)
    by_density = by_sigma_t + albedo * by_sigma_s
    expected = [by_density, sigma * by_density, sigma * by_sigma_s, by_g, value]
    assert_mean(derivatives(scene, params, NAMES, spp=4096, depth=2), np.array(expected), str(case), WIDTH)


def test_density_and_albedo_of_zero(airlight):
    """By density a (pi - gamma) / (4 pi D sin(gamma)) where there is none; by an albedo of zero sigma dL/dsigma_s."""
    scene, params = place(airlight, 0.0, 0.8, 2.0, 30.0, 0.0)
    found = derivatives(scene, params, NAMES, spp=16384, depth=2)
    assert_mean(found, np.array([0.16666667, 0.0, 0.0, 0.0, 0.0]), "no density", WIDTH)
    scene, params = place(airlight, 0.5, 0.0, 2.0, 30.0, 0.0)
    found = derivatives(scene, params, NAMES, spp=4096, depth=2)
    assert_mean(found, np.array([0.0, 0.0, 0.5 * 0.04119168, 0.0, 0.0]), "no albedo", WIDTH)


@pytest.mark.slow
def test_textbook_replay_loses_zeros(airlight):
    """It has the derivatives of what scatters, and of empty space, or at an albedo of 0, none of in-scattering."""
    sigma, sigma_s, distance, angle, g, _value, by_sigma_s, by_sigma_t, by_g = AIRLIGHT[2]
    scene, params = place(airlight, sigma, sigma_s / sigma, distance, angle, g)
    names, by_density = NAMES[:4], by_sigma_t + sigma_s / sigma * by_sigma_s
    expected = np.array([by_density, sigma * by_density, sigma * by_sigma_s, by_g])
    found = derivatives(scene, params, names, spp=4096, depth=2, method=TEXTBOOK)
    assert_mean(found, expected, "textbook replay", WIDTH)
    scene, params = place(airlight, 0.0, 0.8, 2.0, 30.0, 0.0)
    assert not derivatives(scene, params, names[:1], spp=64, depth=2, method=TEXTBOOK).any()
    with pytest.raises(ValueError, match=r"interior\.Textbook\(\) meets the vertices in the order of the path"):
        derivatives(scene, params, ["light.position"], spp=1, depth=2, method=TEXTBOOK)


@pytest.mark.slow
def test_textbook_replay_estimates_what_replay_does():
    """All steps of paths of smoke, glass of a rough surface, three lights; both modes."""
    scene = psdr.load_dict(scenes.smoke())
    params = psdr.traverse(scene)
    medium = "cube.interior_medium."
    params[medium + "sigma_t.data"] = params[medium + "sigma_t.data"].numpy() + 0.05
    params.update()
    names = [medium + "scale", medium + "albedo.value.value", "floor.bsdf.reflectance.value", "sky.radiance.value"]
    one, two = (derivatives(scene, params, names, spp=16, depth=5, method=m) for m in (REPLAY, TEXTBOOK))
    assert_mean(one - two, 0.0, "textbook replay", WIDTH)
    assert (np.abs(one.mean(axis=0)) > 3.0 * one.std(axis=0)).all()
    tangents = {name: np.ones(params[name].shape, np.float32) for name in names}
    integrator = psdr.PathIntegrator(max_depth=5, interior=TEXTBOOK)
    params.requires_grad_only(*names)
    dimage = psdr.render_forward(scene, params, tangents=tangents, integrator=integrator, spp=16, seed=0).numpy()
    np.testing.assert_allclose(dimage.mean(dtype=np.float64), two[0].sum(), rtol=1e-4)


@pytest.fixture(scope="module")
def slab():
    """A cube before a sky, seen along its axis."""
    parts = {
        "sensor": camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)),
        "slab": cube(medium((0.5, 0.5, 0.5), 1.0)),
        "sky": sky(1.0, 1.0, 1.0),
    }
    scene = psdr.load_dict(whole(**parts))
    return scene, psdr.traverse(scene)


@pytest.mark.slow  # as fast, test_emission.py has a slab before a sky
@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.5, 1.0, 1e4])
def test_transmittance(slab, sigma):
    """-l exp(-sigma l) by the density of what absorbs all; at depth 1 without noise."""
    scene, params = slab
    names = [SLAB + "sigma_t.value.value", "sky.radiance.value"]
    params[names[0]] = sigma
    params[SLAB + "albedo.value.value"] = 0.0
    params.update()
    expected = np.exp(-2.0 * sigma) * np.array([-2.0, 1.0])
    found = derivatives(scene, params, names, spp=16, depth=1)
    np.testing.assert_allclose(found.mean(axis=0), expected, rtol=1e-3, atol=1e-30)
    if sigma <= 1.0:
        assert_mean(derivatives(scene, params, names, spp=1024, depth=-1), expected, f"sigma {sigma}", WIDTH)
    assert psdr.invalid_samples(scene)["interior"] == 0


def test_a_furnace_by_density(slab):
    """Nothing absorbs: the image does not depend on the density, nor does it where there is none."""
    scene, params = slab
    params[SLAB + "albedo.value.value"] = 1.0
    for sigma in (0.0, 1.0):
        params[SLAB + "sigma_t.value.value"] = sigma
        params.update()
        found = derivatives(scene, params, [SLAB + "sigma_t.value.value", "sky.radiance.value"], spp=1024, depth=-1)
        assert_mean(found, np.array([0.0, 1.0]), f"sigma {sigma}", WIDTH)
        assert found.std() > 0.0


@pytest.mark.slow
def test_a_furnace_by_albedo():
    """sigma 4 V / S = 2.6667 at albedo 1, averaged over the rays that enter a ball of density 2, whatever the phase.

    Parallel rays do: those through the ball's disk, a share pi / 4 of a film that it fills.
    """
    parts = {
        "sensor": {
            "type": "orthographic",
            "to_world": psdr.Transform.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
        "slab": {"type": "sphere", "bsdf": {"type": "null"}, "interior": medium(2.0, 1.0, 0.7), "resolution": 64},
        "sky": sky(1.0, 1.0, 1.0),
    }
    scene = psdr.load_dict(whole(**parts))
    params = psdr.traverse(scene)
    found = derivatives(scene, params, [SLAB + "albedo.value.value"], spp=512, depth=-1, weight=4.0 / np.pi)
    assert_mean(found, 2.6667, "albedo", 5e-3)


TABLE = np.array([0.0, 0.4, 0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def tabulated():
    """A cube beside a lamp, under a sky, whose directions are drawn by a table; light scattered once."""
    parts = {
        "sensor": camera([0, 0, 5], [0, 0, 0], up=(0, 1, 0)),
        "slab": cube({**medium(0.7, 0.9), "phase": {"type": "tabphase", "values": TABLE}}),
        "lamp": square(3.0, 1.0, BLACK, flipped=True, emitter={"type": "area", "radiance": 5.0})
        | {"to_world": psdr.Transform.translate([4, 0, 0]) @ psdr.Transform.rotate([0, 1, 0], -90.0)},
        "sky": sky(0.2, 0.2, 0.2),
    }
    scene = psdr.load_dict(whole(**parts))
    return scene, psdr.traverse(scene)


@pytest.mark.slow
def test_a_table_that_holds_zeros(tabulated):
    """L is linear in f_p, so with the tents' integrals c and I = c . v: dL/dv_j = c_j (L of the tent j - L) / I."""
    scene, params = tabulated
    name = SLAB + "phase_function.values"

    def image_of(values):
        params[name] = values
        params.update()
        return [
            psdr.render(scene, params, integrator=psdr.PathIntegrator(max_depth=2), spp=512, seed=50 + i).numpy().mean()
            for i in range(BATCHES)
        ]

    tents = np.array([image_of(row) for row in np.eye(5)]).T
    now = np.array(image_of(TABLE))[:, None]
    params.requires_grad_only(name)
    adjoint, found = np.full((4, 4, 3), 1.0 / 48.0, np.float32), []
    for seed in range(BATCHES):
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=2)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=1024, seed=seed)
        found.append(params[name].grad.numpy().astype(np.float64))
    c = np.array([0.25, 0.5, 0.5, 0.5, 0.25])
    expected = c * (tents - now) / (c @ TABLE)
    assert (np.abs(expected.mean(axis=0)[[0, 2, 4]]) > 1e-3).all()
    assert_mean(np.array(found) - expected, 0.0, "values of a table", WIDTH)


@pytest.mark.parametrize("name", ["floor.vertex_positions", "sensor.to_world", "sensor.x_fov", "bulb.position"])
def test_what_moves_discontinuities_has_a_boundary_term(name):
    parts = scenes.milk()
    parts["bulb"] = point([1.0, 1.0, 2.0])
    scene = psdr.load_dict(parts)
    assert "in media: volume vertices" in str(psdr.plan(scene, names=[name]))
    grey = str(psdr.plan(scene, names=["bulb.intensity.value"]))
    assert "in media: volume vertices" not in grey


def test_other_methods_are_refused():
    scene = psdr.load_dict(scenes.milk())
    params = psdr.traverse(scene)
    params.requires_grad("cube.interior_medium.sigma_t.value.value")
    for method in (psdr.interior.Radiative(), psdr.interior.LightTracing()):
        with pytest.raises(ValueError, match=r"does not know participating media; use interior\.Replay\(\)"):
            psdr.render_backward(scene, params, np.ones((24, 24, 3)), integrator=psdr.PathIntegrator(interior=method))
    with pytest.raises(ValueError, match="does not know participating media"):
        psdr.render(scene, integrator="ptracer", spp=1)

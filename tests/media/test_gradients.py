"""Derivatives in scenes with media against finite differences, both modes; zeros; equal bits; what is refused.

Distances are drawn by the density, so a difference of two densities keeps much of its noise, and its steps are long.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients import measure
from tests.gradients.configs import Case, mixed, ones
from tests.gradients.scenes import SCENES, SIZE, noise
from tests.media import scenes
from tests.media.scenes import T, camera, cube, grid, lamp, medium, point, rgb, sky, square

#: Both modes draw the same numbers: float32 sums of the same terms in another order, relative.
ROUNDING = 2e-5


def milk_scene():
    """A cube of milk under a leaf with holes in it, over a textured floor, the camera in a fog."""
    fog = {**medium((0.05, 0.06, 0.08), (0.9, 0.8, 0.7)), "id": "fog"}
    there = {"type": "ref", "id": "fog"}
    holes = {"type": "bitmap", "bitmap": noise(4, 4, 1, low=0.2, high=0.8, seed=8), "raw": True}
    floor = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": noise(4, 4, 3, seed=4)}}
    return {
        "sensor": camera([4, 3, 2.5], [0, 0, -0.3], 40.0, SIZE, medium=fog),
        "floor": square(-1.5, 5.0, floor),
        "milk": cube(medium(1.5, (0.9, 0.8, 0.7), g=0.4), turn=20.0, exterior=there),
        "leaf": {
            "type": "rectangle",
            "to_world": T.translate([0.3, 0.2, 1.6]) @ T.scale(1.2),
            "bsdf": {"type": "mask", "opacity": holes, "leaf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
        },
        "lamp": lamp(),
        "bulb": point([2.0, -1.5, 2.5], (4.0, 5.0, 6.0)),
    }


def ink_scene():
    """A coloured liquid behind rough glass."""
    ink = medium((0.1, 0.3, 0.6), (0.2, 0.3, 0.4), g=-0.3)
    glass = {"type": "roughdielectric", "alpha": 0.3, "int_ior": 1.3, "specular_transmittance": rgb(0.9, 0.8, 0.7)}
    return {
        "sensor": camera([4, 3, 2.5], [0, 0, -0.3], 30.0, SIZE),
        "floor": square(-1.5, 5.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}),
        "glass": cube(ink, glass, turn=30.0),
        "lamp": lamp(),
        "sky": sky(0.6, 0.7, 0.8),
    }


def haze_scene():
    """A cube of thin haze over a floor, in thinner haze that a larger cube bounds, under a bright sky."""
    thin = {**medium((0.1, 0.2, 0.4), (0.5, 0.6, 0.4)), "id": "air"}
    there = {"type": "ref", "id": "air"}
    return {
        "sensor": camera([4, 3, 2.5], [0, 0, -0.3], 30.0, SIZE),
        "floor": square(-1.5, 5.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}),
        "thin": cube(thin, scale=1.4, turn=10.0),
        "haze": cube(medium(0.4, (0.3, 0.5, 0.4), g=0.4), scale=0.9, turn=30.0, exterior=there),
        "sky": sky(0.8, 0.9, 1.0),
    }


def sunlit_scene():
    """A cube of haze that is seen against the sun, over a floor."""
    return {
        "sensor": camera([3.5, 0.5, 0.2], [0, 0, 0], 25.0, SIZE),
        "floor": square(-1.2, 3.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.2)}),
        "haze": cube(medium(0.5, 0.8, g=0.5), turn=20.0),
        "sun": {"type": "directional", "direction": [0.8, -0.2, -0.5], "irradiance": rgb(1.0, 2.0, 3.0)},
    }


def table_scene():
    """Two cubes over a floor, under a sun and a bulb: light is scattered by a table in one, as in air in the other."""
    table = {"type": "tabphase", "values": [0.6, 0.3, 0.2, 0.5, 2.0]}
    return {
        "sensor": camera([3.5, 0.5, 0.2], [0, 0, 0], 25.0, SIZE),
        "floor": square(-1.2, 3.0, {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.2)}),
        "table": cube({**medium(0.8, 0.8), "phase": table}, scale=0.7, translate=(0, 0.8, 0), turn=20.0),
        "air": cube({**medium(0.6, 0.7), "phase": {"type": "rayleigh"}}, scale=0.7, translate=(0, -0.8, 0)),
        "sun": {"type": "directional", "direction": [0.8, -0.2, -0.5], "irradiance": rgb(1.0, 2.0, 3.0)},
        "bulb": point([2.0, -1.5, 2.5], (4.0, 5.0, 6.0)),
    }


def blend_scene():
    """``table_scene`` with blends: of a lobe and a table, and of air and a lobe that is never drawn."""
    scene = table_scene()
    table, lobe = scene["table"]["interior"]["phase"], {"type": "hg", "g": 0.6}
    scene["table"]["interior"]["phase"] = {"type": "blendphase", "weight": 0.4, "a": lobe, "b": table}
    scene["air"]["interior"]["phase"] = {"type": "blendphase", "weight": 0.0, "a": {"type": "rayleigh"}, "b": lobe}
    return scene


def grid_blend_scene():
    """``blend_scene`` with weights that vary in one cube and are 0 in the other."""
    scene = blend_scene()
    for name, values in (("table", noise(3, 2, 2, low=0.2, high=0.8, seed=9)), ("air", np.zeros((1, 2, 2)))):
        box = scene[name]["to_world"] @ T.translate([-1, -1, -1]) @ T.scale(2.0)
        scene[name]["interior"]["phase"]["weight"] = grid(values, box)
    return scene


SCENES |= {"table": table_scene, "blend": blend_scene, "grid blend": grid_blend_scene}
SCENES |= {"sunlit": sunlit_scene, "milk": milk_scene, "haze": haze_scene, "ink": ink_scene}
MILK, FOG, INK, HAZE, THIN = (
    f"{name}medium." for name in ("milk.interior_", "sensor.", "glass.interior_", "haze.interior_", "thin.interior_")
)
BLEND = "table.interior_medium.phase_function."
#: Requested together, so that cases share kernels. Without density the same paths are drawn as in the differences.
TOGETHER = {
    "sunlit": (HAZE + "*", "floor.bsdf.reflectance.value", "sun.irradiance.value"),
    "milk": (
        *(MILK + "albedo*", MILK + "phase*", FOG + "albedo*", "floor.bsdf.reflectance.*", "leaf.bsdf.opacity.data"),
        *("lamp.emitter.*", "bulb.intensity.value"),
    ),
    "haze": (HAZE + "*", THIN + "*"),
    "table": ("table.interior_medium.phase_function.values", "air.interior_medium.albedo.value.value"),
    "grid blend": (BLEND + "*", "air.interior_medium.phase_function.weight.data"),
    "blend": (BLEND + "*", "air.interior_medium.phase_function.weight.value.value"),
    "ink": (INK + "albedo*", INK + "phase*", "glass.bsdf.specular_transmittance.value", "sky.radiance.value"),
}
CASES = [
    Case("sunlit", HAZE + "albedo.value.value", ones, 0.02, depth=4, spp=256),
    Case("sunlit", HAZE + "phase_function.g", ones, 0.06, depth=4, spp=3072, slow=True),
    Case("sunlit", "floor.bsdf.reflectance.value", mixed, 0.05, depth=4, spp=256),
    Case("sunlit", "sun.irradiance.value", mixed, 0.05, depth=4, spp=256, slow=True),
    Case("milk", MILK + "albedo.value.value", mixed, 0.02, depth=4, spp=64, slow=True),
    Case("milk", FOG + "albedo.value.value", ones, 0.02, depth=4, spp=64, slow=True),
    Case("milk", "floor.bsdf.reflectance.data", mixed, 0.05, depth=4, spp=64, slow=True),
    Case("milk", "floor.bsdf.reflectance.to_uv", mixed, 0.005, depth=4, spp=64, slow=True),
    Case("milk", "leaf.bsdf.opacity.data", ones, 0.1, depth=4, spp=1536, slow=True),
    Case("milk", "lamp.emitter.radiance.value", mixed, 0.1, depth=4, spp=64, slow=True),
    Case("milk", "bulb.intensity.value", mixed, 0.1, depth=4, spp=64, slow=True),
    Case("haze", HAZE + "scale", ones, 0.25, depth=4, spp=2048, slow=True),
    Case("haze", HAZE + "albedo.value.value", ones, 0.02, depth=4, spp=512, slow=True),
    Case("haze", THIN + "sigma_t.value.value", ones, 0.04, depth=4, spp=4096, slow=True),
    Case("table", "table.interior_medium.phase_function.values", mixed, 0.1, depth=2, spp=256, slow=True),
    Case("table", "air.interior_medium.albedo.value.value", ones, 0.05, depth=4, spp=256, slow=True),
    Case("blend", BLEND + "weight.value.value", ones, 0.05, depth=2, spp=256, slow=True),
    Case("grid blend", BLEND + "weight.data", mixed, 0.05, depth=2, spp=256, slow=True),
    Case("grid blend", BLEND + "phase_0.g", ones, 0.02, depth=2, spp=256, slow=True),
    Case("blend", BLEND + "phase_0.g", ones, 0.02, depth=2, spp=256, slow=True),
    Case("blend", BLEND + "phase_1.values", mixed, 0.1, depth=2, spp=256, slow=True),
    Case("ink", INK + "albedo.value.value", ones, 0.02, depth=6, spp=64, slow=True),
    Case("ink", "glass.bsdf.specular_transmittance.value", mixed, 0.02, depth=6, spp=64, slow=True),
    Case("ink", "sky.radiance.value", mixed, 0.1, depth=6, spp=64, slow=True),
]


def requested(case):
    """The parameters of a case's scene that are requested together."""
    _scene, params = measure.load(case.scene)
    params.requires_grad_only(*TOGETHER[case.scene])
    return params.requested


@pytest.mark.slow_rows(
    "sunlit-floor.bsdf.reflectance.value-4-reverse", "sunlit-haze.interior_medium.albedo.value.value-4-reverse"
)
@pytest.mark.parametrize(
    ("case", "mode"),
    [
        pytest.param(case, mode, id=f"{case}-{mode}", marks=[pytest.mark.slow] * (case.slow or mode == "forward"))
        for case in CASES
        for mode in ("reverse", "forward")
    ],
)
def test_derivative_equals_finite_differences(case, mode):
    measure.assert_agrees(measure.compare(case, mode, 8, requested(case)))


@pytest.fixture(scope="module")
def sunlit():
    """The scene, its parameters with requests, and an adjoint."""
    scene = psdr.load_dict(scenes.whole(**sunlit_scene()))
    params = psdr.traverse(scene)
    params.requires_grad(*TOGETHER["sunlit"])
    return scene, params, np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)


def gradient(sunlit, block=8, depth=5, rr_depth=3, spp=16):
    """Return the gradients of all requested parameters, float64."""
    scene, params, w = sunlit
    params.zero_grad()
    integrator = psdr.PathIntegrator(max_depth=depth, rr_depth=rr_depth, interior=psdr.interior.Replay(block=block))
    psdr.render_backward(scene, params, w, integrator=integrator, spp=spp, seed=2)
    return {name: params[name].grad.numpy().astype(np.float64) for name in params.requested}


@pytest.mark.slow
def test_forward_and_reverse_mode_are_adjoint(sunlit):
    scene, params, w = sunlit
    integrator = psdr.PathIntegrator(max_depth=5, rr_depth=3)
    for name, found in gradient(sunlit).items():
        v = np.random.default_rng(len(name)).normal(size=found.shape).astype(np.float32)
        tangents = dict.fromkeys(params.requested, 0.0) | {name: v}
        image = psdr.render_forward(scene, params, tangents, integrator=integrator, spp=16, seed=2).numpy()
        left, right = (image.astype(np.float64) * w).sum(), (found * v).sum()
        bound = ROUNDING * max(np.linalg.norm(image) * np.linalg.norm(w), np.linalg.norm(found) * np.linalg.norm(v))
        assert found.any() and abs(left - right) <= bound, (name, left, right, bound)


@pytest.mark.slow
def test_any_number_of_workers_gives_equal_bits(sunlit):
    first = gradient(sunlit)
    before = psdr.set_workers(1)
    try:
        again = gradient(sunlit)
    finally:
        psdr.set_workers(before)
    for name, found in first.items():
        np.testing.assert_array_equal(found, again[name])


@pytest.mark.slow
def test_blocks_of_a_path_are_replayed(sunlit):
    """Steps kept two at a time, and all of them, give one gradient."""
    whole = gradient(sunlit, block=32, depth=12, rr_depth=100)
    for name, found in gradient(sunlit, block=2, depth=12, rr_depth=100).items():
        np.testing.assert_allclose(found, whole[name], rtol=1e-6)


@pytest.mark.slow
def test_a_grid_of_equal_weights_has_the_derivative_of_one_weight():
    """Sample by sample, at any depth: the voxels have the shares of it."""
    found = []
    for name in ("weight.value.value", "weight.data"):
        scene = blend_scene() if name.endswith("value") else grid_blend_scene()
        if name.endswith("data"):
            box = scene["table"]["to_world"] @ T.translate([-1, -1, -1]) @ T.scale(2.0)
            scene["table"]["interior"]["phase"]["weight"] = grid(np.full((3, 2, 2), 0.4), box)
        loaded = psdr.load_dict(scenes.whole(**scene))
        params = psdr.traverse(loaded)
        params.requires_grad_only(BLEND + name)
        adjoint = np.ones((SIZE, SIZE, 3), np.float32)
        psdr.render_backward(loaded, params, adjoint, integrator=measure.integrator(4), spp=16, seed=5)
        found.append(params[BLEND + name].grad.numpy().astype(np.float64))
    assert np.count_nonzero(found[1]) == 12
    assert found[1].sum() == pytest.approx(found[0].item(), rel=1e-4) and abs(found[0].item()) > 0.0

"""Interior derivatives on and around grids of signed distances, and curves, against finite differences."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.test_curves import held as hairy
from tests.path.test_sdfgrid import DIFFUSE, PLAIN, ROUGH, T, blob, nodes, scene

#: Deviation of the slope against finite differences of the same paths.
SLOPE = 0.02
DEPTH, SPP = 4, 64
CASES = [
    ("diffuse", "body.bsdf.reflectance.value"),
    pytest.param("diffuse", "floor.bsdf.reflectance.value", marks=pytest.mark.slow),
    pytest.param("diffuse", "lamp.emitter.radiance.value", marks=pytest.mark.slow),
    pytest.param("diffuse", "sky.radiance.value", marks=pytest.mark.slow),
    pytest.param("rough", "body.bsdf.alpha.value", marks=pytest.mark.slow),
    pytest.param("rough", "body.bsdf.specular_reflectance.value", marks=pytest.mark.slow),
    pytest.param("bsplinecurve", "body.bsdf.reflectance.value", marks=pytest.mark.slow),
    pytest.param("linearcurve", "body.bsdf.reflectance.value", marks=pytest.mark.slow),
]


def held(form: str) -> psdr.Scene:
    if form.endswith("curve"):
        return psdr.load_dict(hairy(form, DIFFUSE))
    rough = {**ROUGH, "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
    normals, bsdf = ("smooth", DIFFUSE) if form == "diffuse" else ("analytic", rough)
    return psdr.load_dict(scene(blob(16), PLAIN, normals, bsdf))


@pytest.mark.slow_rows("diffuse-body.bsdf.reflectance.value")
@pytest.mark.parametrize(("form", "name"), CASES)
def test_slope_against_finite_differences(form: str, name: str) -> None:
    described = held(form)
    params = psdr.traverse(described)
    integrator = psdr.PathIntegrator(max_depth=DEPTH, rr_depth=100)
    value = params[name].numpy().astype(np.float64)
    tangent = np.ones_like(value)
    weights = np.random.default_rng(1).random((32, 32, 3)).astype(np.float32)

    def image(step: float, seed: int) -> float:
        params[name] = value + step * tangent
        params.update()
        found = psdr.render(described, integrator=integrator, spp=SPP, seed=seed).numpy().astype(np.float64)
        params[name] = value
        params.update()
        return float((weights * found).sum())

    # Roughness also steers where samples go, so that its differences are of means, over seeds.
    seeds = range(24 if name.endswith("alpha.value") else 2)
    step = 0.02 if name.endswith("alpha.value") else 0.05
    differences = np.mean([(image(step, seed) - image(-step, seed)) / (2.0 * step) for seed in seeds])
    options = {"integrator": integrator, "spp": SPP}
    forward = np.mean(
        [
            (weights * psdr.render_forward(described, params, {name: tangent}, seed=s, **options).numpy()).sum()
            for s in seeds
        ]
    )
    params.requires_grad(name)
    psdr.render_backward(described, params, weights, seed=0, **options)
    reverse = float(params[name].grad.numpy().sum())
    first = float((weights * psdr.render_forward(described, params, {name: tangent}, seed=0, **options).numpy()).sum())
    assert abs(differences) > 1.0
    assert forward / differences == pytest.approx(1.0, abs=SLOPE)
    assert reverse == pytest.approx(first, rel=2e-4)
    assert not any(psdr.invalid_samples(described).values())


def cave(interpolation: str = "linear") -> psdr.Scene:
    """A camera and a lamp in an ellipsoid of a grid, where everything is seen from everywhere."""
    x, y, z = nodes(16)
    grid = 0.42 - np.sqrt((x - 0.5) ** 2 + (1.1 * (y - 0.5)) ** 2 + (0.95 * (z - 0.5)) ** 2)
    pose = np.eye(4)
    pose[:3, :3] = 2.0 * np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.1], [0.0, 0.1, 1.1]])
    pose[:3, 3] = -0.5 * pose[:3, :3].sum(axis=1)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    view = T.look_at([0.1, -0.5, 0.1], [0.0, 0.3, 0.05], [0, 0, 1])
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 80.0, "near_clip": 0.01, "to_world": view, "film": film},
            "light": {"type": "point", "position": [0.15, 0.1, 0.25], "intensity": 1.0},
            "cave": {
                "type": "sdfgrid",
                "grid": grid.astype(np.float32),
                "interpolation": interpolation,
                "to_world": T(pose),
                "bsdf": DIFFUSE,
            },
        }
    )


def assert_slope(described: psdr.Scene, name: str, tangent: np.ndarray, step: float, spp: int = 256) -> None:
    """Compare both modes with central differences of the same paths, on films of 16^2 at depth 3."""
    params = psdr.traverse(described)
    integrator = psdr.PathIntegrator(max_depth=3, rr_depth=100, boundary=None)
    value = params[name].numpy().astype(np.float64)
    weights = np.random.default_rng(1).random((16, 16, 3)).astype(np.float32)

    def image(step: float, seed: int) -> float:
        params[name] = value + step * tangent
        params.update()
        found = psdr.render(described, integrator=integrator, spp=spp, seed=seed).numpy().astype(np.float64)
        params[name] = value
        params.update()
        return float((weights * found).sum())

    seeds = range(4)
    differences = np.mean([(image(step, seed) - image(-step, seed)) / (2.0 * step) for seed in seeds])
    options = {"integrator": integrator, "spp": spp}
    images = [psdr.render_forward(described, params, {name: tangent}, seed=s, **options).numpy() for s in seeds]
    forward = [float((weights * image).sum()) for image in images]
    params.requires_grad(name)
    psdr.render_backward(described, params, weights, seed=0, **options)
    reverse = float((params[name].grad.numpy() * tangent).sum())
    assert abs(differences) > 1.0
    assert np.mean(forward) / differences == pytest.approx(1.0, abs=SLOPE)
    assert reverse == pytest.approx(forward[0], rel=2e-4)
    assert not any(psdr.invalid_samples(described).values())


def entry(*place: int) -> np.ndarray:
    e = np.zeros((4, 4))
    e[place] = 1.0
    return e


def lumps(count: int) -> np.ndarray:
    x, _y, z = nodes(count)
    return (np.sin(4.0 * x) * np.cos(3.0 * z))[..., None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tangent", "step"),
    [
        pytest.param("cave.grid", lumps(16), 0.003, marks=pytest.mark.slow),
        pytest.param("cave.grid", np.ones((16, 16, 16, 1)), 0.003, marks=pytest.mark.slow),
        pytest.param("cave.to_world", entry(2, 2), 0.005, marks=pytest.mark.slow),
        pytest.param("light.position", np.array([1.0, 0.0, 0.0]), 0.005, marks=pytest.mark.slow),
        pytest.param("sensor.to_world", entry(2, 3), 0.005, marks=pytest.mark.slow),
    ],
)
def test_slope_of_what_moves_where_all_is_seen(name: str, tangent: np.ndarray, step: float) -> None:
    assert_slope(cave(), name, tangent, step)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tangent", "step"),
    [
        ("cave.grid", lumps(16), 0.003),
        ("cave.grid", np.ones((16, 16, 16, 1)), 0.003),
        ("cave.to_world", entry(2, 2), 0.005),
        ("light.position", np.array([1.0, 0.0, 0.0]), 0.005),
        ("sensor.to_world", entry(2, 3), 0.005),
    ],
)
def test_slope_in_a_smooth_cave(name: str, tangent: np.ndarray, step: float) -> None:
    assert_slope(cave("cubic"), name, tangent, step)

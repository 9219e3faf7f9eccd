"""Derivatives on and around grids of signed distances by what moves nothing, against finite differences."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.test_sdfgrid import DIFFUSE, PLAIN, ROUGH, blob, scene

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
]


def held(form: str) -> psdr.Scene:
    rough = {**ROUGH, "alpha": 0.3, "specular_reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
    normals, bsdf = ("smooth", DIFFUSE) if form == "diffuse" else ("analytic", rough)
    return psdr.load_dict(scene(blob(16), PLAIN, normals, bsdf))


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

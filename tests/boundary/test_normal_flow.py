"""Vertices that flow along normals: the same derivatives as by those that slide along rays."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted
from tests.networks import neck as necked

from .measure import assert_transposes
from .scenes import T, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, VIEW
from .test_sdfgrid import MATRIX
from .test_sdfgrid_cubic import neck

GRID, WEIGHT, BIAS, POSE = "body.grid", "body.layer1.weight", "body.layer2.bias", "body.to_world"
FLOWS = [psdr.interior.Replay(), psdr.interior.Replay(flow="normal")]


def room(shape: dict) -> dict:
    """Above a floor that is lit by it as well as by the lamp."""
    body = {**shape, "to_world": T(MATRIX), "bsdf": diffuse(0.9)}
    return {"sensor": VIEW, "floor": floor(half=2.0), "body": body, **LIGHTS["lamp"]()}


register(
    {
        "flow, cubic": lambda: room({"type": "sdfgrid", "grid": neck(), "interpolation": "cubic"}),
        "flow, network": lambda: room(fitted(necked, (24, 24)).plugin()),
    }
)


def sums(name: str, interior, boundary, spp: int) -> np.ndarray:
    """Derivatives of eight batches: by values in two patterns, and by the pose's numbers."""
    scene, params = load(name)
    names = [n for n in (GRID, WEIGHT, BIAS, POSE) if n in params]
    params.requires_grad_only(*names)
    rng = np.random.default_rng(3)
    patterns = {n: [np.ones_like(v), rng.standard_normal(v.shape)] for n in names[:-1] for v in [params[n].numpy()]}
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(
            scene, params, np.full((16, 16, 3), 1.0 / 768.0), spp=spp, seed=seed,
            integrator=psdr.PathIntegrator(max_depth=3, interior=interior, boundary=boundary),
        )  # fmt: skip
        by = {n: params[n].grad.numpy().astype(np.float64) for n in names}
        found.append([(by[n] * p).sum() for n in names[:-1] for p in patterns[n]] + [*by[POSE][:3].ravel()])
    return np.array(found)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flow, cubic", "flow, network"])
def test_derivatives_are_those_of_vertices_that_slide(name: str) -> None:
    """z-test over independent batches; the interior terms alone differ, by what is sent past silhouettes."""
    spp = 512
    ray, normal = (sums(name, interior, "auto", spp) for interior in FLOWS)
    error = np.sqrt((ray.var(axis=0, ddof=1) + normal.var(axis=0, ddof=1)) / len(ray))
    print(ray.mean(axis=0), normal.mean(axis=0), error)
    z = np.abs((normal - ray).mean(axis=0)) / error
    assert z.max() < 4.0 and np.mean(z**2) < 2.5
    assert error[0] < 0.01 * abs(ray[:, 0].mean())
    alone = [sums(name, interior, None, spp) for interior in FLOWS]
    error = np.sqrt((alone[0].var(axis=0, ddof=1) + alone[1].var(axis=0, ddof=1)) / len(ray))
    z = np.abs((alone[1] - alone[0]).mean(axis=0)) / error
    print(alone[0].mean(axis=0), alone[1].mean(axis=0), z)
    assert z.max() > 8.0


@pytest.mark.slow
def test_reverse_mode_is_the_transpose() -> None:
    scene, params = load("flow, cubic")
    options = {"integrator": psdr.PathIntegrator(max_depth=3, interior=FLOWS[1]), "spp": 4, "seed": 1}
    assert_transposes(scene, params, [GRID, POSE], options)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"interpolation": "linear", "normals": "analytic"}, "jump at the faces of voxels"),
        ({"bsdf": {"type": "conductor"}}, "smooth mirrors and glass"),
        ({"to_world": T.translate([0.0, 0.0, -0.45]) @ T(MATRIX)}, "'floor' reaches into the box"),
    ],
)
def test_what_is_refused(change: dict, problem: str) -> None:
    nodes = room({"type": "sdfgrid", "grid": neck(), "interpolation": "cubic"})
    nodes["body"] |= change
    scene = psdr.load_dict({"type": "scene", **nodes})
    with pytest.raises(ValueError, match=problem):
        psdr.plan(scene, names=[GRID], integrator=psdr.PathIntegrator(max_depth=3, interior=FLOWS[1]))


def test_an_unknown_flow() -> None:
    with pytest.raises(ValueError, match="flow: got 'up'"):
        psdr.interior.Replay(flow="up")

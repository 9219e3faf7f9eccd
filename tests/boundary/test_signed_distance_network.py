"""Rays that move with the silhouettes of a network: finite differences, and the explicit boundary term."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.networks import fitted, neck, sphere

from .measure import Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, load, register, sky
from .test_neuralsdf import SECOND, SHIFT, STEP, at_random, ones
from .test_signed_distance import METHODS, entry, radius, shadowed

POSE, NAMES = "body.to_world", [SHIFT, SECOND, "body.to_world"]
TURNED = T.translate([0.1, 0.0, 0.75]).rotate([0.0, 0.6, 0.8], 35.0).translate([-0.5, -0.5, -0.5])
VIEW = camera((0.3, -2.2, 3.0), (0.0, 0.0, 0.7), fov=30.0, rfilter="box")


def body(*color, target=neck, pose=TURNED, **more) -> dict:
    return fitted(target, (24, 24), **more).plugin(to_world=pose, bsdf=diffuse(*color or (0.7, 0.5, 0.3)))


def lamp() -> dict:
    found = shadowed() | {"body": body(0.0)}
    del found["ball"]
    return found


register(
    {
        "moving rays, network": lambda: {"sensor": VIEW, "body": body(), "sky": sky()},
        "moving rays, black network": lambda: {"sensor": VIEW, "body": body(0.0), "sky": sky()},
        "moving rays, network of sines": lambda: (
            {"sensor": VIEW, "sky": sky(), "body": body(0.0, target=sphere, sine=True, scale=2.0, gain=1.5)}
        ),
        "moving rays, network's shadow": lamp,
    }
)
CASES = [
    Case("moving rays, black network", SHIFT, ones, STEP, "shift", 1, 1024, 2048),
    Case("moving rays, black network", SECOND, at_random, STEP, "second weights", 1, 1024, 2048),
    Case("moving rays, black network", POSE, entry(0, 3), 0.01, "x", 1, 1024, 2048),
    Case("moving rays, network's shadow", SHIFT, ones, STEP, "shift", 2, 4096, 16384),
]


@pytest.mark.parametrize("case", rows(CASES))
def test_matches_finite_differences(case: Case) -> None:
    assert_agrees(derivatives(case, "reverse", METHODS[0]), differences(case)[2])


def sums(name: str, boundary, spp: int, depth: int) -> np.ndarray:
    """Derivatives of an image's mean by a shift, weights, the place and the size of a network, of eight batches."""
    scene, params = load(name)
    params.requires_grad_only(*NAMES)
    weights = at_random(params[SECOND].numpy())
    pose = radius(params[POSE].numpy().astype(np.float64))
    found = []
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(
            scene, params, np.full((16, 16, 3), 1.0 / 768.0), spp=spp, seed=seed,
            integrator=psdr.PathIntegrator(max_depth=depth, boundary=boundary),
        )  # fmt: skip
        by = {n: params[n].grad.numpy().astype(np.float64) for n in NAMES}
        found.append([by[SHIFT].sum(), (by[SECOND] * weights).sum(), *by[POSE][:3, 3], (by[POSE] * pose).sum()])
    return np.array(found)


def assert_means_agree(explicit: np.ndarray, moving: np.ndarray, error: float) -> None:
    """z-test over independent batches; ``error``: the largest one of the first derivative that tells something."""
    both = np.sqrt((explicit.var(axis=0, ddof=1) + moving.var(axis=0, ddof=1)) / len(explicit))
    print(explicit.mean(axis=0), moving.mean(axis=0), both)
    assert (np.abs((moving - explicit).mean(axis=0)) < 4.0 * both).all()
    assert both[0] < error * abs(explicit[:, 0].mean())


@pytest.mark.slow
@pytest.mark.parametrize("method", [METHODS[0], pytest.param(METHODS[1], marks=pytest.mark.slow)], ids=["one", "every"])
@pytest.mark.parametrize(
    "name", ["moving rays, black network", pytest.param("moving rays, network of sines", marks=pytest.mark.slow)]
)
def test_silhouettes_agree_with_the_explicit_term(name: str, method) -> None:
    neural = method is METHODS[1]
    moving = sums(name, method, 1024 if neural else 128, 1)
    tells = 0.06 if "sines" in name else 0.02
    assert_means_agree(sums(name, "auto", 64, 1), moving, tells)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=["one", "every"])
def test_shading_agrees_with_the_explicit_term(method) -> None:
    """A network that shades itself."""
    name = "moving rays, network"
    assert_means_agree(sums(name, "auto", 256, 2), sums(name, method, 512, 2), 0.06)


@pytest.mark.slow
def test_forward_and_reverse_mode_are_transposes() -> None:
    scene, params = load("moving rays, network")
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=METHODS[0]), "spp": 8, "seed": 3}
    assert_transposes(scene, params, NAMES, options)


def test_a_surface_that_may_reach_its_box_is_refused() -> None:
    whole = {"type": "scene", "sensor": VIEW, "sky": sky(), "body": body()}
    whole["body"]["layer2.bias"] = whole["body"]["layer2.bias"] - 0.2
    scene = psdr.load_dict(whole)
    with pytest.raises(ValueError, match="the surface of 'body' may reach the border of its box"):
        psdr.plan(scene, names=[SHIFT], integrator=psdr.PathIntegrator(max_depth=2, boundary=METHODS[0]))

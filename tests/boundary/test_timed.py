"""Boundary term before a transient film: shadows and silhouettes that move, bin by bin, against finite differences."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.sensor import timed

BINS = {"temporal_bins": 12, "bin_width_opl": 0.25, "start_opl": 5.0, "pulse_width_opl": 0.4}
SIDEWAYS = np.zeros((4, 4), np.float32)
SIDEWAYS[0, 3] = 1.0
UP = np.zeros((4, 4), np.float32)
UP[2, 3] = 1.0
#: Noise of both sides, and 0.6 % of a step of 0.01.
SLOPE = 0.04


def table(card=None, **film):
    """A card over a floor, in the light of a point and of a panel; the camera sees card, floor and both shadows."""
    view = timed.camera((0.0, -2.2, 2.6), (0.0, 0.0, 0.2), 38.0, 12, (0, 0, 1), **film)
    down = psdr.Transform.look_at((-0.5, 0.2, 2.0), (0, 0, 0), (0, 1, 0)) @ psdr.Transform.scale(0.3)
    scene = {
        "type": "scene",
        "camera": view,
        "floor": {"type": "rectangle", "to_world": psdr.Transform.scale((3, 3, 1)), "bsdf": timed.paint(0.8, 0.6, 0.4)},
        "card": {
            "type": "rectangle",
            "to_world": psdr.Transform.translate((0.1, 0.1, 0.5)) @ psdr.Transform.scale((0.4, 0.3, 1)),
            "bsdf": {"type": "twosided", "bsdf": timed.paint(0.4, 0.7, 0.8)},
        },
        "panel": {
            "type": "rectangle",
            "to_world": down,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9, 9, 9]}},
            "bsdf": timed.paint(0.0, 0.0, 0.0),
        },
        "lamp": {"type": "point", "position": [0.6, 0.3, 1.8], "intensity": {"type": "rgb", "value": [3, 3, 3]}},
    }
    return psdr.load_dict(scene if card is None else {**scene, "card": card})


def derivative(scene, name, direction, integrator, spp, seeds):
    params = psdr.traverse(scene)
    return np.mean(
        [
            psdr.render_forward(scene, params, {name: direction}, integrator=integrator, spp=spp, seed=s).numpy()
            for s in seeds
        ],
        axis=0,
    )


def difference(film, name, direction, step, integrator, spp, seeds):
    images = []
    for sign in (1.0, -1.0):
        scene = table(**film)
        params = psdr.traverse(scene)
        params[name] = params[name].numpy() + np.float32(sign * step) * direction
        params.update()
        images.append(
            np.mean([psdr.render(scene, integrator=integrator, spp=spp, seed=s).numpy() for s in seeds], axis=0)
        )
    return (images[0] - images[1]) / (2.0 * step)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "direction", "depth"),
    [
        pytest.param("card.to_world", SIDEWAYS, 2, id="occluder sideways"),
        pytest.param("card.to_world", UP, 2, id="occluder up"),
        pytest.param("card.to_world", SIDEWAYS, 3, id="occluder, depth 3"),
        pytest.param("floor.to_world", UP, 2, id="receiver"),
        pytest.param("lamp.position", np.float32([1, 0, 0.5]), 2, id="point light"),
        pytest.param("panel.to_world", UP, 2, id="panel"),
        pytest.param("camera.to_world", SIDEWAYS, 2, id="camera"),
        pytest.param("card.to_world", SIDEWAYS, 2, id="wide filter"),
    ],
)
def test_slopes_with_moving_shadows(name, direction, depth, request) -> None:
    integrator = psdr.PathIntegrator(max_depth=depth)
    wide = {"rfilter": {"type": "gaussian"}} if "wide filter" in request.node.callspec.id else {}
    bins = {**BINS, **wide}
    found = derivative(table(**bins), name, direction, integrator, 256, range(4))
    expected = difference(bins, name, direction, 0.01, integrator, 1024, range(4))
    slope = float((found * expected).sum() / (expected**2).sum())
    correlation = np.corrcoef(found.ravel(), expected.ravel())[0, 1]
    assert slope == pytest.approx(1.0, abs=SLOPE)
    assert correlation > 0.9


@pytest.mark.slow
def test_both_modes_agree_with_moving_shadows() -> None:
    integrator = psdr.PathIntegrator(max_depth=3)
    scene = table(**BINS)
    params = psdr.traverse(scene)
    params.requires_grad("card.to_world")
    forward = psdr.render_forward(scene, params, {"card.to_world": SIDEWAYS}, integrator=integrator, spp=64).numpy()
    adjoint = np.random.default_rng(2).normal(size=forward.shape).astype(np.float32)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=64)
    reverse = float((params["card.to_world"].grad.numpy() * SIDEWAYS).sum())
    assert reverse == pytest.approx(float((adjoint * forward).sum()), rel=1e-3)
    interior = psdr.render_forward(
        scene, params, {"card.to_world": SIDEWAYS}, integrator=psdr.PathIntegrator(max_depth=3, boundary=None), spp=64
    ).numpy()
    assert np.abs(forward - interior).mean() > 0.5 * np.abs(forward).mean()  # most of it is boundary


@pytest.mark.slow
def test_the_bins_add_up_to_the_steady_derivative() -> None:
    """At depth 2 with the same random numbers, so up to rounding."""
    integrator = psdr.PathIntegrator(max_depth=2)
    every = {**BINS, "start_opl": 2.0, "temporal_bins": 32}
    bins = derivative(table(**every), "card.to_world", SIDEWAYS, integrator, 64, [0]).sum(axis=2)
    steady = derivative(table(), "card.to_world", SIDEWAYS, integrator, 64, [0])
    np.testing.assert_allclose(bins, steady, rtol=1e-3, atol=1e-4 * np.abs(steady).max())


def test_what_is_not_followed_is_refused() -> None:
    def plan(scene, **options):
        integrator = psdr.PathIntegrator(max_depth=3, **options)
        return psdr.plan(scene, names=["card.to_world"], integrator=integrator)

    assert plan(table(**BINS)).boundary == psdr.boundary.PathSpace()
    with pytest.raises(ValueError, match=r"use boundary.PathSpace\(\)"):
        plan(table(**BINS), boundary=psdr.boundary.Projective())
    with pytest.raises(ValueError, match=r"leave out guiding"):
        plan(table(**BINS), boundary=psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree()))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"type": "cube"}, "'card' and 'floor' run through each other|'floor' and 'card' run through each other"),
        ({"type": "sphere"}, "interpolated normals turn away"),
    ],
)
def test_the_plan_refuses_what_terms_would(shape: dict, message: str) -> None:
    height = 0.1 if shape["type"] == "cube" else 0.8  # the cube pierces the floor
    pose = psdr.Transform.translate((0.1, 0.1, height)) @ psdr.Transform.scale(0.3)
    scene = table(card={**shape, "to_world": pose, "bsdf": timed.paint(0.4, 0.7, 0.8)}, **BINS)
    with pytest.raises(ValueError, match=f"card.to_world moves silhouettes.*({message}).*'transient_hdr_film'"):
        psdr.plan(scene, names=["card.to_world"], integrator=psdr.PathIntegrator(max_depth=3))
    alone = psdr.plan(scene, names=["card.to_world"], integrator=psdr.PathIntegrator(max_depth=3, boundary=None))
    assert alone.boundary is None
    assert psdr.plan(scene, names=["lamp.intensity.value"], integrator=psdr.PathIntegrator(max_depth=3))

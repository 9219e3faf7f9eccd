"""boundary="auto" guides gradients that are repeated where a pilot says that it pays; equal calls give equal bits."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.estimate.guiding import automatic
from warp_psdr.plan import guiding
from warp_psdr.plan.motion import motion

from .scenes import SIZE, camera, panel, under
from .test_guided_surfaces import crowd

OCCLUDER = "occluder.vertex_positions"
INTEGRATOR = psdr.PathIntegrator(max_depth=2)
SPP = 32
WAITS = "once gradients have cost what compiling {}, if it says that it pays"


def adjoint() -> np.ndarray:
    return np.random.default_rng(1).uniform(0.5, 1.5, (SIZE, SIZE, 3)).astype(np.float32)


def alone() -> dict:
    """A soft shadow seen alone: the camera is below what throws it."""
    return under(panel((0.6, -0.4, 3.0), 0.5)) | {"sensor": camera((0.1, 0.1, 0.45), (0.1, 0.1, 0.0), (0, 1, 0), 110.0)}


@pytest.fixture(scope="module")
def loaded():
    scene = psdr.load_dict({"type": "scene", **alone()})
    params = psdr.traverse(scene)
    params.requires_grad(OCCLUDER)
    return scene, params


@pytest.fixture
def soft(loaded, monkeypatch: pytest.MonkeyPatch):
    """Nothing is known of the scene, and kernels cost nothing."""
    monkeypatch.setattr(automatic, "KERNEL_COST", dict.fromkeys(automatic.KERNEL_COST, 0))
    psdr.guiding.reset(loaded[0])
    yield loaded
    psdr.guiding.set_automatic(loaded[0], True)


def gradient(scene, params, seed: int, boundary="auto") -> np.ndarray:
    params.zero_grad()
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    psdr.render_backward(scene, params, adjoint(), integrator=integrator, spp=SPP, seed=seed)
    return params[OCCLUDER].grad.numpy().copy()


def guided(scene, params) -> tuple[str, str]:
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    return next((decision, reason) for item, decision, reason in plan.lines if item == "guiding")


@pytest.mark.slow
def test_a_repeated_gradient_is_guided_where_that_pays(soft) -> None:
    scene, params = soft
    assert guided(scene, params) == ("none", WAITS.format("a pilot's kernels does"))
    plain = [gradient(scene, params, seed, psdr.boundary.PathSpace()) for seed in range(8)]
    calls = [gradient(scene, params, seed) for seed in range(8)]
    np.testing.assert_array_equal(calls[0], plain[0], "the first one costs what it cost")
    decision, reason = guided(scene, params)
    assert decision == "by itself" and reason.startswith("pilot: the variance is"), reason
    assert psdr.plan(scene, params, integrator=INTEGRATOR).boundary.guiding.max_leaves >= automatic.FEWEST_LEAVES
    assert not np.array_equal(calls[1], plain[1])
    spread = [np.var(np.stack(found[1:]), axis=0, ddof=1).sum() for found in (calls, plain)]
    assert spread[0] < 0.2 * spread[1]
    # Four standard errors of means of seven.
    error = np.sqrt((np.var(calls[1:], axis=0, ddof=1) + np.var(plain[1:], axis=0, ddof=1)) / 7)
    assert (np.abs(np.mean(calls[1:], axis=0) - np.mean(plain[1:], axis=0)) < 5.0 * error + 1e-6).all()

    # The same calls once more: each has the bits that it had, guided or not.
    np.testing.assert_array_equal([gradient(scene, params, seed) for seed in (0, 3)], [calls[0], calls[3]])
    # In forward mode, too, the random numbers are those of reverse mode.
    tangent = np.random.default_rng(2).normal(size=calls[0].shape).astype(np.float32)
    for seed in (0, 3):
        image = psdr.render_forward(scene, params, {OCCLUDER: tangent}, integrator=INTEGRATOR, spp=SPP, seed=seed)
        assert (image.numpy().astype(np.float64) * adjoint()).sum() == pytest.approx(
            float((calls[seed] * tangent).sum()), rel=1e-3
        )

    # From the start again: the same calls in the same order, the same bits.
    psdr.guiding.reset(scene)
    assert guided(scene, params)[0] == "none" and not psdr.guiding.structures(scene)
    np.testing.assert_array_equal([gradient(scene, params, seed) for seed in range(3)], calls[:3])


def test_what_is_not_repeated_or_switched_off_is_not_guided(soft) -> None:
    scene, params = soft
    first = gradient(scene, params, 5)
    np.testing.assert_array_equal(gradient(scene, params, 5), first)
    assert guided(scene, params)[0] == "none" and not psdr.guiding.structures(scene)
    psdr.guiding.set_automatic(scene, False)
    gradient(scene, params, 6)
    assert not psdr.guiding.structures(scene)
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    assert not [line for line in plan.lines if line[0] == "guiding"]
    with pytest.raises(ValueError, match="on: got 1, expected True or False"):
        psdr.guiding.set_automatic(scene, 1)


@pytest.mark.parametrize(
    ("shadow", "rest", "expected"),
    [(2.0, 0.0, "none"), (20.0, 0.0, "by itself"), (20.0, 1.0, "none"), (0.5, 0.0, "none")],
    ids=["too little", "much", "much of little", "worse"],
)
def test_the_pilot_weighs_variance_and_cost(soft, monkeypatch, shadow: float, rest: float, expected: str) -> None:
    """Variance that guiding saves of the shadow's, and that of all the rest over the shadow's."""
    scene, params = soft
    random = np.random.default_rng(0)

    def batch(_scene, plan, _names, _role, _sensor, spp, _seed, _given, shadows):
        # Many numbers, so that the variance is told within a few percent.
        variance = rest if not shadows else 1.0 if plan.boundary.guiding is None else 1.0 / shadow
        return random.normal(scale=variance**0.5, size=3 * params[OCCLUDER].size), spp * SIZE**2

    monkeypatch.setattr(automatic, "_batch", batch)
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    for seed in range(2):
        automatic.choose(scene, plan, [OCCLUDER], "reverse", 0, SPP, seed, None)
    decision, reason = guided(scene, params)
    assert (decision, reason.startswith("pilot: ")) == (expected, True), reason


def test_it_waits_until_a_pilot_is_affordable(soft, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, params = soft
    monkeypatch.setattr(automatic, "_batch", lambda *_arguments: (np.zeros(3 * params[OCCLUDER].size), 0))
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    state = guiding.automatic(scene, motion(scene, [OCCLUDER]), 0, 2)
    decided = []
    for seed in range(20):  # one sample a pixel: a batch of the pilot costs as much as a call
        automatic.choose(scene, plan, [OCCLUDER], "reverse", 0, 1, seed, None)
        decided.append(state.decided)
    assert not any(decided[:5]) and decided[-1] and state.said == "no shadow edge moves"


@pytest.mark.parametrize("call", [0, SPP * SIZE**2], ids=["samples alone", "calls, too"])
def test_it_waits_until_gradients_have_cost_what_its_kernels_do(soft, monkeypatch: pytest.MonkeyPatch, call) -> None:
    """A kernel costs as much as four gradients: a pilot of edges, which has three, waits for twelve."""
    scene, params = soft
    for name, cost in (("KERNEL_COST", 4 * SPP * SIZE**2), ("CALL_COST", call)):
        monkeypatch.setattr(automatic, name, dict.fromkeys(getattr(automatic, name), cost))
    monkeypatch.setattr(automatic, "_batch", lambda *_arguments: (np.zeros(3 * params[OCCLUDER].size), 0))
    plan = psdr.plan(scene, params, integrator=INTEGRATOR)
    state = guiding.automatic(scene, motion(scene, [OCCLUDER]), 0, 2)
    waits = 6 if call else 12
    for seed in range(waits):
        automatic.choose(scene, plan, [OCCLUDER], "reverse", 0, SPP, seed, None)
        automatic.choose(scene, plan, [OCCLUDER], "reverse", 0, SPP, seed, None)  # the same call again tells nothing
        assert not state.decided
        percent = f"{100 * seed / waits:.0f}%"
        said = WAITS.format(f"a pilot's 3 kernels does ({percent} so far)" if seed else "a pilot's kernels does")
        assert guided(scene, params) == ("none", said)
    automatic.choose(scene, plan, [OCCLUDER], "reverse", 0, SPP, waits, None)
    assert state.decided and state.said == "no shadow edge moves"


@pytest.mark.slow
def test_shapes_without_triangles_are_guided_where_that_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A soft shadow seen alone, as above."""
    monkeypatch.setattr(automatic, "KERNEL_COST", dict.fromkeys(automatic.KERNEL_COST, 0))
    scene = psdr.load_dict({"type": "scene", **crowd(), "sensor": camera((1.2, 0.0, 0.45), (-0.4, 0.2, 0.0), fov=60.0)})
    name = "shape.to_world"
    params = psdr.traverse(scene)
    params.requires_grad(name)

    def gradients(boundary) -> np.ndarray:
        integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
        found = []
        for seed in range(8):
            params.zero_grad()
            psdr.render_backward(scene, params, adjoint(), integrator=integrator, spp=SPP, seed=seed)
            found.append(params[name].grad.numpy().astype(np.float64).reshape(-1))
        return np.array(found)

    calls, plain = gradients("auto"), gradients(psdr.boundary.PathSpace())
    np.testing.assert_array_equal(calls[0], plain[0], "the first one costs what it cost")
    decision, reason = guided(scene, params)
    assert decision == "by itself" and reason.startswith("pilot: the variance is"), reason
    assert np.var(calls[1:], axis=0, ddof=1).sum() < 0.5 * np.var(plain[1:], axis=0, ddof=1).sum()
    error = np.sqrt((np.var(calls[1:], axis=0, ddof=1) + np.var(plain[1:], axis=0, ddof=1)) / 7)
    assert (np.abs(np.mean(calls[1:], axis=0) - np.mean(plain[1:], axis=0)) < 5.0 * error + 1e-6).all()

"""interior="auto": repeated gradients are drawn for where a pilot says that it pays; equal calls have equal bits."""

import json

import numpy as np
import pytest

import warp_psdr as psdr
from tests.interior import test_antithetic as turned
from tests.interior import test_resampled as resampled
from warp_psdr.estimate import choice as pilot
from warp_psdr.estimate.passes import camera_gradient_kernels
from warp_psdr.options.interior import Branches
from warp_psdr.plan import choice

ALPHA, FLOOR = "ball.bsdf.alpha.value", "floor.bsdf.reflectance.value"
REPLAY = psdr.interior.Replay()


def integrator(method="auto"):
    return resampled.integrator(method)


@pytest.fixture
def metal():
    """Nothing is known of the scene."""
    scene, params = resampled.load("metal")
    psdr.guiding.reset(scene)
    yield scene, params
    psdr.guiding.set_automatic(scene, True)
    psdr.guiding.reset(scene)


def drawn_for(scene, names, method="auto"):
    plan = psdr.plan(scene, names=names, integrator=integrator(method))
    return [(decision, reason) for item, decision, reason in plan.lines if item == "drawn for"]


def calls(scene, names, count: int, first: int = 0):
    """The plans of calls that follow each other, without the rendering."""
    given = np.ones((resampled.SIZE, resampled.SIZE), object)
    plans = []
    for seed in range(first, first + count):
        plan = psdr.plan(scene, names=names, integrator=integrator())
        plans.append(pilot.choose(scene, plan, names, "reverse", 0, 1 << 10, seed, given))
    return plans


@pytest.fixture
def told(monkeypatch):
    """Let the pilot find variances, replay's first, in each round the same, and compile nothing."""
    variances: list = []

    def variance(*_arguments):
        variances.append(variances.pop(0))
        return variances[-1]

    monkeypatch.setattr(pilot, "variance", variance)
    monkeypatch.setattr(pilot.compiler, "begin", lambda *_arguments: None)
    return variances


def test_where_nothing_is_branched_the_kernel_is_replays(metal):
    scene, _params = metal
    plans = [psdr.plan(scene, names=[FLOOR], integrator=integrator(method)) for method in ("auto", REPLAY)]
    first, second = (camera_gradient_kernels(plan, "reverse") for plan in plans)
    assert first == second and plans[0].lines == plans[1].lines and not plans[0].offered
    assert calls(scene, [FLOOR], 2)[1] is not None and not scene.__dict__.get("_interior")


def test_first_gradients_are_replayed_and_a_pilot_waits(metal, told):
    scene, _params = metal
    plain = camera_gradient_kernels(psdr.plan(scene, names=[ALPHA], integrator=integrator(REPLAY)), "reverse")
    needed = pilot.SPENT // (1 << 10) // resampled.SIZE**2
    plans = calls(scene, [ALPHA], needed)
    assert all(camera_gradient_kernels(plan, "reverse") == plain for plan in plans)
    assert drawn_for(scene, [ALPHA]) == [
        ("nothing: replayed", f"{ALPHA}: shape of a lobe, or weight of a mixture; {choice.WAITS}")
    ]
    told += [[10.0], [2.0], [1.0]]
    (plan,) = calls(scene, [ALPHA], 1, first=needed)
    assert plan.kept.branches == Branches(shapes="decomposed")
    decision, reason = drawn_for(scene, [ALPHA])[0]
    assert decision == "decomposed branches" and reason.endswith("10 times less at 3.9 times the cost")
    # What was replayed is replayed again; another request knows nothing.
    assert camera_gradient_kernels(calls(scene, [ALPHA], 1)[0], "reverse") == plain
    assert drawn_for(scene, [ALPHA, FLOOR])[0][1].endswith(choice.WAITS)
    # Another method that is named is taken.
    assert not drawn_for(scene, [ALPHA], REPLAY)
    psdr.guiding.set_automatic(scene, False)
    assert not drawn_for(scene, [ALPHA]) and not psdr.plan(scene, names=[ALPHA], integrator=integrator()).offered


@pytest.mark.parametrize(
    ("names", "variances", "expected"),
    [
        # By replay, resampled, in closed form.
        ([ALPHA], [[5.0], [1.5], [1.0]], Branches(shapes="decomposed")),
        ([ALPHA], [[5.0], [1.0], [1.5]], Branches(shapes="resampled")),
        ([ALPHA], [[3.0], [1.0], [1.0]], None),
        ([ALPHA], [[0.0], [0.0], [0.0]], None),
        # Half of the gain, for what is replayed beside it.
        ([ALPHA, FLOOR], [[9.0, 1.0], [2.0, 1.0], [1.0, 1.0]], None),
        ([ALPHA, FLOOR], [[36.0, 1.0], [2.0, 1.0], [1.0, 1.0]], Branches(shapes="decomposed")),
    ],
)
def test_the_pilot_weighs_variance_and_cost(metal, told, monkeypatch, names, variances, expected):
    scene, _params = metal
    monkeypatch.setattr(pilot, "SPENT", 0)
    told += variances
    assert choice.known(scene, names, 3).method is None
    calls(scene, names, 1)
    assert choice.known(scene, names, 3).method == expected and choice.known(scene, names, 3).decided


@pytest.mark.parametrize(
    ("resampled_rounds", "expected"),
    [
        ([1.0, 1.1, 0.9, 1.0], "resampled"),
        # The mean says that it pays, but it is the mean of few large samples.
        ([0.5, 0.5, 0.5, 4.5], "decomposed"),
    ],
)
def test_a_variance_of_rare_large_samples_is_doubted(metal, monkeypatch, resampled_rounds, expected):
    scene, _params = metal
    rows = {"": [40.0] * 4, "resampled": resampled_rounds, "decomposed": [2.0] * 4}

    def variance(_scene, plan, *_arguments):
        method = plan.kept.branches
        return [rows[method.shapes if method else ""].pop(0)]

    monkeypatch.setattr(pilot, "variance", variance)
    monkeypatch.setattr(pilot, "SPENT", 0)
    monkeypatch.setattr(pilot.compiler, "begin", lambda *_arguments: None)
    calls(scene, [ALPHA], 1)
    assert choice.known(scene, [ALPHA], 3).method == Branches(shapes=expected) and not any(rows.values())


def test_what_has_no_closed_form_is_resampled(metal):
    scene, _params = metal

    def shapes(loaded, names):
        plan = psdr.plan(loaded, names=names, integrator=integrator())
        return [method.shapes for kind, method in choice.candidates(plan) if kind == "shapes"]

    assert shapes(scene, [ALPHA]) == ["resampled", "decomposed"]
    plastic, _params = resampled.load("plastic")
    assert shapes(plastic, ["ball.bsdf.alpha"]) == ["resampled"]


def test_what_was_chosen_is_stored_in_json(metal):
    scene, _params = metal
    found = choice.known(scene, [ALPHA], 3)
    found.spent, found.decided, found.method = 5.0, True, Branches(shapes="resampled", normals="antithetic")
    found.gains, found.costs = {"shapes": 4.0}, {"shapes": 2.9}
    rows = json.loads(json.dumps(choice.stored(scene)))
    psdr.guiding.reset(scene)
    assert choice.stored(scene) == []
    choice.restore(scene, rows)
    again = choice.known(scene, [ALPHA], 3)
    assert (again.spent, again.decided, again.method) == (5.0, True, found.method)
    assert choice.stored(scene) == rows
    with pytest.raises(KeyError):
        choice.restore(scene, [{"names": [ALPHA]}])


@pytest.mark.slow
def test_a_repeated_derivative_by_a_roughness_is_drawn_for(metal, monkeypatch):
    """Of a ball of metal under a lamp and a sky: the bits of every call, unbiased, with a fraction of the variance."""
    scene, params = metal
    monkeypatch.setattr(pilot, "SPENT", 4 * 64 * resampled.SIZE**2)

    def gradients(method, seeds, workers=None):
        params.requires_grad_only(ALPHA)
        psdr.set_workers(workers)
        rows = []
        for seed in seeds:
            params.zero_grad()
            psdr.render_backward(scene, params, resampled.adjoint(), integrator=integrator(method), spp=64, seed=seed)
            rows.append(float(params[ALPHA].grad.numpy()[0]))
        psdr.set_workers(None)
        return np.array(rows)

    found = gradients("auto", range(36))
    plain = gradients(REPLAY, range(36))
    np.testing.assert_array_equal(found[:4], plain[:4])
    np.testing.assert_array_equal(found[4:], gradients(psdr.interior.Decomposed(), range(4, 36)))
    assert choice.known(scene, [ALPHA], 3).gains["shapes"] > 4.0
    assert found[4:].var(ddof=1) < 0.25 * plain[4:].var(ddof=1)
    resampled.assert_equal_means(found[4:, None], plain[4:, None])
    np.testing.assert_array_equal(gradients("auto", (0, 7)), found[[0, 7]])
    psdr.guiding.reset(scene)
    np.testing.assert_array_equal(gradients("auto", range(6), workers=1), found[:6])


@pytest.mark.slow
def test_shapes_and_normals_are_drawn_for_side_by_side():
    """The kernels of several methods add up to what each of them finds with the same random numbers."""
    names = [ALPHA, "floor.vertex_normals", "sky.radiance.value"]
    found = turned.backward("moved", names, Branches(shapes="resampled", normals="antithetic"), [7])[0]
    resampled_too = turned.backward("moved", names, psdr.interior.Resampled(), [7])[0]
    both = turned.backward("moved", names, Branches(shapes="resampled", normals="resampled"), [7])[0]
    paired_too = turned.backward("moved", names, psdr.interior.Antithetic(), [7])[0]
    assert found[0] == resampled_too[0] != paired_too[0]
    np.testing.assert_allclose(found[1:], paired_too[1:], rtol=turned.ROUNDING, atol=1e-6 * np.abs(found).max())
    np.testing.assert_allclose(both, resampled_too, rtol=turned.ROUNDING, atol=1e-6 * np.abs(found).max())
    assert not np.allclose(found[1:-3], resampled_too[1:-3]) and (found[-3:] > 0.0).all()

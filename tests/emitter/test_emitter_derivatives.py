"""Derivatives of light sources that are not surfaces, against finite differences."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.emitter.helpers import ENVIRONMENTS, LIGHTS, Light, envmap, pose, queries, random_map
from warp_psdr.kernels import constants as c

#: Step of the four-point central difference. Studied on these lights from 1e-3 to 1e-1: rounding (1e-7 / h) and the
#: remainder (h^4) cross between 1e-2 and 4e-2. Angles of spots, in degrees, move by 30 times as much.
STEP = 2e-2
#: Error of a difference relative to the largest derivative of a query.
DIFFERENCE_TOLERANCE = 2e-3


def weighted(light, x, w, a_wi, values=None):
    """What the vjp differentiates, per query, float64."""
    if light.kind in ENVIRONMENTS:
        return (w * light.evaluate(x, values)[0]).sum(axis=1)
    s = light.sample(x, np.zeros((len(x), 2)), values)
    return (w * s.radiance).sum(axis=1) + (a_wi * s.wi).sum(axis=1)


def difference(f, step):
    """Fourth-order central difference of f at 0."""
    return (8.0 * (f(step) - f(-step)) - (f(2.0 * step) - f(-2.0 * step))) / (12.0 * step)


@pytest.fixture(scope="module", params=LIGHTS)
def differentiated(request):
    """A light, its queries and the finite-difference Jacobian with respect to all of its values, (N, values)."""
    name = request.param
    light = Light(**LIGHTS[name])
    x, w, a_wi = queries(name, light)
    jacobian = np.zeros((len(x), len(light.values)))
    for k in range(light.named):
        step = STEP * (30.0 if "angles" in light.where and k >= light.where["angles"].start else 1.0)

        def moved(h, k=k):
            values = light.values.copy()
            values[k] += h
            return weighted(light, x, w, a_wi, values)

        jacobian[:, k] = difference(moved, step)
    return SimpleNamespace(name=name, light=light, x=x, w=w, a_wi=a_wi, jacobian=jacobian)


def assert_derivatives_close(actual, expected, scale=None):
    scale = np.abs(expected).max() if scale is None else scale
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=DIFFERENCE_TOLERANCE * max(scale, 1e-3))


def test_reverse_gradient_equals_differences(differentiated):
    d = differentiated
    assert np.abs(d.jacobian).max() > 0.1
    # One query at a time would hide nothing, but costs a launch each: random signs keep the queries apart.
    for seed in range(4):
        sign = np.random.default_rng(seed).choice([-1.0, 1.0], len(d.x))[:, None]
        _, dot, gradient = d.light.vjp("reverse", np.zeros(len(d.light.values)), d.x, sign * d.w, sign * d.a_wi)
        expected = (sign * d.jacobian).sum(axis=0)
        for name, where in d.light.where.items():
            assert_derivatives_close(gradient[where], expected[where], np.abs(d.jacobian[:, where]).sum(axis=0).max())
            if name == "unused":
                np.testing.assert_array_equal(gradient[where], 0.0)
        np.testing.assert_array_equal(dot, 0.0)


def test_forward_derivative_equals_differences_and_the_reverse_gradient(differentiated):
    d = differentiated
    tangent = np.random.default_rng(20).normal(size=len(d.light.values)).astype(np.float32)
    _, dot, target = d.light.vjp("forward", tangent, d.x, d.w, d.a_wi)
    np.testing.assert_array_equal(target, tangent)
    expected = d.jacobian @ tangent.astype(np.float64)
    assert_derivatives_close(dot, expected, np.abs(d.jacobian * tangent).sum(axis=1).max())
    gradient = d.light.vjp("reverse", np.zeros(len(tangent)), d.x, d.w, d.a_wi)[2]
    # <Jv, w> = <v, J'w> up to float32 rounding of the sums.
    np.testing.assert_allclose(dot.sum(dtype=np.float64), gradient.astype(np.float64) @ tangent, rtol=1e-4, atol=1e-4)


def test_adjoint_of_the_point_or_direction_equals_differences(differentiated):
    d = differentiated
    for role in ("reverse", "forward"):
        x_adjoint = d.light.vjp(role, np.zeros(len(d.light.values)), d.x, d.w, d.a_wi)[0]
        for k in range(3):

            def moved(h, k=k):
                offset = np.zeros(3, np.float32)
                offset[k] = h
                return weighted(d.light, d.x + offset, d.w, d.a_wi)

            expected = difference(moved, STEP)
            assert_derivatives_close(x_adjoint[:, k], expected, np.abs(x_adjoint).max())


@pytest.mark.slow_rows(
    "gray point-wanted1",
    "gray point-wanted2",
    "skewed spot-wanted1",
    "skewed spot-wanted2",
    "black envmap-wanted1",
    "black envmap-wanted2",
    "skewed envmap-wanted1",
    "skewed envmap-wanted2",
    "projector-wanted1",
    "projector-wanted2",
    "skewed projector-wanted1",
    "skewed projector-wanted2",
    "textured spot-wanted1",
    "textured spot-wanted2",
    "skewed textured spot-wanted1",
    "skewed textured spot-wanted2",
)
@pytest.mark.parametrize("wanted", [pytest.param((), marks=pytest.mark.slow), ("radiance",), ("pose",)])
def test_only_what_is_wanted_is_scattered(differentiated, wanted):
    d = differentiated
    args = np.zeros(len(d.light.values)), d.x, d.w, d.a_wi
    x_all, _, gradient_all = d.light.vjp("reverse", *args)
    x_adjoint, _, gradient = d.light.vjp("reverse", *args, wanted=wanted)
    np.testing.assert_array_equal(x_adjoint, x_all)
    uses = {"radiance": "radiance", "scale": "radiance", "to_world": "pose", "position": "pose", "angles": "pose"}
    uses["projected"] = "radiance"
    for name, where in d.light.where.items():
        expected = gradient_all[where] if uses.get(name) in wanted else 0.0
        np.testing.assert_array_equal(gradient[where], expected)


@pytest.mark.parametrize("role", ["reverse", "forward"])
def test_derivatives_are_finite_at_singular_places(role):
    poles = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1e-20, 1.0, 0.0]], np.float32)
    cases = [
        (envmap(random_map(), rotation=np.eye(3)), poles),
        (Light(c.EMITTER_POINT, radiance=[1.0], position=[0.1, 0.2, 0.3]), np.array([[0.1, 0.2, 0.3]], np.float32)),
    ]
    spot = Light(c.EMITTER_SPOT, radiance=[1.0], to_world=pose(np.eye(3)), angles=[20.0, 0.0])
    # In the light, on its axis, behind it.
    cases.append((spot, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, -2.0]], np.float32)))
    angles = {"to_world": pose(np.eye(3)), "angles": [20.0, 0.0]}
    slide = Light(c.EMITTER_TEXTURED_SPOT, radiance=[1.0], projected=random_map(), **angles)
    # The same, and across the axis, where the direction meets no texture.
    cases.append((slide, np.concatenate([cases[-1][1], np.float32([[1.0, 0.0, 0.0]])])))
    thrown = Light(c.EMITTER_PROJECTOR, radiance=random_map(), scale=[1.0], **angles)
    cases.append((thrown, cases[-1][1]))
    for light, x in cases:
        ones = np.ones_like(x)
        for v in light.vjp(role, np.zeros(len(light.values)), x, ones, ones):
            assert np.all(np.isfinite(v))
        if light.kind in ENVIRONMENTS:
            assert all(np.all(np.isfinite(v)) for v in light.evaluate(x))
        else:
            s = light.sample(x, ones[:, :2])
            assert all(np.all(np.isfinite(v)) for v in (s.wi, s.radiance, s.distance, s.pdf))

"""Adam against an independent implementation in double precision, its projection, its masks and its refusals."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_psdr import optim

#: Float32 rounding over the steps that a test makes, relative to the largest value.
ROUNDING = 2e-6

BETAS, EPSILON = (0.8, 0.95), 1e-8


class Parameters(dict):
    """The part of a scene's parameters that an optimiser touches: arrays, their ranges, update and zero_grad."""

    scene = SimpleNamespace(
        derived_normals=lambda names: [], instances=SimpleNamespace(derived_normals=lambda names: [])
    )

    def __init__(self, values: dict, ranges: dict | None = None, dtypes: dict | None = None, device: str = "cpu"):
        dtypes = dtypes or {}
        super().__init__(
            {
                name: wp.array(value, dtype=dtypes.get(name, wp.float32), requires_grad=True, device=device)
                for name, value in values.items()
            }
        )
        self.ranges = ranges or {}
        self.updates: list[tuple[str, ...]] = []

    def bounds(self, name: str) -> tuple[float, float]:
        return self.ranges.get(name, (-np.inf, np.inf))

    def update(self, *names: str) -> None:
        self.updates.append(names)

    def zero_grad(self) -> None:
        for array in self.values():
            array.grad.zero_()

    def set_gradient(self, name: str, gradient: np.ndarray) -> None:
        self[name].grad.assign(np.asarray(gradient, dtype=np.float32))


def reference(value, gradients, lr, low=-np.inf, high=np.inf, masked=False):
    """Algorithm 1 of Kingma and Ba in double precision, followed by a projection, over all ``gradients``."""
    value = np.asarray(value, dtype=np.float64).copy()
    m, v = np.zeros_like(value), np.zeros_like(value)
    for t, gradient in enumerate(np.asarray(gradients, dtype=np.float64), start=1):
        touched = gradient != 0.0 if masked else np.ones(value.shape, dtype=bool)
        m = np.where(touched, BETAS[0] * m + (1 - BETAS[0]) * gradient, m)
        v = np.where(touched, BETAS[1] * v + (1 - BETAS[1]) * gradient**2, v)
        step = lr * (m / (1 - BETAS[0] ** t)) / (np.sqrt(v / (1 - BETAS[1] ** t)) + EPSILON)
        value = np.where(touched, np.clip(value - step, low, high), value)
    return value


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    ("shape", "dtype"),
    [((4,), wp.float32), ((3, 5, 3), wp.float32), ((6, 3), wp.vec3), ((1, 4, 4), wp.mat44)],
    ids=["floats", "bitmap", "vec3", "mat44"],
)
def test_steps_follow_the_reference(shape, dtype, masked: bool, device: str) -> None:
    rng = np.random.default_rng(3)
    start = rng.normal(size=shape).astype(np.float32)
    gradients = rng.normal(size=(12, *shape)).astype(np.float32)
    gradients[rng.random(gradients.shape) < 0.3] = 0.0
    params = Parameters({"x": start}, {"x": (-1.0, 0.8)}, {"x": dtype}, device)
    adam = optim.Adam(params, {"x": 0.05}, betas=BETAS, epsilon=EPSILON, mask_updates=masked)
    for gradient in gradients:
        params.set_gradient("x", gradient)
        adam.step()
    expected = reference(start, gradients, 0.05, -1.0, 0.8, masked)
    np.testing.assert_allclose(params["x"].numpy(), expected, rtol=0, atol=ROUNDING)
    assert params.updates == [("x",)] * len(gradients)
    assert np.all(params["x"].grad.numpy() == 0.0)


def test_masked_entries_keep_value_even_with_momentum() -> None:
    params = Parameters({"x": np.zeros(2)})
    adam = optim.Adam(params, 0.1, mask_updates=True)
    params.set_gradient("x", [1.0, 1.0])
    adam.step()
    after_one = params["x"].numpy().copy()
    params.set_gradient("x", [1.0, 0.0])
    adam.step()
    assert params["x"].numpy()[1] == after_one[1]
    assert params["x"].numpy()[0] < after_one[0]


def test_first_step_is_the_learning_rate_whatever_the_gradients_scale() -> None:
    params = Parameters({"a": np.zeros(1), "b": np.zeros(1)})
    adam = optim.Adam(params, {"a": 0.1, "b": 0.3})
    params.set_gradient("a", [1e-4])
    params.set_gradient("b", [-1e4])
    adam.step(scale=0.5)
    np.testing.assert_allclose(params["a"].numpy(), [-0.05], rtol=1e-3)
    np.testing.assert_allclose(params["b"].numpy(), [0.15], rtol=1e-3)


def test_only_named_parameters_change() -> None:
    params = Parameters({"a": np.zeros(1), "b": np.zeros(1)})
    adam = optim.Adam(params, {"a": 0.1})
    for name in params:
        params.set_gradient(name, [1.0])
    adam.step()
    assert params["a"].numpy()[0] != 0.0
    assert params["b"].numpy()[0] == 0.0


@pytest.mark.parametrize("scale", [np.nan, np.inf, -1.0])
def test_a_step_of_no_length_is_refused(scale: float) -> None:
    params = Parameters({"a": np.ones(1)})
    adam = optim.Adam(params, 0.1)
    params.set_gradient("a", [1.0])
    with pytest.raises(ValueError, match="scale: got"):
        adam.step(scale=scale)
    assert params["a"].numpy()[0] == 1.0 and adam.steps == 0


def test_minimises_a_quadratic_inside_a_box() -> None:
    target = np.array([0.3, 2.0], dtype=np.float32)
    params = Parameters({"x": np.array([0.9, 0.1])}, {"x": (0.0, 1.0)})
    adam = optim.Adam(params, 0.05)
    for step in range(400):
        params.set_gradient("x", 2 * (params["x"].numpy() - target))
        adam.step(scale=0.99**step)
    np.testing.assert_allclose(params["x"].numpy(), [0.3, 1.0], atol=1e-3)


def test_state_continues_with_equal_bits() -> None:
    rng = np.random.default_rng(5)
    gradients = rng.normal(size=(6, 4)).astype(np.float32)

    def advance(params: Parameters, adam: optim.Adam, some: np.ndarray) -> None:
        for gradient in some:
            params.set_gradient("x", gradient)
            adam.step()

    whole = Parameters({"x": np.ones(4)})
    advance(whole, optim.Adam(whole, 0.1), gradients)
    first = Parameters({"x": np.ones(4)})
    adam = optim.Adam(first, 0.1)
    advance(first, adam, gradients[:3])
    second = Parameters({"x": first["x"].numpy()})
    resumed = optim.Adam(second, 0.1)
    resumed.load_state_dict(adam.state_dict())
    advance(second, resumed, gradients[3:])
    np.testing.assert_array_equal(second["x"].numpy(), whole["x"].numpy())


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e20])
def test_non_finite_gradient_names_parameter_and_step_and_changes_nothing(bad: float) -> None:
    params = Parameters({"fine": np.zeros(3), "wall.reflectance": np.zeros(3)})
    adam = optim.Adam(params, 0.1)
    params.set_gradient("fine", [1.0, 1.0, 1.0])
    adam.step()
    before = {name: array.numpy().copy() for name, array in params.items()}
    params.set_gradient("fine", [1.0, 1.0, 1.0])
    params.set_gradient("wall.reflectance", [0.0, bad, 0.0])
    with pytest.raises(ValueError, match=r"'wall\.reflectance': 1 of 3 entries are not finite.* at step 2"):
        adam.step()
    for name, value in before.items():
        np.testing.assert_array_equal(params[name].numpy(), value)
    assert adam.steps == 1


@pytest.mark.parametrize("rate", ["0.1", True, None, [0.1]])
def test_learning_rates_are_numbers(rate) -> None:
    for lr, name in ((rate, "lr"), ({"x": rate}, "lr of 'x'")):
        with pytest.raises(TypeError, match=rf"{name}: got .*, expected a number"):
            optim.Adam(Parameters({"x": np.zeros(2)}), lr)
    assert optim.Adam(Parameters({"x": np.zeros(2)}), np.float32(0.5)).lr == {"x": 0.5}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lr": {"y": 0.1}}, "no parameter 'y'"),
        ({"lr": {}}, "no parameter to optimise"),
        ({"lr": -0.1}, "lr of 'x': got -0.1"),
        ({"lr": float("nan")}, "lr of 'x': got nan"),
        ({"lr": 0.1, "betas": (0.9, 1.0)}, r"betas\[1\]: got 1.0"),
        ({"lr": 0.1, "betas": (0.9,)}, "expected two numbers"),
        ({"lr": 0.1, "epsilon": 0.0}, "epsilon: got 0.0"),
    ],
)
def test_options_are_checked(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        optim.Adam(Parameters({"x": np.zeros(2)}), **options)


@pytest.mark.parametrize(
    ("source", "follower"),
    [("to_world", "vertex_positions"), ("to_world", "vertex_normals"), ("vertex_positions", "vertex_normals")],
)
def test_what_follows_another_parameter_is_refused_beside_it(source: str, follower: str) -> None:
    params = Parameters({f"ball.{source}": np.eye(4), f"ball.{follower}": np.zeros((3, 3))})
    params.scene = SimpleNamespace(
        derived_normals=lambda names: [0], instances=SimpleNamespace(derived_normals=lambda names: [])
    )
    with pytest.raises(ValueError, match=rf"'ball\.{follower}' follows 'ball\.{source}'.*leave one of them out"):
        optim.Adam(params, 0.1)
    optim.Adam(params, {f"ball.{source}": 0.1})


def test_normals_that_are_given_do_not_follow() -> None:
    params = Parameters({"ball.vertex_positions": np.zeros((3, 3)), "ball.vertex_normals": np.zeros((3, 3))})
    optim.Adam(params, 0.1)


def test_a_gradient_that_is_not_requested_any_more_is_named() -> None:
    params = Parameters({"x": np.zeros(2)})
    adam = optim.Adam(params, 0.1)
    params["x"].requires_grad = False
    with pytest.raises(ValueError, match="'x' requires no gradient any more"):
        adam.step()


def test_parameter_without_gradient_is_refused() -> None:
    params = Parameters({"x": np.zeros(2)})
    params["x"].requires_grad = False
    with pytest.raises(ValueError, match=r"call params\.requires_grad\('x'\)"):
        optim.Adam(params, {"x": 0.1})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": np.array(-1)}, "steps is"),
        ({"steps": np.array(1.5)}, "steps is"),
        ({"x/m": np.zeros(3, np.float32)}, "'x/m' has shape"),
        ({"x/v": np.zeros(2)}, "dtype float64"),
        ({"x/v": np.full(2, np.nan, np.float32)}, "expected finite"),
        ({"y/v": np.zeros(2, np.float32)}, r"differ in \['y/v'\]"),
    ],
)
def test_foreign_state_is_refused(change: dict, message: str) -> None:
    adam = optim.Adam(Parameters({"x": np.zeros(2)}), 0.1)
    with pytest.raises(ValueError, match=message):
        adam.load_state_dict({**adam.state_dict(), **change})
    assert adam.steps == 0


def test_what_is_no_float32_array_is_refused() -> None:
    with pytest.raises(TypeError, match="expected contiguous float32"):
        optim.flat(wp.zeros(3, dtype=wp.int32, device="cpu"))
    with pytest.raises(TypeError, match="expected contiguous float32"):
        optim.flat(wp.zeros((4, 4), dtype=wp.float32, device="cpu")[:, :2])

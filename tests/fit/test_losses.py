"""Losses against closed forms in double precision, and their derivatives against the same."""

import numpy as np
import pytest
import warp as wp

from warp_psdr import losses

#: Float32 rounding of a sum whose terms are rounded once each.
ROUNDING = 2e-6

HUBER_DELTA = 0.25
EPSILON = 0.05


def huber_value(d, t):
    return np.where(np.abs(d) <= HUBER_DELTA, d * d / 2, HUBER_DELTA * (np.abs(d) - HUBER_DELTA / 2))


#: name: (loss, value of a term, derivative of a term), the latter in NumPy on the difference and the target.
CASES = {
    "l2": (losses.l2, lambda d, t: d * d, lambda d, t: 2 * d),
    "l1": (losses.l1, lambda d, t: np.abs(d), lambda d, t: np.sign(d)),
    "huber": (
        lambda a, b: losses.huber(a, b, delta=HUBER_DELTA),
        huber_value,
        lambda d, t: np.clip(d, -HUBER_DELTA, HUBER_DELTA),
    ),
    "relative_l2": (
        lambda a, b: losses.relative_l2(a, b, epsilon=EPSILON),
        lambda d, t: d * d / (t * t + EPSILON),
        lambda d, t: 2 * d / (t * t + EPSILON),
    ),
}


def images(shape=(7, 5), seed=1):
    rng = np.random.default_rng(seed)
    a, b = rng.random((2, *shape, 3), dtype=np.float32)
    a[0, 0] = b[0, 0]  # a pixel that agrees exactly, where |x| has no derivative
    return a, b


@pytest.mark.parametrize("name", CASES)
def test_value_and_derivative(name: str, device: str) -> None:
    loss, value, derivative = CASES[name]
    a, b = images()
    image = wp.array(a, dtype=wp.vec3, requires_grad=True, device=device)
    with wp.Tape() as tape:
        result = loss(image, b)
    tape.backward(result)
    d, t = a.astype(np.float64) - b, b.astype(np.float64)
    assert result.shape == (1,)
    np.testing.assert_allclose(result.numpy()[0], value(d, t).mean(), rtol=ROUNDING)
    np.testing.assert_allclose(image.grad.numpy(), derivative(d, t) / d.size, rtol=ROUNDING, atol=1e-7 / d.size)


@pytest.mark.parametrize("name", CASES)
def test_no_difference_no_loss_and_no_derivative(name: str) -> None:
    a, _ = images()
    image = wp.array(a, dtype=wp.vec3, requires_grad=True, device="cpu")
    with wp.Tape() as tape:
        result = CASES[name][0](image, a)
    tape.backward(result)
    assert result.numpy()[0] == 0.0
    assert np.all(image.grad.numpy() == 0.0)


def test_warp_and_numpy_targets_agree() -> None:
    a, b = images()
    image = wp.array(a, dtype=wp.vec3, device="cpu")
    from_warp = losses.l2(image, wp.array(b, dtype=wp.vec3, device="cpu")).numpy()
    np.testing.assert_array_equal(from_warp, losses.l2(image, b).numpy())
    np.testing.assert_array_equal(from_warp, losses.l2(image, b.astype(np.float64)).numpy())


def test_the_target_is_a_constant() -> None:
    a, b = (wp.array(x, dtype=wp.vec3, requires_grad=True, device="cpu") for x in images())
    with wp.Tape() as tape:
        result = losses.l2(a, b)
    tape.backward(result)
    assert np.abs(a.grad.numpy()).max() > 0.0
    assert not b.grad.numpy().any()


def test_sum_of_many_terms_keeps_its_digits() -> None:
    # A running float32 sum of this many equal terms is off by far more than one rounding.
    shape, difference = (512, 512), np.float32(0.1)
    image = wp.array(np.full((*shape, 3), difference), dtype=wp.vec3, device="cpu")
    result = losses.l2(image, np.zeros((*shape, 3))).numpy()[0]
    np.testing.assert_allclose(result, float(difference) ** 2, rtol=2e-7)


def test_kernels_before_the_loss_chain() -> None:
    # d/ds mean((s a)^2) = 2 s mean(a^2), through a kernel of the user's own.
    @wp.kernel(module="unique")
    def scale(a: wp.array2d(dtype=wp.vec3), s: wp.array(dtype=wp.float32), out: wp.array2d(dtype=wp.vec3)):
        i, j = wp.tid()
        out[i, j] = s[0] * a[i, j]

    a, _ = images()
    source = wp.array(a, dtype=wp.vec3, device="cpu")
    s = wp.array([1.5], dtype=wp.float32, requires_grad=True, device="cpu")
    image = wp.empty(a.shape[:2], dtype=wp.vec3, requires_grad=True, device="cpu")
    with wp.Tape() as tape:
        wp.launch(scale, dim=a.shape[:2], inputs=[source, s], outputs=[image], device="cpu")
        result = losses.l2(image, np.zeros_like(a))
    tape.backward(result)
    np.testing.assert_allclose(s.grad.numpy()[0], 2 * 1.5 * np.mean(a.astype(np.float64) ** 2), rtol=1e-5)


@pytest.mark.parametrize(
    ("image", "target", "error", "message"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), TypeError, "image: got NumPy array"),
        ("numbers", np.zeros((4, 4)), TypeError, "image: got wp.array of int32"),
        ("scalar", np.zeros((4, 4, 3)), ValueError, r"target: got shape \(4, 4, 3\), expected \(4, 4\)"),
        ("image", np.zeros((4, 5, 3)), ValueError, r"target: got shape \(4, 5, 3\), expected \(4, 4, 3\)"),
        ("image", np.zeros((4, 4, 4)), ValueError, "alpha channel"),
        ("image", "smaller", ValueError, r"target: got shape \(2, 2\)"),
        ("image", "scalar", TypeError, "target: got wp.array of float32"),
        ("image", None, TypeError, "target: got NoneType"),
        ("image", np.zeros((4, 4, 3), np.uint8), TypeError, "uint8.*psdr.read_image, or divide by 255 and linearise"),
        ("image", np.zeros((4, 4, 3), np.uint16), TypeError, "uint16.*divide by 65535"),
    ],
)
def test_what_is_no_image_is_named(image, target, error: type[Exception], message: str) -> None:
    made = {
        "image": lambda: wp.zeros((4, 4), dtype=wp.vec3, device="cpu"),
        "smaller": lambda: wp.zeros((2, 2), dtype=wp.vec3, device="cpu"),
        "scalar": lambda: wp.zeros((4, 4), dtype=wp.float32, device="cpu"),
        "numbers": lambda: wp.zeros((4, 4), dtype=wp.int32, device="cpu"),
    }
    image, target = (made[x]() if isinstance(x, str) else x for x in (image, target))
    with pytest.raises(error, match=message):
        losses.l2(image, target)


@pytest.mark.parametrize("channels", [1, 3])
def test_weights_of_pixels(channels: int) -> None:
    """A weighted mean, of images, and of masks or depths."""
    a, b = images()
    a, b, dtype = (a, b, wp.vec3) if channels == 3 else (a[..., 0], b[..., 0], wp.float32)
    weights = np.random.default_rng(2).random(a.shape[:2]).astype(np.float32)
    weights[:3] = 0.0
    image = wp.array(np.ascontiguousarray(a), dtype=dtype, requires_grad=True, device="cpu")
    with wp.Tape() as tape:
        result = losses.l2(image, np.ascontiguousarray(b), weights=weights)
    tape.backward(result)
    w = weights.astype(np.float64) if channels == 1 else weights.astype(np.float64)[..., None]
    d, total = a.astype(np.float64) - b, weights.sum(dtype=np.float64) * channels
    np.testing.assert_allclose(result.numpy()[0], (w * d * d).sum() / total, rtol=ROUNDING)
    np.testing.assert_allclose(image.grad.numpy(), 2 * w * d / total, rtol=ROUNDING, atol=1e-9)
    assert image.grad.numpy().any() and not image.grad.numpy()[:3].any()


@pytest.mark.parametrize(
    ("weights", "error", "message"),
    [
        (np.ones((4, 5)), ValueError, r"weights: got shape \(4, 5\), expected a number a pixel, \(4, 4\)"),
        (np.ones((4, 4, 3)), ValueError, r"weights: got shape"),
        (np.zeros((4, 4)), ValueError, "some of them positive"),
        (-np.ones((4, 4)), ValueError, "not negative"),
        (np.full((4, 4), np.nan), ValueError, "finite"),
        (np.full((4, 4), "1"), TypeError, "weights: got NumPy array"),
    ],
)
def test_what_are_no_weights_is_named(weights, error: type[Exception], message: str) -> None:
    image = wp.zeros((4, 4), dtype=wp.vec3, device="cpu")
    with pytest.raises(error, match=message):
        losses.l1(image, image, weights=weights)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_thresholds_are_positive(value: float) -> None:
    image = wp.zeros((4, 4), dtype=wp.vec3, device="cpu")
    with pytest.raises(ValueError, match="delta: got"):
        losses.huber(image, image, delta=value)
    with pytest.raises(ValueError, match="epsilon: got"):
        losses.relative_l2(image, image, epsilon=value)


@pytest.mark.parametrize("name", CASES)
def test_what_is_no_number_is_no_loss_either(name: str) -> None:
    a, b = images()
    b[2, 3, 1] = np.nan
    image = wp.array(a, dtype=wp.vec3, device="cpu")
    assert np.isnan(CASES[name][0](image, b).numpy()[0])


def slopes(grid, inverse):
    """Slopes at the middles of voxels, (3, Z - 1, Y - 1, X - 1), along x, y and z."""
    found = []
    for axis in (2, 1, 0):
        along = np.diff(grid, axis=axis)
        for other in {0, 1, 2} - {axis}:
            low, high = (np.take(along, range(o, grid.shape[other] - 1 + o), axis=other) for o in (0, 1))
            along = 0.5 * (low + high)
        found.append(along * inverse[2 - axis])
    return np.stack(found)


def bends(grid, inverse):
    """Sums of second differences at the nodes, the border's values going on."""
    padded = np.pad(grid, 1, mode="edge")
    inner = padded[1:-1, 1:-1, 1:-1]
    return sum(
        (np.roll(padded, 1, axis)[1:-1, 1:-1, 1:-1] + np.roll(padded, -1, axis)[1:-1, 1:-1, 1:-1] - 2.0 * inner)
        * inverse[2 - axis] ** 2
        for axis in range(3)
    )


GRID_LOSSES = {
    "eikonal": (losses.eikonal, lambda g, k: ((np.sqrt((slopes(g, k) ** 2).sum(axis=0)) - 1.0) ** 2).mean()),
    "laplacian": (losses.laplacian, lambda g, k: (bends(g, k) ** 2).mean()),
}


@pytest.mark.parametrize("name", GRID_LOSSES)
def test_regularisers_of_grids_and_their_sum_with_a_loss(name: str, device: str) -> None:
    regulariser, expected = GRID_LOSSES[name]
    lengths, weight = (2.0, 1.5, 1.0), 0.25
    values = np.random.default_rng(2).normal(size=(4, 3, 5)).astype(np.float32)
    inverse = [(n - 1) / x for n, x in zip((5, 3, 4), lengths, strict=True)]
    a, b = images()
    image = wp.array(a, dtype=wp.vec3, requires_grad=True, device=device)
    grid = wp.array(values[..., None], dtype=wp.float32, requires_grad=True, device=device)
    with wp.Tape() as tape:
        part = regulariser(grid, lengths)
        loss = losses.total(losses.l2(image, b), (weight, part))
    tape.backward(loss)
    exact = values.astype(np.float64)
    np.testing.assert_allclose(part.numpy()[0], expected(exact, inverse), rtol=1e-5)
    difference = a.astype(np.float64) - b
    np.testing.assert_allclose(loss.numpy()[0], (difference**2).mean() + weight * part.numpy()[0], rtol=1e-5)
    np.testing.assert_allclose(image.grad.numpy(), 2.0 * difference / difference.size, rtol=1e-5, atol=1e-9)
    found, step = grid.grad.numpy()[..., 0], 1e-6
    for node in [(0, 0, 0), (1, 1, 2), (3, 2, 4), (2, 0, 3)]:
        moved = np.zeros_like(exact)
        moved[node] = step
        slope = (expected(exact + moved, inverse) - expected(exact - moved, inverse)) / (2.0 * step)
        np.testing.assert_allclose(found[node], weight * slope, rtol=2e-4)


def test_grids_of_distances_have_no_eikonal_loss_and_planes_no_laplacian_inside() -> None:
    z, y, x = np.meshgrid(*(np.linspace(0.0, length, 9) for length in (1.0, 2.0, 4.0)), indexing="ij")
    plane = wp.array(((2.0 * x - y + 2.0 * z) / 3.0)[..., None], dtype=wp.float32)
    assert losses.eikonal(plane, (4.0, 2.0, 1.0)).numpy()[0] < 1e-9
    assert losses.eikonal(plane, (1.0, 1.0, 1.0)).numpy()[0] > 1.0  # in other units its slopes are not 1


def test_no_grid_no_regulariser() -> None:
    with pytest.raises(TypeError, match=r"expected wp.array of float32, \(Z, Y, X, 1\)"):
        losses.eikonal(wp.zeros((4, 4, 4, 3)))
    with pytest.raises(ValueError, match="three positive numbers"):
        losses.laplacian(wp.zeros((4, 4, 4)), (1.0, 0.0, 1.0))
    with pytest.raises(TypeError, match=r"terms\[0\]\[1\]: got float"):
        losses.total(wp.zeros(1), (0.1, 0.2))
    with pytest.raises(ValueError, match="finite weight"):
        losses.total(wp.zeros(1), (np.nan, wp.zeros(1)))

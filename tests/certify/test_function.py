"""Certificates of any two functions: a noisy image of known derivatives, right and wrong gradients, bad input."""

import numpy as np
import pytest

import warp_psdr as psdr

SHAPE = (6, 8)
VALUES = {"heights": np.array([0.3, 0.8, 0.5, 0.9]), "gain": 2.0, "unused": 1.0}
#: Seconds: it is decided after a fraction of them.
BUDGET = 20.0
BASIS = np.random.default_rng(1).uniform(0.5, 1.5, (4, *SHAPE, 3))


def noise(seed: int, kind: int) -> np.ndarray:
    return 1.0 + 0.05 * np.random.default_rng((seed, kind)).normal(size=(*SHAPE, 3))


def render(values, seed):
    """gain * sum_i sin(height_i) basis_i, with noise that equal seeds share."""
    total = np.einsum("i,ihwc->hwc", np.sin(values["heights"]), BASIS)
    return float(values["gain"][0]) * total * noise(seed, 0)


def gradient(values, adjoint, seed, factor=1.0):
    weighted = adjoint * noise(seed, 1)
    by_height = np.cos(values["heights"]) * np.einsum("hwc,ihwc->i", weighted, BASIS)
    by_gain = np.einsum("hwc,hwc->", weighted, render({**values, "gain": np.ones(1)}, seed))
    return {"heights": factor * values["gain"] * by_height, "gain": by_gain, "unused": 0.0}


def test_right_gradients() -> None:
    certificate = psdr.certify_function(render, gradient, VALUES, budget=BUDGET)
    assert {name: certificate[name].verdict for name in certificate} == {
        "heights": "within",
        "gain": "within",
        "unused": "not seen",
    }
    assert certificate.ok is None  # a parameter that no pixel depends on is not right


def test_images_without_noise() -> None:
    def exact(values, seed):
        return 1e6 * np.einsum("i,ihwc->hwc", np.sin(values["heights"]), BASIS)

    def of_exact(values, adjoint, seed):
        return {"heights": 1e6 * np.cos(values["heights"]) * np.einsum("hwc,ihwc->i", adjoint, BASIS)}

    heights = {"heights": VALUES["heights"]}
    assert psdr.certify_function(exact, of_exact, heights, budget=BUDGET).ok is True


def test_a_wrong_gradient() -> None:
    def wrong(values, adjoint, seed):
        return gradient(values, adjoint, seed, factor=1.05)

    certificate = psdr.certify_function(render, wrong, VALUES, adjoint=np.ones((*SHAPE, 3)), budget=BUDGET)
    assert certificate.ok is False and certificate["heights"].verdict == "biased"
    assert certificate["gain"].verdict == "within"


def test_values_keep_to_their_range() -> None:
    seen = []

    def watched(values, seed):
        seen.append(values["heights"])
        return render(values, seed)

    bounds = {"heights": (0.3, 0.9)}
    certificate = psdr.certify_function(watched, gradient, VALUES, bounds=bounds, units={"heights": 0.2}, budget=BUDGET)
    assert certificate["heights"].verdict == "within"
    assert np.min(seen) >= 0.3 and np.max(seen) <= 0.9 and np.ptp(seen, axis=0).max() > 0.05


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((render, gradient, {}), "parameters: got none"),
        ((render, gradient, {"gain": np.nan}), "'gain' holds NaN"),
        ((lambda values, seed: np.ones(SHAPE), gradient, VALUES), "render: returned an image of shape"),
        ((render, lambda values, adjoint, seed: {}, VALUES), "gradient: returned none for 'heights'"),
        ((render, lambda values, adjoint, seed: dict.fromkeys(VALUES, 1.0), VALUES), "has shape .*expected"),
        ((render, gradient, VALUES, np.ones((3, 3, 3))), "adjoint: got shape"),
    ],
)
def test_bad_input(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        psdr.certify_function(*arguments)

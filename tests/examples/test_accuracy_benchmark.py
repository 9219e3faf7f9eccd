"""The benchmark of predictions: the error of runs, told from their batches."""

import numpy as np
import pytest

#: Means and deviations of two terms of three components in two blocks, and the batches of each.
MEAN = np.array([[10.0, -5.0, 20.0], [3.0, 4.0, 10.0]])
DEVIATION = np.array([[0.5, 0.2, 1.5], [0.1, 0.6, 0.4]])
BLOCKS, BATCHES = [slice(0, 2), slice(2, 3)], (60, 90)


@pytest.fixture
def predictions(modules):
    return modules("accuracy_predictions")


def test_error_of_runs_is_unbiased_and_knows_its_own(predictions):
    rng = np.random.default_rng(3)
    counts = np.array([[2.0, 4.0], [3.0, 4.0]])
    seen = np.array([True, True])
    per_batch = (1.0 / counts).mean(axis=0)
    total = MEAN.sum(axis=0)
    truth = np.mean([(per_batch @ DEVIATION[:, b] ** 2).sum() / (total[b] @ total[b]) for b in BLOCKS]) ** 0.5
    found = []
    for _ in range(300):
        batches = [list(MEAN[k] + DEVIATION[k] * (rng.exponential(size=(n, 3)) - 1.0)) for k, n in enumerate(BATCHES)]
        found.append(predictions.reached(batches, counts, BLOCKS, seen))
    errors, told = np.array(found).T
    assert abs(errors.mean() - truth) < 4.0 * errors.std(ddof=1) / 300**0.5 + 0.01 * truth  # a root of an estimate
    assert np.sqrt((told**2).mean()) == pytest.approx(errors.std(ddof=1), rel=0.2)
    # A parameter that is lost in noise is not counted.
    only = predictions.reached(batches, counts, BLOCKS, np.array([False, True]))[0]
    assert only == pytest.approx(np.sqrt(per_batch @ DEVIATION[:, 2] ** 2) / 30.0, rel=0.4)


def test_what_is_recorded_is_what_is_run(predictions):
    from warp_psdr.accuracy.quantity import Part, Quantity

    parts = tuple(Part(name, lambda spp, seed, k=k: np.full(3, k + spp + 10.0 * seed)) for k, name in enumerate("ab"))
    what = Quantity(None, None, "reverse", 0, parts, {"x": slice(0, 3)}, None)  # type: ignore[arg-type]
    batches: list[list] = [[], []]
    recorded = predictions.recorded(what, batches)
    for seed in range(2):
        for part, same in zip(recorded.parts, parts, strict=True):
            np.testing.assert_array_equal(part.run(4, seed), same.run(4, seed))
    assert [[x[0] for x in of_term] for of_term in batches] == [[4.0, 14.0], [5.0, 15.0]]

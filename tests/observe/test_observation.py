"""Least squares on what no camera saw: a plane's distance from the time bins of a transient film."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.sensor import timed

FILM = {"temporal_bins": 20, "bin_width_opl": 0.05, "start_opl": 1.8, "pulse_width_opl": 0.05}
DIRECT = psdr.PathIntegrator(max_depth=2, boundary=None)
POSE = "plane.to_world"


def at(height):
    """The plane's pose at a distance from the camera."""
    moved = psdr.Transform.translate((0, 0, -height)) @ psdr.Transform.scale((4, 4, 1))
    return {POSE: moved.matrix}


class Sums(psdr.Observation):
    """An instrument that tells the sums of all pixels, and has an unknown gain."""

    def __init__(self, target):
        super().__init__(target)
        self.unknowns, self.values = ("gain",), {"gain": np.array([1.0])}
        self.linear = target.sum(axis=(0, 1))[None]
        self.weights = np.ones_like(self.linear)

    def residual(self, image):
        return self.values["gain"] * image.sum(axis=(0, 1))[None] - self.linear

    def pushed(self, image, moved):
        return self.values["gain"] * moved.sum(axis=(0, 1))[None]

    def derivatives(self, image):
        return image.sum(axis=(0, 1))[None, None]


@pytest.mark.parametrize(("kind", "gain"), [(psdr.Observation, 1.0), (Sums, 0.8)])
def test_a_distance_comes_back_from_time_bins(kind, gain):
    seen = gain * psdr.render(timed.plane(1.02, **FILM), integrator=DIRECT, spp=1024, seed=9).numpy()
    scene = timed.plane(1.0, **FILM)
    distance = psdr.unknowns.Function(lambda x: at(x[0]), [1.0], ["distance"])
    found = psdr.solve(scene, psdr.traverse(scene), kind(seen), unknowns=[distance], integrator=DIRECT, spp=64)
    assert abs(found.values[0] - 1.02) < 2e-4  # noise of 1024 samples; it started a hundred times that off
    assert abs(found.values[-1] - (1.02 if kind is psdr.Observation else gain)) < 5e-4


def test_what_is_pushed_is_pulled_back():
    rng = np.random.default_rng(4)
    image, moved, target, weights = rng.random((4, 2, 3, 5, 3))
    observed = psdr.Observation(target, weights)
    adjoint = rng.random((2, 15, 3))
    forth = (observed.pushed(image, moved) * adjoint).sum()
    assert forth == pytest.approx((observed.pulled(image, adjoint) * moved).sum(), rel=1e-12)
    with pytest.raises(NotImplementedError, match="give solve method='dense'"):
        Sums(target).pulled(image, adjoint)


def test_weights_of_zero_do_not_count():
    seen = np.full((2, 3, 4, 3), 2.0)
    seen[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="give them the weight 0"):
        psdr.Observation(seen)
    observed = psdr.Observation(seen, np.isfinite(seen) / 0.5)
    assert observed.shape == (2, 3, 4) and observed.weights.shape == (2, 12, 3)
    expected = np.full((2, 12, 3), 2.0)
    expected[0, 0] = 0.0
    np.testing.assert_array_equal(observed.residual(np.full((2, 3, 4, 3), 3.0)), expected)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match="expected \\(H, W, 3\\) or"):
        psdr.Observation(np.ones((4, 4)))
    scene = timed.plane(1.0, **FILM)
    params = psdr.traverse(scene)
    with pytest.raises(ValueError, match="6 x 6 pixels, the film of sensor 0 6 x 6 pixels of 20 bins"):
        psdr.solve(scene, params, np.ones((6, 6, 3)), unknowns=[psdr.unknowns.Entries(POSE)])

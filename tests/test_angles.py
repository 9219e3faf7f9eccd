"""Angles by polynomials against NumPy in float64."""

import numpy as np
import warp as wp

from warp_psdr.kernels.angles import arctan2, circle, sin_quarter

#: Relative errors in float32, rounding included, as the functions promise; the circle's is absolute.
ARCTAN2_ERROR, SINE_ERROR, CIRCLE_ERROR = 4e-7, 3e-7, 3e-7


@wp.kernel(module="unique", enable_backward=False)
def evaluate(
    y: wp.array(dtype=wp.float32),
    x: wp.array(dtype=wp.float32),
    angle_out: wp.array(dtype=wp.float32),
    sine_out: wp.array(dtype=wp.float32),
    circle_out: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    angle_out[i] = arctan2(y[i], x[i])
    sine_out[i] = sin_quarter(x[i])
    circle_out[i] = circle(wp.abs(y[i]))


def results(y, x, device):
    y, x = (np.asarray(a, np.float32) for a in (y, x))
    out = [wp.zeros(len(x), dtype=t, device=device) for t in (wp.float32, wp.float32, wp.vec2)]
    arrays = [wp.array(a, dtype=wp.float32, device=device) for a in (y, x)]
    wp.launch(evaluate, dim=len(x), inputs=arrays, outputs=out, device=device)
    return y.astype(np.float64), x.astype(np.float64), *(a.numpy().astype(np.float64) for a in out)


def test_errors_are_those_promised(device: str) -> None:
    rng = np.random.default_rng(1)
    # All scales of both coordinates: next to the axes, where a pole of an environment map lies, too.
    tiny = 10.0 ** rng.uniform(-12.0, 0.0, (2, 20000)) * rng.choice([-1.0, 1.0], (2, 20000))
    y, x, angle, sine, _circle = results(*np.hstack([tiny, rng.uniform(-1.0, 1.0, (2, 20000))]), device)
    assert np.abs(angle / np.arctan2(y, x) - 1.0).max() < ARCTAN2_ERROR
    assert np.abs(sine / np.sin(0.5 * np.pi * x) - 1.0).max() < SINE_ERROR


def test_circle_goes_round(device: str) -> None:
    turns = np.hstack([np.linspace(0.0, 2.5, 20001), np.arange(0, 11) / 4])
    turns, _x, _angle, _sine, found = results(turns, np.zeros(len(turns)), device)
    expected = np.stack([np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)], 1)
    assert np.abs(found - expected).max() < CIRCLE_ERROR


def test_axes_and_origin(device: str) -> None:
    y, x = [0.0, 0.0, 1.0, -1.0, 0.0], [1.0, -1.0, 0.0, 0.0, 0.0]
    _y, _x, angle, _sine, _circle = results(y, x, device)
    np.testing.assert_allclose(angle, [0.0, np.pi, 0.5 * np.pi, -0.5 * np.pi, 0.0], rtol=1e-7)

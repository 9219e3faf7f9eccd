"""Noise of derivatives by what moves next to a medium: it has a variance."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.media.scenes import BLACK, camera, medium, square, whole

#: Pixels along both sides of the film, each one sample of a batch, and batches.
SIZE, BATCHES = 128, 16


@pytest.mark.slow
def test_a_lamp_that_recedes_in_fog():
    """Points of the medium ride on what is behind them: samples are bounded, and their spread is that of any number.

    With points that rest the standard deviation is 31, 312 and 256 of 2^14, 2^17 and 2^20 samples of such a scene, and
    the largest is 10^5 times the mean. The lamp is so wide that next to no ray passes beside it.
    """
    fog = {**medium(0.8, 0.875), "id": "fog"}
    inside = camera([0, 0, 0.5], [0.01, 0, 0], 60.0, SIZE, up=(0, 1, 0), medium={"type": "ref", "id": "fog"})
    light = {"type": "area", "radiance": 1.0}
    paint = {"type": "diffuse", "reflectance": 0.8}
    lamp = square(1.0, 20.0, BLACK, flipped=True, emitter=light)
    scene = psdr.load_dict(whole(fog=fog, sensor=inside, floor=square(0.0, 20.0, paint), lamp=lamp))
    params = psdr.traverse(scene)
    up = np.zeros((4, 4), np.float32)
    up[2, 3] = 1.0
    options = {"integrator": psdr.PathIntegrator(max_depth=3, rr_depth=100, boundary=None), "spp": 1}
    samples = [
        psdr.render_forward(scene, params, {"lamp.to_world": up}, seed=i, **options).numpy()[..., 0].ravel()
        for i in range(BATCHES)
    ]
    samples = np.concatenate(samples).astype(np.float64)
    whole_spread = samples.std()
    for count in (1 << 12, 1 << 14, 1 << 16):
        assert abs(samples[:count].std() / whole_spread - 1.0) < 0.05, (count, samples[:count].std(), whole_spread)
    assert np.abs(samples).max() < 20.0 * whole_spread
    # Of the largest samples the tail index (Hill) is far above 2, below which there is no variance.
    largest = np.sort(np.abs(samples))[-200:]
    assert 1.0 / np.log(largest[1:] / largest[0]).mean() > 4.0
    assert abs(samples.mean()) > 0.2 * whole_spread

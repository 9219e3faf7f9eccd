"""Guards of samplers at the ends of their ranges: without one a sample is not finite, or drawn with another density."""

import numpy as np
import pytest
import warp as wp
from scipy.special import erfc

from tests.emitter.helpers import envmap, random_map
from warp_psdr.kernels.bsdf.microfacet import BECKMANN_MAX_SLOPE, make_microfacet

#: Of cumulative probabilities.
SHARE_TOLERANCE = 1.0e-3
_NDF, BECKMANN_SMITH, _AREA, BECKMANN_SAMPLE = make_microfacet("beckmann")


@wp.kernel(module="unique", enable_backward=False)
def slopes(w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec2), out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    m = BECKMANN_SAMPLE(w[i], v[i])
    out[i] = wp.vec2(-m[0], -m[1])


@wp.kernel(module="unique", enable_backward=False)
def masking(cotangent: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    r = 1.0 / wp.sqrt(1.0 + cotangent[i] * cotangent[i])
    z = cotangent[i] * r
    out[i] = BECKMANN_SMITH(z, r * r) * z


def test_slopes_that_are_seen_at_all_angles_follow_their_distribution() -> None:
    """Of Beckmann's distribution, with random numbers of all sizes: visible, and as many below as asked for."""
    random, count = np.random.default_rng(2), 1 << 18
    graze = 10.0 ** random.uniform(-7.0, 0.0, count)
    angle = np.where(random.random(count) < 0.5, 0.5 * np.pi - graze, 0.5 * np.pi * random.random(count))
    w = np.float32(np.stack([np.sin(angle), np.zeros(count), np.cos(angle)], axis=1))
    number = random.integers(0, 1 << 24, (count, 2))
    number[: count // 4] = random.integers(0, 100, (count // 4, 2))
    number[count // 4 : count // 2] = (1 << 24) - 1 - random.integers(0, 100, (count // 4, 2))
    v = np.float32(number * 2.0**-24)
    out = wp.zeros(count, dtype=wp.vec2, device="cpu")
    wp.launch(slopes, count, [wp.array(a, dtype=t, device="cpu") for a, t in ((w, wp.vec3), (v, wp.vec2))], [out])
    x, y = out.numpy().T.astype(np.float64)
    r, _zero, z = w.T.astype(np.float64)
    assert np.isfinite(x).all() and np.isfinite(y).all()
    assert (z - x * r > -1e-6).all() and np.abs(x).max() <= 1.0001 * BECKMANN_MAX_SLOPE

    def below(s: np.ndarray) -> np.ndarray:
        return 0.5 * z * erfc(-s) + 0.5 / np.sqrt(np.pi) * r * np.exp(-s * s)

    seen = below(np.minimum(z / np.maximum(r, 1e-30), BECKMANN_MAX_SLOPE))
    # Absorbs Newton's steps that the slope's few digits at grazing angles cut short.
    assert np.abs(below(x) / seen - (1.0 - v[:, 0])).max() < SHARE_TOLERANCE


def test_a_surface_masks_no_more_than_itself() -> None:
    """Where the fit of Beckmann's masking begins, its published coefficients reach 6e-5 above one."""
    cotangent = wp.array(np.linspace(1.5, 1.7, 1 << 12, dtype=np.float32), device="cpu")
    out = wp.zeros(cotangent.shape[0], dtype=wp.float32, device="cpu")
    wp.launch(masking, cotangent.shape[0], [cotangent], [out], device="cpu")
    shown = out.numpy()
    # Absorbs roundings.
    assert shown.max() < 1.0 + 1e-6 and (np.diff(shown) > -1e-6).all()


def stripes(height: int) -> np.ndarray:
    """Return a map of which every other row is black, the poles among them, and the others are suns."""
    data = np.zeros((height, 3, 3), np.float32)
    data[1:-1:2] = 4e4
    return data


@pytest.mark.parametrize("height", [3, 5, 101, 513, 2049])
def test_a_map_has_no_negative_radiance(height: int) -> None:
    """At the borders of its cells, where positions within them are off by a rounding of the row's number."""
    light = envmap(stripes(height), rotation=np.eye(3))
    marginal = light.scene.env_marginal.numpy()[:height]
    starts = np.concatenate([marginal[:-1], marginal[1:] - np.float32(2.0**-24)])
    u = np.stack([np.tile(np.float32([0.0, 0.3, 0.99999994]), len(starts)), np.repeat(starts, 3)], axis=1)
    drawn = light.sample(np.zeros((len(u), 3)), u)
    assert (drawn.radiance >= 0.0).all() and (drawn.pdf > 0.0).all()
    poles, pdf = light.evaluate([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    # Absorbs half a turn less its rounding.
    assert (poles >= 0.0).all() and (poles < 1e-6 * height * 4e4).all() and (pdf > 0.0).all()


def test_a_map_is_the_same_on_all_sides_of_a_pole() -> None:
    data = random_map()
    data[[0, -1]] = data[[0, -1], :1]
    light = envmap(data, rotation=np.eye(3))
    turns = 2.0 * np.pi * np.arange(64) / 64.0
    around = np.stack([np.cos(turns), 0.0 * turns, np.sin(turns)], axis=1)
    for y, row in ((1.0, 0), (-1.0, -1)):
        seen, pdf = light.evaluate(np.float32([[0.0, y, 0.0], *(1e-5 * around + [0.0, y, 0.0])]))
        np.testing.assert_allclose(seen, np.broadcast_to(1.5 * data[row, 0], seen.shape), rtol=1e-3)
        # Each cell has a share of its own.
        assert np.abs(pdf[1:] / pdf[0] - 1.0).min() < 1e-3


def test_the_last_numbers_draw_a_direction_of_a_map() -> None:
    """The largest random number, which rounds up to the end of the last row of cells: the lower pole."""
    light = envmap(random_map(6, 1024), rotation=np.eye(3))
    u = np.stack([np.linspace(0.0, 0.99999994, 1 << 16), np.full(1 << 16, 0.99999994)], axis=1)
    drawn = light.sample(np.zeros((len(u), 3)), u)
    assert np.isfinite(drawn.wi).all() and np.abs(np.linalg.norm(drawn.wi, axis=1) - 1.0).max() < 1e-6


def test_texels_below_zero_have_no_density() -> None:
    """As steps of an optimisation leave them: the sphere's area from its samples, none of which is out of place."""
    data = random_map()
    light = envmap(data, rotation=np.eye(3))
    values = light.values.copy()
    part = values[light.where["radiance"]]
    part[np.random.default_rng(3).random(len(part)) < 0.5] *= -3.0
    u = (np.random.default_rng(4).permutation(1 << 16)[:, None] + 0.5) / (1 << 16)
    drawn = light.sample(
        np.zeros((1 << 16, 3)), np.concatenate([u, np.random.default_rng(5).random((1 << 16, 1))], 1), values
    )
    assert np.isfinite(drawn.wi).all() and (drawn.pdf > 0.0).all()
    area = (1.0 / drawn.pdf).astype(np.float64)
    assert abs(area.mean() - 4.0 * np.pi) < 4.5 * area.std() / 256.0

"""Guards of samplers at the ends of their ranges: without one a sample is not finite, or drawn with another density."""

import numpy as np
import warp as wp
from scipy.special import erfc

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

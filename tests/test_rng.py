"""The counter-based samplers: range, stratification, independence of everything that a path keeps apart."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp
from scipy import stats

from warp_psdr.kernels import rng
from warp_psdr.kernels.rng import Sampler, make_sampler, mix_seed

KINDS = ("independent", "sobol")
#: Significance of one statistical test; a few hundred of them are made in the suite, with fixed seeds.
SIGNIFICANCE = 1e-5


@functools.cache
def draw_kernel(kind: str, count: int):
    functions = make_sampler(kind)
    draw = {1: functions.sample_1d, 2: functions.sample_2d, 4: functions.sample_4d}[count]

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(
        pixels: wp.array(dtype=wp.uint32),
        indices: wp.array(dtype=wp.uint32),
        slots: wp.array(dtype=wp.int32),
        seed: wp.uint32,
        out: wp.array2d(dtype=wp.float32),
    ):
        i = wp.tid()
        s = Sampler()
        s.pixel = pixels[i]
        s.index = indices[i]
        s.seed = seed
        v = draw(s, slots[i])
        if wp.static(count == 1):
            out[i, 0] = v
        else:
            for k in range(wp.static(count)):
                out[i, k] = v[k]

    return kernel


def draw(kind, pixel, index, slot, seed=17, count=4, device="cpu"):
    """Numbers of shape (..., count) for broadcast pixels, indices and slots."""
    pixel, index, slot = np.broadcast_arrays(pixel, index, slot)
    out = wp.zeros((pixel.size, count), dtype=wp.float32, device=device)
    inputs = [
        wp.array(pixel.ravel(), dtype=wp.uint32, device=device),
        wp.array(index.ravel(), dtype=wp.uint32, device=device),
        wp.array(slot.ravel(), dtype=wp.int32, device=device),
        wp.uint32(seed),
    ]
    wp.launch(draw_kernel(kind, count), dim=pixel.size, inputs=inputs, outputs=[out], device=device)
    return out.numpy().reshape(*pixel.shape, count)


def assert_uniform(cells, bins):
    """Chi-square test of cell numbers in [0, bins) against equal probabilities."""
    observed = np.bincount(cells.ravel(), minlength=bins)
    assert observed.size == bins
    assert stats.chisquare(observed).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 4])
def test_numbers_are_uniform_multiples_of_the_unit_in_the_unit_interval(kind, count, device):
    v = draw(kind, np.arange(4096)[:, None], np.arange(16), 3, count=count, device=device)
    assert v.min() >= 0.0
    assert v.max() < 1.0
    np.testing.assert_array_equal(v * 2.0**24, np.round(v * 2.0**24))
    # One sample per pixel: over pixels even the stratified numbers are independent.
    for k in range(count):
        assert_uniform((v[:, 0, k] * 64).astype(int), 64)


@pytest.mark.parametrize("kind", KINDS)
def test_calls_of_fewer_numbers_agree_with_the_leading_numbers_of_larger_ones(kind):
    args = np.arange(64)[:, None], np.arange(8), 2
    np.testing.assert_array_equal(draw(kind, *args, count=1), draw(kind, *args)[..., :1])
    np.testing.assert_array_equal(draw(kind, *args, count=2), draw(kind, *args)[..., :2])


@pytest.mark.parametrize("pixel", [0, 1, 77, 2**31 + 5])
@pytest.mark.parametrize("pair", [0, 1])
@pytest.mark.parametrize("block", [0, 3])
def test_sobol_points_of_a_pixel_are_a_net(pixel, pair, block):
    # (0, m, 2)-net in base 2: every elementary interval of area 2^-m holds exactly one of 2^m points, and so does
    # every aligned block of indices.
    m = 8
    v = draw("sobol", pixel, block * 2**m + np.arange(2**m), 5)[:, 2 * pair : 2 * pair + 2]
    for split in range(m + 1):
        columns = (v[:, 0] * 2**split).astype(int)
        rows = (v[:, 1] * 2 ** (m - split)).astype(int)
        assert len(set(zip(columns, rows, strict=True))) == 2**m


def test_independent_points_are_not_a_net():
    # The net test above can fail.
    v = draw("independent", 0, np.arange(256), 5)
    assert len(set(zip((v[:, 0] * 16).astype(int), (v[:, 1] * 16).astype(int), strict=True))) < 250


@wp.kernel(enable_backward=False)
def sobol_kernel(index: wp.array(dtype=wp.uint32), out: wp.array2d(dtype=wp.uint32)):
    i = wp.tid()
    out[i, 0] = rng.reverse_bits(index[i])
    out[i, 1] = rng.reverse_bits(rng.sobol_reversed(index[i]))


def test_sobol_coordinates_equal_their_generator_matrices():
    index = np.concatenate([np.arange(64), np.random.default_rng(0).integers(0, 2**32, 256)]).astype(np.uint32)
    out = wp.zeros((index.size, 2), dtype=wp.uint32, device="cpu")
    wp.launch(sobol_kernel, dim=index.size, inputs=[wp.array(index, device="cpu")], outputs=[out], device="cpu")
    bits = (index[:, None] >> np.arange(32, dtype=np.uint32)) & 1
    # Pascal's triangle modulo 2, column b: C(b, a), first row the most significant bit.
    pascal = np.zeros((32, 32), np.uint32)
    pascal[0] = 1
    for b in range(1, 32):
        pascal[1:, b] = (pascal[1:, b - 1] + pascal[:-1, b - 1]) % 2
    weights = 1 << np.arange(31, -1, -1, dtype=np.uint64)
    np.testing.assert_array_equal(out.numpy()[:, 0], (bits * weights).sum(axis=1))
    np.testing.assert_array_equal(out.numpy()[:, 1], ((bits @ pascal.T % 2) * weights).sum(axis=1))


def smooth(v):
    """A smooth integrand over four numbers, and its integral."""
    return np.exp(-v[..., 0] * v[..., 1]) + np.cos(v[..., 2]) * (1.0 + v[..., 3] ** 2)


def smooth_integral():
    t = (np.arange(2000) + 0.5) / 2000
    return np.mean((1.0 - np.exp(-t)) / t) + np.sin(1.0) * 4.0 / 3.0


@pytest.mark.parametrize(("spp", "gain"), [(16, 3.0), (256, 10.0)])
def test_sobol_beats_independent_on_a_smooth_integrand_and_both_are_unbiased(spp, gain):
    errors = {}
    for kind in KINDS:
        estimate = smooth(draw(kind, np.arange(1000)[:, None], np.arange(spp), 1)).mean(axis=1)
        deviation = estimate - smooth_integral()
        # 5 standard errors of the mean over pixels.
        assert abs(deviation.mean()) < 5.0 * deviation.std() / np.sqrt(len(deviation))
        errors[kind] = np.sqrt(np.mean(deviation**2))
    assert errors["sobol"] * gain < errors["independent"]


#: Two places of the counter space that a path takes for independent: (pixel, index, slot, number, seed) of each, where
#: i counts pixels (with one sample each, or the first of many).
NEIGHBOURS = {
    "slots": (lambda i: (i, 0, 4, 0, 1), lambda i: (i, 0, 5, 0, 1)),
    "distant slots": (lambda i: (i, 0, 0, 0, 1), lambda i: (i, 0, 16, 0, 1)),
    "slots beyond the stratified ones": (lambda i: (i, 0, 40, 0, 1), lambda i: (i, 0, 1000, 0, 1)),
    "numbers": (lambda i: (i, 0, 4, 0, 1), lambda i: (i, 0, 4, 1, 1)),
    "numbers of one pair": (lambda i: (i, 0, 4, 2, 1), lambda i: (i, 0, 4, 3, 1)),
    "pairs, first number": (lambda i: (i, 0, 4, 0, 1), lambda i: (i, 0, 4, 2, 1)),
    "pairs, second number": (lambda i: (i, 0, 4, 1, 1), lambda i: (i, 0, 4, 3, 1)),
    "pixels": (lambda i: (2 * i, 0, 4, 0, 1), lambda i: (2 * i + 1, 0, 4, 0, 1)),
    "pixel rows": (lambda i: (i, 0, 4, 0, 1), lambda i: (i + 2**17, 0, 4, 0, 1)),
    "seeds": (lambda i: (i, 0, 4, 0, 1), lambda i: (i, 0, 4, 0, 2)),
    "streams": (lambda i: (i, 0, 4, 0, mix_seed(0, 0)), lambda i: (i, 0, 4, 0, mix_seed(0, 1))),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NEIGHBOURS)
def test_neighbours_are_independent(kind, name):
    i = np.arange(2**16)

    def numbers(place):
        pixel, index, slot, number, seed = place(i)
        return draw(kind, pixel, index, slot, seed=seed)[:, number]

    a, b = (numbers(place) for place in NEIGHBOURS[name])
    assert_uniform((a * 32).astype(int) * 32 + (b * 32).astype(int), 1024)


@pytest.mark.parametrize("other", [(0, 2), (1, 0), (5, 1)])
def test_padded_pairs_of_one_pixel_are_matched_at_random(other):
    # The points of one pixel in the plane (first number of slot 0, number k of slot s).
    slot, number = other
    pixels, spp = 256, 256
    a = draw("sobol", np.arange(pixels)[:, None], np.arange(spp), 0)[..., 0]
    b = draw("sobol", np.arange(pixels)[:, None], np.arange(spp), slot)[..., number]
    correlation = np.array([np.corrcoef(x, y)[0, 1] for x, y in zip(a, b, strict=True)])
    deviation = correlation.std() * np.sqrt(spp)
    assert abs(correlation.mean()) < 5.0 * deviation / np.sqrt(spp * pixels)
    # Independent pairs would have 1. A shuffled index keeps neighbours 2 i, 2 i + 1 together, whose leading digits are
    # opposite in every number, so products of leading digits count half as often: up to sqrt(2). In a shared order all
    # correlations would be alike (0) or, for the same number, 1 (16).
    assert 0.8 < deviation < np.sqrt(2.0) * 1.1


@wp.kernel(enable_backward=False)
def hash_kernel(words: wp.array2d(dtype=wp.uint32), out: wp.array2d(dtype=wp.uint32)):
    i = wp.tid()
    h = rng.pcg4d(words[i, 0], words[i, 1], words[i, 2], words[i, 3])
    out[i, 0] = h.x
    out[i, 1] = h.y
    out[i, 2] = h.z
    out[i, 3] = h.w


def hashed(words):
    out = wp.zeros(words.shape, dtype=wp.uint32, device="cpu")
    inputs = [wp.array(words.astype(np.uint32), device="cpu")]
    wp.launch(hash_kernel, dim=len(words), inputs=inputs, outputs=[out], device="cpu")
    return out.numpy()


def test_hash_avalanche():
    # Counters use the low bits: flipping any of the lowest 20 of any word flips every one of the 24 bits that make
    # a number with probability 1/2.
    words = np.random.default_rng(1).integers(0, 2**20, (4096, 4))
    before = hashed(words)
    for word, bit in itertools.product(range(4), range(20)):
        flipped = words.copy()
        flipped[:, word] ^= 1 << bit
        changed = before ^ hashed(flipped)
        rates = ((changed[:, :, None] >> np.arange(8, 32, dtype=np.uint32)) & 1).mean(axis=0)
        # 6 standard deviations of a rate over 4096 trials.
        assert np.abs(rates - 0.5).max() < 6.0 * 0.5 / np.sqrt(4096), (word, bit)


def test_seeds_of_streams_are_distinct_words():
    seeds = {(seed, stream): mix_seed(seed, stream) for seed in range(100) for stream in range(100)}
    assert all(0 <= value < 2**32 for value in seeds.values())
    # Ten thousand random words of 32 bits have 0.01 coincidences on average.
    assert len(set(seeds.values())) >= len(seeds) - 1
    assert mix_seed(2**40, 0) != mix_seed(0, 0)
    assert 0 <= mix_seed(-1, 0) < 2**32


def test_unknown_sampler_is_named():
    with pytest.raises(ValueError, match=r"'halton'.*'independent' or 'sobol'"):
        make_sampler("halton")

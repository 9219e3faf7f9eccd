"""Random numbers: counter-based and stateless, so that a replay can jump to any bounce of any path.

A number is a pure function of (pixel, sample index, seed, slot). A *slot* is a plain counter: every call uses one, and
a path numbers its slots ``base + bounce * STRIDE + k`` without bound. All numbers are multiples of 2^-24 in [0, 1).

Papers: M. Jarzynski, M. Olano, "Hash Functions for GPU Rendering", JCGT 9(3), 2020 (``pcg4d``); B. Burley, "Practical
Hash-based Owen Scrambling", JCGT 9(4), 2020 (padded pairs, shuffled indices); S. Laine, T. Karras, "Stratified Sampling
for Stochastic Transparency", EGSR 2011 (the scrambling permutation, with the constants that N. Vegdahl tuned in 2021).
"""

import functools
from typing import NamedTuple

import warp as wp

#: 2^-24, the spacing of the numbers: each is exact in float32 and the largest is still below one.
UNIT = wp.constant(5.9604644775390625e-08)
#: Slots from this one on are independent also for "sobol", at a third of the time. With the camera in slot 0 and two
#: slots a vertex, the variance of a Cornell box and of a sunlit sphere at 4, 16 and 64 samples stops falling at slot 5;
#: the rest is room for a mirror or a pane in front.
SOBOL_SLOTS = wp.constant(7)
#: Constants of the generator and the two salts that tell the second pair of a slot from the first.
PCG_FACTOR = wp.constant(wp.uint32(1664525))
PCG_INCREMENT = wp.constant(wp.uint32(1013904223))
SALT_X = wp.constant(wp.uint32(0x9E3779B9))
SALT_Y = wp.constant(wp.uint32(0x85EBCA6B))


@wp.struct
class Sampler:
    """Names one sample of one pixel; ``seed`` comes from `mix_seed`."""

    pixel: wp.uint32
    index: wp.uint32  # number of the sample within the pixel, 0, 1, 2, ...
    seed: wp.uint32


@wp.func
def sampler_at(pixel: wp.int32, index: wp.int32, seed: wp.uint32) -> Sampler:
    """The numbers of a sample of a pixel, or of whatever else ``pixel`` numbers."""
    s = Sampler()
    s.pixel = wp.uint32(pixel)
    s.index = wp.uint32(index)
    s.seed = seed
    return s


@wp.func
def branch_of(sampler: Sampler, index: wp.int32) -> Sampler:
    """Numbers of another path of the same pixel and seed."""
    s = Sampler()
    s.pixel = sampler.pixel
    s.index = wp.uint32(index)
    s.seed = sampler.seed
    return s


@wp.func
def salted(s: Sampler, salt: wp.uint32, number: wp.int32) -> Sampler:
    """Other numbers of the same sample, which a salt and a number tell from all that it has."""
    r = Sampler()
    r.pixel = s.pixel
    r.index = s.index
    r.seed = pcg4d(s.seed, salt, wp.uint32(number), wp.uint32(0)).x
    return r


class SamplerFunctions(NamedTuple):
    """Device functions ``f(sampler, slot)`` that return 1, 2 or 4 numbers in [0, 1)."""

    sample_1d: wp.Function
    sample_2d: wp.Function
    sample_4d: wp.Function


def mix_seed(seed: int, stream: int) -> int:
    """Return the uint32 seed of an independent ``stream`` (primal, interior, boundary, ...) of a user's ``seed``.

    Both are hashed with all their bits (SplitMix64, a bijection of 64 bits), so streams of neighbouring seeds never
    coincide by construction of the inputs, for example (1, 0) with (0, 1).
    """
    mask = (1 << 64) - 1
    state = 0
    for word in (seed & mask, stream & mask):
        state = (state ^ word) + 0x9E3779B97F4A7C15 & mask
        state = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9 & mask
        state = (state ^ (state >> 27)) * 0x94D049BB133111EB & mask
        state ^= state >> 31
    return state >> 32


@wp.struct
class Words:
    """Four hashed 32-bit words."""

    x: wp.uint32
    y: wp.uint32
    z: wp.uint32
    w: wp.uint32


@wp.func
def pcg4d(a: wp.uint32, b: wp.uint32, c: wp.uint32, d: wp.uint32) -> Words:
    """Hash four words into four words [Jarzynski and Olano 2020, listing 8]."""
    x = a * PCG_FACTOR + PCG_INCREMENT
    y = b * PCG_FACTOR + PCG_INCREMENT
    z = c * PCG_FACTOR + PCG_INCREMENT
    w = d * PCG_FACTOR + PCG_INCREMENT
    x += y * w
    y += z * x
    z += x * y
    w += y * z
    x = x ^ (x >> wp.uint32(16))
    y = y ^ (y >> wp.uint32(16))
    z = z ^ (z >> wp.uint32(16))
    w = w ^ (w >> wp.uint32(16))
    x += y * w
    y += z * x
    z += x * y
    w += y * z
    out = Words()
    out.x = x
    out.y = y
    out.z = z
    out.w = w
    return out


@wp.func
def unit_float(bits: wp.uint32) -> wp.float32:
    """Map the 24 leading bits to [0, 1)."""
    return wp.float32(bits >> wp.uint32(8)) * UNIT


@wp.func
def hashed(s: Sampler, slot: wp.int32) -> Words:
    """Four independent words of one slot of one sample."""
    return pcg4d(s.pixel, s.index, wp.uint32(slot), s.seed)


@wp.func
def independent_1d(s: Sampler, slot: wp.int32) -> wp.float32:
    """One independent number."""
    return unit_float(hashed(s, slot).x)


@wp.func
def independent_2d(s: Sampler, slot: wp.int32) -> wp.vec2:
    """Two independent numbers."""
    h = hashed(s, slot)
    return wp.vec2(unit_float(h.x), unit_float(h.y))


@wp.func
def independent_4d(s: Sampler, slot: wp.int32) -> wp.vec4:
    """Four independent numbers."""
    h = hashed(s, slot)
    return wp.vec4(unit_float(h.x), unit_float(h.y), unit_float(h.z), unit_float(h.w))


@wp.func
def reverse_bits(v: wp.uint32) -> wp.uint32:
    """Mirror the 32 bits of a word."""
    x = ((v >> wp.uint32(1)) & wp.uint32(0x55555555)) | ((v & wp.uint32(0x55555555)) << wp.uint32(1))
    x = ((x >> wp.uint32(2)) & wp.uint32(0x33333333)) | ((x & wp.uint32(0x33333333)) << wp.uint32(2))
    x = ((x >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F)) | ((x & wp.uint32(0x0F0F0F0F)) << wp.uint32(4))
    x = ((x >> wp.uint32(8)) & wp.uint32(0x00FF00FF)) | ((x & wp.uint32(0x00FF00FF)) << wp.uint32(8))
    return (x >> wp.uint32(16)) | (x << wp.uint32(16))


@wp.func
def scramble_reversed(v: wp.uint32, seed: wp.uint32) -> wp.uint32:
    """Owen-scramble a number given with its bits reversed: each bit is flipped depending on the lower ones only."""
    x = v ^ (v * wp.uint32(0x3D20ADEA))
    x += seed
    x *= (seed >> wp.uint32(16)) | wp.uint32(1)
    x = x ^ (x * wp.uint32(0x05526C56))
    return x ^ (x * wp.uint32(0x53A22864))


@wp.func
def sobol_reversed(index: wp.uint32) -> wp.uint32:
    """Second Sobol coordinate of ``index``, bits reversed.

    Its generator matrix is Pascal's triangle modulo 2, and C(b, a) is odd exactly when the bits of a are among those
    of b (Lucas). So output bit a is the parity of all index bits b that contain a: a sum over supersets, five steps.
    """
    x = index ^ ((index >> wp.uint32(1)) & wp.uint32(0x55555555))
    x = x ^ ((x >> wp.uint32(2)) & wp.uint32(0x33333333))
    x = x ^ ((x >> wp.uint32(4)) & wp.uint32(0x0F0F0F0F))
    x = x ^ ((x >> wp.uint32(8)) & wp.uint32(0x00FF00FF))
    return x ^ (x >> wp.uint32(16))


@wp.func
def sobol_pair(index_reversed: wp.uint32, shuffle: wp.uint32, seed_x: wp.uint32, seed_y: wp.uint32) -> wp.vec2:
    """Shuffle the index, take its Sobol point and scramble both coordinates [Burley 2020, section 3]."""
    index = reverse_bits(scramble_reversed(index_reversed, shuffle))
    # The first coordinate is the index with its bits reversed, so its reversal is the index itself.
    x = reverse_bits(scramble_reversed(index, seed_x))
    y = reverse_bits(scramble_reversed(sobol_reversed(index), seed_y))
    return wp.vec2(unit_float(x), unit_float(y))


@wp.func
def sobol_1d(s: Sampler, slot: wp.int32) -> wp.float32:
    """One number, stratified over the samples of a pixel."""
    if slot >= SOBOL_SLOTS:
        return independent_1d(s, slot)
    h = pcg4d(s.pixel, SALT_X, wp.uint32(slot), s.seed)
    index = reverse_bits(scramble_reversed(reverse_bits(s.index), h.x))
    return unit_float(reverse_bits(scramble_reversed(index, h.y)))


@wp.func
def sobol_2d(s: Sampler, slot: wp.int32) -> wp.vec2:
    """Two numbers: over the samples of a pixel a scrambled (0, 2)-sequence."""
    if slot >= SOBOL_SLOTS:
        return independent_2d(s, slot)
    h = pcg4d(s.pixel, SALT_X, wp.uint32(slot), s.seed)
    return sobol_pair(reverse_bits(s.index), h.x, h.y, h.z)


@wp.func
def sobol_4d(s: Sampler, slot: wp.int32) -> wp.vec4:
    """Four numbers: two independently shuffled (0, 2)-sequences."""
    if slot >= SOBOL_SLOTS:
        return independent_4d(s, slot)
    h = pcg4d(s.pixel, SALT_X, wp.uint32(slot), s.seed)
    index = reverse_bits(s.index)
    a = sobol_pair(index, h.x, h.y, h.z)
    b = sobol_pair(index, h.w, h.y * SALT_X + SALT_Y, h.z * SALT_Y + SALT_X)
    return wp.vec4(a[0], a[1], b[0], b[1])


@functools.cache
def make_sampler(kind: str) -> SamplerFunctions:
    """Return the functions of sampler ``kind``: "independent" or "sobol"."""
    if kind == "independent":
        return SamplerFunctions(independent_1d, independent_2d, independent_4d)
    if kind == "sobol":
        return SamplerFunctions(sobol_1d, sobol_2d, sobol_4d)
    raise ValueError(f"unknown sampler {kind!r}; expected 'independent' or 'sobol'")

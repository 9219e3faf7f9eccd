"""Numbers: very many samples, very many random numbers, and functions without a derivative at an end of their range."""

import functools
import math
import warnings

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from warp_psdr.kernels.math import safe_normalize, safe_sqrt
from warp_psdr.kernels.rng import SOBOL_SLOTS, Sampler, make_sampler, pcg4d

from .record import Case, parameters

#: Samples of a pixel, no power of two: a float32 sum of as many equal terms is off by 0.1 % and more.
MANY = 4_000_003
RADIANCE = 0.1


@functools.cache
def sky(rfilter: str):
    """Return one pixel that sees nothing but a constant sky."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": rfilter}}
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "film": film},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [RADIANCE] * 3}},
        }
    )


def naive_sum(term: float, count: int) -> float:
    """Return what one float32 accumulator makes of equal terms."""
    return float(np.cumsum(np.full(count, term, np.float32), dtype=np.float32)[-1])


def mean_of_many(rfilter: str, spp: int) -> float:
    assert abs(naive_sum(RADIANCE / MANY, MANY) / RADIANCE - 1.0) > 1e-3, "the naive sum is no worse here"
    image = psdr.render(sky(rfilter), spp=spp, integrator=psdr.PathIntegrator(max_depth=1)).numpy()
    return float(np.abs(image.astype(np.float64) / np.float32(RADIANCE) - 1.0).max())


def gradient_of_many(mode: str, spp: int) -> float:
    scene = sky("box")
    params = psdr.traverse(scene)
    name, integrator = "sky.radiance.value", psdr.PathIntegrator(max_depth=1)
    if mode == "reverse":
        params.requires_grad(name)
        params.zero_grad()
        psdr.render_backward(scene, params, np.ones((1, 1, 3)), integrator=integrator, spp=spp)
        derivative = params[name].grad.numpy()
    else:
        derivative = psdr.render_forward(scene, params, {name: 1.0}, integrator=integrator, spp=spp).numpy()
    return float(np.abs(derivative.astype(np.float64) - 1.0).max())


def reverse_against_forward() -> float:
    """Relative difference of the two modes over the same 1e6 samples: forward mode sums in double precision."""
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7] * 3}}
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    look = psdr.Transform.look_at([0.1, 0.2, 3.0], [0.0, 0.0, 0.0], [0, 1, 0])
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 10.0, "to_world": look, "film": film},
            "floor": {"type": "rectangle", "bsdf": white},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [RADIANCE] * 3}},
        }
    )
    params = psdr.traverse(scene)
    name = "floor.bsdf.reflectance.value"
    options = {"integrator": psdr.PathIntegrator(max_depth=2, sampler="independent"), "spp": 1_000_003}
    params.requires_grad(name)
    psdr.render_backward(scene, params, np.ones((1, 1, 3)), **options)
    forward = psdr.render_forward(scene, params, {name: 1.0}, **options).numpy()[0, 0].astype(np.float64)
    return float(np.abs(params[name].grad.numpy() / forward - 1.0).max())


# --- random numbers ---


@wp.kernel(module="unique", enable_backward=False)
def hash_words(words: wp.array2d(dtype=wp.uint32), hashed_out: wp.array2d(dtype=wp.uint32)):
    i = wp.tid()
    h = pcg4d(words[i, 0], words[i, 1], words[i, 2], words[i, 3])
    hashed_out[i, 0] = h.x
    hashed_out[i, 1] = h.y
    hashed_out[i, 2] = h.z
    hashed_out[i, 3] = h.w


def unhash(words: np.ndarray) -> np.ndarray:
    """Undo pcg4d [Jarzynski and Olano 2020] step by step: it is a bijection of 128 bits."""
    x, y, z, w = (words[:, i].copy() for i in range(4))
    for last in (True, False):
        w -= y * z
        z -= x * y
        y -= z * x
        x -= y * w
        if last:
            x, y, z, w = (v ^ (v >> np.uint32(16)) for v in (x, y, z, w))
    inverse = np.uint32(pow(1664525, -1, 1 << 32))
    return np.stack([(v - np.uint32(1013904223)) * inverse for v in (x, y, z, w)], axis=1)


def streams_overlap() -> float:
    """Share of (pixel, sample, slot, seed) that the numbers do not give back, up to 2^40 samples of an image."""
    random = np.random.default_rng(1)
    # 2^20 pixels of 2^20 samples, then all the numbers that there are.
    words = random.integers(0, [1 << 20, 1 << 20, 1 << 8, 1 << 32], (1 << 16, 4), dtype=np.uint64).astype(np.uint32)
    words = np.concatenate([words, random.integers(0, 1 << 32, (1 << 16, 4), dtype=np.uint64).astype(np.uint32)])
    out = wp.empty(words.shape, dtype=wp.uint32, device="cpu")
    wp.launch(hash_words, len(words), [wp.array(words, dtype=wp.uint32, device="cpu")], [out], device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the arithmetic is modulo 2^32
        return float((unhash(out.numpy()) != words).any(axis=1).mean())


@functools.cache
def make_pairs(kind: str) -> wp.Kernel:
    sample_2d = make_sampler(kind).sample_2d

    @wp.kernel(module="unique", enable_backward=False)
    def pairs(first: wp.uint32, slot: wp.int32, out: wp.array(dtype=wp.vec2)):
        i = wp.tid()
        s = Sampler()
        s.pixel = wp.uint32(7)
        s.index = first + wp.uint32(i)
        s.seed = wp.uint32(11)
        out[i] = sample_2d(s, slot)

    return pairs


def beyond_the_dimensions() -> float:
    """Largest |z|, over its limit, of the mean products of numbers of slots around the end of the Sobol dimensions."""
    n, slots = 1 << 14, range(int(SOBOL_SLOTS) - 2, int(SOBOL_SLOTS) + 3)
    worst = 0.0
    for first in (0, (1 << 31) - (n >> 1), (1 << 32) - n):
        columns = []
        for slot in slots:
            out = wp.empty(n, dtype=wp.vec2, device="cpu")
            wp.launch(make_pairs("sobol"), n, [wp.uint32(first), slot], [out], device="cpu")
            columns.append(out.numpy().astype(np.float64))
        u = np.concatenate(columns, axis=1)
        assert (u >= 0.0).all() and (u < 1.0).all()
        z = np.corrcoef(u.T)[np.triu_indices(u.shape[1], 1)] * math.sqrt(n)
        worst = max(worst, float(np.abs(z).max()), float(np.abs((u.mean(axis=0) - 0.5) * math.sqrt(12 * n)).max()))
    return worst / float(stats.norm.isf(0.5e-3 / (3 * 55)))


# --- functions that have no derivative at an end ---


@wp.func
def normalize_dot(v: wp.vec3) -> wp.float32:
    return wp.dot(safe_normalize(v), wp.vec3(0.3, 0.8, -0.5))


@wp.kernel(module="unique", enable_backward=False)
def ends(x: wp.array(dtype=wp.float32), out: wp.array2d(dtype=wp.float32)):
    i = wp.tid()
    v = wp.vec3(0.6 * x[i], 0.0, 0.8 * x[i])
    out[i, 0] = safe_sqrt(x[i])
    out[i, 1] = wp.grad(safe_sqrt)(x[i])
    out[i, 2] = wp.dot(wp.grad(normalize_dot)(v), wp.vec3(0.0, 1.0, 0.0))


def safe_ends() -> float:
    """Error of values and derivatives from 1e-14 to 1e14, relative; infinite if any is not finite down to 0."""
    x = np.concatenate([[0.0, -1.0, 1e-38, -0.0], 10.0 ** np.arange(-14, 15)]).astype(np.float32)
    out = wp.empty((len(x), 3), dtype=wp.float32, device="cpu")
    wp.launch(ends, len(x), [wp.array(x, device="cpu")], [out], device="cpu")
    found, y = out.numpy().astype(np.float64), x[4:].astype(np.float64)
    if not np.isfinite(found).all() or found[:4, 1].any() or found[[0, 2, 3], 2].any():
        return math.inf
    expected = np.stack([np.sqrt(y), 0.5 / np.sqrt(y), 0.8 / y], axis=1)
    return float(np.abs(found[4:] / expected - 1.0).max())


CASES = [
    Case(
        family="numbers",
        name="mean of 4e6 samples, box filter",
        hard="a sum of many small terms",
        naive="a float32 sum loses 1 % of it, and stands still at 2^24 terms",
        bound=1.2e-7,
        measure=lambda: mean_of_many("box", MANY),
    ),
    Case(
        family="numbers",
        name="mean of 4e6 samples, gaussian filter",
        hard="weighted sums of many small terms, and of their weights",
        naive="as above; both sums stand still, so the ratio hides it until a bright sample comes last",
        bound=4e-6,
        measure=lambda: mean_of_many("gaussian", MANY),
        slow=True,
    ),
    Case(
        family="numbers",
        name="mean of 25e6 samples",
        hard="more samples of a pixel than float32 can count",
        naive="the sum stands still",
        bound=0.0,
        measure=lambda: mean_of_many("box", 25_000_001),
        slow=True,
    ),
    Case(
        family="numbers",
        name="gradient of 1e6 samples, reverse against forward",
        slow=True,
        hard="one parameter collects all samples of all pixels",
        naive="a single float32 buffer: 1e-5",
        bound=1e-6,
        measure=reverse_against_forward,
    ),
    Case(
        family="numbers",
        name="gradient of 4e6 equal samples, reverse",
        hard="every addition is rounded in the same direction",
        naive="a single float32 buffer loses 1 %",
        bound=3e-7,
        measure=lambda: gradient_of_many("reverse", MANY),
        slow=True,
    ),
    Case(
        family="numbers",
        name="gradient of 4e6 samples, forward",
        hard="a sum of many small terms",
        naive="a float32 sum loses 1 %",
        bound=1e-7,
        measure=lambda: gradient_of_many("forward", MANY),
    ),
    Case(
        family="numbers",
        name="random streams up to 2^40 samples",
        hard="(pixel, sample, slot, seed) must never give the numbers of another",
        naive="a 32-bit product pixel * spp wraps around and repeats streams",
        bound=0.0,
        measure=streams_overlap,
    ),
    Case(
        family="numbers",
        name="Sobol beyond its dimensions",
        hard="long paths ask for more dimensions than there are, and indices reach 2^32",
        naive="dimensions repeat, so that numbers of one path are correlated",
        bound=1.0,
        quantile=True,
        measure=beyond_the_dimensions,
    ),
    Case(
        family="numbers",
        name="safe roots from 0 to 1e14",
        hard="derivatives at 0",
        naive="0 * inf = NaN in the adjoint",
        bound=2e-7,
        measure=safe_ends,
    ),
]


@pytest.mark.slow_rows("gradient of 4e6 samples, forward")
@pytest.mark.parametrize("case", parameters(CASES))
def test_numbers(case, check) -> None:
    check(case)


def test_more_samples_than_there_are_numbers_are_refused() -> None:
    with pytest.raises(ValueError, match="2147483647"):
        psdr.render(sky("box"), spp=1 << 31)

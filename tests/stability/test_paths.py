"""Paths: many bounces, in closed form. All rooms are closed and shine evenly, so what arrives is a geometric series.

In a box whose surface emits e and reflects the share rho, paths of N vertices bring e (1 + rho + ... + rho^(N-1)).
With a mirror as surface no random number is used, so that the series is met to rounding.
"""

import functools
import math

import numpy as np
import pytest

import warp_psdr as psdr

from .record import Case, parameters

SIZE = 6  # pixels
NAMES = {"conductor": "room.bsdf.specular_reflectance.value", "diffuse": "room.bsdf.reflectance.value"}
EMISSION = "room.emitter.radiance.value"
NO_ROULETTE = 1 << 20
#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3, and the largest relative standard error with
#: which a comparison still says something.
Z_LIMIT, LARGEST_NOISE = 5.4, 0.03


def series(rho: float, n: int) -> tuple[float, float]:
    """Return 1 + rho + ... + rho^(n-1) and its derivative by rho."""
    k = np.arange(n)
    return float((rho**k).sum()), float((k[1:] * rho ** (k[1:] - 1.0)).sum())


@functools.cache
def room(kind: str, rho: float):
    """Return the scene of a shining box seen from inside; flat, for interpolated normals do not keep the energy."""
    value = {"type": "rgb", "value": [rho] * 3}
    bsdf = {"type": "conductor", "material": "none", "specular_reflectance": value}
    if kind == "diffuse":
        bsdf = {"type": "diffuse", "reflectance": value}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = psdr.Transform.look_at([0.15, 0.1, -0.1], [1.0, 0.3, 0.2], [0, 1, 0])
    return psdr.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60.0, "to_world": look, "film": film},
            "room": {
                "type": "cube",
                "flip_normals": True,
                "bsdf": bsdf,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0] * 3}},
            },
        }
    )


def integrator(depth: int, *, rr: int = NO_ROULETTE, block: int = 8) -> psdr.PathIntegrator:
    interior = psdr.interior.Replay(block=block) if block else psdr.interior.Textbook()
    return psdr.PathIntegrator(max_depth=depth, rr_depth=rr, boundary=None, interior=interior)


def gradients(scene, kind: str, options: dict) -> tuple[np.ndarray, float, float]:
    """Return the image, and the derivatives of its mean by reflectance and emission, in reverse mode."""
    image = psdr.render(scene, **options).numpy().astype(np.float64)
    params = psdr.traverse(scene)
    params.requires_grad(NAMES[kind], EMISSION)
    params.zero_grad()
    psdr.render_backward(scene, params, np.full((SIZE, SIZE, 3), 1.0 / (3 * SIZE**2)), **options)
    found = [float(params[name].grad.numpy().astype(np.float64).sum()) for name in (NAMES[kind], EMISSION)]
    return image, found[0], found[1]


def relative(kind: str, rho: float, depth: int, spp: int, **options) -> float:
    """Worst relative error of the pixels and of the two derivatives of their mean."""
    scene = room(kind, rho)
    image, by_rho, by_emission = gradients(scene, kind, {"integrator": integrator(depth, **options), "spp": spp})
    total, derivative = series(float(np.float32(rho)), depth)
    errors = [np.abs(image / total - 1.0).max(), abs(by_emission / total - 1.0)]
    errors.append(abs(by_rho / derivative - 1.0))
    return float(np.max(errors))


def mirrors() -> float:
    return max(relative("conductor", rho, 20, 2) for rho in (0.0, 1e-3, 0.5, 0.999, 1.0))


def z_share(rho: float, rr: int, spp: int) -> float:
    """Largest |z| of image and derivatives against the series, over its limit at 1e-3; infinite if noise hides all."""
    scene, kind, batches = room("diffuse", rho), "diffuse", 8
    total, derivative = series(float(np.float32(rho)), 64)
    found = []
    for seed in range(batches):
        options = {"integrator": integrator(64, rr=rr), "spp": spp, "seed": seed}
        image, by_rho, by_emission = gradients(scene, kind, options)
        found.append((image.mean() / total - 1.0, by_rho / derivative - 1.0, by_emission / total - 1.0))
    errors = np.array(found)
    sigma = errors.std(axis=0, ddof=1) / math.sqrt(batches)
    if sigma.max() > LARGEST_NOISE:
        return math.inf
    return float((np.abs(errors.mean(axis=0)) / sigma).max()) / Z_LIMIT


def replay() -> float:
    """Largest difference, relative, that the block of the replay makes after 64 bounces: all draw the same paths."""
    scene, kind = room("diffuse", 0.999), "diffuse"
    found = [gradients(scene, kind, {"integrator": integrator(64, block=block), "spp": 2})[1:] for block in (5, 8, 64)]
    return float(np.abs(np.array(found[1:]) / np.array(found[0]) - 1.0).max())


CASES = [
    Case(
        family="paths",
        name="20 mirrors, reflectance 0 to 1",
        hard="a chain of 20 delta lobes; a throughput of exactly 0",
        naive="textbook replay divides by the reflectance: no derivative at 0",
        bound=4e-6,
        measure=mirrors,
    ),
    Case(
        family="paths",
        name="64 bounces, albedo 0.999 (|z| over its limit)",
        hard="products of 64 factors, and a derivative that is the sum of 2,000 terms",
        naive="L - (what was met) loses the digits of what remains",
        bound=1.0,
        quantile=True,
        measure=lambda: z_share(0.999, NO_ROULETTE, 32),
        slow=True,
    ),
    Case(
        family="paths",
        name="Russian roulette (|z| over its limit)",
        hard="the weights of paths that go on",
        naive="forgets to divide the derivative by the survival probability",
        bound=1.0,
        quantile=True,
        measure=lambda: z_share(0.5, 2, 64),
        slow=True,
    ),
    Case(
        family="paths",
        name="replay of 64 bounces in blocks of 5, 8 and 64",
        hard="the same path must be drawn twice, 64 vertices deep",
        naive="a state that is off by one random number or one bit is another path",
        bound=0.0,
        measure=replay,
        slow=True,
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", parameters(CASES))
def test_paths(case, check) -> None:
    check(case)

"""Rotations of kernels of directions, a biased method: against a twin in float64, and how far they are off."""

import functools

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import Case, assert_transposes, derivatives, differences, rows, slope
from .scenes import camera, diffuse, load, mesh, register, room
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, PANEL, RECEIVER, SHAPE, moved, scaled
from .test_warped_area import REFUSED, assert_refused

METHOD = psdr.boundary.Rotation()
FRESH = psdr.boundary.Rotation(fresh=True)
#: Half sizes and middles of a light and an occluder over a point of a floor, all of them horizontal.
LIGHT, LIGHT_HALF = np.array([0.1, -0.05, 2.0]), np.array([0.5, 0.4])
PLATE, PLATE_HALF = np.array([0.25, 0.1, 1.0]), np.array([0.25, 0.2])
#: Name -> (what moves, its velocity at a point y seen from its middle).
MOTIONS = {
    "plate moves": (OCCLUDER, lambda y: np.array([1.0, 0.0, 0.0]) + 0.0 * y),
    "plate grows": (OCCLUDER, lambda y: y),
    "light moves": (PANEL, lambda y: np.array([1.0, 0.0, 0.0]) + 0.0 * y),
    "light grows": (PANEL, lambda y: y),
}
#: Bounds of the derivative over what it should be, recorded: the bias is the method's.
TOY_RANGES = {
    "plate moves": (0.8, 1.3),
    "plate grows": (0.5, 0.9),
    "light moves": (0.7, 1.3),
    "light grows": (0.5, 0.9),
}


def plates() -> dict:
    """A point of a floor, in two by two pixels, beneath a light that a black plate hides in part."""

    def plate(middle, half, bsdf, **more) -> dict:
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0] + middle
        return mesh(corners, [[0, 2, 1], [0, 3, 2]], bsdf, **more)

    film = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": "tent"}, "sample_border": True}
    shine = {"type": "area", "radiance": {"type": "rgb", "value": [np.pi] * 3}}
    return {
        "sensor": {**camera((0.0, -0.2, 0.2), (0.0, 0.0, 0.0), fov=0.5), "film": film},
        "floor": plate(np.zeros(3), (2.0, 2.0), {"type": "twosided", "bsdf": diffuse(1.0)}),
        "occluder": plate(PLATE, PLATE_HALF, diffuse(0.0)),
        "light": plate(LIGHT, LIGHT_HALF, diffuse(0.0), emitter=shine),
    }


register({"rotated plates": plates, "rotated room": lambda: room(height=0.3)})


def irradiance(name: str, moved_by: float) -> float:
    """Integral of cos^2 / r^2 over the part of the light that the plate does not hide, by Gauss's rule."""
    what, velocity = MOTIONS[name]
    nodes, weights = np.polynomial.legendre.leggauss(40)

    def sides(middle, half, moves: bool) -> np.ndarray:
        ends = np.array([-half, half])
        return middle[:2] + ends + (moved_by * velocity(np.c_[ends, np.zeros(2)])[:, :2] if moves else 0.0)

    def over(low, high) -> float:
        x, y = (0.5 * (high + low)[i] + 0.5 * (high - low)[i] * nodes for i in range(2))
        r2 = x[:, None] ** 2 + y[None, :] ** 2 + LIGHT[2] ** 2
        return float((np.outer(weights, weights) * LIGHT[2] ** 2 / r2**2).sum() * np.prod(high - low) / 4.0)

    light = sides(LIGHT, LIGHT_HALF, what == PANEL)
    shadow = LIGHT[2] / PLATE[2] * sides(PLATE, PLATE_HALF, what == OCCLUDER)
    return over(*light) - over(np.maximum(light[0], shadow[0]), np.minimum(light[1], shadow[1]))


def exact(name: str) -> float:
    return (irradiance(name, 1e-4) - irradiance(name, -1e-4)) / 2e-4


def about(axis: np.ndarray, kappa: float, random: np.random.Generator) -> np.ndarray:
    """Directions of a von Mises-Fisher kernel."""
    versine = -np.log(1.0 - random.random(len(axis))) / kappa
    angle = 2.0 * np.pi * random.random(len(axis))
    s = np.cross(axis, [1.0, 0.0, 0.0])
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    around = np.cos(angle)[:, None] * s + np.sin(angle)[:, None] * np.cross(axis, s)
    return np.sqrt(versine * (2.0 - versine))[:, None] * around + (1.0 - versine)[:, None] * axis


@functools.cache
def twin(fresh: bool, kappa: float = 1000.0, rays: int = 4, samples: int = 1 << 19) -> dict:
    """The estimator as [LHJ19] draws it: kernels first, two rays of each. Name -> (mean, standard error)."""
    random = np.random.default_rng(1)

    def look(d: np.ndarray) -> np.ndarray:
        """0: nothing, 1: the light, 2: the plate, which hides it."""
        found = np.zeros(len(d), np.int8)
        for kind, middle, half in ((1, LIGHT, LIGHT_HALF), (2, PLATE, PLATE_HALF)):
            beside = np.abs(middle[2] / d[:, 2:] * d[:, :2] - middle[:2])
            found[(beside <= half).all(axis=1)] = kind
        return found

    half = LIGHT_HALF + 10.0 / np.sqrt(kappa)  # kernels reach beyond the light
    y = LIGHT + np.c_[half * random.uniform(-1.0, 1.0, (samples, 2)), np.zeros(samples)]
    mu = y / np.linalg.norm(y, axis=1, keepdims=True)
    over_density = 4.0 * half.prod() * mu[:, 2] / (y**2).sum(axis=1)
    drawn = [about(mu, kappa, random) for _ in range(rays)]
    first = kind = look(drawn[0])
    d = drawn[0]
    for other in drawn[1:]:
        met = look(other)
        hides = (kind == first) & (met > first)  # decided by the first ray that meets something else
        first = np.where((kind == first) & (met < first), -1, first)
        d, kind = np.where(hides[:, None], other, d), np.where(hides, met, kind)
    pair = [about(mu, kappa, random) for _ in range(2)] if fresh else drawn[:2]
    lit = [look(w) == 1 for w in pair]
    result = {}
    for name, (what, velocity) in MOTIONS.items():
        middle = PLATE if what == OCCLUDER else LIGHT
        t = middle[2] / d[:, 2:]
        v = np.where((kind == (2 if what == OCCLUDER else 1))[:, None], velocity(t * d - middle), 0.0)
        turn = np.cross(d, v) / t
        motion = [np.cross(turn, w) for w in pair]
        x = np.zeros(samples)
        for i in range(2):
            divergence = kappa * ((motion[i] - motion[1 - i]) * mu).sum(axis=1)
            x += 0.5 * np.where(lit[i], motion[i][:, 2] + pair[i][:, 2] * divergence, 0.0) * over_density
        result[name] = (x.mean(), x.std() / np.sqrt(samples))
    return result


def gradients(method, spp: int) -> dict:
    """Derivatives of the mean of the image by every motion, batch by batch."""
    scene, params = load("rotated plates")
    how = psdr.PathIntegrator(max_depth=2, boundary=method)
    found: dict[str, list[float]] = {name: [] for name in MOTIONS}
    params.requires_grad_only(OCCLUDER, PANEL)
    for seed in range(8):
        params.zero_grad()
        psdr.render_backward(scene, params, np.full((2, 2, 3), 1.0 / 12.0), integrator=how, spp=spp, seed=seed)
        for name, (what, velocity) in MOTIONS.items():
            y = params[what].numpy().astype(np.float64) - (PLATE if what == OCCLUDER else LIGHT)
            found[name].append((params[what].grad.numpy().astype(np.float64) * velocity(y)).sum())
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize(
    "method",
    [
        METHOD,
        pytest.param(FRESH, marks=pytest.mark.slow),
        pytest.param(psdr.boundary.Rotation(pairs=False, fresh=True), marks=pytest.mark.slow),
        pytest.param(psdr.boundary.Rotation(kappa=200.0, rays=8), marks=pytest.mark.slow),
    ],
    ids=lambda m: f"kappa {m.kappa:g}, rays {m.rays}, pairs {m.pairs}, fresh {m.fresh}",
)
def test_is_the_biased_estimator_of_the_paper(method) -> None:
    """z-test against the twin; with ``fresh``, mirrored kernels and the paper's pairs have one mean."""
    found = gradients(method, 4096)
    for name, (mean, error) in twin(method.fresh, method.kappa, method.rays).items():
        own = found[name].std(ddof=1) / np.sqrt(8.0)
        assert np.hypot(own, error) < 0.1 * abs(exact(name)), "too noisy to tell"
        assert abs(found[name].mean() - mean) < 4.0 * np.hypot(own, error), name
        if method == METHOD:
            low, high = TOY_RANGES[name]
            assert low < found[name].mean() / exact(name) < high, name


#: Bounds of the slope, recorded.
CASES = {
    Case("soft", PANEL, scaled, 0.04, "light scales", spp=128): (0.6, 0.75),
    Case("soft", OCCLUDER, moved(0.0, 0.0, 1.0), 0.01, "occluder rises", spp=128, difference_spp=8192): (0.95, 1.15),
    Case("soft", OCCLUDER, scaled, 0.01, "occluder grows", spp=128, difference_spp=8192): (0.8, 0.95),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, RECEIVER, spp=128, difference_spp=8192): (0.9, 0.98),
    Case("split", SHAPE, ALONG, 0.01, "moves", spp=128, difference_spp=4096): (0.7, 1.0),
    Case("silhouette box", SHAPE, ALONG, 0.01, "moves", spp=128, difference_spp=4096): (0.7, 0.9),
    Case("rotated room", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=128, difference_spp=8192): (
        0.85,
        1.05,
    ),
}


@pytest.mark.parametrize("case", rows(CASES))
def test_bias_against_finite_differences(case: Case) -> None:
    """The slope lies in the recorded range, which excludes zero; where it excludes one, the bias shows."""
    value, error = slope(derivatives(case, "reverse", METHOD), differences(case)[2])
    low, high = CASES[case]
    print(f"slope {value:.3f} +- {error:.3f}")
    assert error < 0.1, "too noisy to tell"
    assert low - 2.0 * error < value < high + 2.0 * error, f"slope {value:.3f} +- {error:.3f}"


@pytest.mark.slow
def test_forward_and_reverse_mode_are_transposes() -> None:
    scene, params = load("soft")
    options = {"integrator": psdr.PathIntegrator(max_depth=2, boundary=METHOD), "spp": 4, "seed": 3}
    assert_transposes(scene, params, [OCCLUDER, PANEL, "floor.bsdf.reflectance.value"], options)


def test_the_plan_says_that_it_is_biased() -> None:
    scene, _params = load("soft")
    said = str(psdr.plan(scene, names=[OCCLUDER], integrator=psdr.PathIntegrator(max_depth=2, boundary=METHOD)))
    assert "biased by design" in said and "4 auxiliary rays for each of two kernels" in said


@pytest.mark.parametrize("what", [name for name in REFUSED if not name.startswith("own paths")])
def test_what_is_refused(what: str) -> None:
    assert_refused(what, METHOD)


@pytest.mark.parametrize(
    "options",
    [
        {"rays": 1},
        {"rays": 4.0},
        {"kappa": 1.0},
        {"film_sigma": 0.0},
        {"pairs": 1},
        {"fresh": None},
        {"spp_secondary": 4},
    ],
    ids=str,
)
def test_options_out_of_range(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        psdr.boundary.Rotation(**options)

"""Vector-Jacobian products of the scattering models against central differences of the float64 twin.

Directions are differentiated along the tangents of the sphere: how a formula continues off it is nobody's business.
"""

import numpy as np
import pytest

from tests.bsdf.helpers import (
    ALL_MODELS,
    GOLD,
    MATERIAL,
    MIRROR,
    ROUGH,
    Launcher,
    direction,
    material,
    random_directions,
    rough,
    twin_eval,
    twin_scatter,
    unit,
)
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import (
    BSDF_CONDUCTOR,
    BSDF_DIELECTRIC,
    BSDF_DIFFUSE,
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
)

WEIGHT = np.array([0.7, -0.4, 1.1])
DIRECTION_WEIGHT = np.array([0.3, 0.8, -0.5])
#: Error relative to the largest partial derivative of its group: float32 arithmetic, and the differences' own error.
TOLERANCE = 1e-3
#: Step of the differences over the scale on which the function changes: errors of 1e-8 (curvature) and 1e-7 (rounding).
STEP = 1e-4
NORMAL = np.array([0.0, 0.0, 1.0])
LOSSLESS = ((1.5, 1.3, 2.0), (0.0, 0.0, 0.0))
BLACK = (0.0, 0.0, 0.0)


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


def near_mirror(wi: np.ndarray, alpha: float) -> np.ndarray:
    """The direction whose half vector has the slope (0.5, 0.3) alpha."""
    h = np.array([0.5 * alpha, 0.3 * alpha, 1.0])
    h /= np.linalg.norm(h)
    return 2.0 * np.dot(wi, h) * h - wi


def rounded(x) -> np.ndarray:
    """What the device sees of a float64 value."""
    return np.asarray(x, np.float32).astype(float)


def rounded_material(mat: np.void) -> np.void:
    out = np.zeros((), dtype=MATERIAL)
    for name in MATERIAL.names:
        out[name] = rounded(mat[name])
    return out[()]


def tangents(w: np.ndarray) -> list[np.ndarray]:
    a = np.cross(w, [0.0, 1.0, 0.0] if abs(w[1]) < 0.9 else [1.0, 0.0, 0.0])
    a /= np.linalg.norm(a)
    return [a, np.cross(w, a)]


def difference(f, step: float) -> float:
    return (f(step) - f(-step)) / (2.0 * step)


def moved(mat: np.void, name: str, channel: int | None, by: float) -> np.void:
    out = np.array(mat.item(), dtype=MATERIAL)
    if channel is None:
        out[name] += by
    else:
        out[name][channel] += by
    return out[()]


def check(f, mat: np.void, wi: np.ndarray, wo: np.ndarray | None, adjoint: np.void, scale: float) -> None:
    """Compare ``adjoint`` with the differences of ``f(mat, wi, wo)``, which changes over the length ``scale``."""
    groups = {}
    for name in MATERIAL.names:
        channels = [None] if MATERIAL[name].shape == () else [0, 1, 2]
        step = STEP * (min(scale, float(mat[name])) if channels == [None] and mat[name] > 0.0 else 1.0)
        expected = [difference(lambda h, n=name, c=c: f(moved(mat, n, c, h), wi, wo), step) for c in channels]
        groups[name] = np.atleast_1d(adjoint["material"][name]), np.array(expected)
    for name, w in (("wi", wi), ("wo", wo)):
        if w is not None:
            move = {"wi": lambda d: f(mat, wi + d, wo), "wo": lambda d: f(mat, wi, wo + d)}[name]
            expected = [difference(lambda h, t=t, g=move: g(h * t), STEP * scale) for t in tangents(w)]
            groups[name] = np.array(tangents(w)) @ adjoint[name], np.array(expected)
    for name, (actual, expected) in groups.items():
        size = np.abs(expected).max()
        value = abs(f(mat, wi, wo))
        # Where the derivative vanishes, float32 leaves rounding of the size of the value over its scale.
        slack = TOLERANCE * size + 2e-6 * value / scale + 1e-7
        np.testing.assert_allclose(actual, expected, rtol=0.0, atol=slack, err_msg=name)


# --- smooth models ---

GREY = material((0.2, 0.5, 0.8))
SMOOTH_CASES = [
    pytest.param(BSDF_DIFFUSE, GREY, direction(40.0), direction(70.0, 200.0), id="diffuse"),
    pytest.param(BSDF_DIFFUSE, material(BLACK), direction(40.0), direction(70.0, 200.0), id="diffuse-black"),
    pytest.param(BSDF_DIFFUSE, GREY, NORMAL, direction(89.99), id="diffuse-grazing"),
]
for _model, _name in zip(ROUGH, ("ggx", "beckmann"), strict=True):
    _oblique, _away = direction(40.0), direction(55.0, 190.0)
    SMOOTH_CASES += [
        pytest.param(_model, rough(*_alpha, metal=_metal), _wi, _wo, id=f"{_name}-{_id}")
        for _id, _alpha, _metal, _wi, _wo in [
            ("gold", (0.3, 0.2), GOLD, _oblique, _away),
            ("alpha=1", (1.0, 1.0), GOLD, _oblique, direction(70.0, 0.0)),
            ("masked", (0.9, 0.7), GOLD, direction(75.0), direction(80.0, 100.0)),
            ("alpha=1e-2", (1e-2, 1e-2), GOLD, _oblique, near_mirror(_oblique, 1e-2)),
            ("alpha=2e-4", (2e-4, 3e-4), GOLD, _oblique, near_mirror(_oblique, 2e-4)),
            ("alpha=2e-5", (2e-5, 3e-5), GOLD, _oblique, near_mirror(_oblique, 2e-5)),
            ("normal", (0.3, 0.2), GOLD, NORMAL, NORMAL),
            ("normal-in", (0.3, 0.2), GOLD, NORMAL, direction(30.0)),
            ("normal-in-smooth", (1e-2, 1e-2), GOLD, NORMAL, near_mirror(NORMAL, 1e-2)),
            ("grazing-in", (0.3, 0.2), GOLD, direction(89.9), _away),
            ("grazing-out", (0.3, 0.2), GOLD, _oblique, direction(89.9, 190.0)),
            ("grazing-both", (0.3, 0.2), GOLD, direction(89.0), direction(88.0, 200.0)),
            ("mirror", (0.3, 0.2), MIRROR, _oblique, _away),
            ("mirror-grazing", (0.3, 0.2), MIRROR, direction(89.9), direction(89.8, 209.9)),
            ("lossless", (0.3, 0.2), LOSSLESS, _oblique, _away),
        ]
    ]
    SMOOTH_CASES.append(pytest.param(_model, rough(0.3, 0.2, reflectance=BLACK), _oblique, _away, id=f"{_name}-black"))


@pytest.mark.parametrize(("model", "mat", "wi", "wo"), SMOOTH_CASES)
def test_eval_vjp(bsdf: Launcher, model: int, mat: np.void, wi: np.ndarray, wo: np.ndarray) -> None:
    mat, wi, wo, w = rounded_material(mat), rounded(wi), rounded(wo), rounded(WEIGHT)
    scale = min(wi[2], wo[2], 1.0 if model == BSDF_DIFFUSE else mat["s0"])

    def f(mat, wi, wo):
        return np.dot(w, twin_eval(model, mat, unit(wi), unit(wo)))

    assert mat["c0"].max() == 0.0 or abs(f(mat, wi, wo)) > 0.0
    check(f, mat, wi, wo, bsdf.eval_vjp(model, mat, wi, wo, w)[0], scale)


def test_a_black_surface_has_the_reflectance_derivative_of_a_white_one(bsdf: Launcher) -> None:
    wi, wo = direction(40.0), direction(55.0, 190.0)
    for model in (BSDF_DIFFUSE, *ROUGH):
        black, white = (bsdf.eval_vjp(model, rough(0.3, reflectance=c), wi, wo, WEIGHT)[0] for c in (BLACK, (1, 1, 1)))
        assert np.all(black["material"]["c0"] != 0.0)
        np.testing.assert_array_equal(black["material"]["c0"], white["material"]["c0"])


@pytest.mark.parametrize("model", ROUGH)
def test_the_floor_of_the_roughness_has_no_derivative(bsdf: Launcher, model: int) -> None:
    wi = direction(40.0)
    wo = rounded(near_mirror(wi, MIN_ALPHA))
    below = bsdf.eval_vjp(model, rough(1e-6), wi, wo, WEIGHT)[0]["material"]
    assert below["s0"] == below["s1"] == 0.0
    value, _ = bsdf.eval_pdf(model, rough(1e-6), wi, wo)
    at_floor, _ = bsdf.eval_pdf(model, rough(MIN_ALPHA), wi, wo)
    assert np.all(value > 0.0)
    np.testing.assert_array_equal(value, at_floor)


# --- delta models ---

CRITICAL = np.degrees(np.arcsin(1.0 / 1.5))
GLASS = material((0.9, 0.5, 0.1), (0.2, 0.4, 0.6), s0=1.5)
BELOW = np.array([1.0, 1.0, -1.0])


def glass(eta: float) -> np.void:
    return material((0.9, 0.5, 0.1), (0.2, 0.4, 0.6), s0=eta)


DELTA_CASES = [
    pytest.param(model, mat, wi, lobe, id=f"{name}-{'reflected' if lobe == LOBE_DELTA_REFLECTION else 'transmitted'}")
    for name, model, mat, wi, lobes in [
        ("gold", BSDF_CONDUCTOR, rough(0.0), direction(50.0), 1),
        ("gold-normal", BSDF_CONDUCTOR, rough(0.0), NORMAL, 1),
        ("gold-grazing", BSDF_CONDUCTOR, rough(0.0), direction(89.9), 1),
        ("gold-black", BSDF_CONDUCTOR, rough(0.0, reflectance=BLACK), direction(50.0), 1),
        ("mirror", BSDF_CONDUCTOR, rough(0.0, metal=MIRROR), direction(50.0), 1),
        ("mirror-normal", BSDF_CONDUCTOR, rough(0.0, metal=MIRROR), NORMAL, 1),
        ("lossless", BSDF_CONDUCTOR, rough(0.0, metal=LOSSLESS), direction(50.0), 1),
        ("glass", BSDF_DIELECTRIC, GLASS, direction(50.0), 2),
        ("glass-normal", BSDF_DIELECTRIC, GLASS, NORMAL, 2),
        ("glass-grazing", BSDF_DIELECTRIC, GLASS, direction(89.5), 2),
        ("glass-inside", BSDF_DIELECTRIC, GLASS, direction(30.0) * BELOW, 2),
        ("glass-inside-normal", BSDF_DIELECTRIC, GLASS, -NORMAL, 2),
        ("glass-below-critical", BSDF_DIELECTRIC, GLASS, direction(CRITICAL - 0.5) * BELOW, 2),
        ("glass-total", BSDF_DIELECTRIC, GLASS, direction(CRITICAL + 0.5) * BELOW, 1),
        ("bubble", BSDF_DIELECTRIC, glass(0.7), direction(30.0), 2),
        ("matched", BSDF_DIELECTRIC, glass(1.0), direction(50.0), 2),
        ("nearly-matched", BSDF_DIELECTRIC, glass(1.001), direction(50.0), 2),
        ("matched-grazing-inside", BSDF_DIELECTRIC, glass(1.0), direction(85.0) * BELOW, 2),
        ("glass-black", BSDF_DIELECTRIC, material(BLACK, BLACK, s0=1.5), direction(50.0), 2),
    ]
    for lobe in (LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION)[:lobes]
]


@pytest.mark.parametrize(("model", "mat", "wi", "lobe"), DELTA_CASES)
def test_scatter_vjp(bsdf: Launcher, model: int, mat: np.void, wi: np.ndarray, lobe: int) -> None:
    mat, wi, w, a_wo = rounded_material(mat), rounded(wi), rounded(WEIGHT), rounded(DIRECTION_WEIGHT)

    def f(mat, wi, _wo):
        direction_out, value = twin_scatter(model, mat, wi, lobe)
        return np.dot(w, value) + np.dot(a_wo, direction_out)

    scale = abs(wi[2])
    if model == BSDF_DIELECTRIC:
        # The refracted cosine vanishes, as a root, at the critical angle.
        eta = mat["s0"] if wi[2] > 0.0 else 1.0 / mat["s0"]
        scale *= min(1.0, abs(eta**2 - 1.0 + wi[2] ** 2))
    adjoint = bsdf.scatter_vjp(model, mat, wi, lobe, w, a_wo)[0]
    assert np.all(adjoint["wo"] == 0.0)
    check(f, mat, wi, None, adjoint, scale)


def test_refraction_depends_on_the_index(bsdf: Launcher) -> None:
    # sin(theta_t) = sin(theta) / eta: at fixed theta, d sin(theta_t) / d eta = -sin(theta) / eta^2.
    wi = direction(50.0, azimuth=0.0)
    a = bsdf.scatter_vjp(BSDF_DIELECTRIC, GLASS, wi, LOBE_DELTA_TRANSMISSION, (0, 0, 0), (1, 0, 0))[0]
    np.testing.assert_allclose(a["material"]["s0"], np.sin(np.radians(50.0)) / 1.5**2, rtol=1e-5)


# --- nothing is infinite anywhere ---


def all_finite(adjoint: np.ndarray) -> bool:
    fields = [adjoint["material"][name] for name in MATERIAL.names] + [adjoint["wi"], adjoint["wo"]]
    return all(np.all(np.isfinite(x)) for x in fields)


EXTREMES = [
    rough(MIN_ALPHA),
    rough(MIN_ALPHA, 1.0),
    rough(1.0, metal=MIRROR),
    rough(0.3, metal=((0.0, 1.0, 1e-4), (0.0, 0.0, 1e-4))),
    rough(0.1, metal=((20.0, 0.0, 1.0), (0.0, 50.0, 0.0)), reflectance=BLACK),
]


def edge_directions() -> np.ndarray:
    rng = np.random.default_rng(0)
    angles = [0.0, 1e-6, 1e-3, 1.0, 45.0, 89.0, 89.99, 89.9999, 89.999999, 90.0]
    rows = [direction(t, p) for t in angles for p in (0.0, 90.0, 180.0, 217.0)]
    # Cosines on both sides of the least one that scatters, down to float32's smallest.
    rows += [(np.cos(p), np.sin(p), c) for c in (5e-7, 1.5e-7, 9e-8, 1e-12, 1e-20, 1e-30, 1e-38) for p in (0.0, 2.0)]
    return np.concatenate([rows, random_directions(rng, 40)])


@pytest.mark.parametrize("mat", EXTREMES, ids=range(len(EXTREMES)))
@pytest.mark.parametrize("model", ALL_MODELS)
def test_derivatives_are_finite_everywhere(bsdf: Launcher, model: int, mat: np.void) -> None:
    w = edge_directions()
    wi, wo = np.repeat(w, len(w), axis=0), np.tile(w, (len(w), 1))
    value, pdf = bsdf.eval_pdf(model, mat, wi, wo)
    assert np.all(np.isfinite(value)) and np.all(value >= 0.0) and np.all(np.isfinite(pdf)) and np.all(pdf >= 0.0)
    assert all_finite(bsdf.eval_vjp(model, mat, wi, wo, WEIGHT))


@pytest.mark.parametrize("eta", [0.5, 0.999999, 1.0, 1.000001, 1.5, 4.0])
def test_delta_derivatives_are_finite_everywhere(bsdf: Launcher, eta: float) -> None:
    w = edge_directions()
    critical = np.degrees(np.arcsin(min(eta, 1.0 / eta))) + np.linspace(-1e-4, 1e-4, 101)
    w = np.concatenate([w, [direction(t) for t in critical]])
    w = np.concatenate([w, w * BELOW])
    for lobe in (LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION):
        s = bsdf.scatter(BSDF_DIELECTRIC, glass(eta), w, lobe)
        assert np.all(np.isfinite(s["value"])) and np.all(s["value"] >= 0.0) and np.all(np.isfinite(s["wo"]))
        assert all_finite(bsdf.scatter_vjp(BSDF_DIELECTRIC, glass(eta), w, lobe, WEIGHT, DIRECTION_WEIGHT))
    for mat in EXTREMES:
        assert all_finite(bsdf.scatter_vjp(BSDF_CONDUCTOR, mat, w, LOBE_DELTA_REFLECTION, WEIGHT, DIRECTION_WEIGHT))

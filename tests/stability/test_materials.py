"""Materials: every scattering model at the ends of its parameters' ranges, value and derivatives, against float64.

A model joins the sweeps by a row of ``SMOOTH``, or of a table of its own where its errors are of another size.
"""

import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest

from tests.bsdf.helpers import (
    BECKMANN,
    EXAMPLES,
    GGX,
    GOLD,
    LOSSLESS,
    MIRROR,
    Launcher,
    all_finite,
    as_seen,
    direction,
    glass,
    index_behind,
    material,
    metal,
    plastic,
    rough,
    rough_glass,
    rough_plastic,
    rounded,
    unit,
)
from tests.bsdf.materials import abc
from tests.bsdf.principled import principled
from tests.bsdf.twins import fresnel_conductor, ggx_g1
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION

from .record import Case, parameters

WEIGHT = np.array([0.7, -0.4, 1.1])
#: Metals: gold, a perfect mirror, a lossless medium.
METALS = (GOLD, MIRROR, LOSSLESS)
ALPHAS = (MIN_ALPHA, 1e-4, 1e-3, 1e-2, 1e-1, 0.3, 1.0)
ANGLES = (0.0, 40.0, 80.0, 89.0, 89.9)


def twin(key: str, mat: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """f_s cos in float64 of directions as the device sees them but for their lengths, which are rounded too."""
    return EXAMPLES[key].eval(mat, unit(wi), unit(wo))


def rough_pairs(alpha: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Directions whose half vectors have slopes up to 2 alpha, as the device sees them."""
    for angle in ANGLES:
        wi = rounded(direction(angle))
        for slope in ((0.0, 0.0), (0.5, 0.3), (-1.5, 1.0)):
            h = np.array([slope[0] * alpha, slope[1] * alpha, 1.0])
            wo = 2.0 * np.dot(wi, h) / np.dot(h, h) * h - wi
            if wo[2] > 1e-3:
                yield wi, rounded(wo)


def diffuse_pairs(_alpha: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    for angle in ANGLES:
        yield rounded(direction(angle)), rounded(direction(89.9 - angle, 200.0))


def shirley(n: float) -> dict:
    return material(reflectance=(0.0, 1.0, 0.5), specular_reflectance=(0.5, 0.0, 1.0), nu=n, nv=0.1 * n)


#: model, the reflectance in which it is linear, materials by a roughness, pairs of directions.
SMOOTH = [
    ("diffuse", "reflectance", lambda a: [material(reflectance=(0.0, 1.0, a))], diffuse_pairs),
    ("orennayar", "reflectance", lambda a: [material(reflectance=(0.0, 1.0, a), sigma=a)], diffuse_pairs),
    (GGX, "specular_reflectance", lambda a: [rough(a, metal=m) for m in METALS], rough_pairs),
    (BECKMANN, "specular_reflectance", lambda a: [rough(a, metal=m) for m in METALS], rough_pairs),
    (GGX, "specular_reflectance", lambda a: [rough(a, min(10.0 * a, 1.0))], rough_pairs),
]
ROUGHLY_COATED = [
    (f"roughplastic ({kind})", "diffuse_reflectance", lambda a, ior=ior: [rough_plastic(ior, a)], pairs)
    for kind, ior in (("ggx", 1.5), ("beckmann nonlinear", 3.0))
    for pairs in (rough_pairs, diffuse_pairs)
]
PRINCIPLED = [
    (key, "base_color", lambda a, more=more: [principled(a**0.5, (0.0, 1.0, 0.5), **more)], pairs)
    for key, more in (
        ("principled", {"clearcoat": 1.0, "clearcoat_gloss": 1.0, "sheen": 1.0, "flatness": 0.5, "metallic": 0.5}),
        ("principled (spec_trans)", {"spec_trans": 0.5, "ior": 0.0, "specular": 0.0}),
    )
    for pairs in (rough_pairs, diffuse_pairs)
]
ABC = [
    (
        "abc",
        "specular_reflectance",
        lambda a: [abc(1.0, min(a**-2, 1e6), c, m) for c in (0.7, 3.0) for m in METALS],
        rough_pairs,
    )
]
PHONG = [
    ("ashikhminshirley", "reflectance", lambda a: [shirley(min(2.0 / a**2, 1e5))], pairs)
    for pairs in (rough_pairs, diffuse_pairs)
]
#: Indices of refraction over the range, and numbers for samples.
INDICES = (1.001, 1.01, 1.5, 3.0)
DRAWN = np.random.default_rng(6).random((32, 3))
COATED = [
    ("plastic", "diffuse_reflectance", lambda a, ior=ior: [plastic(ior, (0.0, 1.0, a))], diffuse_pairs)
    for ior in INDICES
]


def smooth_rows(models: list) -> Iterator[tuple[str, str, dict, np.ndarray, np.ndarray]]:
    for key, linear, materials, pairs in models:
        for alpha in ALPHAS:
            for mat in materials(alpha):
                for wi, wo in pairs(alpha):
                    yield key, linear, as_seen(mat), wi, wo


def smooth_values(models: list) -> float:
    """Worst error of f_s cos, relative; infinite where something is not finite."""
    launcher, worst = Launcher("cpu"), 0.0
    for key, _linear, mat, wi, wo in smooth_rows(models):
        value, pdf = launcher.eval_pdf(key, mat, wi, wo)
        expected = twin(key, mat, wi, wo)
        if not (np.isfinite(value).all() and np.isfinite(pdf).all() and pdf[0] > 0.0):
            return math.inf
        worst = max(worst, float(np.abs(value[0] - expected).max() / np.abs(expected).max()))
    return worst


def smooth_derivatives(models: list) -> float:
    """Worst error of the derivatives by reflectance and roughness, relative to value over parameter."""
    launcher, worst = Launcher("cpu"), 0.0
    for key, linear, mat, wi, wo in smooth_rows(models):
        adjoint = launcher.eval_vjp(key, mat, wi, wo, WEIGHT)[0]
        if not all_finite(adjoint):
            return math.inf
        value = np.abs(WEIGHT) @ np.abs(twin(key, mat, wi, wo)) + 1e-30
        # By the reflectance: linear, so exact also where it is 0.
        for c in range(3):
            expected = WEIGHT[c] * twin(key, mat | {linear: np.eye(3)[c]}, wi, wo)[c]
            worst = max(worst, float(abs(adjoint["material"][linear][c] - expected)) / max(abs(expected), 1e-30))
        # By the roughness: one-sided where the range begins.
        for name in ("alpha_u", "alpha_v"):
            alpha = mat.get(name, 0.0)
            if alpha > 0.0:
                h = 1e-5 * alpha
                first = 0 if alpha < 1.5 * MIN_ALPHA else -1
                f = [WEIGHT @ twin(key, mat | {name: alpha + k * h}, wi, wo) for k in range(first, first + 3)]
                forward = (-1.5 * f[0] + 2.0 * f[1] - 0.5 * f[2]) / h
                expected = forward if first == 0 else (f[2] - f[0]) / (2.0 * h)
                worst = max(worst, abs(float(adjoint["material"][name]) - expected) * alpha / value)
    return worst


def below_the_range() -> float:
    """Roughness below 1e-5 is that of 1e-5: largest difference of values, and of derivatives from 0."""
    launcher, worst = Launcher("cpu"), 0.0
    for key in (GGX, BECKMANN):
        for wi, wo in rough_pairs(MIN_ALPHA):
            at = launcher.eval_pdf(key, rough(MIN_ALPHA), wi, wo)
            for alpha in (9e-6, 1e-7, 0.0):
                below = launcher.eval_pdf(key, rough(alpha), wi, wo)
                worst = max(worst, *(float(np.abs(a - b).max()) for a, b in zip(at, below, strict=True)))
                adjoint = launcher.eval_vjp(key, rough(alpha), wi, wo, WEIGHT)[0]["material"]
                worst = max(worst, abs(float(adjoint["alpha_u"])), abs(float(adjoint["alpha_v"])))
    return worst


# --- smooth interfaces ---


def interface(eta: float, c: float) -> tuple[float, float, float]:
    """Reflectance of a lossless interface in float64, and its derivatives by eta and by the cosine."""

    def reflectance(eta: np.longdouble, c: np.longdouble) -> np.longdouble:
        root = (eta - 1) * (eta + 1) + c * c
        if root <= 0:
            return np.longdouble(1.0)
        g = np.sqrt(root)
        contrast = (eta - 1) * (eta + 1)
        r_s = contrast / (c + g) ** 2
        r_p = contrast * (c * c * (eta * eta + 1) - 1) / (eta * eta * c + g) ** 2
        return 0.5 * (r_s**2 + r_p**2)

    e, x = np.longdouble(eta), np.longdouble(c)
    # Steps follow the distance to where the function has a kink or a root.
    distance = abs((e - 1) * (e + 1) + x * x)
    h = np.longdouble(1e-5) * min(distance, abs(e - 1) if e != 1 else distance)
    by_eta = (reflectance(e + h, x) - reflectance(e - h, x)) / (2 * h)
    by_c = (reflectance(e, x + h) - reflectance(e, x - h)) / (2 * h)
    return float(reflectance(e, x)), float(by_eta), float(by_c)


def rough_glass_weights() -> float:
    """Worst error of sampled weights f_s cos / pdf of a GGX interface, which are its masking of the direction drawn.

    Over the squared index where light is refracted, from both sides; relative, and infinite where a number or a
    derivative is not finite.
    """
    launcher, worst, key = Launcher("cpu"), 0.0, "roughdielectric (ggx)"
    for alpha, ior, angle, up in itertools.product(ALPHAS, INDICES, ANGLES, (1.0, -1.0)):
        mat = as_seen(rough_glass(ior, alpha, reflectance=np.ones(3), transmittance=np.ones(3)))
        wi = rounded(direction(angle) * np.array([1.0, 1.0, up]))
        s = launcher.sample(key, mat, wi, DRAWN)
        s = s[s["pdf"] > 0.0]
        adjoint = launcher.eval_vjp(key, mat, wi, s["wo"], WEIGHT)
        if not (len(s) and np.isfinite(s["value"]).all() and np.isfinite(s["pdf"]).all() and all_finite(adjoint)):
            return math.inf
        for value, pdf, wo in zip(s["value"][:, 0], s["pdf"], s["wo"].astype(float), strict=True):
            masking = ggx_g1(alpha * np.hypot(wo[0], wo[1]) / abs(wo[2]))
            expected = masking / (index_behind(mat, wi) ** 2 if wi[2] * wo[2] < 0.0 else 1.0)
            worst = max(worst, abs(float(value) / float(pdf) / expected - 1.0))
    return worst


def dielectric_error(eta: float, c: float) -> float:
    """Worst error of reflectance and its derivative by eta, relative to themselves."""
    launcher = Launcher("cpu")
    wi = rounded([math.sqrt(max(1.0 - c * c, 0.0)), 0.0, c])
    mat = as_seen(glass(eta, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
    value = launcher.scatter("dielectric", mat, wi, LOBE_DELTA_REFLECTION)[0]["value"]
    w, none = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    adjoint = launcher.scatter_vjp("dielectric", mat, wi, LOBE_DELTA_REFLECTION, w, none)[0]
    through = launcher.scatter_vjp("dielectric", mat, wi, LOBE_DELTA_TRANSMISSION, w, np.ones(3))[0]
    found = [value[0], adjoint["material"]["ior"], *adjoint["wi"], through["material"]["ior"], *through["wi"]]
    if not np.isfinite(found).all():
        return math.inf
    expected, by_eta, _by_c = interface(float(mat["ior"]), float(wi[2]))
    if eta == 1.0:
        return max(abs(float(value[0])), abs(float(adjoint["material"]["ior"])))
    return max(
        abs(float(value[0]) / expected - 1.0),
        abs(float(adjoint["material"]["ior"]) - by_eta) / max(abs(by_eta), 1e-30) if abs(by_eta) > 0.0 else 0.0,
    )


def equal_indices() -> float:
    etas = [1.0, *(1.0 + s * 10.0**-k for k in range(1, 7) for s in (1.0, -1.0))]
    # Towards the thinner side only where there is no total reflection.
    rows = [(e, c) for e in etas for c in (1.0, 0.7, 0.05) if (e - 1.0) * (e + 1.0) + c * c > 0.25 * c * c]
    return max(dielectric_error(e, c) for e, c in rows)


def critical_angle() -> float:
    """From 1e-1 to 1e-6 beyond the critical cosine of glass, seen from inside."""
    eta = float(np.float32(1.0 / 1.5))
    edge = math.sqrt(1.0 - eta * eta)
    return max(dielectric_error(eta, edge * (1.0 + 10.0**-k)) for k in range(1, 7))


def total_reflection() -> float:
    """At and behind the critical angle: the reflectance is 1 and everything is finite."""
    eta = float(np.float32(1.0 / 1.5))
    edge = math.sqrt(1.0 - eta * eta)
    return max(dielectric_error_inside(eta, edge * (1.0 - d)) for d in (1e-6, 1e-4, 1e-2, 0.5, 0.999))


def dielectric_error_inside(eta: float, c: float) -> float:
    launcher = Launcher("cpu")
    wi = rounded([math.sqrt(1.0 - c * c), 0.0, c])
    mat = as_seen(glass(eta, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
    value = launcher.scatter("dielectric", mat, wi, LOBE_DELTA_REFLECTION)[0]["value"]
    adjoint = launcher.scatter_vjp("dielectric", mat, wi, LOBE_DELTA_REFLECTION, WEIGHT, np.ones(3))[0]
    found = [*value, adjoint["material"]["ior"], *adjoint["wi"]]
    return abs(float(value[0]) - 1.0) if np.isfinite(found).all() else math.inf


def metals() -> float:
    """Reflectance of metals from eta = 0 and k = 0 to 1e3, at all angles: worst absolute error."""
    launcher, worst = Launcher("cpu"), 0.0
    for eta in (0.0, 1e-3, 0.2, 1.0, 3.0, 1e3):
        for k in (0.0, 1e-3, 1.0, 10.0, 1e3):
            if eta == k == 0.0:
                continue
            for angle in ANGLES:
                wi = rounded(direction(angle))
                mat = as_seen(metal(((eta,) * 3, (k,) * 3), (1.0, 1.0, 1.0)))
                value = launcher.scatter("conductor", mat, wi, LOBE_DELTA_REFLECTION)[0]["value"]
                adjoint = launcher.scatter_vjp("conductor", mat, wi, LOBE_DELTA_REFLECTION, WEIGHT, np.ones(3))[0]
                found = [*value, *adjoint["material"]["eta"], *adjoint["material"]["k"], *adjoint["wi"]]
                if not np.isfinite(found).all():
                    return math.inf
                if eta > 0.0:  # without it the twin's roots are ambiguous
                    expected = fresnel_conductor(wi[2], mat["eta"] + 0j, mat["k"])
                    worst = max(worst, float(np.abs(value - expected).max()))
    return worst


CASES = [
    Case(
        family="materials",
        name="values, alpha 1e-5 to 1, up to 89.9 degrees",
        hard="lobes of 1e10 per steradian, half vectors that cancel to 1e-5, grazing angles",
        naive="slopes of wi + wo alone: off by 0.8 at alpha 1e-5 and 89.9 degrees",
        bound=1.5e-6,
        measure=lambda: smooth_values(SMOOTH),
    ),
    Case(
        family="materials",
        name="derivatives, alpha 1e-5 to 1, albedo 0 and 1",
        hard="as above; the derivative by a reflectance of 0",
        naive="value / reflectance is 0 / 0 at a black surface",
        bound=2.5e-6,
        measure=lambda: smooth_derivatives(SMOOTH),
    ),
    Case(
        family="materials",
        name="a coat, values and derivatives, eta 1.001 .. 3, up to 89.9 degrees",
        hard="little light passes the coat at grazing angles, and is what reflection leaves of 1",
        naive="a transmittance below 0 by rounding",
        bound=6e-6,
        measure=lambda: max(smooth_values(COATED), smooth_derivatives(COATED)),
    ),
    Case(
        family="materials",
        name="a rough coat, values, alpha 1e-5 .. 1, up to 89.9 degrees",
        hard="the lobe of the coat is narrow, and its transmittance at grazing angles follows from alpha",
        naive="of a half vector alone: 1.3 alpha of the lobe at 89.9 degrees",
        bound=3e-6,
        measure=lambda: smooth_values(ROUGHLY_COATED),
    ),
    Case(
        family="materials",
        name="rough glass, sampled weights, alpha 1e-5 .. 1, eta 1.001 .. 3, both sides, up to 89.9 degrees",
        hard="half vectors of refraction that are rounding alone: 2^-24 / (alpha (eta - 1)) of the lobe",
        naive="value and density by different half vectors",
        bound=2e-6,
        measure=rough_glass_weights,
    ),
    Case(
        family="materials",
        name="principled, values, alpha 1e-3 .. 1, up to 89.9 degrees",
        hard="narrow lobes, an index of refraction of 1, a base whose channels are 0 and 1",
        naive="the clear coat by 1 + (a^2 - 1) cos^2, which cancels: off by 6e-2 at gloss 1",
        bound=5e-5,
        measure=lambda: smooth_values(PRINCIPLED),
    ),
    Case(
        family="materials",
        name="a power of a cosine, exponents 2 to 1e5, up to 89.9 degrees",
        hard="cosines next to 1, raised to the exponent 1e5",
        naive="6e-3: the exponent times the rounding of the cosine",
        bound=2e-5,
        measure=lambda: smooth_values(PHONG),
    ),
    Case(
        family="materials",
        name="abc, B 1 to 1e6, up to 89.9 degrees",
        hard="1 - h_z next to 0",
        naive="6e-2: B times the rounding of a cosine",
        bound=1.5e-6,
        measure=lambda: smooth_values(ABC),
    ),
    Case(
        family="materials",
        name="alpha below 1e-5",
        hard="a lobe that float32 directions do not resolve",
        naive="overflow of D, 0 * inf",
        bound=0.0,
        measure=below_the_range,
    ),
    Case(
        family="materials",
        name="equal indices: |eta - 1| from 1e-1 to 1e-6, and 0",
        hard="a reflectance of (eta - 1)^2, and its derivative",
        naive="(c - g) / (c + g) cancels: all digits lost at 1e-4",
        bound=6e-7,
        measure=equal_indices,
    ),
    Case(
        family="materials",
        name="before total reflection, 1e-1 to 1e-6",
        hard="the derivative grows without bound towards the critical angle",
        naive="sqrt(1 - sin^2) cancels; its derivative at 0 is infinite",
        bound=4e-3,
        measure=critical_angle,
    ),
    Case(
        family="materials",
        name="total reflection, 1e-6 to 1",
        hard="the transmitted direction does not exist",
        naive="the root of a negative number",
        bound=0.0,
        measure=total_reflection,
    ),
    Case(
        family="materials",
        name="metals, eta and k from 0 to 1e3",
        hard="complex roots near the axes",
        naive="0 / 0 for the perfect mirror; cancellation in good metals",
        bound=3e-7,
        measure=metals,
    ),
]


@pytest.mark.slow_rows("a rough coat, values, alpha 1e-5 .. 1, up to 89.9 degrees")
@pytest.mark.parametrize("case", parameters(CASES))
def test_materials(case, check) -> None:
    check(case)

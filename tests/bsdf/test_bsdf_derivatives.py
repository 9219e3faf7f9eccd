"""Vector-Jacobian products of the scattering models against differences of the float64 twin.

The tests run over ``EXAMPLES`` in ``helpers.py``, over every value that a model declares. Directions are
differentiated along the tangents of the sphere: how a formula continues off it is nobody's business.
"""

import numpy as np
import pytest

from tests.bsdf.helpers import (
    BECKMANN,
    BELOW,
    BUMPED,
    DELTA_MODELS,
    EXAMPLES,
    GGX,
    MAPPED,
    SMOOTH_MODELS,
    Launcher,
    all_finite,
    as_seen,
    corners,
    direction,
    glass,
    index_behind,
    lobes_of,
    members,
    narrowest,
    passes,
    random_directions,
    rough,
    rounded,
    transmits,
    unit,
    values_of,
)
from tests.bsdf.nested import bare
from tests.bsdf.principled import coat_alpha
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import LOBE_DELTA_TRANSMISSION

WEIGHT = np.array([0.7, -0.4, 1.1])
DIRECTION_WEIGHT = np.array([0.3, 0.8, -0.5])
#: Error relative to the largest partial derivative of its group: float32 arithmetic, and the differences' own error.
TOLERANCE = 1e-3
#: Step of the differences over the scale on which the function changes: errors of 1e-8 (curvature) and 1e-7 (rounding).
STEP = 1e-4
#: Colours that stand for directions.
TURNING = ("normalmap", "heights")
NORMAL = np.array([0.0, 0.0, 1.0])


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


def near_mirror(wi: np.ndarray, alpha: float) -> np.ndarray:
    """The direction whose half vector has the slope (0.5, 0.3) alpha."""
    h = np.array([0.5 * alpha, 0.3 * alpha, 1.0])
    h /= np.linalg.norm(h)
    return 2.0 * np.dot(wi, h) * h - wi


def tangents(w: np.ndarray) -> list[np.ndarray]:
    a = np.cross(w, [0.0, 1.0, 0.0] if abs(w[1]) < 0.9 else [1.0, 0.0, 0.0])
    a /= np.linalg.norm(a)
    return [a, np.cross(w, a)]


def difference(f, step: float) -> float:
    return (f(step) - f(-step)) / (2.0 * step)


def forward_difference(f, step: float) -> float:
    """Of second order too."""
    return (-3.0 * f(0.0) + 4.0 * f(step) - f(2.0 * step)) / (2.0 * step)


def scale_of(mat: dict, *directions: np.ndarray) -> float:
    """The length over which scattering changes."""
    scale = min(*(abs(w[2]) for w in directions), narrowest(mat))
    if "base_color" in mat:
        scale = min(scale, coat_alpha(mat))
    if "ior" in bare(mat):
        # The refracted cosine vanishes, as a root, at the critical angle.
        scale *= min(1.0, *(abs(index_behind(mat, w) ** 2 - 1.0 + w[2] ** 2) for w in directions))
    return scale


def check(
    key: str, f, mat: dict, wi: np.ndarray, wo: np.ndarray | None, adjoint: np.void, scale: float, where: str = ""
) -> None:
    """Compare ``adjoint`` with the differences of ``f(mat, wi, wo)``, which changes over the length ``scale``."""
    groups = {}
    for value in values_of(key):
        name = value.name
        number = not value.color
        step = STEP * (min(scale, mat[name]) if number and mat[name] > 0.0 else 1.0)
        step = STEP * scale if name in TURNING else step
        if name in ("base_color", "specular") and np.min(mat[name]) < 1e-3:
            step *= 1e-4  # of a black base and of no reflectance: tint and roots bend within 1e-5
        # One-sided where the range begins: a roughness below is as good as its end.
        at_end = number and 0.0 < mat[name] <= float(np.float32(value.low))
        moves = [1.0] if number else np.eye(3)
        if name == "ior" and mat[name] == 0.0:  # given as ``specular``
            moves = [0.0]
        expected = [
            (forward_difference if at_end else difference)(
                lambda h, n=name, move=move: f(mat | {n: mat[n] + h * move}, wi, wo), step
            )
            for move in moves
        ]
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
        np.testing.assert_allclose(actual, expected, rtol=0.0, atol=slack, err_msg=f"{name} {where}")
    undeclared = set(members(adjoint)) - {value.name for value in values_of(key)}
    assert all(np.all(adjoint["material"][name] == 0.0) for name in undeclared)


# --- smooth lobes ---

OBLIQUE, AWAY = direction(40.0), direction(55.0, 190.0)
PAIRS = {
    "oblique": (OBLIQUE, AWAY),
    "forward": (OBLIQUE, direction(70.0, 0.0)),
    "masked": (direction(75.0), direction(80.0, 100.0)),
    "normal": (NORMAL, NORMAL),
    "normal-in": (NORMAL, direction(30.0)),
    "normal-in-grazing-out": (NORMAL, direction(89.99)),
    "grazing-in": (direction(89.9), AWAY),
    "grazing-out": (OBLIQUE, direction(89.9, 190.0)),
    "grazing-both": (direction(89.0), direction(88.0, 200.0)),
    "grazing-mirror": (direction(89.9), direction(89.8, 209.9)),
}


def near_refraction(mat: dict, wi: np.ndarray, alpha: float) -> np.ndarray:
    """The refracted direction at a half vector with the slope (0.5, 0.3) alpha; (0, 0, 0): total reflection."""
    h = np.array([0.5 * alpha, 0.3 * alpha, 1.0]) * np.sign(wi[2])
    h /= np.linalg.norm(h)
    eta, c = index_behind(mat, wi), np.dot(wi, h)
    g2 = eta**2 - 1.0 + c**2
    return ((c - np.sqrt(g2)) * h - wi) / eta if g2 > 0.0 else np.zeros(3)


def refracted_pairs(mat: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of directions on both sides of a rough interface."""
    alpha, found = narrowest(mat), {}
    for name, wi in (
        ("oblique", OBLIQUE),
        ("normal", NORMAL),
        ("grazing", direction(80.0)),
        ("inside", OBLIQUE * BELOW),
    ):
        wo = near_refraction(mat, wi, alpha)
        if abs(wo[2]) > 0.05:
            found[f"through-{name}"] = wi, wo
    inside = OBLIQUE * BELOW
    return found | ({"under": (inside, AWAY * BELOW)} if alpha >= 0.2 else {})


def pairs_of(mat: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of directions in the material's lobes."""
    alpha = narrowest(mat)
    if "sigma" in mat:  # seen along the normal the grooves have a kink, across which the azimuths agree
        return {name: pair for name, pair in PAIRS.items() if not name.startswith("normal-in")}
    if alpha >= 0.2:
        # On both sides of equal indices, by however little they differ, some grazing angle is one of total reflection.
        metal = bare(mat)
        matched = "eta" in metal and np.any((metal["eta"] == 1.0) & (metal["k"] == 0.0))
        return {name: pair for name, pair in PAIRS.items() if not (matched and name.startswith("grazing"))}
    return {f"near-mirror-{d:g}": (direction(d), near_mirror(direction(d), alpha)) for d in (0.0, 40.0, 70.0)}


SMOOTH_CASES = [
    pytest.param(key, mat, id=f"{key}-{i}")
    for key in SMOOTH_MODELS
    for i, mat in enumerate((*EXAMPLES[key].materials, *EXAMPLES[key].more))
]


@pytest.mark.parametrize(("key", "mat"), SMOOTH_CASES)
def test_eval_vjp(bsdf: Launcher, key: str, mat: dict) -> None:
    w = rounded(WEIGHT)
    pairs = pairs_of(mat) | (refracted_pairs(mat) if passes(key) else {})
    mat = as_seen(mat)

    def f(mat, wi, wo):
        return np.dot(w, EXAMPLES[key].eval(mat, unit(wi), unit(wo)))

    wis, wos = (np.array([rounded(pair[i]) for pair in pairs.values()]) for i in (0, 1))
    for name, wi, wo, adjoint in zip(pairs, wis, wos, bsdf.eval_vjp(key, mat, wis, wos, w), strict=True):
        check(key, f, mat, wi, wo, adjoint, scale_of(mat, wi, wo), name)


@pytest.mark.parametrize("key", SMOOTH_MODELS)
def test_a_derivative_is_compared_where_there_is_a_lobe(key: str) -> None:
    mat = as_seen(EXAMPLES[key].materials[0])
    values = [np.dot(WEIGHT, EXAMPLES[key].eval(mat, *pair)) for pair in pairs_of(mat).values()]
    # Under a normal or bump map some pairs are above one of the two surfaces only.
    assert np.mean(np.abs(values) > 0.0) > (0.4 if key in (MAPPED, BUMPED) else 0.99)


@pytest.mark.parametrize(("key", "name"), [
    ("diffuse", "reflectance"), (GGX, "specular_reflectance"), (BECKMANN, "specular_reflectance"),
    ("plastic", "diffuse_reflectance"),
])  # fmt: skip
def test_a_black_surface_has_the_reflectance_derivative_of_a_white_one(bsdf: Launcher, key: str, name: str) -> None:
    typical = EXAMPLES[key].materials[0]
    black, white = (bsdf.eval_vjp(key, typical | {name: np.full(3, c)}, OBLIQUE, AWAY, WEIGHT)[0] for c in (0.0, 1.0))
    assert np.all(black["material"][name] != 0.0)
    np.testing.assert_array_equal(black["material"][name], white["material"][name])


@pytest.mark.parametrize("key", [GGX, BECKMANN])
def test_the_floor_of_the_roughness_has_no_derivative(bsdf: Launcher, key: str) -> None:
    wi = direction(40.0)
    wo = rounded(near_mirror(wi, MIN_ALPHA))
    below = bsdf.eval_vjp(key, rough(1e-6), wi, wo, WEIGHT)[0]["material"]
    assert below["alpha_u"] == below["alpha_v"] == 0.0
    value, _ = bsdf.eval_pdf(key, rough(1e-6), wi, wo)
    at_floor, _ = bsdf.eval_pdf(key, rough(MIN_ALPHA), wi, wo)
    assert np.all(value > 0.0)
    np.testing.assert_array_equal(value, at_floor)


# --- delta lobes ---


def critical_angle(ior: float) -> float:
    """Degrees from the normal, on the denser side."""
    return float(np.degrees(np.arcsin(min(ior, 1.0 / ior))))


def directions_of(key: str, mat: dict) -> dict[str, np.ndarray]:
    """Directions of incidence; where light passes from both sides, also around the critical angle."""
    angles = {"normal": 0.0, "oblique": 30.0, "steep": 50.0, "grazing": 89.5, "nearly-in-the-surface": 89.9}
    if transmits(key):
        angles.pop("nearly-in-the-surface")
    found = {name: direction(angle) for name, angle in angles.items()}
    if transmits(key):
        found |= {f"{name}-inside": w * BELOW for name, w in found.items()}
    ior = bare(mat).get("ior", 1.0)
    if abs(ior - 1.0) > 0.01:
        dense = BELOW if ior > 1.0 else np.ones(3)
        if transmits(key) or ior < 1.0:
            found["below-critical"] = direction(critical_angle(ior) - 0.5) * dense
            found["total"] = direction(critical_angle(ior) + 0.5) * dense
    return found


DELTA_CASES = [
    pytest.param(key, mat, lobe, id=f"{key}-{i}-{lobe}")
    for key in DELTA_MODELS
    for i, mat in enumerate((*EXAMPLES[key].materials, *EXAMPLES[key].more))
    for lobe in lobes_of(key)
]


@pytest.mark.parametrize(("key", "mat", "lobe"), DELTA_CASES)
def test_scatter_vjp(bsdf: Launcher, key: str, mat: dict, lobe: int) -> None:
    w, a_wo = rounded(WEIGHT), rounded(DIRECTION_WEIGHT)
    ways = directions_of(key, mat)
    if lobe == LOBE_DELTA_TRANSMISSION:  # behind total reflection there is no direction to differentiate
        ways = {name: wi for name, wi in ways.items() if index_behind(mat, wi) ** 2 - 1.0 + wi[2] ** 2 >= 0.0}
    mat = as_seen(mat)

    def f(mat, wi, _wo):
        direction_out, value = EXAMPLES[key].scatter(mat, wi, lobe)
        return np.dot(w, value) + np.dot(a_wo, direction_out)

    wis = np.array([rounded(wi) for wi in ways.values()])
    for name, wi, adjoint in zip(ways, wis, bsdf.scatter_vjp(key, mat, wis, lobe, w, a_wo), strict=True):
        assert np.all(adjoint["wo"] == 0.0), name
        check(key, f, mat, wi, None, adjoint, scale_of(mat, wi), name)


def test_refraction_depends_on_the_index(bsdf: Launcher) -> None:
    # sin(theta_t) = sin(theta) / eta: at fixed theta, d sin(theta_t) / d eta = -sin(theta) / eta^2.
    wi = direction(50.0, azimuth=0.0)
    a = bsdf.scatter_vjp("dielectric", glass(1.5), wi, LOBE_DELTA_TRANSMISSION, (0, 0, 0), (1, 0, 0))[0]
    np.testing.assert_allclose(a["material"]["ior"], np.sin(np.radians(50.0)) / 1.5**2, rtol=1e-5)


# --- nothing is infinite anywhere ---


def edge_directions() -> np.ndarray:
    rng = np.random.default_rng(0)
    angles = [0.0, 1e-6, 1e-3, 1.0, 45.0, 89.0, 89.99, 89.9999, 89.999999, 90.0]
    rows = [direction(t, p) for t in angles for p in (0.0, 90.0, 180.0, 217.0)]
    # Cosines on both sides of the least one that scatters, down to float32's smallest.
    rows += [(np.cos(p), np.sin(p), c) for c in (5e-7, 1.5e-7, 9e-8, 1e-12, 1e-20, 1e-30, 1e-38) for p in (0.0, 2.0)]
    return np.concatenate([rows, random_directions(rng, 10)])


def all_materials(key: str) -> list[dict]:
    example = EXAMPLES[key]
    return [*example.materials, *example.more, *example.extremes, *corners(key)]


def critical_directions(mat: dict) -> np.ndarray:
    if "ior" not in bare(mat):
        return np.zeros((0, 3))
    return np.array([direction(t) for t in critical_angle(index_behind(mat, NORMAL)) + np.linspace(-1e-4, 1e-4, 101)])


@pytest.mark.slow_rows(
    "cpu-roughplastic (beckmann nonlinear)",
    "cpu-roughplastic (ggx)",
    "cpu-roughdielectric (beckmann)",
    "cpu-roughplastic (beckmann)",
)
@pytest.mark.parametrize("key", SMOOTH_MODELS)
def test_derivatives_are_finite_everywhere(bsdf: Launcher, key: str) -> None:
    for mat in all_materials(key):
        w = np.concatenate([edge_directions(), critical_directions(mat)[::10]])
        if passes(key):
            w = np.concatenate([w, w * BELOW])
        wi, wo = np.repeat(w, len(w), axis=0), np.tile(w, (len(w), 1))
        value, pdf = bsdf.eval_pdf(key, mat, wi, wo)
        assert np.all(np.isfinite(value)) and np.all(value >= 0.0) and np.all(np.isfinite(pdf)) and np.all(pdf >= 0.0)
        assert all_finite(bsdf.eval_vjp(key, mat, wi, wo, WEIGHT))


@pytest.mark.parametrize("key", DELTA_MODELS)
def test_delta_derivatives_are_finite_everywhere(bsdf: Launcher, key: str) -> None:
    for mat in all_materials(key):
        w = np.concatenate([edge_directions(), critical_directions(mat)])
        w = np.concatenate([w, w * BELOW])
        for lobe in lobes_of(key):
            s = bsdf.scatter(key, mat, w, lobe)
            assert np.all(np.isfinite(s["value"])) and np.all(s["value"] >= 0.0) and np.all(np.isfinite(s["wo"]))
            assert all_finite(bsdf.scatter_vjp(key, mat, w, lobe, WEIGHT, DIRECTION_WEIGHT))

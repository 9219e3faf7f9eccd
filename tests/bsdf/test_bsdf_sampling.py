"""Sampling of the scattering models: samples against densities and probabilities, energy, the ends of the unit square.

The tests run over ``EXAMPLES`` in ``helpers.py``; a new model joins them by its entry there.
"""

import zlib

import numpy as np
import pytest
from scipy import stats

from tests.bsdf.helpers import (
    ALL_MODELS,
    BECKMANN,
    BELOW,
    BUMPED,
    EXAMPLES,
    GGX,
    SMOOTH_MODELS,
    Launcher,
    corners,
    delta_samples,
    direction,
    energy_of,
    index_behind,
    lobes_of,
    narrowest,
    passes,
    rough,
    rounded,
    transmits,
    uniform,
    white,
)
from tests.bsdf.principled import alphas, is_thin
from tests.path.helpers import chi_square_p
from warp_psdr.kernels.bsdf.dispatch import declaration_of
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import LOBE_DELTA_TRANSMISSION, LOBE_NONE, LOBE_SMOOTH

#: Relative error of float32 arithmetic through a microfacet model (a few dozen operations of 6e-8 each).
FLOAT32 = 2e-5
#: What a cosine is off by once a direction has been turned out of a frame and back into it, in float32.
ROUNDED_COSINE = 1e-7
#: Probability of a false alarm of all tests of one kind together.
SIGNIFICANCE = 0.01
SAMPLES = 100_000
ANGLES = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 75.0, 80.0, 85.0, 88.0]
#: Cosine below which half vectors in front are a small part of their chart, which takes a finer quadrature.
GRAZING = 0.1
#: Key, material and signed cosine's direction of all lobes that are sampled; by default at one angle, from both
#: sides a model's first material, from the front the others.
LOBES = [
    pytest.param(
        key,
        mat,
        direction(angle) * side,
        id=f"{key}-{i}-{angle:g}{'' if side[2] > 0.0 else '-below'}",
        marks=() if angle == 75.0 and (i == 0 or side[2] > 0.0) else pytest.mark.slow,
    )
    for key in ALL_MODELS
    for i, mat in enumerate(EXAMPLES[key].materials)
    for angle in ANGLES
    for side in ([np.ones(3), BELOW] if transmits(key) or passes(key) else [np.ones(3)])
    # At 80 degrees the narrowest lobe is only some sixty float32 directions wide, at 88 twelve.
    if angle < 80.0 or narrowest(mat) > MIN_ALPHA
]

each_model = pytest.mark.parametrize("key", ALL_MODELS)
each_smooth_model = pytest.mark.parametrize("key", SMOOTH_MODELS)


def lobes(having) -> pytest.MarkDecorator:
    """Parametrise over the lobes of the models that are ``having``."""
    return pytest.mark.parametrize(("key", "mat", "wi"), [p for p in LOBES if having(declaration_of(p.values[0])[0])])


each_lobe = lobes(lambda model: True)
each_smooth_lobe = lobes(lambda model: model.has_smooth)
each_delta_lobe = lobes(lambda model: model.has_delta)


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


def seed(*parts) -> int:
    return zlib.crc32(repr(parts).encode())


# --- coordinates in which a lobe is smooth: (q, phi), q in [0, 1) ---


def lobe_scales(mat: dict) -> tuple[float, float] | None:
    """Slopes in units of which a rough mirror's half vectors are measured; beside a diffuse base, no small ones."""
    if "base_color" in mat:
        u, v = alphas(mat)
        return max(u, 0.3), max(v, 0.3)
    if "nu" in mat or "B" in mat:
        return 0.3, 0.3
    if "alpha" in mat:
        scale = max(mat["alpha"], 0.3)
        return scale, scale
    return (mat["alpha_u"], mat["alpha_v"]) if "alpha_u" in mat else None


def from_lobe(mat: dict, wi: np.ndarray, q: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) and solid angle per dq dphi."""
    scales = lobe_scales(mat)
    if scales is None:
        r, z = np.sqrt(1.0 - q), np.sqrt(q)
        return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 0.5 / z
    # Slopes of the half vector, in units of alpha; their length p is mapped to [0, 1), tails wide open.
    au, av = scales
    p = np.tan(0.5 * np.pi * q)
    h = np.stack([au * p * np.cos(phi), av * p * np.sin(phi), np.ones_like(p)], axis=1)
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    dot = h @ wi
    wo = 2.0 * dot[:, None] * h - wi
    return wo, 4.0 * np.abs(dot) * h[:, 2] ** 3 * au * av * p * (1.0 + p * p) * 0.5 * np.pi


def to_lobe(mat: dict, wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scales = lobe_scales(mat)
    if scales is None:
        return wo[:, 2] ** 2, np.arctan2(wo[:, 1], wo[:, 0]) % (2.0 * np.pi)
    h = wi + wo
    x, y = h[:, 0] / h[:, 2] / scales[0], h[:, 1] / h[:, 2] / scales[1]
    return np.arctan(np.hypot(x, y)) * 2.0 / np.pi, np.arctan2(y, x) % (2.0 * np.pi)


def from_refraction(mat: dict, wi: np.ndarray, q: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions behind a rough interface, by the slopes of the half vector, and solid angle per dq dphi."""
    up, eta = np.where(wi[2] < 0.0, BELOW, np.ones(3)), index_behind(mat, wi)
    au, av = lobe_scales(mat)
    p = np.tan(0.5 * np.pi * q)
    h = np.stack([au * p * np.cos(phi), av * p * np.sin(phi), np.ones_like(p)], axis=1)
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    c = h @ (wi * up)
    g2 = eta**2 - 1.0 + c**2
    refracts = (c > 0.0) & (g2 > 0.0)
    g = np.sqrt(np.where(refracts, g2, 1.0))
    wo = np.where(refracts[:, None], ((c - g)[:, None] * h - wi * up) / eta, (0.0, 0.0, -1.0)) * up
    jacobian = h[:, 2] ** 3 * au * av * p * (1.0 + p * p) * 0.5 * np.pi * (c - g) ** 2 / (eta * g)
    return wo, np.where(refracts, jacobian, 0.0)


def to_charts(key: str, mat: dict, wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(q, phi) of directions; behind a surface that they pass q lies in [1, 2)."""
    if not passes(key):
        return to_lobe(mat, wi, wo)
    behind = wi[2] * wo[:, 2] < 0.0
    through = wi + wo * BELOW if is_thin(mat) else wi + index_behind(mat, wi) * wo
    half = np.where(behind[:, None], through, wi + wo)
    slopes = half[:, :2] / half[:, 2:] * np.where(wi[2] < 0.0, -1.0, 1.0) / np.array(lobe_scales(mat))
    q = np.arctan(np.linalg.norm(slopes, axis=1)) * 2.0 / np.pi
    return q + behind, np.arctan2(slopes[:, 1], slopes[:, 0]) % (2.0 * np.pi)


def quadrature(bsdf: Launcher, key: str, mat: dict, wi: np.ndarray):
    """``integrals`` in front of the surface and, where light passes it, behind, where radiance is scaled to energy."""
    fine = (160, 24) if abs(wi[2]) < GRAZING else (40, 6) if passes(key) else (24, 4)
    mass, energy = integrals(bsdf, key, mat, wi, fine=fine)
    if passes(key):
        through, radiance = integrals(bsdf, key, mat, wi, fine=fine, behind=True)
        mass, energy = np.concatenate([mass, through]), energy + index_behind(mat, wi) ** 2 * radiance
    return mass, energy


def integrals(
    bsdf: Launcher, key: str, mat: dict, wi: np.ndarray, bins=(20, 24), *, fine: tuple[int, int], behind=False
):
    """Integrals of the pdf over each bin (shape ``bins``) and of the value over the hemisphere, midpoint rule.

    Finer in q, since at normal incidence the horizon cuts all of a ring of bins at one q.
    """
    n_q, n_phi = bins[0] * fine[0], bins[1] * fine[1]
    q, phi = np.meshgrid((np.arange(n_q) + 0.5) / n_q, (np.arange(n_phi) + 0.5) * 2.0 * np.pi / n_phi, indexing="ij")
    if behind and is_thin(mat):
        wo, jacobian = from_lobe(mat, wi * np.where(wi[2] < 0.0, BELOW, np.ones(3)), q.ravel(), phi.ravel())
        wo = wo * np.where(wi[2] < 0.0, np.ones(3), BELOW)
    elif behind:
        wo, jacobian = from_refraction(mat, wi, q.ravel(), phi.ravel())
    elif passes(key) and wi[2] < 0.0:
        wo, jacobian = from_lobe(mat, wi * BELOW, q.ravel(), phi.ravel())
        wo = wo * BELOW
    else:
        wo, jacobian = from_lobe(mat, wi, q.ravel(), phi.ravel())
    if passes(key):  # half vectors of each lobe lead to the other side as well
        jacobian = np.where((wi[2] * wo[:, 2] < 0.0) == behind, jacobian, 0.0)
    value, pdf = bsdf.eval_pdf(key, mat, wi, wo)
    cell = jacobian * 2.0 * np.pi / (n_q * n_phi)
    cells = (pdf * cell).reshape(bins[0], fine[0], bins[1], fine[1])
    return cells.sum(axis=(1, 3)), (value * cell[:, None]).sum(axis=0)


def sampler_p(bsdf: Launcher, key: str, mat: dict, wi: np.ndarray, pdf_mat: dict) -> float:
    """Chi-square test of the smooth samples of ``mat`` against the pdf of ``pdf_mat``; all others are one more bin."""
    wi = rounded(wi)
    s = bsdf.sample(key, mat, wi, uniform(seed(key, wi.tolist(), narrowest(mat)), SAMPLES))
    assert set(s["lobe"]) <= {LOBE_NONE, *declaration_of(key)[0].lobes}
    assert np.all((s["pdf"] > 0.0) == (s["lobe"] != LOBE_NONE))
    smooth = s["lobe"] == LOBE_SMOOTH
    mass, _ = quadrature(bsdf, key, pdf_mat, wi)
    if mass.sum() == 0.0:  # total reflection by a coat
        return float(not smooth.any())
    q, phi = to_charts(key, pdf_mat, wi, s["wo"][smooth].astype(float))
    top = 2.0 if passes(key) else 1.0
    observed, _, _ = np.histogram2d(q, phi, bins=mass.shape, range=[(0.0, top), (0.0, 2.0 * np.pi)])
    observed = np.append(observed.ravel(), SAMPLES - smooth.sum())
    expected = SAMPLES * np.append(mass.ravel(), max(1.0 - mass.sum(), 0.0))
    return chi_square_p(observed, expected)


@each_smooth_lobe
def test_samples_follow_the_pdf(bsdf: Launcher, key: str, mat: dict, wi: np.ndarray) -> None:
    assert sampler_p(bsdf, key, mat, wi, mat) > SIGNIFICANCE / len(LOBES)


#: Models with values that lobes are linear in, which branches draw from the ends of.
MIXTURES = [key for key in ALL_MODELS if declaration_of(key)[0].mixes]


@pytest.mark.parametrize("key", MIXTURES)
def test_values_are_linear_in_weights_and_drawn_at_their_ends(bsdf: Launcher, key: str) -> None:
    """At both ends samples follow the pdf, which is positive where the value is; in between the value is their mix."""
    model = declaration_of(key)[0]
    mat = EXAMPLES[key].materials[0]
    ranges = {value.name: (value.low, value.high) for value in model.values}
    wi = direction(40.0)
    wo = np.random.default_rng(seed(key)).normal(size=(2000, 3))
    wo[:, 2] = np.abs(wo[:, 2]) * (1.0 if not passes(key) else np.where(np.arange(2000) % 2, 1.0, -1.0))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    for name in model.mixes:
        low, high = ranges[name]
        ends = [mat | {name: end} for end in (low, high)]
        middle = low + 0.3 * (high - low)
        if model.has_smooth:
            (f0, p0), (f1, p1), (f, _) = (bsdf.eval_pdf(key, m, wi, wo) for m in (*ends, mat | {name: middle}))
            np.testing.assert_allclose(f, 0.7 * f0 + 0.3 * f1, rtol=1e-4, atol=FLOAT32 * np.abs(f).max())
            assert ((f0 == 0.0).all(axis=1) | (p0 > 0.0)).all() and ((f1 == 0.0).all(axis=1) | (p1 > 0.0)).all()
            for end in ends:
                assert sampler_p(bsdf, key, end, wi, end) > SIGNIFICANCE / (2 * len(MIXTURES) * len(model.mixes)), name
        for lobe in model.lobes if model.has_delta else ():
            if lobe != LOBE_SMOOTH:
                d0, d1, d = (bsdf.scatter(key, m, wi, lobe)["value"] for m in (*ends, mat | {name: middle}))
                np.testing.assert_allclose(d, 0.7 * d0 + 0.3 * d1, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("key", [GGX, BECKMANN])
@pytest.mark.parametrize("angle", [0.0, 75.0])
def test_the_chi_square_test_notices_a_slightly_wrong_roughness(bsdf: Launcher, key: str, angle: float) -> None:
    assert sampler_p(bsdf, key, rough(0.3), direction(angle), rough(0.32)) < 1e-6


@each_delta_lobe
def test_delta_lobes_are_drawn_with_their_probabilities(bsdf: Launcher, key: str, mat: dict, wi: np.ndarray) -> None:
    n = 20_000
    for drawn in delta_samples(bsdf, key, mat, wi, uniform(seed(key, wi.tolist()), n)).values():
        if len(drawn):
            assert np.all(drawn["pdf"] == drawn["pdf"][0])
            probability = min(float(drawn["pdf"][0]), 1.0)
            assert stats.binomtest(len(drawn), n, probability).pvalue > SIGNIFICANCE / (2 * len(LOBES))


@each_lobe
def test_sample_returns_the_value_and_pdf_of_its_direction(bsdf, key: str, mat: dict, wi: np.ndarray) -> None:
    s = bsdf.sample(key, mat, wi, uniform(1, 1000))
    drawn = s["lobe"] != LOBE_NONE
    # Without flipping, a bumped surface may look away from the viewer.
    # Nor does an opaque model behind.
    assert drawn.any() or key == BUMPED or mat.get("opacity") == 1.0
    through = (s["lobe"] == LOBE_DELTA_TRANSMISSION) | (passes(key) & drawn & (s["wo"][:, 2] * wi[2] < 0.0))
    assert np.all(s["eta"][drawn & ~through] == 1.0)
    if through.any():
        np.testing.assert_allclose(s["eta"][through], index_behind(mat, wi), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(s["wo"][drawn], axis=1), 1.0, atol=1e-6)
    for lobe in lobes_of(key):
        found = s[s["lobe"] == lobe]
        np.testing.assert_allclose(found["value"], np.repeat(bsdf.scatter(key, mat, wi, lobe)["value"], len(found), 0))
        np.testing.assert_allclose(found["wo"], np.repeat(bsdf.scatter(key, mat, wi, lobe)["wo"], len(found), 0))
    if declaration_of(key)[0].has_smooth:
        found = s[s["lobe"] == LOBE_SMOOTH]
        value, pdf = bsdf.eval_pdf(key, mat, wi, found["wo"]) if len(found) else (np.zeros((0, 3)), np.zeros(0))
        # A map's child is asked in its frame; the direction is rounded on its way out of it, and back again.
        turned = ROUNDED_COSINE if "map(" in key else 0.0
        np.testing.assert_allclose(found["value"], value, rtol=FLOAT32, atol=turned * np.abs(value).max(initial=0.0))
        np.testing.assert_allclose(found["pdf"], pdf, rtol=FLOAT32, atol=turned * pdf.max(initial=0.0))
        if EXAMPLES[key].bounded_by:
            # Beckmann's pdf has the exact G_1 and its value the fit, which exceeds it by up to 0.4 %.
            assert np.all(found["value"] <= 1.005 * mat[EXAMPLES[key].bounded_by] * found["pdf"][:, None])


@each_lobe
def test_no_energy_is_made_and_none_is_lost_in_a_white_furnace(bsdf, key: str, mat: dict, wi: np.ndarray) -> None:
    mat, wi = white(key, mat), rounded(wi)
    probability, energy = 0.0, np.zeros(3)
    # The midpoint rule, above all where the horizon cuts the lobe, and fits within a model.
    slack = 2e-3 if declaration_of(key)[0].has_smooth else 1e-5
    if declaration_of(key)[0].has_smooth:
        mass, energy = quadrature(bsdf, key, mat, wi)
        probability = mass.sum()
    numbers = np.full((2000, 3), 0.5)
    numbers[:, 0] = (np.arange(2000) + 0.5) / 2000
    for lobe, drawn in delta_samples(bsdf, key, mat, wi, numbers).items():
        probability += drawn["pdf"][0] if len(drawn) else 0.0
        energy = energy + energy_of(mat, wi, lobe, bsdf.scatter(key, mat, wi, lobe)["value"][0].astype(float))
    assert np.all(energy <= 1.0 + EXAMPLES[key].made + slack)
    assert probability <= 1.0 + slack
    if EXAMPLES[key].lossless(mat):
        np.testing.assert_allclose(energy, 1.0, atol=slack)
        # Lobes rarer than the numbers above tell are not found.
        np.testing.assert_allclose(probability, 1.0, atol=slack + (1e-3 if lobes_of(key) else 0.0))


@each_model
def test_samples_are_finite_at_the_ends_of_the_unit_square(bsdf: Launcher, key: str) -> None:
    other = np.linspace(0.0, 0.99999994, 17, dtype=np.float32)
    ends = (0.0, np.float32(0.99999994))
    uvw = np.concatenate([[(0.5, c, x), (0.5, x, c), (c, x, x)] for c in ends for x in other])
    for mat in (*EXAMPLES[key].materials, *EXAMPLES[key].extremes, *corners(key)):
        for angle in (0.0, 30.0, 89.9999):
            s = bsdf.sample(key, mat, direction(angle), uvw)
            assert all(np.all(np.isfinite(s[name])) for name in ("wo", "value", "pdf"))


@each_smooth_model
def test_samples_are_finite_at_the_rim_of_the_unit_square(bsdf: Launcher, key: str) -> None:
    """The squared radius of a point on a disk's rim may exceed one by rounding; a uniform number may be zero."""
    mat = EXAMPLES[key].materials[0]
    if "alpha_u" in mat:
        mat = mat | {"alpha_u": 0.05, "alpha_v": 0.05}
    rim = np.linspace(0.0, 0.99999994, 1 << 15, dtype=np.float32)
    half = np.full_like(rim, 0.5)
    for end in (0.0, 0.99999994):
        for v in ((half, np.full_like(rim, end), rim), (half, rim, np.full_like(rim, end))):
            s = bsdf.sample(key, mat, direction(0.0), np.stack(v, axis=1))
            assert all(np.all(np.isfinite(s[name])) for name in ("wo", "value", "pdf"))
            # GGX has normals in the surface, and the diffuse model directions.
            assert key != BECKMANN or np.all(s["lobe"] == LOBE_SMOOTH)

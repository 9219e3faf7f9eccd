"""Scattering models: values against a float64 twin and Mitsuba, samplers against densities, energy, reciprocity."""

from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy import stats

from tests.bsdf.helpers import (
    ALL_MODELS,
    GOLD,
    MIRROR,
    ROUGH,
    Launcher,
    direction,
    make_kernels,
    material,
    random_directions,
    rough,
    twin_eval,
    twin_scatter,
    unit,
)
from warp_psdr.kernels.bsdf.dispatch import make_bsdf
from warp_psdr.kernels.bsdf.microfacet import MIN_ALPHA
from warp_psdr.kernels.constants import (
    BSDF_CONDUCTOR,
    BSDF_DIELECTRIC,
    BSDF_DIFFUSE,
    BSDF_ROUGH_CONDUCTOR_BECKMANN,
    BSDF_ROUGH_CONDUCTOR_GGX,
    LOBE_DELTA_REFLECTION,
    LOBE_DELTA_TRANSMISSION,
    LOBE_NONE,
    LOBE_SMOOTH,
)

#: Relative error of float32 arithmetic through a microfacet model (a few dozen operations of 6e-8 each).
FLOAT32 = 2e-5
#: Probability of a false alarm of all chi-square tests together.
SIGNIFICANCE = 0.01
SAMPLES = 100_000

GREY = material((0.2, 0.5, 0.8))
ALPHAS = [(MIN_ALPHA, MIN_ALPHA), (1e-4, 1e-4), (0.05, 0.05), (0.3, 0.08), (0.6, 0.6), (0.2, 1.0)]
ANGLES = [0.0, 40.0, 75.0, 88.0]
LOBES = [(BSDF_DIFFUSE, GREY, angle) for angle in ANGLES] + [
    # At 88 degrees the narrowest lobe is only twelve float32 directions wide.
    (model, rough(*alpha), angle)
    for model in ROUGH
    for alpha in ALPHAS
    for angle in ANGLES
    if angle < 88.0 or min(alpha) > MIN_ALPHA
]


def lobe_name(value) -> str:
    return f"alpha={value['s0']:g},{value['s1']:g}" if isinstance(value, np.void) else f"{value:g}"


each_lobe = pytest.mark.parametrize(("model", "mat", "angle"), LOBES, ids=lobe_name)


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


# --- coordinates in which a lobe is smooth: (q, phi), q in [0, 1) ---


def from_lobe(
    model: int, mat: np.void, wi: np.ndarray, q: np.ndarray, phi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) and solid angle per dq dphi."""
    if model == BSDF_DIFFUSE:
        r, z = np.sqrt(1.0 - q), np.sqrt(q)
        return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 0.5 / z
    # Slopes of the half vector, in units of alpha; their length p is mapped to [0, 1), tails wide open.
    p = np.tan(0.5 * np.pi * q)
    h = np.stack([mat["s0"] * p * np.cos(phi), mat["s1"] * p * np.sin(phi), np.ones_like(p)], axis=1)
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    dot = h @ wi
    wo = 2.0 * dot[:, None] * h - wi
    return wo, 4.0 * np.abs(dot) * h[:, 2] ** 3 * mat["s0"] * mat["s1"] * p * (1.0 + p * p) * 0.5 * np.pi


def to_lobe(model: int, mat: np.void, wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if model == BSDF_DIFFUSE:
        return wo[:, 2] ** 2, np.arctan2(wo[:, 1], wo[:, 0]) % (2.0 * np.pi)
    h = wi + wo
    x, y = h[:, 0] / h[:, 2] / mat["s0"], h[:, 1] / h[:, 2] / mat["s1"]
    return np.arctan(np.hypot(x, y)) * 2.0 / np.pi, np.arctan2(y, x) % (2.0 * np.pi)


def quadrature(bsdf: Launcher, model: int, mat: np.void, angle: float, bins=(20, 24), fine=(60, 12)):
    """Integrals of the pdf over each bin (shape ``bins``) and of the value over the hemisphere, midpoint rule.

    Finer in q, since at normal incidence the horizon cuts all of a ring of bins at one q.
    """
    wi = direction(angle).astype(np.float32).astype(float)
    n_q, n_phi = bins[0] * fine[0], bins[1] * fine[1]
    q, phi = np.meshgrid((np.arange(n_q) + 0.5) / n_q, (np.arange(n_phi) + 0.5) * 2.0 * np.pi / n_phi, indexing="ij")
    wo, jacobian = from_lobe(model, mat, wi, q.ravel(), phi.ravel())
    value, pdf = bsdf.eval_pdf(model, mat, wi, wo)
    cell = jacobian * 2.0 * np.pi / (n_q * n_phi)
    cells = (pdf * cell).reshape(bins[0], fine[0], bins[1], fine[1])
    return cells.sum(axis=(1, 3)), (value * cell[:, None]).sum(axis=0)


def chi_square_p(observed: np.ndarray, expected: np.ndarray) -> float:
    """p-value; the rarest bins are pooled into one that expects at least 5 samples."""
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    pooled = max(int(np.searchsorted(np.cumsum(expected), 5.0)) + 1, int(np.searchsorted(expected, 5.0)))
    observed = np.append(observed[pooled:], observed[:pooled].sum())
    expected = np.append(expected[pooled:], expected[:pooled].sum())
    return float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), df=len(expected) - 1))


def sampler_p(bsdf: Launcher, model: int, mat: np.void, angle: float, pdf_mat: np.void) -> float:
    """Chi-square test of the samples of ``mat`` against the pdf of ``pdf_mat``; invalid samples are one more bin."""
    rng = np.random.default_rng([model, round(angle), round(1e6 * mat["s0"])])
    wi = direction(angle).astype(np.float32).astype(float)
    s = bsdf.sample(model, mat, wi, rng.random((SAMPLES, 3), dtype=np.float32))
    valid = s["lobe"] == LOBE_SMOOTH
    assert np.all(valid | (s["lobe"] == LOBE_NONE))
    assert np.all((s["pdf"] > 0.0) == valid)
    mass, _ = quadrature(bsdf, model, pdf_mat, angle)
    q, phi = to_lobe(model, pdf_mat, wi, s["wo"][valid].astype(float))
    observed, _, _ = np.histogram2d(q, phi, bins=mass.shape, range=[(0.0, 1.0), (0.0, 2.0 * np.pi)])
    observed = np.append(observed.ravel(), SAMPLES - valid.sum())
    expected = SAMPLES * np.append(mass.ravel(), max(1.0 - mass.sum(), 0.0))
    return chi_square_p(observed, expected)


@each_lobe
def test_samples_follow_the_pdf(bsdf: Launcher, model: int, mat: np.void, angle: float) -> None:
    assert sampler_p(bsdf, model, mat, angle, mat) > SIGNIFICANCE / len(LOBES)


@pytest.mark.parametrize("model", ROUGH)
@pytest.mark.parametrize("angle", [0.0, 75.0])
def test_the_chi_square_test_notices_a_slightly_wrong_roughness(bsdf: Launcher, model: int, angle: float) -> None:
    assert sampler_p(bsdf, model, rough(0.3), angle, rough(0.32)) < 1e-6


@each_lobe
def test_sample_returns_the_value_and_pdf_of_its_direction(bsdf, model: int, mat: np.void, angle: float) -> None:
    rng = np.random.default_rng(1)
    s = bsdf.sample(model, mat, direction(angle), rng.random((1000, 3), dtype=np.float32))
    value, pdf = bsdf.eval_pdf(model, mat, direction(angle), s["wo"])
    valid = s["lobe"] == LOBE_SMOOTH
    np.testing.assert_allclose(s["value"][valid], value[valid], rtol=FLOAT32)
    np.testing.assert_allclose(s["pdf"][valid], pdf[valid], rtol=FLOAT32)
    np.testing.assert_allclose(np.linalg.norm(s["wo"][valid], axis=1), 1.0, atol=1e-6)
    assert np.all(s["eta"] == 1.0)
    # Weights are bounded by the reflectance: visible normals leave G_1(wo) F. Beckmann's pdf has the exact G_1 and its
    # value the fit, which exceeds it by up to 0.4 %.
    assert np.all(s["value"][valid] <= 1.005 * mat["c0"] * s["pdf"][valid, None])


@each_lobe
def test_albedo_is_below_one_and_pdf_mass_at_most_one(bsdf, model: int, mat: np.void, angle: float) -> None:
    white = material((1.0, 1.0, 1.0), *MIRROR, mat["s0"], mat["s1"])
    mass, albedo = quadrature(bsdf, model, white, angle)
    # The midpoint rule, above all where the horizon cuts the lobe.
    slack = 2e-3
    assert np.all(albedo <= 1.0 + slack)
    assert mass.sum() <= 1.0 + slack
    if model == BSDF_DIFFUSE or mat["s0"] == mat["s1"] <= 1e-4:
        # Nothing is lost: a Lambertian surface and a nearly smooth mirror are white in a white furnace.
        np.testing.assert_allclose(albedo, 1.0, atol=slack)
        np.testing.assert_allclose(mass.sum(), 1.0, atol=slack)


@pytest.mark.parametrize("model", ALL_MODELS)
def test_values_agree_with_the_twin(bsdf: Launcher, model: int) -> None:
    rng = np.random.default_rng(2)
    wi, anywhere = (random_directions(rng, 300, both_sides=True).astype(np.float32).astype(float) for _ in range(2))
    metals = [GOLD, MIRROR, ((1.5, 1.0, 0.5), (0.0, 0.0, 0.1))]
    mats = [GREY] if model == BSDF_DIFFUSE else [rough(*a, metal=m) for a in ALPHAS for m in metals]
    for mat in mats:
        # A third of the directions lie in the lobe, however narrow it is.
        s = bsdf.sample(model, mat, wi, rng.random((300, 3), dtype=np.float32))
        inside = (s["lobe"] == LOBE_SMOOTH) & (np.arange(300) % 3 > 0)
        wo = np.where(inside[:, None], s["wo"].astype(float), anywhere)
        value, _ = bsdf.eval_pdf(model, mat, wi, wo)
        # Directions are as the device sees them but for their lengths, which are rounded too.
        expected = np.array([twin_eval(model, mat, a, b) for a, b in zip(unit(wi), unit(wo), strict=True)])
        np.testing.assert_allclose(value, expected, rtol=10 * FLOAT32, atol=1e-9)
        assert (expected.max() > 0.0) == (model in (BSDF_DIFFUSE, *ROUGH))


@pytest.mark.parametrize("model", [BSDF_DIFFUSE, *ROUGH])
def test_reciprocity(bsdf: Launcher, model: int) -> None:
    rng = np.random.default_rng(3)
    wi, wo = (random_directions(rng, 300) for _ in range(2))
    mat = GREY if model == BSDF_DIFFUSE else rough(0.4, 0.2)
    forward, _ = bsdf.eval_pdf(model, mat, wi, wo)
    backward, _ = bsdf.eval_pdf(model, mat, wo, wi)
    assert forward.max() > 0.1
    np.testing.assert_allclose(forward / wo[:, 2:], backward / wi[:, 2:], rtol=FLOAT32)


@pytest.mark.parametrize("model", [BSDF_DIFFUSE, BSDF_CONDUCTOR, *ROUGH])
def test_opaque_models_scatter_on_their_front_only(bsdf: Launcher, model: int) -> None:
    mat = rough(0.3)
    behind = direction(40.0) * [1.0, 1.0, -1.0]
    uvw = np.random.default_rng(4).random((100, 3), dtype=np.float32)
    s = bsdf.sample(model, mat, behind, uvw)
    assert np.all(s["lobe"] == LOBE_NONE) and np.all(s["pdf"] == 0.0) and np.all(s["value"] == 0.0)
    for wi, wo in [(behind, direction(10.0)), (direction(10.0), behind), (behind, behind)]:
        value, pdf = bsdf.eval_pdf(model, mat, wi, wo)
        assert np.all(value == 0.0) and np.all(pdf == 0.0)
    if model == BSDF_CONDUCTOR:
        assert np.all(bsdf.scatter(model, mat, behind, LOBE_DELTA_REFLECTION)["value"] == 0.0)


@pytest.mark.parametrize("corner", [0.0, np.float32(0.99999994)])
@pytest.mark.parametrize("model", ALL_MODELS)
def test_samples_are_finite_at_the_ends_of_the_unit_square(bsdf: Launcher, model: int, corner: float) -> None:
    other = np.linspace(0.0, 0.99999994, 17, dtype=np.float32)
    uvw = np.concatenate([[(0.5, corner, x), (0.5, x, corner), (corner, x, x)] for x in other])
    for mat in [rough(MIN_ALPHA), rough(1.0), material(s0=1.5), rough(0.3, metal=MIRROR)]:
        for angle in (0.0, 30.0, 89.9999):
            s = bsdf.sample(model, mat, direction(angle), uvw)
            assert all(np.all(np.isfinite(s[name])) for name in ("wo", "value", "pdf"))


@pytest.mark.parametrize("model", [BSDF_DIFFUSE, *ROUGH])
def test_samples_are_finite_at_the_rim_of_the_unit_square(bsdf: Launcher, model: int) -> None:
    """The squared radius of a point on a disk's rim may exceed one by rounding; a uniform number may be zero."""
    rim = np.linspace(0.0, 0.99999994, 1 << 15, dtype=np.float32)
    half = np.full_like(rim, 0.5)
    for end in (0.0, 0.99999994):
        for v in ((half, np.full_like(rim, end), rim), (half, rim, np.full_like(rim, end))):
            s = bsdf.sample(model, rough(0.05) if model in ROUGH else GREY, direction(0.0), np.stack(v, axis=1))
            assert all(np.all(np.isfinite(s[name])) for name in ("wo", "value", "pdf"))
            # GGX has normals in the surface, and the diffuse model directions.
            assert model != BSDF_ROUGH_CONDUCTOR_BECKMANN or np.all(s["lobe"] == LOBE_SMOOTH)


# --- delta lobes ---


@pytest.mark.parametrize("eta", [1.5, 1.0, 0.7, 1.0001, 2.4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_dielectric_splits_the_energy(bsdf: Launcher, eta: float, side: float) -> None:
    mat = material((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), s0=eta)
    relative = eta if side > 0.0 else 1.0 / eta
    n = 20_000
    for angle in (0.0, 30.0, 60.0, 89.0):
        wi = direction(angle) * [1.0, 1.0, side]
        s = bsdf.sample(BSDF_DIELECTRIC, mat, wi, np.random.default_rng(5).random((n, 3), dtype=np.float32))
        reflected = s["lobe"] == LOBE_DELTA_REFLECTION
        assert np.all(reflected | (s["lobe"] == LOBE_DELTA_TRANSMISSION))
        energy = np.where(reflected[:, None], s["value"], s["value"] * relative**2)
        np.testing.assert_allclose(energy, np.tile(s["pdf"][:, None], 3), rtol=1e-5)
        np.testing.assert_allclose(s["eta"], np.where(reflected, 1.0, relative), rtol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(s["wo"], axis=1), 1.0, atol=1e-6)
        both = [bsdf.scatter(BSDF_DIELECTRIC, mat, wi, lobe)["value"][0, 0] for lobe in (2, 3)]
        np.testing.assert_allclose(both[0] + both[1] * relative**2, 1.0, rtol=1e-5)
        assert stats.binomtest(int(reflected.sum()), n, float(min(both[0], 1.0))).pvalue > SIGNIFICANCE / 40


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_delta_lobes_agree_with_the_twin(bsdf: Launcher, side: float) -> None:
    wi = random_directions(np.random.default_rng(6), 200).astype(np.float32).astype(float) * [1.0, 1.0, side]
    cases = [(BSDF_DIELECTRIC, material((0.9, 0.5, 0.1), (0.2, 0.4, 0.6), s0=eta)) for eta in (1.5, 0.7, 1.001)]
    cases += [(BSDF_CONDUCTOR, rough(0.0)), (BSDF_CONDUCTOR, rough(0.0, metal=MIRROR))]
    for model, mat in cases:
        for lobe in (LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION)[: 2 if model == BSDF_DIELECTRIC else 1]:
            s = bsdf.scatter(model, mat, wi, lobe)
            twin = [twin_scatter(model, mat, w, lobe) for w in wi]
            # Near the critical angle the refracted cosine is the root of a float32 difference.
            np.testing.assert_allclose(s["value"], [v for _, v in twin], rtol=1e-3, atol=1e-6)
            lit = np.array([v.max() for _, v in twin]) > 0.0
            assert lit.any() == (model == BSDF_DIELECTRIC or side > 0.0)
            np.testing.assert_allclose(s["wo"][lit], np.array([d for d, _ in twin])[lit], atol=2e-4)


def test_refraction_is_reversible(bsdf: Launcher) -> None:
    wi = random_directions(np.random.default_rng(7), 100)
    mat = material((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), s0=1.5)
    there = bsdf.scatter(BSDF_DIELECTRIC, mat, wi, LOBE_DELTA_TRANSMISSION)
    back = bsdf.scatter(BSDF_DIELECTRIC, mat, there["wo"], LOBE_DELTA_TRANSMISSION)
    np.testing.assert_allclose(back["wo"], wi, atol=1e-5)
    np.testing.assert_allclose(there["value"] * 1.5**2, back["value"] / 1.5**2, rtol=2e-3)


def test_a_mirror_without_material_reflects_everything(bsdf: Launcher) -> None:
    wi = random_directions(np.random.default_rng(8), 100)
    s = bsdf.scatter(BSDF_CONDUCTOR, rough(0.0, metal=MIRROR, reflectance=(1, 1, 1)), wi, LOBE_DELTA_REFLECTION)
    assert np.all(s["value"] == 1.0)


# --- Mitsuba ---


@pytest.mark.parametrize(
    ("model", "mat", "plugin"),
    [
        (BSDF_DIFFUSE, GREY, {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}),
        *[
            (model, rough(u, v), {"type": "roughconductor", "distribution": name, "alpha_u": u, "alpha_v": v})
            for model, name in zip(ROUGH, ("ggx", "beckmann"), strict=True)
            for u, v in ((0.05, 0.05), (0.3, 0.08), (0.6, 0.6))
        ],
    ],
)  # fmt: skip
def test_values_and_densities_agree_with_mitsuba(bsdf: Launcher, model: int, mat: np.void, plugin: dict) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    if model != BSDF_DIFFUSE:
        rgb = {"specular_reflectance": mat["c0"], "eta": mat["c1"], "k": mat["c2"]}
        plugin = {**plugin, **{name: {"type": "rgb", "value": value.tolist()} for name, value in rgb.items()}}
    theirs = mi.load_dict(plugin)
    wi = random_directions(np.random.default_rng(9), 300)
    s = bsdf.sample(model, mat, wi, np.random.default_rng(10).random((300, 3), dtype=np.float32))
    wo = np.where((s["lobe"] == LOBE_SMOOTH)[:, None], s["wo"], random_directions(np.random.default_rng(11), 300))
    value, pdf = bsdf.eval_pdf(model, mat, wi, wo)
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    expected = []
    for a, b in zip(wi, wo, strict=True):
        si.wi = mi.Vector3f(*a)
        expected.append((*theirs.eval(context, si, mi.Vector3f(*b)), theirs.pdf(context, si, mi.Vector3f(*b))))
    expected = np.array(expected)
    np.testing.assert_allclose(value, expected[:, :3], rtol=2e-3, atol=1e-5 * value.max())
    # Mitsuba's Beckmann pdf takes a rational fit of the masking, ours the exact one. It cuts densities below 1e-20.
    rtol = 1e-2 if model == BSDF_ROUGH_CONDUCTOR_BECKMANN else 2e-3
    np.testing.assert_allclose(pdf, expected[:, 3], rtol=rtol, atol=1e-12)


def test_delta_lobes_agree_with_mitsuba(bsdf: Launcher) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    rgb = {name: {"type": "rgb", "value": list(v)} for name, v in zip(("eta", "k"), GOLD, strict=True)}
    glass = mi.load_dict({"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0})
    metal = mi.load_dict({"type": "conductor", **rgb})
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    rng = np.random.default_rng(12)
    cases = [
        (BSDF_DIELECTRIC, glass, material(c1=(1, 1, 1), s0=1.5)),
        (BSDF_CONDUCTOR, metal, material((1, 1, 1), *GOLD)),
    ]
    for model, theirs, mat in cases:
        for wi in random_directions(rng, 100, both_sides=model == BSDF_DIELECTRIC):
            uvw = rng.random(3, dtype=np.float32)
            s = bsdf.sample(model, mat, wi, uvw)[0]
            si.wi = mi.Vector3f(*wi)
            reference, weight = theirs.sample(context, si, float(uvw[0]), mi.Point2f(*uvw[1:]))
            np.testing.assert_allclose(s["wo"], np.array(reference.wo), atol=1e-5)
            np.testing.assert_allclose(s["value"] / s["pdf"], np.array(weight), rtol=1e-4)
            np.testing.assert_allclose([s["pdf"], s["eta"]], [reference.pdf, reference.eta], rtol=1e-4)


# --- dispatch ---


#: Warp warns that the library is bound to this processor; only its source is read.
ignore_native = pytest.mark.filterwarnings("ignore:compile_aot_module")


def generated_source(models: tuple[int, ...], folder: Path) -> str:
    for kernel in make_kernels(models).values():
        wp.compile_aot_module(kernel.module, device="cpu", module_dir=folder)
    return "".join(path.read_text() for path in folder.glob("*.cpp")).lower()


@ignore_native
def test_one_model_compiles_nothing_of_the_others(tmp_path: Path) -> None:
    source = generated_source((BSDF_DIFFUSE,), tmp_path)
    assert "diffuse_eval" in source and "diffuse_sample" in source
    for other in ("microfacet", "ggx", "beckmann", "dielectric", "conductor", "fresnel", "alpha", "delta_"):
        assert other not in source
    # Nor is there anything to choose from.
    assert "var_model ==" not in source and "var_model !=" not in source


@ignore_native
def test_one_distribution_compiles_nothing_of_the_other(tmp_path: Path) -> None:
    source = generated_source((BSDF_ROUGH_CONDUCTOR_GGX,), tmp_path)
    assert "ggx_ndf" in source and "beckmann" not in source and "diffuse" not in source


@pytest.mark.parametrize("models", [(BSDF_DIFFUSE,), (BSDF_CONDUCTOR, BSDF_DIELECTRIC), ALL_MODELS], ids=str)
def test_is_delta(models: tuple[int, ...], device: str) -> None:
    is_delta = make_bsdf(models).is_delta

    @wp.kernel(module="unique", enable_backward=False)
    def ask(model: wp.array(dtype=wp.int32), answer_out: wp.array(dtype=wp.bool)):
        i = wp.tid()
        answer_out[i] = is_delta(model[i])

    answer = wp.empty(len(models), dtype=wp.bool, device=device)
    wp.launch(ask, answer.shape, [wp.array(models, dtype=wp.int32, device=device)], [answer], device=device)
    assert answer.numpy().tolist() == [m in (BSDF_CONDUCTOR, BSDF_DIELECTRIC) for m in models]


def test_functions_that_no_model_provides_are_absent() -> None:
    smooth, delta = make_bsdf((BSDF_DIFFUSE, BSDF_ROUGH_CONDUCTOR_GGX)), make_bsdf((BSDF_CONDUCTOR, BSDF_DIELECTRIC))
    assert smooth.scatter is None and smooth.scatter_vjp is None
    assert delta.eval is None and delta.pdf is None and delta.eval_vjp is None


def test_dispatch_changes_no_bit(bsdf: Launcher, device: str) -> None:
    wi, wo = (random_directions(np.random.default_rng(13), 50) for _ in range(2))
    mat, w = material((0.9, 0.5, 0.1), *GOLD, 0.3, 0.2), (0.3, 0.5, 0.7)
    for model in (BSDF_DIFFUSE, BSDF_ROUGH_CONDUCTOR_GGX):
        alone = Launcher(device, (model,))
        for mine, other in zip(bsdf.eval_pdf(model, mat, wi, wo), alone.eval_pdf(model, mat, wi, wo), strict=True):
            np.testing.assert_array_equal(mine, other)
        np.testing.assert_array_equal(bsdf.eval_vjp(model, mat, wi, wo, w), alone.eval_vjp(model, mat, wi, wo, w))
        assert np.all(bsdf.scatter(model, mat, wi, LOBE_DELTA_REFLECTION)["value"] == 0.0)


@pytest.mark.parametrize("models", [(), (BSDF_CONDUCTOR, BSDF_DIFFUSE), (BSDF_DIFFUSE, BSDF_DIFFUSE), (99,)], ids=str)
def test_bad_model_sets_are_named(models: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="strictly ascending"):
        make_bsdf(models)


@pytest.mark.slow
def test_all_models_compile_for_cuda(tmp_path: Path) -> None:
    for kernel in make_kernels(ALL_MODELS).values():
        assert wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path)

"""Scattering models: values against a float64 twin and Mitsuba, reciprocity, sides.

The tests run over ``EXAMPLES`` in ``helpers.py``; a new model joins them by its entry there.
"""

import numpy as np
import pytest

from tests.bsdf.helpers import (
    ALL_MODELS,
    BELOW,
    BUMPED,
    COATED_BLEND,
    DELTA_MODELS,
    EXAMPLES,
    GLASS_BLEND,
    MAPPED,
    MASKED_COAT,
    MASKED_PLATE,
    MIRROR,
    SMOOTH_MODELS,
    Launcher,
    as_seen,
    delta_samples,
    direction,
    energy_of,
    glass,
    index_behind,
    is_black,
    lobes_of,
    metal,
    narrowest,
    passes,
    plastic,
    random_directions,
    rounded,
    transmits,
    uniform,
    unit,
    values_of,
    white,
)
from tests.bsdf.nested import bare, bumped_normal, nest
from tests.bsdf.twins import fresnel_dielectric, mean_reflectance
from warp_psdr.kernels.bsdf.dispatch import declaration_of
from warp_psdr.kernels.constants import LOBE_DELTA_REFLECTION, LOBE_DELTA_TRANSMISSION, LOBE_NONE, LOBE_SMOOTH

#: Relative error of float32 arithmetic through a microfacet model (a few dozen operations of 6e-8 each).
FLOAT32 = 2e-5
#: Relative error of a refracted value times the roughness: 2^-24 over what the indices 1.1 and 1 leave of a direction.
REFRACTION = 1e-6
#: Pairs of directions at which Mitsuba's values are compared.
PAIRS = 2000

UP = np.array([0.0, 0.0, 1.0])

each_model = pytest.mark.parametrize("key", ALL_MODELS)
each_smooth_model = pytest.mark.parametrize("key", SMOOTH_MODELS)
each_delta_model = pytest.mark.parametrize("key", DELTA_MODELS)


@pytest.fixture
def bsdf(device: str) -> Launcher:
    return Launcher(device)


# --- the table ---


def test_every_model_has_an_example() -> None:
    assert tuple(EXAMPLES) == ALL_MODELS


@each_model
def test_an_example_has_what_its_model_declares(key: str) -> None:
    example, model = EXAMPLES[key], declaration_of(key)[0]
    assert (example.eval is not None) == model.has_smooth
    assert (example.scatter is not None) == model.has_delta
    names = {value.name for value in values_of(key)}
    for mat in (*example.materials, *example.more, *example.extremes):
        assert set(mat) == names
    typical = example.materials[0]
    for value in values_of(key):
        assert np.all(value.low < typical[value.name]) and np.all(typical[value.name] < value.high), value.name
        assert np.shape(typical[value.name]) == ((3,) if value.color else ())


# --- smooth lobes ---


def is_smoothly_black(mat: dict) -> bool:
    """Whether no smooth lobe has light, although others may."""
    return bool(np.all(bare(mat).get("diffuse_reflectance", 1.0) == 0.0)) or mat.get("weight") == 1.0


@each_smooth_model
def test_values_agree_with_the_twin(bsdf: Launcher, key: str) -> None:
    rng, example = np.random.default_rng(2), EXAMPLES[key]
    wi, anywhere = (rounded(random_directions(rng, 300, both_sides=True)) for _ in range(2))
    for mat in map(as_seen, (*example.materials, *example.more)):
        # A third of the directions lie in the lobe, however narrow it is.
        s = bsdf.sample(key, mat, wi, rng.random((300, 3), dtype=np.float32))
        inside = (s["lobe"] == LOBE_SMOOTH) & (np.arange(300) % 3 > 0)
        wo = np.where(inside[:, None], s["wo"].astype(float), anywhere)
        value, _ = bsdf.eval_pdf(key, mat, wi, wo)
        # Directions are as the device sees them but for their lengths, which are rounded too.
        expected = np.array([example.eval(mat, a, b) for a, b in zip(unit(wi), unit(wo), strict=True)])
        # Of a refraction nothing but the directions' rounding tells the half vector (docs/theory/materials.md).
        digits = REFRACTION / narrowest(mat) if passes(key) else 0.0
        np.testing.assert_allclose(value, expected, rtol=10 * FLOAT32 + digits, atol=1e-9)
        assert (
            expected.max() > 0.0
            or is_black(key, mat)
            or is_smoothly_black(mat)
            or 0.0 in (mat.get("opacity"), mat.get("A"))
        )


@pytest.mark.parametrize("key", [key for key in SMOOTH_MODELS if key != MAPPED])
def test_reciprocity(bsdf: Launcher, key: str) -> None:
    """The shadowing of a normal map is not reciprocal."""
    rng = np.random.default_rng(3)
    wi, wo = (random_directions(rng, 300) for _ in range(2))
    mat = EXAMPLES[key].materials[0]
    forward, _ = bsdf.eval_pdf(key, mat, wi, wo)
    backward, _ = bsdf.eval_pdf(key, mat, wo, wi)
    assert forward.max() > 0.1
    n = bumped_normal(mat) if key == BUMPED else UP
    both = (wi @ n > 0.02) & (wo @ n > 0.02)
    forward, backward = (f[both] / (w[both] @ n)[:, None] for f, w in ((forward, wo), (backward, wi)))
    np.testing.assert_allclose(forward, backward, rtol=5 * FLOAT32 if key == BUMPED else FLOAT32)


@pytest.mark.parametrize("key", [key for key in SMOOTH_MODELS if passes(key)])
def test_what_passes_is_reciprocal_but_for_the_index(bsdf: Launcher, key: str) -> None:
    """Radiance over the squared index is what an interface leaves alone [Veach 1997, section 5.2]."""
    rng = np.random.default_rng(3)
    wi, wo = random_directions(rng, 3000), random_directions(rng, 3000) * BELOW
    mat = EXAMPLES[key].materials[0]
    forward, _ = bsdf.eval_pdf(key, mat, wi, wo)
    backward, _ = bsdf.eval_pdf(key, mat, wo, wi)
    assert (forward > 0.01).any(axis=1).sum() > 100
    np.testing.assert_allclose(
        index_behind(mat, UP) ** 2 * forward / -wo[:, 2:], backward / wi[:, 2:], rtol=10 * FLOAT32, atol=1e-5
    )


@pytest.mark.parametrize("key", [key for key in ALL_MODELS if not (transmits(key) or passes(key))])
def test_opaque_models_scatter_on_their_front_only(bsdf: Launcher, key: str) -> None:
    mat = EXAMPLES[key].materials[0]
    behind = direction(40.0) * BELOW
    s = bsdf.sample(key, mat, behind, uniform(4, 100))
    assert np.all(s["lobe"] == LOBE_NONE) and np.all(s["pdf"] == 0.0) and np.all(s["value"] == 0.0)
    s = bsdf.sample(key, mat, direction(40.0), uniform(4, 100))
    assert np.all(s["wo"][s["lobe"] != LOBE_NONE, 2] > 0.0)
    for wi, wo in [(behind, direction(10.0)), (direction(10.0), behind), (behind, behind)]:
        value, pdf = bsdf.eval_pdf(key, mat, wi, wo)
        assert np.all(value == 0.0) and np.all(pdf == 0.0)
    for lobe in lobes_of(key):
        assert np.all(bsdf.scatter(key, mat, behind, lobe)["value"] == 0.0)


# --- delta lobes ---


def is_unlit(mat: dict) -> bool:
    """Whether a delta lobe has no light, whatever the direction."""
    black = np.all(bare(mat).get("specular_reflectance", 1.0) == 0.0)
    return black or bare(mat).get("ior") == 1.0 or mat.get("weight") == 0.0 or mat.get("opacity") in (0.0, 1.0)


@each_delta_model
@pytest.mark.parametrize("side", [np.ones(3), BELOW], ids=["front", "back"])
def test_delta_lobes_agree_with_the_twin(bsdf: Launcher, key: str, side: np.ndarray) -> None:
    wi = rounded(random_directions(np.random.default_rng(6), 200)) * side
    example = EXAMPLES[key]
    for mat in map(as_seen, (*example.materials, *example.more)):
        for lobe in lobes_of(key):
            s = bsdf.scatter(key, mat, wi, lobe)
            twin = [example.scatter(mat, w, lobe) for w in wi]
            # Near the critical angle the refracted cosine is the root of a float32 difference.
            np.testing.assert_allclose(s["value"], [v for _, v in twin], rtol=1e-3, atol=1e-6)
            lit = np.array([v.max() for _, v in twin]) > 0.0
            if not (is_black(key, mat) or is_unlit(mat)):
                # What lets light pass has a mirror reflection on both sides, unless that is a masked model's.
                front_only = not transmits(key) or (key == MASKED_COAT and lobe == LOBE_DELTA_REFLECTION)
                assert lit.any() == (not front_only or side[2] > 0.0)
            np.testing.assert_allclose(s["wo"][lit], np.array([d for d, _ in twin])[lit], atol=2e-4)


@pytest.mark.parametrize("ior", [1.5, 1.0, 0.7, 1.0001, 2.4])
@pytest.mark.parametrize("side", [np.ones(3), BELOW], ids=["front", "back"])
def test_glass_is_sampled_by_its_energy(bsdf: Launcher, ior: float, side: np.ndarray) -> None:
    mat = white("dielectric", glass(ior))
    for angle in (0.0, 30.0, 60.0, 89.0):
        wi = direction(angle) * side
        for lobe, drawn in delta_samples(bsdf, "dielectric", mat, wi, uniform(5, 1000)).items():
            energy = energy_of(mat, wi, lobe, drawn["value"])
            np.testing.assert_allclose(energy, np.tile(drawn["pdf"][:, None], 3), rtol=1e-5)


@pytest.mark.parametrize("key", [key for key in ALL_MODELS if LOBE_DELTA_TRANSMISSION in lobes_of(key)])
def test_refraction_is_reversible(bsdf: Launcher, key: str) -> None:
    wi = random_directions(np.random.default_rng(7), 100)
    mat = white(key, EXAMPLES[key].materials[0])
    ior = index_behind(mat, UP)
    there = bsdf.scatter(key, mat, wi, LOBE_DELTA_TRANSMISSION)
    back = bsdf.scatter(key, mat, there["wo"], LOBE_DELTA_TRANSMISSION)
    np.testing.assert_allclose(back["wo"], wi, atol=1e-5)
    np.testing.assert_allclose(there["value"] * ior**2, back["value"] / ior**2, rtol=2e-3)


def test_a_mirror_without_material_reflects_everything(bsdf: Launcher) -> None:
    wi = random_directions(np.random.default_rng(8), 100)
    s = bsdf.scatter("conductor", metal(MIRROR, (1, 1, 1)), wi, LOBE_DELTA_REFLECTION)
    assert np.all(s["value"] == 1.0)


@pytest.mark.slow
def test_the_fits_of_plastic_are_mean_reflectances() -> None:
    """Integrated over the hemisphere; the fit above 1 is to 0.2 %, that below 1, of what stays inside, to 0.1 %."""
    c, weights = np.polynomial.legendre.leggauss(2000)
    c, weights = 0.5 * (c + 1.0), 0.5 * weights
    for ior in (1.1, 1.3, 1.5, 1.9):
        for eta in (ior, 1.0 / ior):
            reflectance = [fresnel_dielectric(x, eta)[0] for x in c]
            assert mean_reflectance(eta) == pytest.approx(2.0 * np.sum(weights * c * reflectance), abs=2e-3)


# --- Mitsuba ---

#: Blends with a delta lobe, whose probability Mitsuba adds to the other model's density: a sampled mirror counts too
#: little. Right is the weighted sum of the models (``tests/bsdf/twins.py``), which both are compared with above.
MITSUBA_MIXES = (COATED_BLEND, GLASS_BLEND, MASKED_PLATE)


def mitsuba_of(key: str):
    """Yield our materials and Mitsuba's models."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    for mat in EXAMPLES[key].materials:
        plugin = EXAMPLES[key].mitsuba(mat)
        if plugin is not None:
            yield mi, mat, mi.load_dict(plugin)


def interaction_of(mi, mat: dict):
    """A point in the middle of the texture coordinates, in a frame along the axes."""
    a, b, c = mat.get("metric", (1.0, 0.0, 1.0))
    si = mi.SurfaceInteraction3f()
    si.uv, si.n, si.sh_frame = mi.Point2f(0.5, 0.5), mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.sh_frame.s, si.sh_frame.t = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.dp_du, si.dp_dv = mi.Vector3f(a, 0, 0), mi.Vector3f(b, c, 0)
    return si


@each_smooth_model
def test_values_and_densities_agree_with_mitsuba(bsdf: Launcher, key: str) -> None:
    for mi, mat, theirs in mitsuba_of(key):
        wi = random_directions(np.random.default_rng(9), PAIRS, both_sides=passes(key))
        s = bsdf.sample(key, mat, wi, uniform(10, PAIRS))
        wo = np.where(
            (s["lobe"] == LOBE_SMOOTH)[:, None],
            s["wo"],
            random_directions(np.random.default_rng(11), PAIRS, passes(key)),
        )
        right = [not EXAMPLES[key].mitsuba_wrong(a, b) for a, b in zip(wi, wo, strict=True)]
        wi, wo = wi[right], wo[right]
        assert len(wi) > 0.75 * PAIRS
        value, pdf = bsdf.eval_pdf(key, mat, wi, wo)
        si, context = interaction_of(mi, mat), mi.BSDFContext()
        expected = []
        for a, b in zip(wi, wo, strict=True):
            si.wi = mi.Vector3f(*a)
            expected.append((*theirs.eval(context, si, mi.Vector3f(*b)), theirs.pdf(context, si, mi.Vector3f(*b))))
        expected = np.array(expected)
        np.testing.assert_allclose(value, expected[:, :3], rtol=2e-4, atol=1e-5 * value.max())
        # Mitsuba cuts densities below 1e-20.
        np.testing.assert_allclose(pdf, expected[:, 3], rtol=EXAMPLES[key].mitsuba_pdf, atol=1e-12)


@each_delta_model
def test_delta_lobes_agree_with_mitsuba(bsdf: Launcher, key: str) -> None:
    rng = np.random.default_rng(12)
    for mi, mat, theirs in mitsuba_of(key):
        si, context = interaction_of(mi, mat), mi.BSDFContext()
        found = 0
        for wi in random_directions(rng, 100, both_sides=transmits(key)):
            uvw = rng.random(3, dtype=np.float32)
            s = bsdf.sample(key, mat, wi, uvw)[0]
            si.wi = mi.Vector3f(*wi)
            reference, weight = theirs.sample(context, si, float(uvw[0]), mi.Point2f(*uvw[1:]))
            is_delta = mi.has_flag(reference.sampled_type, mi.BSDFFlags.Delta)
            if key == MAPPED and s["lobe"] == LOBE_NONE:
                # Below one of the two surfaces; in Mitsuba that is a sample without weight.
                assert np.all(np.array(weight) == 0.0)
                continue
            assert (s["lobe"] in lobes_of(key)) == is_delta
            if key in MITSUBA_MIXES:
                assert not is_delta or s["eta"] == pytest.approx(reference.eta, rel=1e-4)
                found += is_delta
                continue
            np.testing.assert_allclose(s["pdf"], reference.pdf, rtol=1e-4)
            if s["lobe"] != LOBE_NONE:
                np.testing.assert_allclose(s["eta"], reference.eta, rtol=1e-4)
            if is_delta:
                np.testing.assert_allclose(s["wo"], np.array(reference.wo), atol=1e-5)
                np.testing.assert_allclose(s["value"] / s["pdf"], np.array(weight), rtol=1e-4)
                found += 1
        assert found > 0


def test_half_mirror_half_paint_reflects_half_in_the_mirror(bsdf: Launcher) -> None:
    """In Mitsuba it is 0.40, for black paint: divided by half the probability plus half the paint's density."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    paint, mirror = {"type": "diffuse", "reflectance": 0.0}, {"type": "conductor", "material": "none"}
    theirs = mi.load_dict({"type": "blendbsdf", "weight": 0.5, "a": paint, "b": mirror})
    si, context = mi.SurfaceInteraction3f(), mi.BSDFContext()
    numbers = uniform(14, 20_000).astype(float)
    wi = direction(40.0)
    si.wi = mi.Vector3f(*wi)
    energy = 0.0
    for a, b, c in numbers:
        s, weight = theirs.sample(context, si, a, mi.Point2f(b, c))
        energy += weight[0] / len(numbers) * mi.has_flag(s.sampled_type, mi.BSDFFlags.Delta)
    assert energy == pytest.approx(0.5 * 0.5 / (0.5 + 0.5 * wi[2] / np.pi), abs=0.02)
    # A base that reflects nothing leaves the weight of the metal alone; the coat of index 1 is none.
    mat = nest(weight=0.5, first=plastic(1.0), second=metal(MIRROR, (1.0, 1.0, 1.0)))
    s = bsdf.sample(COATED_BLEND, mat, wi, numbers)
    mirrored = s[s["lobe"] == LOBE_DELTA_REFLECTION]
    assert np.sum(mirrored["value"][:, 0] / mirrored["pdf"]) / len(s) == pytest.approx(0.5, abs=0.02)

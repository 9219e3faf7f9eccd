"""Tables of materials: the transmittance of a rough coat, and that it follows what it was made from."""

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.bsdf import twins
from warp_psdr.kernels.bsdf.roughplastic import HEADER, RESOLUTION
from warp_psdr.scene.materials.rough_transmittance import COSINES, albedo, through, transmittance

BRUSHED = {"type": "roughplastic", "alpha_u": 0.2, "alpha_v": 0.2}
#: Error of the sums over slopes below, and of Smith's fit of Beckmann's masking, which the table has for one side.
QUADRATURE = 4e-3


def scene(alpha: float = 0.2, ior: float = 1.5, **more) -> dict:
    film = {"type": "hdrfilm", "width": 6, "height": 6, "rfilter": {"type": "box"}}
    pose = psdr.Transform.look_at([0, -1.5, 2], [0, 0, 0], [0, 0, 1])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": pose, "film": film},
        "floor": {
            "type": "rectangle",
            "bsdf": {"type": "roughplastic", "alpha": alpha, "int_ior": ior, "ext_ior": 1.0},
        },
        "sky": {"type": "constant"},
        **more,
    }


def image(scene: psdr.Scene) -> np.ndarray:
    return psdr.render(scene, integrator=psdr.PathIntegrator(max_depth=2), spp=4, seed=3).numpy()


def transmitted(distribution: str, alpha: float, ior: float, cosine: float) -> float:
    """E[(1 - F) G_1(wo)] over visible normals, summed over a grid of slopes instead of samples."""
    n_q, n_phi = 400, 160
    q, phi = np.meshgrid((np.arange(n_q) + 0.5) / n_q, (np.arange(n_phi) + 0.5) * np.pi / n_phi, indexing="ij")
    p = np.tan(0.5 * np.pi * q)
    density = np.exp(-p * p) if distribution == "beckmann" else 1.0 / (1.0 + p * p) ** 2
    # d slope = p dp dphi; visible normals have the density D max(0, <wi, m>), of slopes P <wi, (slope, 1)>.
    normals = np.stack([-alpha * p * np.cos(phi), -alpha * p * np.sin(phi), np.ones_like(p)], axis=-1)
    wi = np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine])
    weight = density * p * (1.0 + p * p) * np.maximum(normals @ wi, 0.0)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    c = np.clip(normals @ wi, 1e-9, 1.0)
    behind = np.sqrt(1.0 - (1.0 - c * c) / ior**2)
    r_s, r_p = (c - ior * behind) / (c + ior * behind), (ior * c - behind) / (ior * c + behind)
    wo = (c / ior - behind)[..., None] * normals - wi / ior
    z = np.clip(-wo[..., 2], 1e-9, 1.0)
    masking = np.vectorize({"ggx": twins.ggx_g1, "beckmann": twins._beckmann_g1}[distribution])
    share = (1.0 - 0.5 * (r_s**2 + r_p**2)) * np.where(wo[..., 2] < 0.0, masking(alpha * np.sqrt(1.0 - z * z) / z), 0.0)
    return float((weight * share).sum() / weight.sum())


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize(("alpha", "ior"), [(0.3, 1.5), (0.1, 1.2)])
def test_the_table_is_the_transmittance_of_microfacets(distribution: str, alpha: float, ior: float) -> None:
    table = through(distribution, alpha, (ior,))[0]
    for i in (12, 40, 63):
        assert table[i] == pytest.approx(transmitted(distribution, alpha, ior, float(COSINES[i])), abs=QUADRATURE)


@pytest.mark.parametrize("distribution", ["ggx", "beckmann"])
@pytest.mark.parametrize(("alpha", "ior"), [(0.4, 1.5), (0.1, 1.9), (0.3, 1.1), (1e-5, 1.5), (0.3, 0.7)])
def test_derivatives_are_those_of_the_table(distribution: str, alpha: float, ior: float) -> None:
    """Over steps that pass over the ripples of the quadrature."""
    table = transmittance(distribution, alpha, ior).reshape(-1, 3).astype(float)
    assert np.isfinite(table).all() and table[0].tolist() == np.float32([alpha, ior, 0.0]).tolist()
    assert table.size == HEADER + 3 * RESOLUTION and 0.0 <= table[1, 0] < 1.0
    assert np.all(table[2:, 0] >= 0.0) and np.all(table[2:, 0] <= 1.0)
    d_alpha, d_ior = 0.01 * alpha, (0.001 if ior > 1.0 else 0.01) * ior
    for column, step, points in (
        (1, d_alpha, [(alpha + d_alpha, ior), (alpha - d_alpha, ior)]),
        (2, d_ior, [(alpha, ior + d_ior), (alpha, ior - d_ior)]),
    ):
        more, less = (through(distribution, a, (n,))[0] for a, n in points)
        expected = (more - less) / (2.0 * step)
        slack = (0.15 if ior < 1.0 else 0.01) * np.abs(expected).max() + 1e-3
        np.testing.assert_allclose(table[2:, column], expected, rtol=0.0, atol=slack)


@pytest.mark.parametrize(("alpha", "ior"), [(0.4, 1.5), (1e-4, 1.3), (1e-4, 1.7), (0.05, 2.2)])
def test_the_internal_reflectance_has_the_derivative_of_its_trend(alpha: float, ior: float) -> None:
    """At 64 cosines it has steps where the coat is nearly smooth; at many it is the mean reflectance."""
    cosines = (np.arange(600) + 0.5) / 600
    iors = (1.0 / (ior * 1.01), 1.0 / (ior * 0.99))
    more, less = 2.0 * np.mean(albedo("ggx", alpha, iors, cosines, transmitted=False) * cosines, axis=1)
    assert transmittance("ggx", alpha, ior)[5] == pytest.approx((more - less) / (0.02 * ior), rel=0.05)


@pytest.mark.parametrize("name", ["alpha", "eta"])
def test_a_table_follows_its_sources_with_and_without_update(name: str) -> None:
    moved = {"alpha": {"alpha": 0.5}, "eta": {"ior": 1.9}}[name]
    expected = image(psdr.load_dict(scene(**moved)))
    followed, edited = (psdr.load_dict(scene()) for _ in range(2))
    before = image(followed)
    value = np.float32(next(iter(moved.values())))
    params = psdr.traverse(followed)
    params[f"floor.bsdf.{name}"] = value
    params.update()
    psdr.traverse(edited)[f"floor.bsdf.{name}"].assign(np.array([value]))  # no update
    np.testing.assert_array_equal(image(followed), expected)
    np.testing.assert_array_equal(image(edited), expected)
    assert np.abs(before - expected).max() > 1e-3


def test_a_table_goes_back_with_the_state_of_a_scene() -> None:
    loaded = psdr.load_dict(scene())
    before = image(loaded)
    alpha = psdr.traverse(loaded)["floor.bsdf.alpha"]
    alpha.assign(np.float32([0.5]))
    state = loaded.state()  # whose table is that of the old roughness
    rough = image(loaded)
    alpha.assign(np.float32([0.2]))
    np.testing.assert_array_equal(image(loaded), before)
    loaded.restore(state)
    np.testing.assert_array_equal(image(loaded), rough)


def test_each_material_has_its_own_table() -> None:
    wall = {"type": "rectangle", "bsdf": {"type": "roughplastic", "distribution": "ggx", "alpha": 0.4}}
    loaded = psdr.load_dict(scene(wall=wall | {"to_world": psdr.Transform.translate([0, 0, -1])}))
    loaded.data()  # as launches ask for it
    first, second = loaded.builder.tables
    values = loaded.values.numpy()
    for table, (variant, alpha) in ((first, ("beckmann", 0.2)), (second, ("ggx", 0.4))):
        made = values[table.offset : table.offset + HEADER + 3 * RESOLUTION]
        np.testing.assert_array_equal(made, transmittance(variant, *made[:2].tolist()))
        assert made[0] == np.float32(alpha)
    assert isinstance(loaded.values, wp.array)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"int_ior": 1.2, "ext_ior": 1.2}, ("scene['x']['bsdf']", "have to differ")),
        ({"alpha": {"type": "bitmap", "bitmap": np.full((2, 2), 0.1)}}, ("'alpha'", "a texture", "give a number")),
        ({"alpha_u": 0.1, "alpha_v": 0.2}, ("alpha_u 0.1 and alpha_v 0.2", "isotropic")),
        ({"alpha": 0.0}, ("'alpha'", "at least 1e-05")),
    ],
)
def test_what_a_coat_cannot_be_is_named(parameters: dict, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError) as caught:
        psdr.load_dict(scene(x={"type": "cube", "bsdf": {"type": "roughplastic", **parameters}}))
    assert all(word in str(caught.value) for word in words), caught.value


def test_equal_roughnesses_are_one() -> None:
    params = psdr.traverse(psdr.load_dict(scene(x={"type": "cube", "bsdf": BRUSHED})))
    assert params["x.bsdf.alpha"].numpy().tolist() == [np.float32(0.2)]


def test_normals_that_are_hidden_are_not_sampled_and_that_is_noted() -> None:
    with pytest.warns(psdr.SceneWarning, match="sample_visible.*visible normals are always sampled"):
        psdr.load_dict(scene(x={"type": "cube", "bsdf": BRUSHED | {"sample_visible": False}}))

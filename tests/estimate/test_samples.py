"""Ranges of samples: films, tiles, checkpoints, and gradients add up to those of a whole call."""

import pickle

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from tests.accuracy.test_light_paths import integrator as from_lights
from tests.boundary import scenes as boundary_scenes
from tests.estimate.test_workers import INTEGRATOR, SIZE
from tests.gradients import scenes
from tests.interior.test_light_tracing import corner
from tests.path.test_light_tracing import lamp

#: Sums of some samples in float32, where a film or a gradient makes them in another order.
SUMMATION = 1e-5
#: Float32 rounding of parts of a gradient, over the gradient.
ROUNDING = 5e-6
MOVING = psdr.PathIntegrator(max_depth=2)  # as tests/test_parts.py
RANGES = [(0, 3), (3, 4), (4, 8)]
LIGHTS = from_lights(psdr.interior.Bidirectional())


def gap_of(*more):
    node = scenes.gap_scene()
    node["sensor"]["film"] |= {"width": SIZE, "height": SIZE}
    extra = {f"sensor{i}": node["sensor"] | {"sampler": {"type": "sobol", **one}} for i, one in enumerate(more)}
    return psdr.load_dict({"type": "scene", **node, **extra})


@pytest.fixture(scope="module")
def gap():
    return gap_of()


@pytest.fixture(scope="module")
def box():
    """The scene of docs/start.md's first program, which has a gaussian filter."""
    return psdr.load_file(psdr.scenes.cornell_box, resolution=24)


@pytest.fixture(scope="module")
def lit():
    return psdr.load_dict(corner(lamp=lamp()))


def film(scene, samples, **options):
    return psdr.render(scene, samples=samples, **{"integrator": INTEGRATOR, "seed": 3, **options})


def assert_equal(one, other):
    for name in ("weights", "radiance", "drawn", "squares", "splats"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_films_of_ranges_add_up_to_the_image(gap):
    whole, parts = film(gap, (0, 16)), film(gap, (0, 3)) + film(gap, (3, 16))
    assert whole.samples == parts.samples == 16 and whole.splats is None
    for name in ("radiance", "squares"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-12)
    np.testing.assert_array_equal(parts.weights, np.full((SIZE, SIZE), 16.0))
    image = psdr.render(gap, integrator=INTEGRATOR, seed=3, spp=16).numpy()
    found = parts.image().numpy()
    assert (np.abs(found - image) <= np.spacing(image)).all() and (found == image).mean() > 0.99


def test_a_sample_is_the_same_whatever_the_number_of_samples(gap):
    """Neither ``spp`` nor the sampler's own number, four, says what is drawn."""
    assert_equal(film(gap, (7, 9)), film(gap, (7, 9), spp=1))
    assert_equal(film(gap, (7, 9)), film(gap, (7, 9), spp=4096))


def test_films_of_wide_filters_add_up_to_the_image(box):
    options = {"integrator": None}
    whole, parts = film(box, (0, 16), **options), sum(film(box, r, **options) for r in ((0, 5), (5, 6), (6, 16)))
    assert whole.squares is None and parts.samples == 16
    image = psdr.render(box, spp=16, seed=3).numpy()
    np.testing.assert_array_equal(whole.image().numpy(), image)
    np.testing.assert_allclose(parts.image().numpy(), image, rtol=SUMMATION)


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_tiles_have_the_values_of_the_whole(rfilter, request):
    name, options, size = {"box": ("gap", {}, SIZE), "gaussian": ("box", {"integrator": None}, 24)}[rfilter]
    scene = request.getfixturevalue(name)
    whole = film(scene, (2, 6), **options)
    tiles = [(x0, y0, x1, y1) for x0, x1 in ((0, 5), (5, 6), (6, size)) for y0, y1 in ((0, 11), (11, size))]
    drawn = [film(scene, (2, 6), pixels=[tile], **options) for tile in tiles]
    assert_equal(sum(drawn), whole)
    assert sum(drawn).samples == 4
    for (x0, y0, x1, y1), tile in zip(tiles, drawn, strict=True):
        inside = np.zeros((size, size), bool)
        inside[y0:y1, x0:x1] = True
        assert (tile.drawn == 4 * inside).all()
        assert not tile.weights[~inside].any() and not tile.image().numpy()[~inside].any()


def test_pixels_in_several_rectangles_are_drawn_once(gap):
    found, whole = film(gap, (2, 6), pixels=np.array([[0, 0, 9, 9], [5, 5, 12, 12]])), film(gap, (2, 6))
    assert (found.drawn > 0).sum() == 81 + 49 - 16
    np.testing.assert_array_equal(found.radiance[:9, :9], whole.radiance[:9, :9])
    np.testing.assert_array_equal(found.radiance[5:12, 5:12], whole.radiance[5:12, 5:12])


def test_films_of_light_paths_add_up_to_the_image(lit):
    options = {"integrator": LIGHTS}
    parts = film(lit, (0, 6), **options) + film(lit, (6, 16), **options)
    image = psdr.render(lit, spp=16, seed=3, **options).numpy()
    assert parts.squares is None and parts.splats.max() > 0.0
    np.testing.assert_allclose(parts.image().numpy(), image, atol=SUMMATION * image.max())
    with pytest.raises(ValueError, match="pixels: paths start at the lights"):
        film(lit, (0, 2), pixels=[(0, 0, 1, 1)], **options)
    with pytest.raises(ValueError, match="no squares"):
        parts.variance()


def test_the_variance_is_that_of_independent_images(gap):
    """Samples of several seeds are independent, those of one seed are stratified."""
    runs, count = 24, 8
    independent = [sum(film(gap, (0, 1), seed=count * run + k) for k in range(count)) for run in range(runs)]
    stratified = [film(gap, (0, count), seed=run) for run in range(runs)]
    ratios = []
    for films in (independent, stratified):
        spread = np.var([f.radiance / f.weights[..., None] for f in films], axis=0, ddof=1).mean()
        ratios.append(np.mean([f.variance().mean() for f in films]) / spread)
    assert abs(ratios[0] - 1.0) < 0.05  # of 1600 pixels and 24 runs
    assert ratios[1] > 1.2


def test_the_variance_of_pixels_without_two_samples_is_not_known(gap):
    found = (film(gap, (0, 1)) + film(gap, (1, 3), pixels=[(0, 0, 5, 5)])).variance()
    assert np.isfinite(found[:5, :5]).all() and np.isnan(found[5:]).all() and np.isnan(found[:, 5:]).all()


@pytest.mark.parametrize("kind", ["squares", "splats"])
def test_a_film_is_saved_and_resumed_to_equal_bits(kind, gap, lit, tmp_path):
    scene, options = (gap, {}) if kind == "squares" else (lit, {"integrator": LIGHTS})
    first, rest = film(scene, (0, 4), **options), film(scene, (4, 6), **options)
    assert getattr(first, kind) is not None
    for n in range(2):  # the second time over the first
        (first if n else rest).save(tmp_path / "film.npz")
    loaded = psdr.Film.load(tmp_path / "film.npz")
    assert_equal(loaded + rest, first + rest)
    assert_equal(pickle.loads(pickle.dumps(loaded)), first)
    assert [path.name for path in tmp_path.iterdir()] == ["film.npz"]
    assert repr(loaded) == f"Film({first.weights.shape[1]} x {first.weights.shape[0]} pixels, 4 samples a pixel)"


def test_what_holds_no_film_is_refused(tmp_path):
    path = tmp_path / "film.npz"
    with pytest.raises(FileNotFoundError):
        psdr.Film.load(path)
    path.write_text("none")
    with pytest.raises(ValueError, match=r"film\.npz: holds no film that Film\.save has written"):
        psdr.Film.load(path)
    for arrays in ({"values": np.ones(3)}, {"weights": np.ones((2, 2)), "drawn": np.ones(3), "radiance": np.ones(3)}):
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match="holds no film"):
            psdr.Film.load(path)


def test_films_that_do_not_add_are_named(gap, lit):
    one = film(gap, (0, 1))
    with pytest.raises(ValueError, match="films of one size"):
        one + film(lit, (0, 1), integrator=LIGHTS)
    with pytest.raises(ValueError, match="only one of the two has squares"):
        one + psdr.Film(weights=one.weights, radiance=one.radiance, drawn=one.drawn)
    with pytest.raises(TypeError):
        one + 1


def gradient(scene, adjoint, names="*", **options):
    params = psdr.traverse(scene)
    params.requires_grad(names)
    psdr.render_backward(scene, params, adjoint, **{"integrator": INTEGRATOR, "seed": 3, "spp": 8, **options})
    return np.concatenate([params[name].grad.numpy().astype(np.float64).ravel() for name in params.requested])


def adjoint_of(*shape):
    return np.random.default_rng(0).normal(size=(*shape, 3))


def assert_adds_up(parts, whole):
    assert all(np.abs(part).max() > 0.05 * np.abs(whole).max() for part in parts)
    np.testing.assert_allclose(sum(parts), whole, atol=ROUNDING * np.abs(whole).max())


def test_gradients_of_ranges_add_up(gap):
    adjoint = adjoint_of(SIZE, SIZE)
    whole = gradient(gap, adjoint)
    assert_adds_up([gradient(gap, adjoint, samples=r) for r in RANGES], whole)
    np.testing.assert_array_equal(gradient(gap, adjoint, samples=(0, 8)), whole)


def test_gradients_and_derivative_images_of_moving_edges_add_up():
    scene, params = boundary_scenes.load("soft")
    name = "occluder.vertex_positions"
    options = {"integrator": MOVING, "spp": 8, "seed": 3}

    def forward(**more):
        tangents = {name: np.ones_like(params[name].numpy())}
        return psdr.render_forward(scene, params, tangents, **options, **more).numpy().astype(np.float64)

    def reverse(**more):
        return gradient(scene, adjoint_of(16, 16), name, **options, **more)

    for call in (forward, reverse):
        assert_adds_up([call(samples=r) for r in RANGES], call())


def test_gradients_of_several_cameras_add_up():
    scene, adjoint = gap_of({"sample_count": 8}), adjoint_of(2, SIZE, SIZE)
    options = {"sensor": [0, 1], "spp": 8}
    whole = gradient(scene, adjoint, **options)
    assert_adds_up([gradient(scene, adjoint, samples=r, **options) for r in RANGES], whole)
    # Of the first camera's four samples there is no sixth: nothing is added.
    params = psdr.traverse(scene)
    params.requires_grad("*")
    with pytest.raises(ValueError, match=r"samples: got \(0, 6\), expected .* b <= spp = 4"):
        psdr.render_backward(scene, params, adjoint, sensor=[1, 0], integrator=INTEGRATOR, samples=(0, 6))
    assert not any(params[name].grad.numpy().any() for name in params.requested)


BAD_RANGES = [(3, 3), (-1, 2), (0, 0), (0, 2.0), (0,), (0, 1, 2), 4, "01", (False, True), range(4), (0, 1 << 31)]


@pytest.mark.parametrize("given", BAD_RANGES, ids=str)
def test_what_is_no_range_is_refused(gap, given):
    with pytest.raises(ValueError, match=r"samples: got .* expected \(a, b\) with 0 <= a < b <= 2147483647"):
        film(gap, given)
    with pytest.raises(ValueError, match=r"samples: got .* expected \(a, b\) with 0 <= a < b <= spp = 8"):
        gradient(gap, adjoint_of(SIZE, SIZE), samples=given)


@pytest.mark.parametrize(
    "given",
    [
        [],
        (0, 0, 1, 1),
        [(0, 0, 41, 1)],
        [(0, 0, 1)],
        [(0, 0, 0, 1)],
        [(0, 3, 1, 2)],
        [(-1, 0, 1, 1)],
        [(0, 0, 1.0, 1)],
        3,
    ],
    ids=str,
)
def test_what_are_no_rectangles_is_refused(gap, given):
    with pytest.raises(ValueError, match=r"pixels: got .*expected rectangles .*x1 <= 40 and 0 <= y0 < y1 <= 40"):
        film(gap, (0, 1), pixels=given)


def test_what_films_exclude_is_named(gap):
    params = psdr.traverse(gap)
    params.requires_grad("*")
    for options in ({"tape": wp.Tape()}, {"params": params, "tape": wp.Tape()}):
        with pytest.raises(ValueError, match="samples: a film is not recorded on a tape"):
            film(gap, (0, 1), **options)
    with wp.Tape(), pytest.raises(ValueError, match="not recorded on a tape"):
        film(gap, (0, 1), params=params)
    with pytest.raises(ValueError, match="pixels: rectangles of a film of samples"):
        psdr.render(gap, pixels=[(0, 0, 1, 1)])
    with pytest.raises(ValueError, match="samples: a film is that of one sensor"):
        film(gap, (0, 1), sensor=[0])
    with pytest.raises(ValueError, match="spp: got 0"):
        film(gap, (0, 1), spp=0)


def test_films_have_no_time_bins():
    node = scenes.gap_scene()
    bins = {"type": "transient_hdr_film", "temporal_bins": 3, "bin_width_opl": 1.0, "start_opl": 0.0}
    node["sensor"]["film"] |= bins
    with pytest.raises(ValueError, match=r"render\(samples=\.\.\.\) does not take the 'transient_hdr_film'"):
        film(psdr.load_dict({"type": "scene", **node}), (0, 1))


@pytest.mark.parametrize("budget", [{"target_error": 0.1}, {"time_budget": 1.0}, {"report": "a report"}], ids=str)
def test_budgets_choose_their_samples_themselves(gap, budget):
    params = psdr.traverse(gap)
    (name,) = budget
    calls = (
        lambda: film(gap, (0, 1), **budget),
        lambda: psdr.render_backward(gap, params, adjoint_of(SIZE, SIZE), samples=(0, 1), **budget),
        lambda: psdr.render_forward(gap, params, {}, samples=(0, 1), **budget),
    )
    for call in calls:
        with pytest.raises(ValueError, match=f"samples and {name} exclude each other"):
            call()


def test_guided_ranges_are_refused(gap):
    guided = psdr.PathIntegrator(boundary=psdr.boundary.Projective())  # which guides by default
    with pytest.raises(ValueError, match=r"samples: guiding.Octree keeps .* say boundary\.Projective\(guiding=None\)"):
        gradient(gap, adjoint_of(SIZE, SIZE), samples=(0, 1), integrator=guided)

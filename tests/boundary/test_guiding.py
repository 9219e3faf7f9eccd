"""Guiding: cells are sampled as they say, coordinates have inverses, and guided estimates equal unguided ones."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy import stats

import warp_psdr as psdr
from warp_psdr.estimate.guiding import edge_chains
from warp_psdr.estimate.guiding.build import Growth, Target, volume
from warp_psdr.estimate.guiding.methods import build
from warp_psdr.estimate.guiding.structure import whole
from warp_psdr.kernels.boundary.guiding.cells import Cells, pdf_cells, sample_cells
from warp_psdr.kernels.boundary.guiding.light_square import make_light_square
from warp_psdr.kernels.boundary.local_form import Edges, edge_at
from warp_psdr.kernels.boundary.path_space.direction import wedge_at, wedge_direction, wedge_square
from warp_psdr.kernels.structs import Scene
from warp_psdr.plan.motion import Motion
from warp_psdr.topology.secondary_edges import secondary_edges

from .measure import Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import ball, camera, diffuse, envmap, floor, load, panel, sky
from .test_table import ALONG, BOX, FLOOR, OCCLUDER, moved

METHODS = {"kdtree": psdr.guiding.KdTree, "octree": psdr.guiding.Octree}
#: Samples of a test of a density; a p-value that a right density falls below once in a million tests.
SAMPLES, P_VALUE = 1 << 17, 1e-6


@wp.kernel(module="unique", enable_backward=False)
def draw(
    cells: Cells,
    v: wp.array(dtype=wp.float64),
    jitter: wp.array(dtype=wp.vec3),
    u_out: wp.array(dtype=wp.vec3d),
    pdf_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    s = sample_cells(cells, v[i], jitter[i])
    u_out[i] = s.u
    pdf_out[i] = s.pdf


@wp.kernel(module="unique", enable_backward=False)
def density(cells: Cells, u: wp.array(dtype=wp.vec3d), pdf_out: wp.array(dtype=wp.float32)):
    pdf_out[wp.tid()] = pdf_cells(cells, u[wp.tid()])


class Bump:
    """An integrand with a narrow bump and a plane of zeros."""

    def __init__(self):
        self.random = np.random.default_rng(3)

    def at(self, points):
        d2 = ((points - [0.3, 0.7, 0.4]) ** 2).sum(axis=1)
        return np.where(points[:, 1] > 0.25, np.exp(-d2 / 0.02), 0.0)

    def within(self, low, high, count):
        octant = np.arange(count) % 8
        upper = (octant[:, None] >> np.array([2, 1, 0])) & 1
        t = 0.5 * (self.random.random((len(low), count, 3)) + upper)
        return self.at((low[:, None] + t * (high - low)[:, None]).reshape(-1, 3)).reshape(len(low), count)


def target(integrand=None):
    edges = np.linspace(0.0, 1.0, 33)
    # The trees read neither the request nor the device's edges.
    return Target("wedge", integrand or Bump(), edges, None, None, np.random.default_rng(7), None, None)


def built(name, **options):
    return build(METHODS[name](**options), target())


def densities(cells, u):
    out = wp.zeros(len(u), dtype=wp.float32)
    wp.launch(density, dim=len(u), inputs=[cells, wp.array(u, dtype=wp.vec3d)], outputs=[out])
    return out.numpy()


def samples(cells, n=SAMPLES):
    random = np.random.default_rng(1)
    u, pdf = wp.zeros(n, dtype=wp.vec3d), wp.zeros(n, dtype=wp.float32)
    numbers = np.floor(random.random((n, 3)) * 2**24) / 2**24
    inputs = [cells, wp.array(random.random(n)), wp.array(numbers, dtype=wp.vec3)]
    wp.launch(draw, dim=n, inputs=inputs, outputs=[u, pdf])
    return u.numpy(), pdf.numpy()


@pytest.mark.slow_rows("kdtree-1.0", "octree-1.0")
@pytest.mark.parametrize("floor_share", [0.2, 1.0])
@pytest.mark.parametrize("name", METHODS)
def test_cells_are_sampled_with_their_density(name, floor_share) -> None:
    leaves = built(name, max_leaves=600)
    assert np.abs(leaves.slope).max() > 0.1, "no ramps to test"
    cells = leaves.upload(floor_share, wp.get_device("cpu"))
    u, pdf = samples(cells)
    assert u.min() >= 0.0 and u.max() < 1.0
    # Absorbs points whose rounded coordinates lie in the next leaf.
    assert np.mean(np.abs(densities(cells, u) - pdf) > 1e-4 * pdf) < 1e-4
    assert pdf.min() >= floor_share * (1.0 - 1e-6)
    # What another technique draws may be in no place of the cube.
    assert not densities(cells, [[-1.0, 0.5, 0.5], [0.5, 2.0, 0.5], [0.5, 0.5, 1.0]]).any()
    # Expected counts in a grid, by stratified quadrature; its error is far below the counts' own.
    grid = np.stack(np.meshgrid(*[np.arange(128)] * 3, indexing="ij"), -1).reshape(-1, 3)
    grid = (grid + np.random.default_rng(6).random(grid.shape)) / 128
    weights = densities(cells, grid)
    assert weights.mean() == pytest.approx(1.0, abs=1e-3)
    index = [(np.floor(8 * x).astype(int) * [64, 8, 1]).sum(axis=1) for x in (grid, u)]
    expected = np.bincount(index[0], weights, 512)
    counts = np.bincount(index[1], minlength=512)
    assert stats.chisquare(counts, expected * (counts.sum() / expected.sum())).pvalue > P_VALUE


@pytest.mark.parametrize("name", METHODS)
def test_leaves_tile_the_cube_and_follow_the_integrand(name) -> None:
    for most in (4, 64, 2000):
        leaves = built(name, max_leaves=most)
        assert len(leaves.low) <= most + 8
        assert volume(leaves.low, leaves.high).sum() == pytest.approx(1.0, abs=1e-6)
    u, pdf = samples(leaves.upload(0.2, wp.get_device("cpu")))
    f = Bump().at(u)
    uniform = Bump().at(np.random.default_rng(2).random((SAMPLES, 3)))
    # Without bias, and with far less variance than uniform samples.
    spread = np.std(f / pdf)
    assert abs((f / pdf).mean() - uniform.mean()) < 4.0 * np.hypot(spread, uniform.std()) / np.sqrt(SAMPLES)
    assert spread < 0.3 * uniform.std()


def test_without_any_mass_all_is_uniform() -> None:
    class Nothing(Bump):
        def at(self, points):
            return np.zeros(len(points))

    for leaves in (whole(), *(build(METHODS[name](max_leaves=64), target(Nothing())) for name in METHODS)):
        u, pdf = samples(leaves.upload(0.2, wp.get_device("cpu")), 1 << 12)
        np.testing.assert_allclose(pdf, 1.0, rtol=1e-5)
        assert stats.kstest(u[:, 0], "uniform").pvalue > P_VALUE


def test_edges_are_split_between_and_within() -> None:
    growth = Growth(target())
    leaf = np.array([0])
    assert growth.middle(leaf, np.array([0]))[0] == 0.5
    lower = growth.split(leaf, np.array([0]), np.array([1.0 / 32.0]))[:1]
    assert growth.middle(lower, np.array([0]))[0] == 1.0 / 64.0


def test_chains_keep_straight_edges_together() -> None:
    random = np.random.default_rng(4)
    x = np.arange(41.0)
    points = np.concatenate([np.stack([x, 5.0 * k + 0.0 * x, 0.0 * x], axis=1) for k in range(3)])
    ends = np.concatenate([np.stack([np.arange(40), np.arange(1, 41)], axis=1) + 41 * k for k in range(3)])
    ends = random.permutation(ends)
    turned_in = random.random(len(ends)) < 0.5
    ends[turned_in] = ends[turned_in, ::-1]
    order, turned = edge_chains.chain_order(points, ends)
    assert sorted(order) == list(range(120))
    walked = np.where(turned[:, None], ends[order][:, ::-1], ends[order])
    joined = walked[1:, 0] == walked[:-1, 1]
    # Chains of twenty edges: six of them, five joints between.
    assert joined.sum() >= 120 - 6


# -- coordinates -----------------------------------------------------------------------------------------------------


@functools.cache
def make_round_trip(config):
    aim, coordinates = make_light_square(config.lights)

    @wp.kernel(module="unique", enable_backward=False)
    def round_trip(
        scene: Scene,
        edges: Edges,
        u: wp.array(dtype=wp.vec3d),
        light_out: wp.array(dtype=wp.vec3d),
        wedge_out: wp.array(dtype=wp.vec2),
    ):
        i = wp.tid()
        point = edge_at(scene, edges, u[i][0])
        d = aim(scene, edges, point, u[i][1], u[i][2])
        light_out[i] = wp.vec3d(wp.float64(-2.0), wp.float64(-2.0), wp.float64(0.0))
        if d.valid == 1 and d.light < 0:
            light_out[i] = coordinates(scene, edges, point, d.face, d.u, d.v, d.w)
        wedge = wedge_at(scene, edges, point)
        wedge_out[i] = wedge_square(wedge, wedge_direction(wedge, wp.vec2(wp.float32(u[i][1]), wp.float32(u[i][2]))))

    return round_trip


def lit(*lights):
    objects = {"floor": floor(), "occluder": ball((0.1, 0.1, 0.9), 0.4, diffuse(0.5))}
    objects |= {f"light{i}": light for i, light in enumerate(lights)}
    return psdr.load_dict({"type": "scene", "sensor": camera(), **objects})


SHINING = ball((0.8, 0.5, 2.0), 0.2, diffuse(0.0), emitter={"type": "area", "radiance": {"type": "rgb", "value": 3.0}})
LIGHTS = {
    "area": (panel((0.5, -0.3, 2.2), 0.35), SHINING),
    "area and sky": (panel((0.5, -0.3, 2.2), 0.35), sky()),
    "area and image": (SHINING, envmap()),
}


@pytest.mark.slow_rows("area and sky", "area")
@pytest.mark.parametrize("name", LIGHTS)
def test_coordinates_have_inverses(name) -> None:
    scene = lit(*LIGHTS[name])
    plan = psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=2))
    edges = secondary_edges(scene, set())
    u = np.random.default_rng(5).random((20000, 3))
    light, wedge = wp.zeros(len(u), dtype=wp.vec3d), wp.zeros(len(u), dtype=wp.vec2)
    inputs = [scene.data(), edges, wp.array(u, dtype=wp.vec3d)]
    wp.launch(make_round_trip(plan.config), dim=len(u), inputs=inputs, outputs=[light, wedge])
    found = light.numpy()
    valid = found[:, 0] > -2.0
    assert valid.mean() > 0.05
    # Absorbs float32 barycentrics of thin stripes; a wrong map misses everywhere.
    wrong = np.abs(found[valid, :2] - u[valid, 1:]).max(axis=1) > 2e-3
    assert wrong.mean() < 0.01
    # At the poles of the wedge's sphere, and between its halves, rounding may choose the other side.
    assert (np.abs(wedge.numpy() - u[:, 1:]).max(axis=1) > 2e-3).mean() < 0.01


# -- estimates -------------------------------------------------------------------------------------------------------


def guided(name="kdtree", **options):
    return psdr.boundary.PathSpace(guiding=METHODS[name](**{"max_leaves": 1024, **options}))


def image(scene, params, boundary, *, seed=0, spp=32, depth=2, tangents=None):
    integrator = psdr.PathIntegrator(max_depth=depth, boundary=boundary)
    tangents = tangents or {OCCLUDER: 1.0}
    return psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()


ROWS = [
    Case("soft", OCCLUDER, ALONG, 0.01, "occluder moves", difference_spp=2048, slow=False),
    Case("soft", FLOOR, moved(0.0, 0.0, 1.0), 0.02, "receiver moves along its normal", spp=1024, difference_spp=4096),
    Case("envmap", OCCLUDER, ALONG, 0.01, "occluder moves", spp=512, difference_spp=8192),
    Case("point", OCCLUDER, ALONG, 0.01, "occluder moves"),
    Case("soft", "sensor.to_world", ALONG, 0.01, "camera moves", difference_spp=2048),
    Case("floating", BOX, moved(1.0, -0.5, 0.0), 0.005, "a box moves", depth=3, spp=1024, difference_spp=4096),
]


@pytest.mark.slow_rows(
    "soft, occluder moves, depth 2-reverse-octree",
    "soft, occluder moves, depth 2-forward-kdtree",
    "soft, occluder moves, depth 2-forward-octree",
)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("case", rows(ROWS))
def test_guided_derivatives_equal_finite_differences(case, mode, name) -> None:
    assert_agrees(derivatives(case, mode, guided(name)), differences(case)[2])


@pytest.mark.parametrize("name", METHODS)
def test_a_tree_that_overflows_drops_nothing(name) -> None:
    case = ROWS[0]
    assert_agrees(derivatives(case, "forward", guided(name, max_leaves=3, samples=1)), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("scene_name", "depth"), [("soft", 2), ("sky", 2), ("floating", 3)])
def test_the_mean_over_builds_is_the_unguided_one(scene_name, depth, name) -> None:
    scene, params = load(scene_name)
    tangents = {BOX: 1.0} if scene_name == "floating" else {OCCLUDER: 1.0}
    weights = (
        image(scene, params, None, depth=depth, spp=1, tangents=tangents) * 0.0 + np.linspace(0.2, 1.0, 16)[:, None]
    )
    sums = {}
    for boundary in (psdr.boundary.PathSpace(), guided(name)):
        sums[boundary] = []
        for seed in range(64):
            psdr.guiding.reset(scene)
            result = image(scene, params, boundary, seed=seed, spp=64, depth=depth, tangents=tangents)
            sums[boundary].append(float((weights * result).sum()))
    a, b = (np.array(s) for s in sums.values())
    assert abs(a.mean() - b.mean()) < 3.5 * np.hypot(a.std(ddof=1), b.std(ddof=1)) / 8.0


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_guiding_lowers_the_noise(name) -> None:
    scene, params = load("point")
    noise = []
    for boundary in (psdr.boundary.PathSpace(spp_primary=64), psdr.boundary.PathSpace(
        spp_primary=64, guiding=METHODS[name](max_leaves=1024)
    )):  # fmt: skip
        images = [image(scene, params, boundary, seed=s, spp=8, tangents={OCCLUDER: 1.0}) for s in range(4)]
        # The floor alone, where the shadow's edge is.
        noise.append(float(np.var(images, axis=0)[10:].mean()))
    assert noise[1] < 0.5 * noise[0]


def test_the_modes_are_transposes_of_each_other() -> None:
    scene, params = load("soft")
    psdr.guiding.reset(scene)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=guided())
    # With equal random numbers, and the same structure.
    assert_transposes(scene, params, [OCCLUDER], {"integrator": integrator, "spp": 16})


def gradient(scene, params, boundary, adjoint, spp=8):
    params.requires_grad(OCCLUDER)
    params.zero_grad()
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp)
    return params[OCCLUDER].grad.numpy().copy()


def test_results_do_not_depend_on_the_number_of_workers() -> None:
    scene, params = load("soft")
    results = []
    try:
        for workers in (1, 3):
            psdr.set_workers(workers)
            psdr.guiding.reset(scene)
            results.append(image(scene, params, guided(), spp=8))
    finally:
        psdr.set_workers(None)
    np.testing.assert_array_equal(*results)


DRIFT = 0.005


def test_structures_are_kept_refreshed_and_forgotten() -> None:
    scene, params = load("soft")
    psdr.guiding.reset(scene)
    boundary = guided(drift=DRIFT)
    base = params[OCCLUDER].numpy().copy()
    lines = dict(line[::2] for line in plan_lines(scene, boundary))
    assert "first gradient" in lines["guiding"]
    try:
        first = image(scene, params, boundary)
        (kept,) = psdr.guiding.structures(scene)
        assert kept.memory > 0 and 8 < kept.leaf_count <= 1100 and kept.builds == 1
        evaluations = kept.evaluations
        np.testing.assert_array_equal(image(scene, params, boundary), first)
        assert kept.evaluations == evaluations
        assert str(kept.leaf_count) in dict(line[::2] for line in plan_lines(scene, boundary))["guiding"]
        # Ways in units of the drift. Beyond one a build waits until its evaluations are few beside the samples.
        for way, spp, builds in ((0.4, 8, 1), (3.0, 8, 1), (3.0, 512, 1), (4.0, 8, 2), (4.5, 8, 2), (30.0, 8, 3)):
            evaluations = kept.evaluations
            params[OCCLUDER] = base + np.float32(way * DRIFT * scene.radius)
            params.update()
            image(scene, params, boundary, spp=spp)
            (now,) = psdr.guiding.structures(scene)
            assert now.builds == builds
            if spp > 8:
                assert now.evaluations == evaluations
            elif way < 4.0:
                # A refresh costs a fraction of the samples that it guides.
                assert 0 < now.evaluations - evaluations <= 0.1 * 16 * 16 * spp + 2
            kept = now
    finally:
        params[OCCLUDER] = base
        params.update()
    psdr.guiding.reset(scene)
    assert psdr.guiding.structures(scene) == []


def plan_lines(scene, boundary):
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    return psdr.plan(scene, names=[OCCLUDER], integrator=integrator).lines


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    "options",
    [{"max_leaves": 0}, {"max_leaves": 1 << 21}, {"samples": 0.5}, {"floor": 0.0}, {"floor": 1.5}, {"refresh": True},
     {"drift": -1.0}],
)  # fmt: skip
def test_wrong_options_are_refused(name, options) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        METHODS[name](**options)


def test_other_wrong_options_are_refused() -> None:
    with pytest.raises(ValueError, match="max_depth"):
        psdr.guiding.Octree(max_depth=0)
    with pytest.raises(ValueError, match="guiding"):
        psdr.boundary.PathSpace(guiding="kdtree")


def test_a_moving_camera_or_light_moves_everything() -> None:
    from warp_psdr.plan.motion import moving_shapes

    scene, _params = load("soft")
    none = Motion(frozenset(), camera=False, light_pose=False)
    assert not moving_shapes(scene, none).numpy().any()
    for moves in (
        Motion(frozenset(), camera=True, light_pose=False),
        Motion(frozenset(), camera=False, light_pose=True),
    ):
        assert moving_shapes(scene, moves).numpy().all()


def test_a_kept_structure_has_the_edges_where_they_are() -> None:
    """A mesh whose vertices swap places in every order by coordinates, as the equal ones of a sphere do."""
    scene, params = load("soft")
    before = params[OCCLUDER].numpy().copy()
    psdr.guiding.reset(scene)
    try:
        image(scene, params, guided(max_leaves=64), spp=1)
        params[OCCLUDER] = before + 1e-3 * np.random.default_rng(2).normal(size=before.shape).astype(np.float32)
        params.update()
        image(scene, params, guided(max_leaves=64), spp=1)
        (kept,) = psdr.guiding.structures(scene)
        assert kept.builds == 1
        points = scene.points
        np.testing.assert_array_equal(kept.edges.points.numpy(), points[kept.edges.ends.numpy()])
    finally:
        params[OCCLUDER] = before
        params.update()

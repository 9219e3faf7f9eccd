"""Samples of the boundary term against the gradient that they add up to, and the density that edges are drawn with."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_psdr as psdr
from tests.boundary.scenes import load
from tests.boundary.test_guiding import draw
from tests.estimate.test_invalid import SIZE, SPP, broken
from warp_psdr.view import edge_fields

NAME = "occluder.vertex_positions"
DIRECT = psdr.PathIntegrator(max_depth=2)
#: Float32 sums of some thousand samples, in another order, relative to the largest of the sums.
SUMMATION = 1e-4


@pytest.fixture(scope="module")
def under_a_light():
    scene, params = load("soft")
    params.requires_grad_only(NAME)
    return scene, params


def gradient(scene, params, adjoint, boundary, spp: int = 8) -> np.ndarray:
    params.requires_grad_only(NAME)
    params.zero_grad()
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=spp, seed=5)
    return params[NAME].grad.numpy().astype(np.float64)


def adjoint_of(scene) -> np.ndarray:
    camera = scene.camera(0)
    return np.random.default_rng(1).normal(size=(camera.crop_height, camera.crop_width, 3)).astype(np.float32)


@pytest.mark.slow
def test_samples_add_up_to_the_boundary_gradient(under_a_light) -> None:
    # The occluder is convex: it casts no shadow on itself, so that only its edges are pulled at.
    scene, params = under_a_light
    adjoint = adjoint_of(scene)
    expected = (gradient(scene, params, adjoint, "auto") - gradient(scene, params, adjoint, None)).sum(axis=0)
    samples = edge_fields.boundary_samples(scene, params, adjoint, integrator=DIRECT, spp=8, seed=5)
    assert set(samples.kinds) == {"primary", "secondary"}
    pulls = samples.pulls.astype(np.float64)
    moving = np.linalg.norm(samples.points - [0.1, 0.1, 0.9], axis=1) < 0.41  # not those of floor and light
    np.testing.assert_allclose(pulls[moving].sum(axis=0), expected, atol=SUMMATION * np.abs(pulls).sum())
    assert np.abs(expected).max() > 10 * SUMMATION * np.abs(pulls).sum()


@pytest.mark.slow
def test_points_lie_on_edges_and_pulls_across_them(under_a_light) -> None:
    scene, params = under_a_light
    samples = edge_fields.boundary_samples(scene, params, adjoint_of(scene), integrator=DIRECT, spp=4)
    shape = next(s for s in scene.description.shapes if s.path == "occluder")
    ball = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
    ends = np.asarray(ball.vertices)[ball.edges_unique]
    moving = np.linalg.norm(samples.points - [0.1, 0.1, 0.9], axis=1) < 0.41
    for point, edge, pull in zip(samples.points[moving][::50], samples.edges[moving][::50], samples.pulls[moving][::50],
                                 strict=True):  # fmt: skip
        along = ends[:, 1] - ends[:, 0]
        fraction = np.clip(((point - ends[:, 0]) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
        distance = np.linalg.norm(ends[:, 0] + fraction[:, None] * along - point, axis=1)
        assert distance.min() < 1e-5
        nearest = along[distance.argmin()]
        assert np.linalg.norm(np.cross(nearest, edge)) < 1e-4 * np.linalg.norm(edge)
        assert abs(pull @ edge) < 1e-3 * np.linalg.norm(pull) * np.linalg.norm(edge)
    np.testing.assert_allclose(samples.magnitude, np.linalg.norm(samples.pulls, axis=1))


def test_density_integrates_to_one(under_a_light) -> None:
    scene, params = under_a_light
    density = edge_fields.edge_density(scene, params)
    length = np.linalg.norm(density.segments[:, 1] - density.segments[:, 0], axis=1)
    assert (density.density * length).sum() == pytest.approx(1.0, abs=1e-5)
    middle = density.segments.mean(axis=1)
    moving = np.linalg.norm(middle - [0.1, 0.1, 0.9], axis=1) < 0.41
    assert (density.density * length)[moving].sum() > 0.5  # half of the samples, and a share of the rest


def test_the_density_of_guided_sampling_is_that_of_its_cells(under_a_light) -> None:
    scene, params = under_a_light
    params.requires_grad_only(NAME)
    tree = psdr.guiding.KdTree()
    integrator = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.PathSpace(guiding=tree))
    psdr.guiding.reset(scene)
    pieces, count = 4, 1 << 16
    density = edge_fields.edge_density(scene, params, integrator=integrator, seed=5, pieces=pieces)
    length = np.linalg.norm(density.segments[:, 1] - density.segments[:, 0], axis=1)
    expected = density.density * length
    assert expected.sum() == pytest.approx(1.0, abs=1e-5) and (expected > 0.0).all()
    # The structure is the one that gradients use: the samples of its cells, counted.
    (built,) = psdr.guiding.structures(scene)
    cdf = built.edges.cdf.numpy().astype(np.float64)
    border = np.append((cdf[:-1, None] + np.diff(cdf)[:, None] * np.arange(pieces) / pieces).reshape(-1), 1.0)
    random, counted = np.random.default_rng(2), 0.0
    for share, cells in ((built.guide.share, built.guide.wedge), (1.0 - built.guide.share, built.guide.light)):
        u = wp.empty(count, dtype=wp.vec3d, device="cpu")
        given = [wp.array(random.random(count), dtype=wp.float64, device="cpu")]
        given.append(wp.array(random.random((count, 3)).astype(np.float32), dtype=wp.vec3, device="cpu"))
        pdf = wp.empty(count, dtype=wp.float32, device="cpu")
        wp.launch(draw, dim=count, inputs=[cells, *given], outputs=[u, pdf], device="cpu")
        counted = counted + share * np.histogram(u.numpy()[:, 0], border)[0] / count
    # Largest of some hundred deviations in standard deviations of a count; 5 is reached once in some thousand tests.
    deviation = np.abs(counted - expected) / np.sqrt((expected + 1.0 / count) / count)
    assert deviation.max() < 5.0
    unguided = edge_fields.edge_density(scene, params, pieces=pieces)
    assert len(unguided.density) == len(density.density)
    assert np.abs(counted - np.diff(border)).sum() > 0.2  # far from the unguided one


@pytest.mark.slow
def test_guided_samples_add_up_to_the_boundary_gradient(under_a_light) -> None:
    scene, params = under_a_light
    adjoint = adjoint_of(scene)
    boundary = psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree())
    psdr.guiding.reset(scene)
    expected = (gradient(scene, params, adjoint, boundary) - gradient(scene, params, adjoint, None)).sum(axis=0)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=boundary)
    samples = edge_fields.boundary_samples(scene, params, adjoint, integrator=integrator, spp=8, seed=5)
    pulls = samples.pulls.astype(np.float64)
    moving = np.linalg.norm(samples.points - [0.1, 0.1, 0.9], axis=1) < 0.41
    np.testing.assert_allclose(pulls[moving].sum(axis=0), expected, atol=SUMMATION * np.abs(pulls).sum())
    assert np.abs(expected).max() > 10 * SUMMATION * np.abs(pulls).sum()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["primary", "secondary"])
def test_samples_that_are_not_finite_are_counted(kind) -> None:
    scene = broken(lookup="bilinear")
    params = psdr.traverse(scene)
    params.requires_grad("blocker.to_world")
    with pytest.warns(RuntimeWarning, match=f"{kind}: [1-9]"):
        samples = edge_fields.boundary_samples(scene, params, np.ones((SIZE, SIZE, 3)), integrator=DIRECT, spp=SPP)
    assert len(samples.pulls) and np.isfinite(samples.pulls).all()


def test_wrong_pieces_are_refused(under_a_light) -> None:
    scene, params = under_a_light
    params.requires_grad_only(NAME)
    for pieces in (0, 1.5, True):
        with pytest.raises(ValueError, match="pieces: got"):
            edge_fields.edge_density(scene, params, pieces=pieces)


def test_what_has_no_boundary_term_is_refused(under_a_light) -> None:
    scene, params = under_a_light
    adjoint = adjoint_of(scene)
    params.requires_grad_only("floor.bsdf.reflectance.value")
    with pytest.raises(ValueError, match="have no boundary term here"):
        edge_fields.boundary_samples(scene, params, adjoint, integrator=DIRECT)
    params.requires_grad_only(NAME)
    with pytest.raises(ValueError, match=r"only those of boundary.PathSpace\(\)"):
        other = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.EdgeSampling())
        edge_fields.boundary_samples(scene, params, adjoint, integrator=other)
    with pytest.raises(ValueError, match="draws edges by each path vertex"):
        edge_fields.edge_density(scene, params, integrator=other)
    with pytest.raises(ValueError, match="left it out"):
        edge_fields.boundary_samples(scene, params, adjoint, integrator=psdr.PathIntegrator(max_depth=2, boundary=None))
    with pytest.raises(ValueError, match=r"adjoint: got shape \(3, 3, 3\)"):
        edge_fields.boundary_samples(scene, params, np.zeros((3, 3, 3)), integrator=DIRECT)


def test_samples_that_carry_little_are_left_out_of_the_picture() -> None:
    class Plotter:
        def __init__(self):
            self.meshes, self.options = [], []

        def add_mesh(self, mesh, **options):
            self.meshes.append(mesh)
            self.options.append(options)

    pulls = np.zeros((4, 3))
    pulls[:, 0] = [1.0, 0.5, 0.01, 0.2]
    kinds = np.array(["primary", "primary", "secondary", "secondary"])
    samples = edge_fields.EdgeSamples(np.eye(4, 3), np.ones((4, 3)), pulls, kinds)
    plotter = Plotter()
    edge_fields.draw_samples(plotter, samples, least=0.1, title="pull [W/m²/sr per world unit]")
    lines, points = plotter.meshes
    assert (lines.n_cells, points.n_points) == (3, 3)
    assert plotter.options[1]["scalar_bar_args"]["title"] == "pull [W/m²/sr per world unit]\n"
    assert samples.of_kind("primary").magnitude.tolist() == [1.0, 0.5]
    assert samples.of_kind("secondary").magnitude.tolist() == [0.01, 0.2]

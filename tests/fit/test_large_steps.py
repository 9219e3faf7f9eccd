"""LargeSteps against dense algebra in double precision: the preconditioner, AdamUniform, welding, and its refusals."""

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr import optim
from warp_psdr.topology.laplacian import GridSmoother, Smoother

#: Optimisers alone: there is no light.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

#: Of a sparse solve in double precision, relative to the largest value.
SOLVE = 1e-12
#: Float32 rounding of moments and positions over the steps that a test makes, for values of about 1.
ROUNDING = 2e-6
BETAS, EPSILON, WEIGHT = (0.8, 0.95), 1e-8, 7.0
NAME, OTHER, COLOR = "ball.vertex_positions", "box.vertex_positions", "ball.bsdf.reflectance.value"
BALL = trimesh.creation.icosphere(subdivisions=1)
BOX = trimesh.creation.box()


def split(mesh):
    """Every triangle with vertices of its own."""
    return np.asarray(mesh.vertices)[mesh.faces.reshape(-1)], np.arange(mesh.faces.size).reshape(-1, 3)


def parameters(*names: str, **meshes) -> psdr.Parameters:
    """A scene of meshes (vertices, faces) by id."""
    meshes = meshes or {"ball": (BALL.vertices, BALL.faces)}
    scene = {"type": "scene", "sensor": {"type": "perspective"}}
    for name, (vertices, faces) in meshes.items():
        scene[name] = {
            "type": "mesh",
            "vertices": np.asarray(vertices, np.float32),
            "faces": np.asarray(faces, np.int32),
            "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.3, 0.5, 0.7]}},
        }
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad(*(names or (NAME,)))
    return params


def dense(mesh, weight: float = WEIGHT) -> np.ndarray:
    """I + weight L of a mesh without seams."""
    matrix = np.eye(len(mesh.vertices))
    for a, b in mesh.edges_unique:
        matrix[a, a] += weight
        matrix[b, b] += weight
        matrix[a, b] -= weight
        matrix[b, a] -= weight
    return matrix


def gradients(count: int, size: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, size, 3)).astype(np.float32)


def advance(params, optimiser, name: str, some: np.ndarray) -> None:
    for gradient in some:
        params[name].grad.assign(gradient)
        optimiser.step()


def reference(vertices, matrix, some, lr: float) -> np.ndarray:
    """AdamUniform on u, in double precision; positions after the last step."""
    u = matrix @ np.asarray(vertices, np.float64)
    m, v = np.zeros_like(u), np.zeros_like(u)
    for t, gradient in enumerate(some.astype(np.float64), start=1):
        du = np.linalg.solve(matrix.T, gradient)  # the transposed chain: v = M^-1 u
        m = BETAS[0] * m + (1 - BETAS[0]) * du
        v = BETAS[1] * v + (1 - BETAS[1]) * du**2
        u -= lr * (m / (1 - BETAS[0] ** t)) / (np.sqrt((v / (1 - BETAS[1] ** t)).max()) + EPSILON)
    return np.linalg.solve(matrix, u)


def test_solve_is_the_inverse() -> None:
    smoother = Smoother(BALL.vertices, BALL.faces, WEIGHT)
    values = np.random.default_rng(1).normal(size=(len(BALL.vertices), 3))
    solved = smoother.scatter(smoother.solve(smoother.gather(values)))
    np.testing.assert_allclose(solved, np.linalg.solve(dense(BALL), values), atol=SOLVE)
    constant = smoother.solve(np.ones((len(BALL.vertices), 1)))
    np.testing.assert_allclose(constant, 1.0, atol=SOLVE)


def test_a_large_mesh_is_solved_accurately() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=5)
    smoother = Smoother(mesh.vertices, mesh.faces, 1000.0)
    values = np.random.default_rng(1).normal(size=(len(mesh.vertices), 3))
    solved = smoother.solve(values)
    residual = solved + 1000.0 * (smoother.laplacian @ solved) - values
    assert np.abs(residual).max() < 1e-10


def test_copies_of_a_vertex_are_one_unknown() -> None:
    vertices, faces = split(BOX)
    smoother = Smoother(vertices, faces, WEIGHT)
    values = np.random.default_rng(1).normal(size=(len(vertices), 3))
    summed = np.zeros((len(BOX.vertices), 3))
    np.add.at(summed, BOX.faces.reshape(-1), values)
    solved = smoother.scatter(smoother.solve(smoother.gather(values)))
    np.testing.assert_allclose(solved, np.linalg.solve(dense(BOX), summed)[BOX.faces.reshape(-1)], atol=SOLVE)


def test_gradient_of_u_is_the_smoothed_gradient() -> None:
    # By differences of a loss of v, seen as a function of u; no algebra in common with the preconditioner.
    matrix, rng = dense(BALL), np.random.default_rng(2)
    u, target = matrix @ BALL.vertices, rng.normal(size=BALL.vertices.shape)
    loss = lambda u: 0.5 * ((np.linalg.inv(matrix) @ u - target) ** 2).sum()  # noqa: E731
    smoother = Smoother(BALL.vertices, BALL.faces, WEIGHT)
    gradient = smoother.scatter(smoother.solve(smoother.gather(BALL.vertices - target)))
    for direction in rng.normal(size=(3, *u.shape)):
        difference = (loss(u + 1e-4 * direction) - loss(u - 1e-4 * direction)) / 2e-4
        assert (gradient * direction).sum() == pytest.approx(difference, rel=1e-6)


def test_steps_are_adam_uniform_in_u() -> None:
    params = parameters()
    some = gradients(12, len(BALL.vertices))
    advance(params, optim.LargeSteps(params, 0.03, lambda_=WEIGHT, betas=BETAS, epsilon=EPSILON), NAME, some)
    expected = reference(BALL.vertices, dense(BALL), some, 0.03)
    np.testing.assert_allclose(params[NAME].numpy(), expected, atol=ROUNDING)
    assert np.abs(expected - BALL.vertices).max() > 0.01
    assert np.all(params[NAME].grad.numpy() == 0.0)


def test_grids_move_by_adam_uniform_in_u() -> None:
    shape, weight = (3, 4, 2), 2.0
    path = lambda n: 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1) - np.diag(np.eye(n)[0] + np.eye(n)[-1])  # noqa: E731
    a, b, c = (np.eye(n) for n in shape)
    matrix = np.kron(np.kron(path(3), b), c) + np.kron(np.kron(a, path(4)), c) + np.kron(np.kron(a, b), path(2))
    matrix = np.eye(24) + weight * matrix
    rng = np.random.default_rng(4)
    values = rng.normal(size=24)
    np.testing.assert_allclose(matrix @ GridSmoother(shape, weight).solve(values[:, None])[:, 0], values, atol=SOLVE)
    grid = rng.normal(size=(*shape, 1)).astype(np.float32)
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "shape": {"type": "sdfgrid", "grid": grid}}
    params = psdr.traverse(psdr.load_dict(scene))
    params.requires_grad("shape.grid")
    some = rng.normal(size=(6, *shape, 1)).astype(np.float32)
    options = {"lambda_": weight, "betas": BETAS, "epsilon": EPSILON}
    advance(params, optim.LargeSteps(params, 0.03, **options), "shape.grid", some)
    expected = reference(grid.reshape(-1, 1), matrix, some.reshape(6, -1, 1), 0.03)
    np.testing.assert_allclose(params["shape.grid"].numpy().reshape(-1, 1), expected, atol=ROUNDING)
    assert np.abs(expected - grid.reshape(-1, 1)).max() > 0.01


def test_alpha_is_another_name_of_lambda() -> None:
    results = []
    for option in ({"alpha": 0.95}, {"lambda_": 19.0}, {}):
        params = parameters()
        advance(params, optim.LargeSteps(params, 0.03, **option), NAME, gradients(3, len(BALL.vertices)))
        results.append(params[NAME].numpy())
    np.testing.assert_allclose(results[0], results[1], atol=ROUNDING)
    np.testing.assert_array_equal(results[1], results[2])


def test_equal_gradients_move_the_mesh_by_the_learning_rate() -> None:
    params = parameters()
    optimiser = optim.LargeSteps(params, {NAME: 0.25})
    params[NAME].grad.assign(np.tile(np.float32([0.0, -3e-4, 0.0]), (len(BALL.vertices), 1)))
    optimiser.step(scale=0.5)
    np.testing.assert_allclose(params[NAME].numpy() - BALL.vertices, np.tile([0, 0.125, 0], (42, 1)), atol=1e-5)


def test_a_split_mesh_does_not_tear() -> None:
    vertices, faces = split(BOX)
    params = parameters(OTHER, box=(vertices, faces))
    some = gradients(8, len(vertices))
    advance(params, optim.LargeSteps(params, 0.05, lambda_=WEIGHT, betas=BETAS), OTHER, some)
    moved = params[OTHER].numpy()
    for corner in range(len(BOX.vertices)):
        copies = moved[BOX.faces.reshape(-1) == corner]
        np.testing.assert_array_equal(copies, np.tile(copies[0], (len(copies), 1)))
    summed = np.zeros((len(some), len(BOX.vertices), 3))
    np.add.at(summed, (slice(None), BOX.faces.reshape(-1)), some)
    expected = reference(BOX.vertices, dense(BOX), summed, 0.05)
    np.testing.assert_allclose(moved, expected[BOX.faces.reshape(-1)], atol=ROUNDING)
    assert np.abs(moved - vertices).max() > 0.01


def test_fixed_vertices_stay_and_so_do_their_copies() -> None:
    vertices, faces = split(BOX)
    corner = BOX.faces.reshape(-1)
    mask = np.zeros(len(vertices), bool)
    mask[np.flatnonzero(corner == 2)[0]] = True  # one copy of one corner
    params = parameters(OTHER, box=(vertices, faces))
    optimiser = optim.LargeSteps(params, 0.05, lambda_=WEIGHT, fixed={OTHER: mask})
    gradient = gradients(1, len(vertices))
    advance(params, optimiser, OTHER, gradient)
    move = params[OTHER].numpy() - vertices
    assert np.all(move[corner == 2] == 0.0)
    free = np.arange(len(BOX.vertices)) != 2
    matrix = dense(BOX)[free][:, free]
    summed = np.zeros((len(BOX.vertices), 3))
    np.add.at(summed, corner, gradient[0])
    du = np.linalg.solve(matrix, summed[free])
    expected = np.zeros((len(BOX.vertices), 3))
    expected[free] = np.linalg.solve(matrix, -0.05 * du / np.abs(du).max())
    np.testing.assert_allclose(move, expected[corner], atol=ROUNDING)


def test_vertices_of_no_triangle_stay() -> None:
    vertices = np.concatenate([BALL.vertices, [[5.0, 5.0, 5.0]]])
    params = parameters(ball=(vertices, BALL.faces))
    some = gradients(4, len(vertices))
    some[:, -1] = 0.0  # no pixel depends on it
    advance(params, optim.LargeSteps(params, 0.05), NAME, some)
    np.testing.assert_array_equal(params[NAME].numpy()[-1], np.float32([5.0, 5.0, 5.0]))


def test_meshes_and_other_parameters_do_not_mix() -> None:
    meshes = {"ball": (BALL.vertices, BALL.faces), "box": (BOX.vertices, BOX.faces)}
    rates = {NAME: 0.02, OTHER: 0.04, COLOR: 0.1}
    params = parameters(*rates, **meshes)
    together = optim.LargeSteps(params, rates, lambda_=WEIGHT)
    alone = {name: parameters(name, **meshes) for name in rates}
    single = {n: optim.LargeSteps(alone[n], {n: rates[n]}, lambda_=WEIGHT) for n in (NAME, OTHER)}
    single[COLOR] = optim.Adam(alone[COLOR], {COLOR: rates[COLOR]})
    rng = np.random.default_rng(4)
    for _ in range(5):
        for name in rates:
            gradient = rng.normal(size=params[name].numpy().shape).astype(np.float32)
            params[name].grad.assign(gradient)
            alone[name][name].grad.assign(gradient)
            single[name].step()
        together.step()
    for name in rates:
        np.testing.assert_array_equal(params[name].numpy(), alone[name][name].numpy())


def test_state_continues_with_equal_bits() -> None:
    some = gradients(6, len(BALL.vertices))
    whole = parameters()
    advance(whole, optim.LargeSteps(whole, 0.05), NAME, some)
    first = parameters()
    optimiser = optim.LargeSteps(first, 0.05)
    advance(first, optimiser, NAME, some[:3])
    second = parameters()
    second[NAME] = first[NAME].numpy()
    second.update()
    resumed = optim.LargeSteps(second, 0.05)
    resumed.load_state_dict(optimiser.state_dict())
    advance(second, resumed, NAME, some[3:])
    np.testing.assert_array_equal(second[NAME].numpy(), whole[NAME].numpy())


def test_what_meets_later_is_not_welded() -> None:
    # A resumed run builds its matrix in the middle of a fit, where two vertices may have met.
    fresh, met = parameters(), parameters()
    positions = BALL.vertices.astype(np.float32)
    positions[1] = positions[0]
    met[NAME] = positions
    met.update()
    gradient = gradients(1, len(positions))
    for params in (fresh, met):
        advance(params, optim.LargeSteps(params, 0.05), NAME, gradient)
    moves = fresh[NAME].numpy() - BALL.vertices, met[NAME].numpy() - positions
    np.testing.assert_allclose(moves[1], moves[0], atol=ROUNDING)


def test_a_gradient_that_is_not_finite_changes_nothing() -> None:
    params = parameters()
    optimiser = optim.LargeSteps(params, 0.05)
    bad = np.zeros((len(BALL.vertices), 3), np.float32)
    bad[3, 1] = np.nan
    params[NAME].grad.assign(bad)
    with pytest.raises(ValueError, match=r"'ball.vertex_positions': 1 of 126 entries are not finite"):
        optimiser.step()
    np.testing.assert_array_equal(params[NAME].numpy(), BALL.vertices.astype(np.float32))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lr": {"ball.vertices": 0.1}}, "no parameter 'ball.vertices'"),
        ({"lr": {NAME: -0.1}}, "got -0.1"),
        ({"lr": 0.1, "lambda_": 0.0}, "lambda_: got 0.0, expected a positive number"),
        ({"lr": 0.1, "lambda_": float("inf")}, "lambda_: got inf"),
        ({"lr": 0.1, "alpha": 1.0}, r"alpha: got 1.0, expected a number in \(0, 1\)"),
        ({"lr": 0.1, "alpha": 0.5, "lambda_": 1.0}, "give one of them"),
        ({"lr": {COLOR: 0.1}}, "none of .* are vertex positions.* use psdr.optim.Adam"),
        ({"lr": 0.1, "fixed": {OTHER: np.zeros(8, bool)}}, "fixed: 'box.vertex_positions' is none of"),
        ({"lr": 0.1, "fixed": {NAME: np.zeros(41, bool)}}, r"expected a mask \(bool\) of shape \(42,\)"),
        ({"lr": 0.1, "fixed": {NAME: np.zeros(42, int)}}, r"got int64 values of shape \(42,\)"),
        ({"lr": 0.1, "fixed": {NAME: np.ones(42, bool)}}, "'ball.vertex_positions': all vertices are fixed"),
    ],
)
def test_options_are_checked(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        optim.LargeSteps(parameters(NAME, COLOR), **options)

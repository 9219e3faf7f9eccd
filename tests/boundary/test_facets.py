"""Creases between flat faces: one path for both sides against two, on the same edges."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms
from warp_psdr.estimate.boundary.drivers import launch_backward
from warp_psdr.estimate.gradient_sums import GradientSums
from warp_psdr.kernels.boundary.path_space.primary import make_primary_kernel
from warp_psdr.plan.motion import motion
from warp_psdr.plan.plan import decide
from warp_psdr.topology.film_edges import film_edges

from .scenes import SIZE, ball, camera, diffuse, envmap, floor, load, mesh, panel, register, rough, sky, spot

SHAPE = "shape.vertex_positions"
#: Largest deviate of a z-test whose seed is fixed, the largest of some 100 values.
Z = 4.5
BATCHES = 24
#: Two squares that form a ridge of 0.14 radians, and with the sign of their third corners a notch; seen from above.
RIDGE = np.array(
    [[0.0, -0.6, 0.0], [0.0, 0.6, 0.0], [-0.7, -0.6, -0.05], [-0.7, 0.6, -0.05], [0.7, -0.6, -0.05], [0.7, 0.6, -0.05]]
)
RIDGE_FACES = [[0, 1, 2], [1, 3, 2], [0, 4, 1], [4, 5, 1]]


def scene_of(shape, light):
    return {"sensor": camera(), "floor": floor(), "shape": shape, "light": light}


def ridge(bsdf, up=1.0):
    return mesh(
        RIDGE * [1.0, 1.0, up] + [0.1, 0.2, 0.4], RIDGE_FACES, {"type": "twosided", "bsdf": bsdf}, face_normals=True
    )


def fine(bsdf):
    return ball((0.0, 0.0, 0.7), 0.6, bsdf, subdivisions=3)


def spots():
    """A ball with vertex colours."""
    shape = ball((0.0, 0.0, 0.7), 0.6, diffuse(0.5), subdivisions=3)
    colors = np.random.default_rng(3).uniform(0.1, 0.9, (len(shape["vertices"]), 3)).astype(np.float32)
    shape["bsdf"] = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    return shape | {"vertex_color": colors}


def light():
    return panel((0.5, -0.9, 2.2), 0.5)


SCENES = {
    "ridge, panel": lambda: scene_of(ridge(diffuse(0.8, 0.5, 0.3)), light()),
    "notch, panel": lambda: scene_of(ridge(diffuse(0.8, 0.5, 0.3), -1.0), light()),
    "shiny notch, panel": lambda: scene_of(ridge(rough(0.4), -1.0), light()),
    "ball, spot": lambda: scene_of(fine(diffuse(0.7)), spot()),
    "ball, sky": lambda: scene_of(fine(diffuse(0.7)), sky()),
    "shiny ball, map": lambda: scene_of(fine(rough(0.2)), envmap()),
    "coloured ball, panel": lambda: scene_of(spots(), light()),
}
register({f"facets: {name}": make for name, make in SCENES.items()})


def request_of(name: str, parameter: str, depth: int, seed: int, spp: int = 32) -> terms.Request:
    scene, params = load(f"facets: {name}")
    plan = decide(scene, params, integrator=psdr.PathIntegrator(max_depth=depth), names=[parameter])
    return terms.Request(scene, plan, motion(scene, [parameter]), "reverse", 0, spp, seed)


def gradient(request: terms.Request, parameter: str, term: terms.Term) -> np.ndarray:
    adjoint = np.random.default_rng(1).normal(1.0, 1.0, (SIZE, SIZE, 3)).astype(np.float32)
    sums = GradientSums(request.scene, [parameter])
    launch_backward(request.scene, [term], wp.array(adjoint, dtype=wp.vec3), sums)
    record = request.scene.parameters[parameter]
    return sums.result().numpy()[record.offset : record.offset + record.size].astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "depth"),
    [
        ("ridge, panel", SHAPE, 2),
        pytest.param("notch, panel", SHAPE, 3, marks=pytest.mark.slow),
        pytest.param("shiny notch, panel", SHAPE, 3, marks=pytest.mark.slow),
        pytest.param("ball, spot", SHAPE, 3, marks=pytest.mark.slow),
        pytest.param("ball, sky", "sensor.to_world", 3, marks=pytest.mark.slow),
        pytest.param("shiny ball, map", "sensor.x_fov", 2, marks=pytest.mark.slow),
        pytest.param("coloured ball, panel", SHAPE, 2, marks=pytest.mark.slow),
    ],
)
def test_one_path_equals_two(name, parameter, depth) -> None:
    found: dict[bool, list] = {False: [], True: []}
    for seed in range(2 * BATCHES):
        two = bool(seed % 2)
        request = request_of(name, parameter, depth, seed)
        (term,) = terms.launches(terms.named("flat_creases"), request)
        if two:
            term = replace(term, kernel=make_primary_kernel(request.config, request.role, request.moves.camera))
        found[two].append(gradient(request, parameter, term))
    directions = np.random.default_rng(2).normal(size=(len(found[True][0]), 8))
    one, two = (np.array(found[k]) @ directions for k in (False, True))
    error = np.sqrt((one.var(axis=0, ddof=1) + two.var(axis=0, ddof=1)) / BATCHES)
    assert (np.abs(one.mean(axis=0) - two.mean(axis=0)) < Z * error).all()
    # A term of nothing would be equal, too.
    assert np.abs(two.mean(axis=0) / error).max() > 2.0 * Z


@pytest.mark.slow
def test_the_noise_falls_with_the_angle_between_the_faces() -> None:
    # Creases of 0.1 radians: path by path they differ by light that meets one and not the other.
    spread = {False: 0.0, True: 0.0}
    for two in spread:
        batches = []
        for seed in range(16):
            request = request_of("coloured ball, panel", SHAPE, 4, seed, spp=8)
            (term,) = terms.launches(terms.named("flat_creases"), request)
            if two:
                term = replace(term, kernel=make_primary_kernel(request.config, request.role, request.moves.camera))
            batches.append(gradient(request, SHAPE, term).reshape(-1, 3).sum(axis=0))
        spread[two] = np.var(batches, axis=0, ddof=1).sum()
    assert spread[False] < 0.7 * spread[True]


def test_samples_are_shared_by_what_they_are_worth() -> None:
    # The finer the ball, the more of the image's length of edges are creases; what they are worth stays.
    shares = []
    for subdivisions in (3, 4, 5):
        shape = ball((0.0, 0.0, 0.7), 0.6, diffuse(0.7), subdivisions=subdivisions)
        scene = psdr.load_dict({"type": "scene", **scene_of(shape, sky())})
        found = film_edges(scene, 0, {1}, camera_moves=False)
        assert not set(found.others.keep) & set(found.flat_creases.keep)
        shares.append(found.share)
    assert np.ptp(shares) < 0.05 and 0.3 < shares[0] < 0.9


def test_faces_that_turn_different_sides_are_left_to_two_paths() -> None:
    # One of them may be black, or shine.
    for faces, count in ((RIDGE_FACES, 1), ([*RIDGE_FACES[:2], [0, 1, 4], [4, 1, 5]], 0)):
        shape = mesh(RIDGE + np.array([0.1, 0.2, 0.4]), faces, diffuse(0.5), face_normals=True)
        scene = psdr.load_dict({"type": "scene", **scene_of(shape, sky())})
        assert len(film_edges(scene, 0, {1}, camera_moves=False).flat_creases.keep) == count


def test_a_kept_choice_follows_the_camera_and_the_vertices() -> None:
    scene = psdr.load_dict({"type": "scene", **scene_of(fine(diffuse(0.7)), sky())})
    params = psdr.traverse(scene)
    chosen = lambda: film_edges(scene, 0, {1}, camera_moves=False)  # noqa: E731
    first = chosen()
    assert chosen() is first
    vertices = params[SHAPE].numpy().copy()
    params[SHAPE] = vertices + np.float32([0.1, 0.0, 0.0])
    params.update()
    moved = chosen()
    assert moved is not first
    fov = float(params["sensor.x_fov"].numpy()[0])
    params["sensor.x_fov"] = 0.8 * fov
    params.update()
    assert chosen() is not moved
    params[SHAPE], params["sensor.x_fov"] = vertices, fov
    params.update()
    np.testing.assert_array_equal(chosen().flat_creases.length, first.flat_creases.length)

"""Samples on the outlines of shapes without triangles against the gradient by their motion, which they add up to."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.scenes import T, camera, diffuse, floor, panel, sky
from tests.path.test_sdfgrid import nodes
from warp_psdr.view.edge_fields import PIECE, boundary_samples

#: Where the shapes are, and how far they reach.
CENTER, REACH = np.array([0.1, 0.1, 0.8]), 0.75
BOXED = {"to_world": T.translate(list(CENTER - 0.6)) @ T.scale(1.2)}
TILTED = T.translate(list(CENTER)) @ T.rotate([0.6, 0.8, 0.0], 40.0)
#: Frequency of a network's sines.
OMEGA = 0.6
#: Float32 numbers that are added up in another order, relative to the sum of their sizes.
SUMMATION = 1e-6
#: Cosine between float32 vectors that are perpendicular.
PERPENDICULAR = 1e-5


def ball(count: int) -> np.ndarray:
    x, y, z = nodes(count)
    return (np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.33).astype(np.float32)


def line(count: int) -> np.ndarray:
    """Control points of a tube that tapers."""
    k = np.linspace(-1.0, 1.0, count)[:, None]
    return np.hstack([CENTER + k * [0.35, 0.1, 0.1], 0.2 - 0.05 * k])


def bowl() -> dict:
    """A network of three sines: phi is the sum of 4 sin^2(OMEGA (x - 1 / 2) / 2) / OMEGA^2 less a squared radius."""
    return {
        "type": "neuralsdf",
        "activation": "sine",
        "omega": OMEGA,
        "layer0.weight": np.eye(3),
        "layer0.bias": np.full(3, 0.5 * np.pi / OMEGA - 0.5),
        "layer1.weight": np.full((1, 3), -2.0 / OMEGA**2),
        "layer1.bias": np.array([6.0 / OMEGA**2 - 0.33**2]),
    }


#: Convex shapes, or black inside: they cast no shadow on themselves, so that their outlines alone are pulled at.
SHAPES = {
    "sphere": {"type": "sphere", "exact": True, "to_world": T.translate(list(CENTER)) @ T.scale(0.4)},
    "cylinder": {"type": "cylinder", "exact": True, "to_world": TILTED @ T.scale([0.3, 0.3, 0.4])},
    "disk": {"type": "disk", "exact": True, "to_world": TILTED @ T.scale(0.4)},
    "linear grid": {"type": "sdfgrid", "grid": ball(9), "normals": "analytic", **BOXED},
    "cubic grid": {"type": "sdfgrid", "grid": ball(17), "interpolation": "cubic", **BOXED},
    "network": {**bowl(), **BOXED},
    "tube": {"type": "bsplinecurve", "control_points": line(5)},
    "cones": {"type": "linearcurve", "control_points": line(3)},
}


def scene_of(kind: str, depth: int = 3) -> tuple[psdr.Scene, psdr.Parameters, str]:
    """Return a scene, its parameters, and the one that moves the shape; of one vertex: before a sky, else in a room."""
    bsdf = diffuse(0.7, 0.5, 0.3)
    if kind == "disk":
        bsdf = {"type": "twosided", "bsdf": bsdf}
    parts = {"sensor": camera((0.3, -3.0, 2.4), (0.0, 0.0, 0.5)), "body": {**SHAPES[kind], "bsdf": bsdf}}
    around = {"light": sky()} if depth == 1 else {"floor": floor(half=2.0), "light": panel((0.5, -0.6, 2.6), 0.4)}
    scene = psdr.load_dict({"type": "scene", **parts, **around})
    return scene, psdr.traverse(scene), "body.control_points" if kind in ("tube", "cones") else "body.to_world"


def assert_samples_add_up(kind: str, depth: int) -> None:
    """Pulls at the points of a shape are the boundary gradient by its place, each across the outline there."""
    scene, params, name = scene_of(kind, depth)
    adjoint = np.random.default_rng(1).normal(size=(16, 16, 3)).astype(np.float32)

    def by_place(boundary) -> np.ndarray:
        params.requires_grad_only(name)
        params.zero_grad()
        integrator = psdr.PathIntegrator(max_depth=depth, boundary=boundary)
        psdr.render_backward(scene, params, adjoint, integrator=integrator, spp=8, seed=5)
        found = params[name].grad.numpy().astype(np.float64)
        return found.reshape(-1, 4)[:, :3].sum(axis=0) if name.endswith("points") else found[:3, 3]

    expected = by_place("auto") - by_place(None)
    integrator = psdr.PathIntegrator(max_depth=depth)
    samples = boundary_samples(scene, params, adjoint, integrator=integrator, spp=8, seed=5)
    own = np.linalg.norm(samples.points - CENTER, axis=1) < REACH
    assert set(samples.kinds[own]) == ({"primary"} if depth == 1 else {"primary", "secondary"})
    pulls, edges = samples.pulls[own].astype(np.float64), samples.edges[own].astype(np.float64)
    size = np.abs(pulls).sum()
    np.testing.assert_allclose(pulls.sum(axis=0), expected, atol=SUMMATION * size)
    assert np.abs(expected).max() > 0.01 * size
    lengths = np.linalg.norm(edges, axis=1)
    assert (np.abs((pulls * edges).sum(axis=1)) < PERPENDICULAR * lengths * np.linalg.norm(pulls, axis=1)).all()
    assert (lengths > 0.0).all() and lengths.max() < 2.0 * PIECE * 2.0 * REACH


def test_samples_of_an_exact_shape_add_up_to_its_boundary_gradient() -> None:
    assert_samples_add_up("sphere", 1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHAPES)
def test_samples_add_up_to_the_boundary_gradient(kind: str) -> None:
    # Of three vertices paths go from a shape past its own silhouette, too.
    assert_samples_add_up(kind, 3)

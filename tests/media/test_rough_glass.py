"""What moves beside media behind surfaces with smooth lobes on both sides: differences, vacuum, and spread."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.boundary.measure import slope
from tests.boundary.scenes import ball, box, camera, diffuse, floor, mesh, panel, sky
from tests.media.scenes import medium

#: Rays through the shapes' own edges.
pytestmark = pytest.mark.filterwarnings("ignore:samples that were not finite")

VIEW = camera((0.0, -3.0, 1.6), (0.0, 0.0, 0.5), fov=40.0)
GLASS = {"type": "roughdielectric", "alpha": 0.6, "int_ior": 1.2, "ext_ior": 1.0}
#: Its lobes are diffuse on both sides, so that few samples tell much.
SHEET = {
    "type": "principledthin",
    "base_color": {"type": "rgb", "value": [0.9, 0.8, 0.7]},
    "roughness": 1.0,
    "spec_trans": 0.0,
    "diff_trans": 1.2,
}
SHAPE, BATCHES = "shape.vertex_positions", 8


def notched(bsdf, **more):
    """An L, whose concave edge is seen from within."""
    outline = np.array([(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)], np.float64)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    vertices = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (-0.8, 0.8)])
    front = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    sides = [(i, i + 6, (i + 1) % 6) for i in range(6)] + [((i + 1) % 6, i + 6, (i + 1) % 6 + 6) for i in range(6)]
    faces = np.concatenate([front, front[:, ::-1] + 6, sides])
    return mesh(0.5 * vertices @ turn.T + [0.0, 0.0, 0.6], faces, bsdf, face_normals=True, **more)


def scene(shape, light) -> psdr.Scene:
    behind = box((0.3, 1.0, 0.5), (0.2, 0.2, 0.5), diffuse(0.8, 0.3, 0.2), 0.4)
    return psdr.load_dict({"type": "scene", "sensor": VIEW, "floor": floor(), "shape": shape, "box": behind, **light})


def scaled(vertices):
    return vertices - np.array([0.0, 0.0, 0.6])


def moved(vertices):
    return np.broadcast_to([1.0, 0.3, 0.0], vertices.shape)


def turned(pose):
    found = np.zeros_like(pose)
    found[:3, 3] = 0.3, 0.1, 0.2
    return found


def compared(found, name, tangent, depth, spp, difference_spp, step):
    """Return the weighted derivatives and differences of the batches, weights of other numbers."""
    params = psdr.traverse(found)
    base = params[name].numpy().astype(np.float64)
    direction = np.asarray(tangent(base), np.float64)
    integrator = psdr.PathIntegrator(max_depth=depth)

    def difference(seed):
        images = []
        for sign in (1.0, -1.0):
            params[name] = (base + sign * step * direction).astype(np.float32)
            params.update()
            images.append(psdr.render(found, integrator=integrator, spp=difference_spp, seed=seed).numpy())
        params[name] = base.astype(np.float32)
        params.update()
        return (images[0].astype(np.float64) - images[1]) / (2.0 * step)

    weights = np.mean([difference(900 + b) for b in range(2)], axis=0)
    given = {name: direction.astype(np.float32)}
    options = {"integrator": integrator, "spp": spp}
    derivatives = [
        (weights * psdr.render_forward(found, params, given, seed=b, **options).numpy()).sum() for b in range(BATCHES)
    ]
    return np.array(derivatives), np.array([(weights * difference(300 + b)).sum() for b in range(BATCHES)])


def coloured(density, albedo=0.9):
    return medium(density, albedo, g=0.3)


ROWS = {
    "an L that grows": (lambda: scene(notched(SHEET, interior=coloured(1.5)), {"sky": sky()}), SHAPE, scaled, 3),
    "an L that moves": (lambda: scene(notched(SHEET, interior=coloured(1.5)), {"sky": sky()}), SHAPE, moved, 3),
    "camera": (lambda: scene(notched(SHEET, interior=coloured(1.5)), {"sky": sky()}), "sensor.to_world", turned, 3),
    "lamp before glass": (
        lambda: scene(
            ball((0.0, 0.0, 0.6), 0.5, GLASS, subdivisions=0, interior=coloured(1.5)),
            {"lamp": panel((0.8, 0.4, 2.5), 1.5, 2.0)},
        ),
        "lamp.vertex_positions",
        moved,
        4,
    ),
    "box beside glass": (
        lambda: scene(ball((0.0, 0.0, 0.6), 0.5, GLASS, subdivisions=0, interior=coloured(1.5)), {"sky": sky()}),
        "box.vertex_positions",
        moved,
        4,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_derivatives_equal_finite_differences(row) -> None:
    make, name, tangent, depth = ROWS[row]
    found = make()
    found.contact_ratio = 0.1
    value, error = slope(*compared(found, name, tangent, depth, 2048, 4096, 0.01))
    assert error < 0.03, f"too noisy to tell: slope {value:.4f} +- {error:.4f}"
    assert abs(value - 1.0) < 3.0 * error + 0.01, f"slope {value:.4f} +- {error:.4f}"


@pytest.mark.slow
def test_a_medium_that_is_hardly_there_has_the_derivatives_of_none() -> None:
    """Glass, whose squared index of refraction the two estimators scale by, each in its own way."""
    totals = []
    for more in ({}, {"interior": coloured(1e-5, 0.0)}):
        found = scene(ball((0.0, 0.0, 0.6), 0.5, GLASS, subdivisions=0, **more), {"sky": sky()})
        found.contact_ratio = 0.1
        params = psdr.traverse(found)
        given = {SHAPE: np.float32(scaled(params[SHAPE].numpy()))}
        options = {"integrator": psdr.PathIntegrator(max_depth=3), "spp": 4096}
        images = [psdr.render_forward(found, params, given, seed=b, **options).numpy() for b in range(BATCHES)]
        totals.append(np.mean(images, axis=(1, 2, 3), dtype=np.float64))
    spread = np.hypot(*(t.std(ddof=1) for t in totals)) / np.sqrt(BATCHES)
    assert abs(totals[0].mean() - totals[1].mean()) < 4.0 * spread
    assert spread < 0.02 * abs(totals[0].mean())


@pytest.mark.slow
def test_the_modes_are_transposes() -> None:
    found = scene(ball((0.0, 0.0, 0.6), 0.5, GLASS, smooth=True, interior=coloured(1.5)), {"sky": sky()})
    params = psdr.traverse(found)
    options = {"integrator": psdr.PathIntegrator(max_depth=4), "spp": 16, "seed": 1}
    weights = np.linspace(0.5, 1.5, 16 * 16 * 3, dtype=np.float32).reshape(16, 16, 3)
    tangent = np.float32(scaled(params[SHAPE].numpy()))
    image = psdr.render_forward(found, params, {SHAPE: tangent}, **options).numpy()
    params.requires_grad_only(SHAPE)
    psdr.render_backward(found, params, weights, **options)
    gradient = (params[SHAPE].grad.numpy().astype(np.float64) * tangent).sum()
    assert abs(gradient) > 1.0
    np.testing.assert_allclose(gradient, (weights * image).sum(dtype=np.float64), rtol=1e-3)


def test_glass_that_moves_through_points_beside_it_has_a_variance() -> None:
    """The turn of light at a surface is weighted where the volume vertex in front of it is near.

    Without the weight the spread is 1.7 here and grows without bound with the number of samples.
    """
    found = scene(
        ball((0.0, 0.0, 0.6), 0.5, {**GLASS, "alpha": 0.4, "int_ior": 1.3}, subdivisions=0, interior=coloured(2.0)),
        {"lamp": panel((0.8, 0.4, 2.5), 1.5, 2.0)},
    )
    found.contact_ratio = 0.3
    params = psdr.traverse(found)
    given = {SHAPE: np.float32(moved(params[SHAPE].numpy()))}
    options = {"integrator": psdr.PathIntegrator(max_depth=4, boundary=None), "spp": 256}
    images = np.array([psdr.render_forward(found, params, given, seed=b, **options).numpy() for b in range(6)])
    assert 0.0 < images.std(axis=0).mean() < 0.6

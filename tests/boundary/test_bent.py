"""Interpolated normals at any depth: the terminator that other surfaces see."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows, slope
from .scenes import ball, camera, diffuse, floor, mesh, panel, register, sky
from .test_table import moved


def glow():
    """A smooth ball that lights the floor below it."""
    return {
        "sensor": camera((0.0, -2.5, 3.0), (0.0, 0.0, 0.0), fov=35.0),
        "floor": floor(),
        "shape": ball((0.2, 0.1, 0.75), 0.5, diffuse(0.9, 0.8, 0.7), 1, smooth=True),
        "light": panel((1.2, -0.4, 1.6), 0.3, 20.0),
    }


def waves(**bsdf):
    """A flat sheet with the normals of waves, seen by a wall, which alone the camera sees."""
    wall = mesh([[-1, 1.5, 0], [1, 1.5, 0], [1, 1.5, 2], [-1, 1.5, 2]], [[0, 1, 2], [0, 2, 3]], diffuse(0.8))
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 4), np.linspace(0.2, 1.3, 4))
    vertices = np.stack([x, y, 0.1 + 0.0 * x], axis=-1).reshape(-1, 3)
    tilt = 1.5 * np.cos(3.0 * np.arange(4))[:, None] * np.ones(4)
    normals = np.stack([0.3 * np.sin(5.0 * x), tilt, np.ones_like(x)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    i = np.array([4 * r + c for r in range(3) for c in range(3)])[:, None]
    faces = np.concatenate([i + np.array([0, 1, 5]), i + np.array([0, 5, 4])])
    return {
        "sensor": camera((0.0, 0.4, 1.0), (0.0, 1.5, 1.0), fov=70.0),
        "wall": wall,
        "shape": mesh(vertices, faces, bsdf or diffuse(0.9, 0.8, 0.7), normals=normals.astype(np.float32)),
        "light": panel((0.3, 0.4, 1.2), 0.3, 30.0),
    }


register(
    {
        "glow": glow,
        "waves": waves,
        "waves metal": lambda: waves(type="roughconductor", alpha=0.5),
    }
)

SHAPE, WALL, NORMALS = "shape.vertex_positions", "wall.vertex_positions", "shape.vertex_normals"
NEARER = moved(0.0, 1.0, 0.0)


def tilted(values):
    """All normals towards +y."""
    return np.array([0.0, 1.0, 0.0]) - values * values[:, 1:2]


def bent_plate():
    """The sheet of waves before the camera."""
    return {k: v for k, v in waves().items() if k != "wall"} | {"sensor": camera((0.0, -1.5, 0.7), (0.0, 0.7, 0.1))}


def rim():
    """A smooth tube in a wide scene, whose upper facet is seen so edge-on that rays beside its edges just meet it."""
    n = 48
    angle = 2.0 * np.pi * (np.arange(n) + 0.5) / n
    ring = np.stack([np.zeros(n), np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([0.3 * ring + [x, 0.0, 0.0] for x in (-0.5, 0.5)])
    k = np.arange(n)
    j = (k + 1) % n
    faces = np.concatenate([np.stack([k, n + k, n + j], axis=1), np.stack([k, n + j, j], axis=1)])
    eye = 0.3 * np.cos(np.pi / n) + 0.006
    return {
        "sensor": camera((0.0, -3.0, eye), (0.0, 0.0, eye - 0.005), fov=3.0),
        "shape": mesh(vertices, faces, diffuse(0.8, 0.6, 0.4), normals=np.float32(np.tile(ring, (2, 1)))),
        "floor": floor(half=200.0),
        "sky": sky(),
    }


register({"bent plate": bent_plate, "rim": rim})

CASES = [
    # The wall is the vertex that sees the terminator.
    Case("waves", WALL, NEARER, 0.01, "a wall moves", 3, 512, 1024),
    Case("waves metal", WALL, NEARER, 0.01, "a wall moves", 3, 1024, 2048),
    Case("waves", WALL, NEARER, 0.01, "a wall moves", 4, 1024, 2048),
    Case("glow", SHAPE, moved(0.3, 0.2, 1.0), 0.01, "a ball moves", 3, 1024, 2048),
    # Vertex normals alone: the camera's terminator, and that of others.
    # The silhouette, the crease beside it and the terminator in between have one jump.
    Case("rim", SHAPE, moved(0.0, 0.0, 1.0), 0.0005, "a facet seen edge-on", 2, 4096, 2048, slow=False),
    Case("bent plate", NORMALS, tilted, 0.03, "normals turn", spp=1024, difference_spp=4096),
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if str(c) == "waves, a wall moves, depth 3"], ids=str)
def test_the_table_can_tell_missing_terminators(case: Case, monkeypatch) -> None:
    left_out = ("indirect_terminator", "terminator")
    rest = tuple(t for t in terms.TERMS[psdr.boundary.PathSpace] if t.name not in left_out)
    monkeypatch.setitem(terms.TERMS, psdr.boundary.PathSpace, rest)
    value, error = slope(derivatives(case, "forward"), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


def test_vertex_normals_alone_have_a_boundary_term() -> None:
    scene = psdr.load_dict({"type": "scene", **bent_plate()})
    plan = psdr.plan(scene, names=[NORMALS], integrator=psdr.PathIntegrator(max_depth=2))
    assert plan.boundary is not None and "interpolated normals turn away" in plan.discontinuities[0]
    emission = psdr.PathIntegrator(max_depth=1)
    assert psdr.plan(scene, names=[NORMALS], integrator=emission).boundary is None

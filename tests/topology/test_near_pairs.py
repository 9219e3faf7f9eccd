"""Pairs of triangles that may run through each other: none is missed, at any move, however rays are traced."""

import itertools

import numpy as np
import pytest
import trimesh

import warp_psdr as psdr
from warp_psdr.kernels.bvh.wide import WIDTHS
from warp_psdr.kernels.step import TOUCH
from warp_psdr.topology import intersection_curves
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.intersection_curves import IN_PLANE

from .test_edges import cube, mesh, scene_with


def knot() -> tuple[np.ndarray, np.ndarray]:
    """A bumpy ball that is pulled through itself, far from the origin."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    x = np.asarray(ball.vertices)
    x = x * (1.0 + 0.4 * np.sin(5.0 * x[:, :1] + 3.0 * x[:, 1:2]))
    x[:, 2] *= x[:, 0]
    return x + np.array([3.0, -2.0, 1.0]), np.asarray(ball.faces)


def soup() -> tuple[np.ndarray, np.ndarray]:
    """Triangles of all sizes, and needles."""
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-3.0, 0.3, (300, 1, 1))
    corners = rng.uniform(-1.0, 1.0, (300, 1, 3)) + size * rng.normal(size=(300, 3, 3))
    corners[::10, 2] = 0.5 * (corners[::10, 0] + corners[::10, 1]) + 1e-5 * rng.normal(size=(30, 3))
    return corners.reshape(-1, 3), np.arange(900).reshape(-1, 3)


def plates() -> tuple[np.ndarray, np.ndarray]:
    """Two grids of flat triangles that cross, one with vertices in the plane of the other."""
    x, y = (a.reshape(-1) for a in np.meshgrid(np.linspace(-1.0, 1.0, 13), np.linspace(-1.0, 1.0, 13)))
    n = np.arange(12 * 13).reshape(12, 13)[:, :-1].reshape(-1)
    faces = np.concatenate([np.stack([n, n + 1, n + 13], 1), np.stack([n + 1, n + 14, n + 13], 1)])
    flat, upright = np.stack([x, y, 0.0 * x], axis=1), np.stack([x + 0.03, 0.0 * x + 0.04, y], axis=1)
    return np.concatenate([flat, upright]), np.concatenate([faces, faces + len(flat)])


MESHES = {"knot": knot, "soup": soup, "plates": plates}


def straddling(scene) -> np.ndarray:
    """Return all pairs of triangles whose boxes meet, that share no edge, and that reach through each other's plane."""
    triangles, points = scene.builder.indices, scene.points.astype(np.float64)
    corners, groups = scene.points[triangles], scene_adjacency(scene).group[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    i, j = np.triu_indices(len(corners), 1)
    meet = ((low[i] <= high[j]) & (low[j] <= high[i])).all(axis=1)
    i, j = i[meet], j[meet]
    across = (groups[i][:, :, None] == groups[j][:, None]).any(axis=1).sum(axis=1) < 2
    for plane, of in ((i, j), (j, i)):
        h = intersection_curves._heights(points, triangles, plane, of)
        h[np.abs(h) <= IN_PLANE * scene.steps.far.min()] = 0.0
        above = (h.max(axis=1) > 0.0) | ((h == 0.0).sum(axis=1) == 2)
        across &= (h.min(axis=1) < 0.0) & above
    return np.stack([i, j], axis=1)[across]


def crossings(scene, pairs: np.ndarray) -> tuple:
    """Return which of the pairs intersect, and where."""
    edges = scene_adjacency(scene)
    far = scene.steps.far[scene.builder.face_shape[pairs]]
    tolerance = np.maximum(IN_PLANE * far.min(axis=1, initial=np.inf), TOUCH * far.max(axis=1, initial=0.0))
    points = scene.points.astype(np.float64)
    return intersection_curves._segments(points, scene.builder.indices, edges, pairs, tolerance)


@pytest.fixture(params=[*WIDTHS, 0], ids=lambda width: f"wide {width}" if width else "mesh queries")
def rays(request):
    try:
        psdr.set_ray_backend("wide" if request.param else "warp")
        psdr.set_vector_width(request.param or None)
        yield
    finally:
        psdr.set_ray_backend("auto")
        psdr.set_vector_width(None)


@pytest.mark.parametrize("name", MESHES)
def test_no_pair_is_missed(name: str, rays, monkeypatch) -> None:
    monkeypatch.setattr(intersection_curves, "ROOM", 1)  # the rows are too short at first
    vertices, faces = MESHES[name]()
    scene = scene_with(shape=mesh(vertices, faces), box=mesh(*cube()))
    params = psdr.traverse(scene)
    rng = np.random.default_rng(4)
    # From no move to one after which the tree is built anew.
    for size in (0.0, 1e-6, 1e-2, 1.0):
        moved = vertices + size * rng.normal(size=vertices.shape)
        if size == 1e-2:
            moved[2::150] = moved[1::150]  # some triangles lose their area
        params["shape.vertex_positions"] = moved
        params.update()
        found = intersection_curves._candidates(scene, scene_adjacency(scene))
        assert (found[:, 0] < found[:, 1]).all() and len(np.unique(found, axis=0)) == len(found)
        expected = crossings(scene, straddling(scene))
        assert len(expected[0]) > 10
        for a, b in zip(crossings(scene, found), expected, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_scene_of_no_pairs() -> None:
    shapes = {f"box{i}": mesh(cube()[0] + [4.0 * i, 0.0, 0.0], cube()[1]) for i in range(3)}
    scene = scene_with(**shapes)
    assert len(intersection_curves._candidates(scene, scene_adjacency(scene))) == 0
    assert len(list(itertools.chain(*crossings(scene, np.zeros((0, 2), np.int64))))) == 0

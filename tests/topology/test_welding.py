"""Welded vertices that move: the edges of a scene are those that a fresh search finds."""

import itertools

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology.edges import adjacency, scene_adjacency
from warp_psdr.topology.welding import still_welded, weld

from .test_edges import cube, mesh, scene_with

TOLERANCE = 1e-6


def records(edges):
    """All edges, in an order that does not depend on how vertices were numbered."""
    rows = []
    for i, (first, last) in enumerate(itertools.pairwise(edges.first)):
        ends = sorted(map(tuple, np.round(edges.points[i], 6)))
        rows.append((sorted(edges.faces[first:last]), ends, edges.length[i], edges.wedge[i]))
    return sorted(rows, key=lambda row: row[:2])


def same(a, b) -> None:
    a, b = records(a), records(b)
    assert [row[:2] for row in a] == [row[:2] for row in b]
    np.testing.assert_allclose([row[2:] for row in a], [row[2:] for row in b], atol=1e-9)


def test_points_that_keep_together_and_apart_are_still_welded() -> None:
    points = np.repeat(np.random.default_rng(0).random((500, 3)), 2, axis=0)
    group = weld(points, TOLERANCE)
    assert group.max() == 499
    moved = points @ np.diag([1.1, -0.7, 1.0]) + 0.3
    assert still_welded(moved, group, TOLERANCE)
    # Rounding of posed copies.
    assert still_welded(moved + 0.2 * TOLERANCE * np.sin(np.arange(1000.0))[:, None], group, TOLERANCE)
    torn = moved.copy()
    torn[7] += [0.0, 2.0 * TOLERANCE, 0.0]
    assert not still_welded(torn, group, TOLERANCE)
    joined = moved.copy()
    joined[10:12] = joined[900] + [0.5 * TOLERANCE, 0.0, 0.0]
    assert not still_welded(joined, group, TOLERANCE)
    # Anything may be asked of points that nobody looks at again.
    assert not still_welded(np.full_like(points, np.nan), group, TOLERANCE)
    assert still_welded(np.zeros((0, 3)), np.zeros(0, int), TOLERANCE)


def test_many_points_in_one_plane_across_the_direction_do_not_take_long() -> None:
    points = np.zeros((4000, 3))
    points[:, 0] = np.arange(4000) * 1e-9
    assert not still_welded(points, np.arange(4000), TOLERANCE)


@pytest.mark.parametrize("split", [False, True])
def test_edges_of_moved_shapes_are_those_of_a_fresh_search(split: bool) -> None:
    vertices, faces = cube(split)
    scene = scene_with(shape=mesh(vertices, faces), other=mesh(vertices + np.array([5.0, 0.0, 0.0]), faces))
    params = psdr.traverse(scene)
    start = params["shape.vertex_positions"].numpy().copy()

    def check(points) -> bool:
        """Move the shape; return whether its topology was found again."""
        before = scene_adjacency(scene)
        params["shape.vertex_positions"] = points.astype(np.float32)
        params.update()
        found = scene_adjacency(scene)
        rows = slice(scene.positions, scene.positions + 3 * scene.vertex_count)
        same(found, adjacency(scene.values.numpy()[rows].reshape(-1, 3), scene.builder.indices))
        return found.faces is before.faces

    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    assert check(start @ turn.T + [0.0, 0.1, 0.0])
    # A corner moves with all of its copies: faces bend, edges stay.
    corner = np.linalg.norm(start - start[0], axis=1) < 1e-6
    assert check(start + np.where(corner[:, None], [0.3, 0.2, 0.0], 0.0))
    # The shapes touch at a face, and part again.
    assert not check(start + np.array([3.0, 0.0, 0.0]))
    assert not check(start)
    # A face loses its area.
    flat = start.copy()
    flat[faces[0, 0]] = 0.5 * (start[faces[0, 1]] + start[faces[0, 2]])
    assert not check(flat)
    if split:
        torn = start.copy()
        torn[faces[0]] += [0.0, 0.0, 0.5]
        assert not check(torn)


def test_edges_come_in_one_order_whatever_the_scene_was_before() -> None:
    """So samples on them are the same: of a scene that followed a motion, and of one that was put there at once."""
    scenes = [scene_with(box=mesh(*cube())) for _ in range(2)]
    name = next(n for n in psdr.traverse(scenes[0]) if n.endswith("vertex_positions"))
    params = [psdr.traverse(s) for s in scenes]
    first = scene_adjacency(scenes[0])
    base = params[0][name].numpy().copy()
    turned = base @ np.float32([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for p in params:
        p[name] = turned
        p.update()
    kept, fresh = (scene_adjacency(s) for s in scenes)
    for field in ("ends", "twins", "faces", "first"):
        np.testing.assert_array_equal(getattr(kept, field), getattr(fresh, field))
    np.testing.assert_array_equal(kept.ends, first.ends)
    # In the order of the coordinates that the vertices were loaded with.
    assert (np.diff(base[kept.ends].min(axis=1)[:, 0]) > -1.0e-6).mean() > 0.8

"""Edges of the convex hull, which no segment between two vertices passes, and what is kept while values rest."""

import numpy as np
import pytest

import warp_psdr as psdr
from tests.path.test_sdfgrid import sphere
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.kinds.grid_silhouettes import grid_items, grid_shapes
from warp_psdr.topology.outermost import outermost_edges
from warp_psdr.topology.secondary_edges import secondary_candidates
from warp_psdr.topology.unchanged import at_rest, kept

T = psdr.Transform
LAMP = {"emitter": {"type": "area", "radiance": 4.0}}
SKY = {"sky": {"type": "constant"}}
#: A point light above the lamp, and one below it.
ABOVE, BELOW = ({"bulb": {"type": "point", "position": [0.0, 0.0, z]}} for z in (5.0, 2.0))


def loaded(*lights: dict) -> psdr.Scene:
    """Return a grid between a floor and a lamp, with a square in the air that has edges on all sides."""
    shapes = {
        "floor": {"type": "rectangle", "to_world": T().scale(3.0)},
        "lamp": {"type": "rectangle", "to_world": T().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.5), **LAMP},
        "square": {"type": "rectangle", "to_world": T().translate([0.2, 0, 2]).scale(0.3)},
        "ball": {"type": "sdfgrid", "grid": sphere(12, 0.3), "to_world": T().translate([-0.5, -0.5, 0.1])},
    }
    sensor = {"type": "perspective", "to_world": T().look_at([0, -3, 1], [0, 0, 1], [0, 0, 1])}
    scene = {"type": "scene", "sensor": sensor, **shapes}
    for light in lights:
        scene |= light
    return psdr.load_dict(scene)


def outermost(scene: psdr.Scene) -> list[str]:
    """Return the shapes all of whose borders are outermost, and assert that no shape has only some."""
    edges, mask = scene_adjacency(scene), outermost_edges(scene)
    shape = scene.builder.face_shape[edges.faces[edges.first[:-1]]]
    border = edges.count == 1
    found = []
    for i in np.unique(shape):
        own = mask[(shape == i) & border]
        assert own.all() or not own.any()
        assert not mask[(shape == i) & ~border].any()
        if own.all():
            found.append(scene.description.shapes[i].path)
    return found


@pytest.mark.parametrize(
    ("lights", "expected"),
    [((), ["floor", "lamp"]), ((BELOW,), ["floor", "lamp"]), ((ABOVE,), ["floor"]), ((SKY,), [])],
    ids=["lamp", "bulb below", "bulb above", "sky"],
)
def test_borders_of_a_floor_and_of_a_lamp_above_it(lights: tuple, expected: list[str]) -> None:
    scene = loaded(*lights)
    assert outermost(scene) == expected
    keep, p = secondary_candidates(scene, {3})
    assert not outermost_edges(scene)[keep].any() and p.sum() == pytest.approx(1.0)


def test_no_segment_passes_an_outermost_edge() -> None:
    """Of segments between any two points of the scene none comes as near to one as to others."""
    scene, rng = loaded(), np.random.default_rng(0)
    edges, mask = scene_adjacency(scene), outermost_edges(scene)
    weight = rng.dirichlet(np.full(len(scene.points), 0.02), (2, 20000))
    a, b = weight @ scene.points
    ends = edges.points.astype(np.float64)
    angles = []
    for p, q in ends:
        x = p + rng.random((len(a), 1)) * (q - p)
        to_a, to_b = (end - x - ((end - x) @ (q - p))[:, None] * (q - p) / ((q - p) @ (q - p)) for end in (a, b))
        lengths = np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1)
        angles.append(((to_a * to_b).sum(axis=1) / np.maximum(lengths, 1e-12))[lengths > 1e-6].min())
    angles = np.array(angles)
    # Opposite directions have the cosine -1.
    assert angles[mask].min() > -0.99
    assert (angles[~mask] < -0.999).all()


def test_what_is_found_is_kept_until_a_value_changes() -> None:
    scene = loaded()
    params = psdr.traverse(scene)
    calls = []

    def find() -> int:
        calls.append(1)
        return len(calls)

    assert [kept(scene, "a", find), kept(scene, "a", find), kept(scene, "b", find)] == [1, 1, 2]
    before = grid_items(scene, grid_shapes(scene), None)
    again = grid_items(scene, grid_shapes(scene), None)
    assert before is not None and again is not None and again is not before
    assert again.items.ptr == before.items.ptr
    params["ball.grid"] = sphere(12, 0.2)
    params.update("ball.grid")
    after = grid_items(scene, grid_shapes(scene), None)
    assert after is not None and len(after.items) < len(before.items)
    with at_rest(scene), at_rest(scene):
        assert [kept(scene, "a", find), kept(scene, "a", find)] == [3, 3]
    params["ball.grid"] = sphere(12, 0.25)
    params.update("ball.grid")
    assert kept(scene, "a", find) == 4

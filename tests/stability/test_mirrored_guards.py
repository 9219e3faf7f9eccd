"""Guards of the search for discontinuities through mirrors and glass (``boundary/specular/discontinuity.py``)."""

import functools

import numpy as np
import pytest
import warp as wp

import warp_psdr as psdr
from warp_psdr.kernels.boundary.local_form import Edges
from warp_psdr.kernels.boundary.specular.chain_pullback import Visit
from warp_psdr.kernels.boundary.specular.discontinuity import make_crossing
from warp_psdr.kernels.boundary.specular.line_search import ARC_LENGTH, MAX_VISITS, RESOLUTION
from warp_psdr.kernels.boundary.specular.ray_differential import RayDifferential
from warp_psdr.kernels.boundary.specular.specular_chain import Block
from warp_psdr.kernels.boundary.specular.triangle_borders import Tables
from warp_psdr.kernels.structs import Camera, Scene
from warp_psdr.kernels.vertex import PathConfig
from warp_psdr.topology.faces import face_tables

from .sweeps import box, room

#: Radians between the two sides of a crossing on an arc.
CELL = ARC_LENGTH / RESOLUTION
CURVE, EDGE = 2, 1
#: Somewhere, so that there is a search.
MIRROR = {
    "type": "rectangle",
    "to_world": psdr.Transform.translate([-2.5, 0.0, 1.0]) @ psdr.Transform.rotate([0, 1, 0], 90),
    "bsdf": {"type": "conductor", "material": "none"},
}


@functools.cache
def crossing_kernel(config: PathConfig):
    crossing = make_crossing(config)

    @wp.kernel(module="unique", enable_backward=False)
    def crossed(
        scene: Scene,
        camera: Camera,
        edges: Edges,
        tables: Tables,
        x: wp.array(dtype=wp.vec3),
        toward: wp.array(dtype=wp.vec3),
        aside: wp.vec3,
        half: wp.float32,
        found_out: wp.array(dtype=wp.int32),
        tau_out: wp.array(dtype=wp.float32),
        point_out: wp.array(dtype=wp.vec3),
    ):
        i = wp.tid()
        block = Block()
        block.x = x[i]
        block.n = wp.vec3(0.0, 0.0, 1.0)
        block.w0 = toward[i]
        block.w1 = wp.normalize(aside - wp.dot(aside, toward[i]) * toward[i])
        block.ell = 1.0
        block.depth = 2
        block.step = scene.ray_epsilon
        block.first = 1
        a = RayDifferential()
        a.d = block.w1
        b = RayDifferential()
        b.d = wp.cross(block.w0, block.w1)
        visits = wp.zeros(shape=(wp.static(MAX_VISITS),), dtype=Visit)
        r = crossing(scene, camera, edges, tables, block, -half, half, 0, a, b, visits, 1, 4)
        found_out[i] = r.valid * r.edge
        tau_out[i] = r.segment.tau
        point_out[i] = r.segment.x

    return crossed


def crossings(bottom: float, sunk: float, x, at, aside, half: float, width: float = 1.0) -> tuple[np.ndarray, ...]:
    """``crossings_in`` a room with a box on its floor, from (0.7 - width, -0.4, 0) to (0.7, 0.6, 1).

    The box reaches ``sunk`` deep into a wall, which begins at the height ``bottom``.
    """
    y = 0.6 - sunk
    corners = [[-2.0, y, bottom], [2.0, y, bottom], [2.0, y, 2.0], [-2.0, y, 2.0]]
    wall = {"type": "mesh", "vertices": corners, "faces": [[0, 1, 2], [0, 2, 3]]}
    description = room(extra={"wall": wall, "mirror": MIRROR})
    vertices, faces = box((0.7 - 0.5 * width, 0.1, 0.5), np.array([0.5 * width, 0.5, 0.5]), 0.0)
    description["box"] |= {"vertices": vertices, "faces": faces}
    return crossings_in(psdr.load_dict(description), x, at, aside, half)


def crossings_in(scene, x, at, aside, half: float) -> tuple[np.ndarray, ...]:
    """Return what lines cross that go from x (n, 3) through ``at`` (n, 3), ``half`` radians to either side of it.

    Returns:
        EDGE, CURVE or 0 (n,), tau (n,), the points (n, 3).
    """
    kernel = crossing_kernel(psdr.plan(scene, integrator=psdr.PathIntegrator(max_depth=4)).config)
    # Rays start a step off the surface, whose normal is +z.
    toward = at - x
    toward = toward - scene.ray_epsilon * np.sign(toward[:, 2:]) * [0.0, 0.0, 1.0]
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    arrays = [wp.array(np.float32(v), dtype=wp.vec3, device="cpu") for v in (x, toward)]
    out = [wp.zeros(len(x), dtype=t, device="cpu") for t in (wp.int32, wp.float32, wp.vec3)]
    inputs = [scene.data(), scene.camera(0), *face_tables(scene), *arrays, wp.vec3(*aside), half]
    wp.launch(kernel, len(x), inputs, out, device="cpu")
    return tuple(v.numpy() for v in out)


def test_seen_from_close_by_a_sunk_edge_is_its_own_background() -> None:
    """An edge inside of a wall, where the two touch, is behind the wall: tau is 1 there, not more.

    Points of the floor as near as five times that depth. What touches there is met at the same distance.
    """
    sunk = 5e-5
    near = np.geomspace(5.0 * sunk, 5e-3, 64)[:, None]
    at = np.array([0.7, 0.6 - sunk, 0.0]) + near * [0.0, 0.0, 1.0]
    found, tau, _point = crossings(0.0, sunk, at + near * [1.0, -1.0, -1.0], at, (-1.0, -1.0, 0.0), 1e-3)
    assert (found == EDGE).all() and tau.min() > 0.99 and tau.max() == 1.0


def test_what_no_edge_is_near_is_not_taken_for_the_nearest() -> None:
    """A wall and a floor that run through each other, from places that are far apart: their curve is not there."""
    x = np.array([[-1.5, -1.0, 0.5]])
    for half, expected in ((CELL, CURVE), (2e-2, 0)):
        found, _tau, _point = crossings(-1.0, 0.0, x, np.array([[-1.5, 0.6, 0.0]]), (0.0, 0.0, 1.0), half)
        assert found[0] == expected


@pytest.mark.parametrize(("width", "least"), [(1.0, 2e-4), (2e-3, 1e-3)])
def test_an_edge_of_a_face_seen_nearly_edge_on_is_not_lost(width: float, least: float) -> None:
    """The top of a box, or of a thin plate: its points in the finest cell are far from its edge."""
    angle = np.geomspace(least, 0.1, 64)[:, None]
    at = np.array([[0.7, 0.1, 1.0]])
    x = at + np.concatenate([-np.ones_like(angle), 0.0 * angle, angle], axis=1)
    found, _tau, point = crossings(0.0, -0.1, x, at, (0.0, 0.0, 1.0), CELL, width)
    assert (found == EDGE).all()
    np.testing.assert_allclose(point, np.broadcast_to(at, point.shape), atol=1e-3)


@pytest.mark.slow
def test_beyond_the_rim_of_a_smooth_cup_its_next_side_is_another_surface() -> None:
    """The two sides share an edge across which normals are interpolated, and are far apart where the rim is seen.

    Three sides; from above, the foot of the next one is seen across the rim of the first, near their common corner.
    """
    angle = 2.0 * np.pi / 3.0 * np.arange(3)
    foot = np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.5 + 0.0 * angle], 1)
    top = foot + np.array([0.0, 0.0, 0.2])
    faces = [face for i, j in ((0, 1), (1, 2), (2, 0)) for face in ([i, j, j + 3], [i, j + 3, i + 3])]
    cup = {"type": "mesh", "vertices": np.concatenate([foot, top]), "faces": faces, "face_normals": False}
    scene = psdr.load_dict(room(extra={"box": cup, "mirror": MIRROR}))
    at = top[0] + np.linspace(0.02, 0.1, 32)[:, None] * (top[1] - top[0])
    x = at + np.array([0.5, np.sqrt(0.75), 1.0])
    found, _tau, point = crossings_in(scene, x, at, (0.0, 0.0, 1.0), CELL)
    assert (found == EDGE).all()
    np.testing.assert_allclose(point, at, atol=1e-3)


def test_where_a_wall_runs_through_a_mirror_no_edge_is_near() -> None:
    """It leans over the mirror, so that next to their curve reflected rays start behind it, close to its diagonal."""
    lean = np.radians(30.0)
    up = np.array([np.cos(lean), 0.0, np.sin(lean)])
    side = np.array([0.0, 1.0, 0.0])
    wall = {
        "type": "mesh",
        "vertices": [-up - side, -up + side, up + side, up - side],
        "faces": [[0, 1, 2], [0, 2, 3]],
    }
    floor = {"type": "rectangle", "to_world": psdr.Transform.scale(3.0), "bsdf": {"type": "conductor"}}
    scene = psdr.load_dict(room(extra={"floor": floor, "wall": wall}))
    # Half of the width of that strip, from afar.
    strip = scene.ray_epsilon / np.tan(lean)
    at = np.stack([np.full(32, strip), np.linspace(-0.05, 0.05, 32), np.zeros(32)], 1)
    x = at + np.array([2.0, 0.0, 0.3])
    found, _tau, _point = crossings_in(scene, x, at, (0.0, 0.0, 1.0), 0.5 * strip * 0.3 / 4.0)
    assert (found == 0).all()

"""Shapes that abut without sharing vertices: an edge of each runs along one line, seen once, with one shadow."""

import warnings

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology import contacts
from warp_psdr.topology.edges import scene_adjacency

from .measure import MODES, Case, assert_agrees, derivatives, differences, move, rows
from .scenes import SIZE, T, box, camera, diffuse, floor, load, mesh, panel, register, sky
from .test_brushed import pans
from .test_table import moved

FACES = [[0, 1, 2], [0, 2, 3]]
RED, BLUE = diffuse(0.8, 0.3, 0.2), diffuse(0.2, 0.4, 0.8)
VIEW = camera((0.3, -3.0, 2.5), (0.0, 0.2, 0.2))


def tiles():
    """Two tiles of a floor, one of them longer."""
    first = mesh([[-2, -1, 0], [0, -1, 0], [0, 1, 0], [-2, 1, 0]], FACES, RED)
    second = mesh([[0, -1.5, 0], [2, -1.5, 0], [2, 1.5, 0], [0, 1.5, 0]], FACES, BLUE)
    return {"sensor": VIEW, "first": first, "second": second, "sky": sky()}


def corner():
    """A wall on a part of the border of a floor."""
    first = mesh([[-2, -2, 0], [2, -2, 0], [2, 1, 0], [-2, 1, 0]], FACES, RED)
    second = mesh([[-1, 1, 0], [1, 1, 0], [1, 1, 1.5], [-1, 1, 1.5]], FACES, BLUE)
    return {"sensor": VIEW, "first": first, "second": second, "light": panel((0.8, -0.6, 2.5), 0.5)}


def post():
    """A post with a pointed foot: the ring between post and foot lies in the floor."""
    n = 8
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = 0.4 * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    vertices = np.concatenate([np.add(ring, [0.0, 0.0, 0.8]), ring, [[0.0, 0.0, 0.8], [0.0, 0.0, -0.6]]])
    k = np.arange(n)
    j = (k + 1) % n
    sides = [[n + k, n + j, j], [n + k, j, k], [k, j, 0 * k + 2 * n], [n + j, n + k, 0 * k + 2 * n + 1]]
    faces = np.concatenate([np.stack(side, axis=1) for side in sides])
    return {"sensor": VIEW, "floor": floor(), "shape": mesh(vertices, faces, RED), "sky": sky()}


def behind():
    """A wall on a part of the border of a floor, in front of it."""
    first = mesh([[-2, 0, 0], [2, 0, 0], [2, 2, 0], [-2, 2, 0]], FACES, RED)
    second = mesh([[-1, 0, 0], [1, 0, 0], [1, 0, 1.5], [-1, 0, 1.5]], FACES, {"type": "twosided", "bsdf": BLUE})
    return {"sensor": VIEW, "first": first, "second": second, "sky": sky()}


def stairs():
    """Two boxes side by side, one higher: edges that coincide from straight above alone."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE}
    pose = T.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]) @ T.scale([1.5, 1.5, 1])
    return {
        "sensor": {"type": "orthographic", "to_world": pose, "film": film},
        "first": box((-0.5, 0.0, 1.0), (0.5, 0.6, 1.0), RED),
        "second": box((0.4, 0.1, 0.5), (0.4, 0.7, 0.5), BLUE),
        "light": panel((0.8, -0.6, 3.5), 0.5),
    }


def flush():
    """A small box on a big one, one side of either in the same plane."""
    first, second = box((0.0, 0.0, 0.4), (0.6, 0.5, 0.4), RED), box((0.3, -0.2, 1.05), (0.3, 0.3, 0.25), BLUE)
    return {"sensor": VIEW, "floor": floor(), "first": first, "second": second, "light": panel((0.8, -0.6, 2.5), 0.5)}


def shelf(light):
    """A wall on a part of the rear border of a plate above a floor, both on one side of the light from behind."""
    first = mesh([[-0.8, -0.4, 0.8], [0.8, -0.4, 0.8], [0.8, 0.4, 0.8], [-0.8, 0.4, 0.8]], FACES, RED)
    second = mesh([[-0.5, 0.4, 0.8], [0.4, 0.4, 0.8], [0.4, 0.4, 1.3], [-0.5, 0.4, 1.3]], FACES, BLUE)
    return {
        "sensor": camera((0.3, -3.0, 2.0), (0.0, -0.2, 0.2)),
        "floor": floor(),
        "first": first,
        "second": second,
    } | {"light": light}


def sun():
    return {"type": "directional", "direction": [0.1, -0.5, -1.0], "irradiance": {"type": "rgb", "value": [3.0] * 3}}


register(
    {
        "tiles": tiles,
        "wall on a border": corner,
        "wall before a floor": behind,
        "stairs": stairs,
        "flush boxes": flush,
        "sunk post": post,
    }
    | {"shelf": lambda: shelf(panel((0.2, 1.6, 2.8), 0.2)), "shelf in the sun": lambda: shelf(sun())}
)
BOTH = ("first.vertex_positions", "second.vertex_positions")
CASES = [
    Case("tiles", "sensor.to_world", pans, 0.02, "seen in passing"),
    Case("tiles", BOTH, moved(1.0, 0.2, 0.0), 0.02, "both slide"),
    Case("wall on a border", "sensor.to_world", pans, 0.02, "seen in passing", 2, 512, 2048),
    Case("wall on a border", BOTH, moved(1.0, 0.2, 0.3), 0.02, "both move", 2, 1024, 4096),
    Case("wall before a floor", "sensor.to_world", pans, 0.02, "seen in passing", 2, 512, 2048),
    Case("stairs", BOTH, moved(1.0, 0.2, 0.0), 0.02, "both slide", spp=1024, difference_spp=2048),
    Case("sunk post", "sensor.to_world", pans, 0.01, "seen in passing", 2, 512, 2048, slow=False),
    Case("sunk post", "shape.vertex_positions", moved(0.0, 1.0, 0.0), 0.01, "slides", 2, 512, 2048),
    Case("flush boxes", "sensor.to_world", pans, 0.01, "seen in passing", 2, 512, 2048),
    Case("flush boxes", BOTH, moved(1.0, 0.2, 0.0), 0.01, "both slide", 2, 1024, 4096),
]
SHADOWS = [
    Case("shelf", BOTH, moved(0.2, 1.0, 0.1), 0.02, "both move", 2, 512, 2048),
    Case("shelf", BOTH, moved(0.2, 1.0, 0.1), 0.02, "both move", 4, 1024, 4096),
    Case("shelf", "light.vertex_positions", moved(0.3, 1.0, 0.0), 0.02, "its light moves", 2, 1024, 2048),
    Case("shelf in the sun", BOTH, moved(0.2, 1.0, 0.1), 0.01, "both move", 2, 512, 2048),
]
METHODS = {
    "unguided": psdr.boundary.PathSpace(guiding=None),
    "guided": psdr.boundary.PathSpace(guiding=psdr.guiding.KdTree()),
    "edge sampling": psdr.boundary.EdgeSampling(),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_agree_with_differences(case, mode) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.parametrize(
    "method", ["unguided", *(pytest.param(m, marks=pytest.mark.slow) for m in ("guided", "edge sampling"))]
)
@pytest.mark.parametrize("case", rows(SHADOWS))
def test_shadows_agree_with_differences(case, method) -> None:
    assert_agrees(derivatives(case, "reverse", METHODS[method]), differences(case)[2])


@pytest.mark.slow
def test_guiding_follows_what_abuts() -> None:
    scene, params = load("shelf")
    name = "second.vertex_positions"
    base = params[name].numpy().copy()
    weights = np.ones((SIZE, SIZE, 3), np.float32)
    params.requires_grad_only(*BOTH)
    integrator = psdr.PathIntegrator(max_depth=2, boundary=METHODS["guided"])
    beside = []
    try:
        for lift in (0.0, 0.02, 0.0):
            move(params, {name: base + np.array([0.0, 0.0, lift])})
            psdr.render_backward(scene, params, weights, integrator=integrator, spp=4)
            (kept,) = psdr.guiding.structures(scene)
            beside.append(kept.edges.beside_first.shape[0] > 1)
    finally:
        move(params, {name: base})
        psdr.guiding.reset(scene)
    assert beside == [True, False, True]


def brick():
    """A box on a plate that is cut along the line on which one of its sides stands: edges of four triangles."""
    x, y = np.meshgrid([-1.5, 0.25, 1.5], [-1.5, -0.3, 0.4, 1.5], indexing="ij")
    quads = np.array([[0, 4, 5], [0, 5, 1]])
    plate = mesh(
        np.stack([x, y, 0.0 * x], axis=2).reshape(-1, 3),
        np.concatenate([quads + 4 * i + j for i in (0, 1) for j in range(3)]),
        RED,
    )
    view = camera((1.8, -2.6, 1.7), (0.0, 0.0, 0.1))
    return {
        "sensor": view, "plate": plate, "brick": box((-0.05, 0.05, 0.25), (0.3, 0.35, 0.25), BLUE),
        "light": panel((1.5, 0.3, 2.5), 0.5), "sky": sky(),
    }  # fmt: skip


register({"brick": brick})
BRICK = [
    Case("brick", name, moved(0.6, 0.8, 0.0), 0.004, "slides", depth=3, spp=1024)
    for name in ("brick.vertex_positions", "plate.vertex_positions")
]


def test_what_slides_on_a_cut_plate_moves_along_the_contact() -> None:
    """The first two triangles of an edge of four are the plate's top and the brick's side, and nothing is torn."""
    scene, _params = load("brick")
    edges = scene_adjacency(scene)
    (shared,) = np.flatnonzero(edges.count > 2)
    first = edges.faces[edges.first[shared] : edges.first[shared] + 2]
    normals = np.cross(*(np.diff(scene.points[scene.builder.indices[first]], axis=1).transpose(1, 0, 2)))
    assert set(scene.builder.face_shape[first]) == {0, 1} and abs(normals[0] @ normals[1]) < 1e-6
    tangents = np.zeros(len(scene.values), np.float32)
    shape = scene.builder.shapes[1]
    at = scene.positions + 3 * shape.first_vertex
    moved_by = tangents[at : at + 3 * shape.vertex_count].reshape(-1, 3)
    moved_by[:] = [0.6, 0.8, 0.0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        contacts.warn(scene, tangents)
    moved_by[:] = [0.0, 0.0, 1.0]
    with pytest.warns(RuntimeWarning, match="'plate' and 'brick' touch"):
        contacts.warn(scene, tangents)


@pytest.mark.slow
@pytest.mark.parametrize("case", BRICK, ids=str)
def test_a_brick_slides_on_a_cut_plate(case) -> None:
    assert_agrees(derivatives(case, "forward"), differences(case)[2])

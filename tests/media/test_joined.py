"""Shapes in media whose edges lie along each other: rooms of six rectangles, a wall on a part of a plate's border."""

import functools

import numpy as np
import pytest

import warp_psdr as psdr
from tests.gradients.configs import shift
from tests.media.scenes import T, camera, cube, lamp, medium, rgb, whole
from tests.media.test_boundary import COLOURS, Z, derivatives, difference

FOG = medium((0.3, 0.25, 0.35), (0.9, 0.8, 0.7), g=0.3)
WALL = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
PAINT = {"type": "twosided", "bsdf": WALL}
SIZE, BATCHES = 8, 6
BOX = {
    "type": "cube",
    "to_world": T.translate([0.3, 0.1, -0.7]) @ T.rotate([0, 0, 1], 25.0) @ T.scale(0.3),
    "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.5, 0.7)},
}
RAMP = np.linspace(-1.0, 1.0, SIZE)
#: Weights of the pixels.
ADJOINT = (COLOURS * (1.0 + 0.3 * RAMP[:, None, None] + 0.5 * RAMP[None, :, None])).astype(np.float32)
MOTIONS = {
    "box.to_world": shift(1.0, 0.2, 0.0),
    "lamp.to_world": shift(0.3, 0.1, -1.0),
    "sensor.to_world": shift(-0.1, 0.4, 0.2),
}


def side(axis, angle, low=-1.0, high=1.0):
    """A side of the room, or a part of it along x."""
    part = T.translate([0.5 * (low + high), 0, -1]) @ T.scale([0.5 * (high - low), 1, 1])
    return {"type": "rectangle", "to_world": T.rotate(axis, angle) @ part, "bsdf": WALL}


def walls(split):
    """Six rectangles; ``split``: one of them in two, so that four edges lie along parts of others."""
    z, x, y = [0, 0, 1], [1, 0, 0], [0, 1, 0]
    left = {"left": side(x, 90, -1.0, -0.4), "more": side(x, 90, -0.4, 1.0)} if split else {"left": side(x, 90)}
    others = {"right": side(x, -90), "back": side(y, 90), "front": side(y, -90)}
    return {"floor": side(z, 0), "ceiling": side(x, 180), **left, **others}


ROOMS = {
    "one mesh": {"room": {"type": "cube", "flip_normals": True, "bsdf": WALL}},
    "six": walls(False),
    "seven": walls(True),
}


#: A box that is tilted, and sunk into the floor.
SUNK = {**BOX, "to_world": T.translate([0, 0, -0.05]) @ BOX["to_world"] @ T.rotate([1, 0, 0], 10.0)}
LAMP = lamp(0.9, 0.35, (6.0, 5.0, 4.0))


def room(kind, box=BOX):
    """The camera in fog, a box that stands on the floor, a lamp."""
    view = camera([-0.8, -0.5, 0.2], [0.3, 0.1, -0.3], 70.0, SIZE, medium={"type": "ref", "id": "fog"})
    return psdr.load_dict(whole(air={**FOG, "id": "fog"}, sensor=view, **ROOMS[kind], box=box, lamp=LAMP))


def slopes(scene, names, depth, spp):
    """Return the derivatives of the weighted image along the motions, (batches, names)."""
    params = psdr.traverse(scene)
    tangents = [MOTIONS[name](params[name].numpy()) for name in names]
    found = derivatives(scene, names, ADJOINT, spp=spp, depth=depth, batches=BATCHES)
    return np.array([[(g * t).sum() for g, t in zip(batch, tangents, strict=True)] for batch in found])


@functools.cache
def of_room(kind):
    return slopes(room(kind), list(MOTIONS), 2, 64)


@pytest.mark.parametrize("kind", ["six", "seven"])
def test_a_room_of_rectangles_has_the_derivatives_of_one_mesh(kind):
    found, expected = of_room(kind), of_room("one mesh")
    spread = np.hypot(*(a.std(axis=0, ddof=1) for a in (found, expected))) / np.sqrt(BATCHES)
    assert (np.abs(found.mean(axis=0) - expected.mean(axis=0)) < Z * spread).all()
    assert (spread < 0.1 * np.abs(expected.mean(axis=0))).all(), "too noisy to tell"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "box", "names", "depth", "noise"),
    [
        ("six", BOX, list(MOTIONS), 2, 0.03),
        ("seven", BOX, list(MOTIONS), 4, 0.1),
        ("six", SUNK, list(MOTIONS)[1:], 2, 0.03),
    ],
    ids=["six", "seven", "sunk"],
)
def test_a_room_of_rectangles_equals_finite_differences(kind, box, names, depth, noise):
    scene = room(kind, box)
    found = slopes(scene, names, depth, 4096)
    for column, name in enumerate(names):
        tangent = MOTIONS[name](psdr.traverse(scene)[name].numpy())
        images = [difference(scene, name, tangent, depth, 8192, seed, 0.02) for seed in range(1, 1 + BATCHES)]
        expected = np.array([(ADJOINT * image).sum() for image in images])
        spread = np.hypot(found[:, column].std(ddof=1), expected.std(ddof=1)) / np.sqrt(BATCHES)
        assert abs(found[:, column].mean() - expected.mean()) < Z * spread, (name, found, expected)
        assert spread < noise * abs(expected.mean()), "too noisy to tell"


def test_curves_of_intersection_may_be_seen_and_move():
    scene, integrator = room("six", SUNK), psdr.PathIntegrator(max_depth=2)
    psdr.plan(scene, names=["sensor.to_world", "lamp.to_world", "box.to_world"], integrator=integrator)


PLATE = [[-0.8, -0.4, 0.0], [0.8, -0.4, 0.0], [0.8, 0.4, 0.0], [-0.8, 0.4, 0.0]]
RISER = [[-0.5, 0.4, 0.0], [0.4, 0.4, 0.0], [0.4, 0.4, 0.5], [-0.5, 0.4, 0.5]]
FACES = [[0, 1, 2], [0, 2, 3]]


def mesh(vertices, faces):
    shape = {"type": "mesh", "vertices": np.float32(vertices), "faces": np.int32(faces), "bsdf": PAINT}
    return {**shape, "face_normals": True}


SHELVES = {
    "one mesh": {"both": mesh(PLATE + RISER, FACES + [[i + 4 for i in f] for f in FACES])},
    "two": {"plate": mesh(PLATE, FACES), "riser": mesh(RISER, FACES)},
}
LIGHTS = {
    "area": lamp(0.0, 0.3) | {"to_world": T.look_at([0.2, 1.6, 1.6], [0, 0.3, 0], [0, 0, 1]) @ T.scale(0.3)},
    "sun": {"type": "directional", "direction": [0.1, -0.5, -1.0], "irradiance": rgb(3.0, 3.0, 3.0)},
}


def shelf(kind, light):
    """A wall on a part of the rear border of a plate in fog, both on one side of the light from behind."""
    view = camera([0.5, -3.0, 1.0], [0.0, 0.0, -0.2], 40.0, SIZE)
    return psdr.load_dict(whole(sensor=view, fog=cube(FOG, scale=1.2, turn=10.0), **SHELVES[kind], light=LIGHTS[light]))


@pytest.mark.parametrize(
    ("light", "method", "spp"),
    [
        ("area", psdr.boundary.PathSpace(), 1024),
        pytest.param("sun", psdr.boundary.PathSpace(), 1024, marks=pytest.mark.slow),
        pytest.param("area", psdr.boundary.EdgeSampling(), 4096, marks=pytest.mark.slow),
    ],
    ids=["area", "sun", "edge sampling"],
)
@pytest.mark.filterwarnings("ignore:samples that were not finite")  # rays through the cube's own edges
def test_what_abuts_casts_one_shadow(light, method, spp):
    """Two shapes that move together against one mesh: counted twice, their common line would show."""
    found = []
    for kind, parts in SHELVES.items():
        scene = shelf(kind, light)
        names = [f"{name}.vertex_positions" for name in parts]
        grads = derivatives(scene, names, ADJOINT, method, spp=spp, depth=2, batches=BATCHES)
        found.append(np.array([sum(g.reshape(-1, 3).sum(axis=0) for g in batch) for batch in grads]))
    one, two = (f.mean(axis=0) for f in found)
    spread = np.hypot(*(f.std(axis=0, ddof=1) for f in found)) / np.sqrt(BATCHES)
    assert (np.abs(two - one) < Z * spread).all(), (one, two, spread)
    assert (spread < 0.05 * np.abs(one).max()).all(), "too noisy to tell"

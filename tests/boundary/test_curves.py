"""Curves along which surfaces run through each other: found, and their part of the derivative."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.estimate.boundary import terms
from warp_psdr.topology.intersection_curves import scene_curves

from .measure import MODES, Case, assert_agrees, derivatives, differences, rows, slope
from .scenes import T, ball, box, camera, diffuse, floor, load, mesh, panel, register, sky
from .test_table import moved, scaled

#: Geometry alone: there is no light.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")


def sunk(smooth=False, light=None, **more):
    """A ball half sunk into a floor."""
    return {
        "sensor": camera(),
        "floor": floor(bsdf=diffuse(0.8, 0.7, 0.3)),
        "shape": ball((0.1, 0.1, 0.2), 0.7, diffuse(0.3, 0.5, 0.8), 1, smooth),
        "light": light or panel((0.5, -0.3, 2.2), 0.35),
        **more,
    }


def post():
    """A turned box through a floor."""
    return sunk() | {"shape": box((0.1, 0.0, 0.15), (0.4, 0.3, 0.5), diffuse(0.3, 0.5, 0.8), 0.4)}


def behind():
    """A wall lit by a floor and a box in it, which the camera does not see: nothing but deeper vertices counts."""
    wall = mesh([[-1, 1.5, -0.3], [1, 1.5, -0.3], [1, 1.5, 2], [-1, 1.5, 2]], [[0, 1, 2], [0, 2, 3]], diffuse(0.8))
    return {
        "sensor": camera((0.0, 0.3, 1.2), (0.0, 1.5, 1.2), fov=70.0),
        "wall": wall,
        "floor": floor(bsdf=diffuse(0.8, 0.7, 0.3), half=1.5),
        "shape": box((0.1, 0.9, -0.1), (0.5, 0.35, 0.3), diffuse(0.05), 0.4),
        "light": {"type": "point", "position": [0.3, 0.6, 2.0], "intensity": {"type": "rgb", "value": 10.0}},
    }


def knot(smooth=False):
    """Two balls of one mesh that run through each other."""
    a, b = ball((-0.35, 0, 0.6), 0.5, None, 1), ball((0.3, 0.1, 0.7), 0.4, None, 1)
    vertices = np.concatenate([a["vertices"], b["vertices"]])
    faces = np.concatenate([a["faces"], b["faces"] + len(a["vertices"])])
    return sunk() | {"shape": mesh(vertices, faces, diffuse(0.3, 0.5, 0.8), face_normals=not smooth)}


def lamp():
    """A glowing box through a black floor, seen by its light on a wall."""
    glow = {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}}
    return {
        **{k: v for k, v in behind().items() if k != "light"},
        "floor": floor(bsdf=diffuse(0.0), half=1.5),
        "shape": {**box((0.1, 0.7, 0.0), (0.4, 0.25, 0.4), diffuse(0.0), 0.4), "emitter": glow},
    }


def emerging():
    """A fine ball out of a pipe: where its outline turns into the curve both are tangent, and so is its terminator."""
    ball_pose = [[0.43, 0.08, 0.27, -0.548], [0.236, 0.167, -0.426, 0.027], [-0.154, 0.48, 0.103, 0.202]]
    pipe_pose = [[0.052, -0.179, 0.366, -0.352], [-0.072, -0.367, -0.169, 0.694], [0.401, -0.042, -0.078, 0.319]]
    view = camera((-0.0993, -1.5137, 1.5821), (-0.005, -0.7745, 0.9153))
    view["film"] |= {"width": 192, "height": 192, "crop_width": 24, "crop_height": 24}
    view["film"] |= {"crop_offset_x": 50, "crop_offset_y": 44}
    return {
        "sensor": view,
        "floor": floor(),
        "shape": {"type": "sphere", "to_world": T([*ball_pose, [0, 0, 0, 1]]), "bsdf": diffuse(0.3, 0.2, 0.8)},
        "pipe": {
            "type": "cylinder",
            "to_world": T([*pipe_pose, [0, 0, 0, 1]]),
            "bsdf": {"type": "twosided", "bsdf": diffuse(0.8)},
        },
        "sky": sky(),
    }


def raking():
    """A ball, sunk below its middle, along one of whose faces the light shines: its shadow is a sliver beside it."""
    light = {"type": "point", "position": [0.5, -0.3, 2.2], "intensity": {"type": "rgb", "value": 5.0}}
    low = ball((0.75, -0.25, -0.05), 0.3, diffuse(0.0))
    view = camera(target=(0.72, -0.45, 0.05), fov=9.0)
    view["film"] |= {"crop_offset_x": 1, "crop_offset_y": 7, "crop_width": 5, "crop_height": 3}
    return sunk(light=light) | {"sensor": view, "shape": low}


register(
    {
        "emerging": emerging,
        "raking": raking,
        "sunk": sunk,
        "sunk smooth": lambda: sunk(True),
        "post": post,
        "hidden": behind,
        "knot": knot,
        "glowing box": lamp,
        "sunk sky": lambda: sunk(light=sky()),
    }
)

SHAPE, FLOOR, CAMERA = "shape.vertex_positions", "floor.to_world", "sensor.to_world"


def stretched(values):
    return values * [0.3, 0.2, 1.0]


CASES = [
    # As the camera sees them.
    Case("post", SHAPE, moved(1.0, -0.5, 0.0), 0.01, "a box moves along the floor", difference_spp=2048, slow=False),
    Case("post", SHAPE, moved(0.2, 0.0, 1.0), 0.01, "a box is lifted", difference_spp=2048),
    Case("raking", SHAPE, moved(0.5, -0.5, 0.0), 0.004, "a ball moves", spp=4096, difference_spp=16384),
    Case("sunk", SHAPE, moved(0.0, 0.0, 1.0), 0.005, "a ball sinks", difference_spp=4096),
    Case("sunk", SHAPE, scaled, 0.01, "a ball grows", difference_spp=2048),
    Case("sunk", FLOOR, moved(0.2, 0.1, 1.0), 0.01, "the floor rises", spp=1024, difference_spp=4096),
    Case("sunk", CAMERA, moved(1.0, 0.3, 0.4), 0.01, "the camera moves", difference_spp=2048),
    Case("sunk smooth", SHAPE, moved(0.3, 0.2, 1.0), 0.01, "a ball moves", spp=512, difference_spp=4096),
    Case("sunk sky", SHAPE, moved(1.0, 0.2, 0.5), 0.005, "a ball moves", spp=512, difference_spp=8192),
    Case("emerging", SHAPE, moved(-1.0, 0.2, 0.0), 0.001, "a ball moves", spp=2048, difference_spp=16384),
    Case("knot", SHAPE, stretched, 0.01, "a mesh through itself", difference_spp=4096),
    # As other path vertices do.
    Case("glowing box", SHAPE, moved(0.0, 0.0, 1.0), 0.01, "a light rises", spp=1024, difference_spp=8192, slow=False),
    Case("glowing box", SHAPE, moved(1.0, -0.5, 0.0), 0.01, "a light moves", spp=1024, difference_spp=8192),
    Case("hidden", SHAPE, moved(0.2, 0.1, 1.0), 0.01, "a box rises", 3, 4096, 16384),
    Case("hidden", FLOOR, moved(0.0, 0.0, 1.0), 0.01, "the floor rises", 3, 4096, 16384),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if c.scene == "glowing box" and not c.slow], ids=str)
def test_the_table_can_tell_missing_curves(case: Case, monkeypatch) -> None:
    rest = tuple(t for t in terms.TERMS[psdr.boundary.PathSpace] if t.name != "intersection_curve")
    monkeypatch.setitem(terms.TERMS, psdr.boundary.PathSpace, rest)
    value, error = slope(derivatives(case, "forward"), differences(case)[2])
    assert abs(value - 1.0) > 0.05 + 3.0 * error


def curves_of(**shapes):
    """Curves of a scene, and their length."""
    found = scene_curves(psdr.load_dict({"type": "scene", "sensor": camera(), **shapes}))
    np.testing.assert_allclose(found.length, np.linalg.norm(found.points[:, 1] - found.points[:, 0], axis=1))
    return found, float(found.length.sum())


def crossed(angle: float, size: float = 0.5):
    """An upright card through the floor, turned about z."""
    x, y = size * np.cos(angle), size * np.sin(angle)
    corners = [[-x, -y, -size], [x, y, -size], [x, y, size], [-x, -y, size]]
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], diffuse(0.5))


def test_the_curve_of_a_box_is_its_outline() -> None:
    found, length = curves_of(floor=floor(), box=box((0.1, 0.0, 0.15), (0.4, 0.3, 0.5), diffuse(0.5), 0.4))
    # Absorbs the rounding of float32 vertices.
    assert length == pytest.approx(4 * (0.4 + 0.3), rel=1e-6)
    np.testing.assert_allclose(found.points[..., 2], 0.0, atol=1e-6)
    assert (found.ends == -1).all() and (found.count == 2).all()


def test_curves_of_balls_are_circles() -> None:
    _found, length = curves_of(
        floor=floor(), a=ball((0, 0, 0.2), 0.7, diffuse(0.5), 4), b=ball((0.5, 0.1, 0.4), 0.6, diffuse(0.5), 4)
    )
    d = np.linalg.norm([0.5, 0.1, 0.2])
    across = (d**2 + 0.7**2 - 0.6**2) / (2.0 * d)
    radii = [np.sqrt(0.7**2 - 0.2**2), np.sqrt(0.6**2 - 0.4**2), np.sqrt(0.7**2 - across**2)]
    # Absorbs the tessellation.
    assert length == pytest.approx(2.0 * np.pi * sum(radii), rel=2e-3)


def test_a_mesh_may_run_through_itself() -> None:
    scene = psdr.load_dict({"type": "scene", **knot()})
    found = scene_curves(scene)
    # A closed curve: every end is the start of another segment.
    ends = np.round(found.points.reshape(-1, 3), 5)
    assert len(found.length) > 10 and (np.unique(ends, axis=0, return_counts=True)[1] == 2).all()


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, -np.pi / 4, np.pi / 2])
def test_a_curve_along_an_edge_counts_once(angle: float) -> None:
    # The floor's diagonal lies in the card's plane at one of the angles, a grid line of the card in the floor's at all.
    assert curves_of(floor=floor(), card=crossed(angle))[1] == pytest.approx(1.0, rel=1e-5)


def test_the_equator_of_a_ball_in_a_plane() -> None:
    vertices = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    faces = [[i, (i + 1) % 4, 4] for i in range(4)] + [[(i + 1) % 4, i, 5] for i in range(4)]
    _found, length = curves_of(floor=floor(), shape=mesh(vertices, faces, diffuse(0.5)))
    assert length == pytest.approx(4.0 * np.sqrt(2.0), rel=1e-5)
    flipped = floor()
    flipped["to_world"] = flipped["to_world"] @ T.rotate([1, 0, 0], 180)
    assert curves_of(floor=flipped, shape=mesh(vertices, faces, diffuse(0.5)))[1] == pytest.approx(length, rel=1e-5)


@pytest.mark.parametrize("z", [0.3, 0.31, 0.3 - 1e-4])
def test_what_touches_is_a_contact(z: float) -> None:
    # The last is three ray epsilons deep.
    assert curves_of(floor=floor(), box=box((0.1, 0, z), (0.4, 0.3, 0.3), diffuse(0.5), 0.4))[1] == 0.0


def test_triangles_that_share_a_corner_may_intersect() -> None:
    vertices = [[0, 0, 0], [1, -1, 0], [1, 1, 0], [1, 0, -1], [1, 0, 1]]
    assert curves_of(shape=mesh(vertices, [[0, 1, 2], [0, 3, 4]], diffuse(0.5)))[1] == pytest.approx(1.0, rel=1e-5)
    assert curves_of(shape=ball((0, 0, 0), 1.0, diffuse(0.5), 2))[1] == 0.0


def test_curves_follow_the_vertices() -> None:
    scene, params = load("post")
    before = scene_curves(scene)
    assert scene_curves(scene) is before
    values = params[SHAPE].numpy().copy()
    try:
        params[SHAPE] = values + np.float32([0.0, 0.0, 5.0])
        params.update()
        assert len(scene_curves(scene).length) == 0
    finally:
        params[SHAPE] = values
        params.update()

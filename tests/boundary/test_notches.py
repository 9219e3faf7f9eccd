"""Surfaces that meet at an acute angle: rays that leave one close to the other must not start behind it."""

import numpy as np
import pytest

import warp_psdr as psdr

from .measure import MODES, Case, accumulated, assert_agrees, derivatives, differences, rows, slope
from .mirrors import ALONG, CAMERA, ETA, GLASS, GLASSES, LAMP, MIRROR, lamp, shining, slab
from .scenes import ball, box, camera, diffuse, floor, mesh, register
from .test_table import moved

SHAPE, BALL = "shape.vertex_positions", "ball.vertex_positions"
TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.3)}


def sun(direction):
    rgb = {"type": "rgb", "value": [3.0, 2.5, 2.0]}
    return {"type": "directional", "direction": list(direction), "irradiance": rgb}


def wedge(angle):
    """A prism that stands on a floor on an edge, and light that shines into the notch between them."""
    a = np.radians(angle)
    profile = [[0.0, 0.0], [-np.cos(a), np.sin(a)], [-0.2, 1.0]]
    vertices = [[x, y, z] for x in (-0.7, 0.7) for y, z in profile]
    faces = [[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2], [2, 5, 3], [2, 3, 0]]
    return {
        "sensor": camera((0.15, -4.0, 0.5), (0.0, -0.2, 0.1), fov=22.0),
        "shape": mesh(vertices, faces, TWO_SIDED, face_normals=True),
        "floor": floor(bsdf=diffuse(0.2, 0.3, 0.6)),
        "sun": sun((0.1, 1.0, -0.15)),
    }


def screened():
    """The same, seen by the light that it throws on a screen."""
    corners = [[-1.5, -2.5, 0.05], [1.5, -2.5, 0.05], [1.5, -2.5, 0.7], [-1.5, -2.5, 0.7]]
    return {
        **wedge(60.0),
        "sensor": camera((1.4, -0.9, 1.3), (-0.2, -2.5, 0.3), fov=40.0),
        "floor": floor(bsdf=diffuse(0.8, 0.7, 0.6)),
        "screen": mesh(corners, [[0, 2, 1], [0, 3, 2]], diffuse(0.8)),
        "sun": sun((0.1, 1.0, -0.38)),
    }


def book(angle):
    """Two pages that open towards a light."""
    a = 0.5 * np.radians(angle)
    left, right = (-np.sin(a), -np.cos(a)), (np.sin(a), -np.cos(a))
    vertices = [[0, 0, -0.6], [0, 0, 0.6], [*left, 0.6], [*left, -0.6], [*right, -0.6], [*right, 0.6]]
    faces = [[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 1]]
    return {
        "sensor": camera((0.15, -4.0, 0.4), (0.0, -0.3, 0.0), fov=22.0),
        "shape": mesh(vertices, faces, TWO_SIDED, face_normals=True),
        "sun": sun((0.1, 1.0, -0.2)),
    }


def mirror():
    """A mirror in front of the shapes, which faces them."""
    corners = [[-2, -3, -2], [2, -3, -2], [2, -3, 2], [-2, -3, 2]]
    return mesh(corners, [[0, 2, 1], [0, 3, 2]], MIRROR)


def mirrored(angle):
    return {
        **book(angle),
        "sensor": camera((1.3, 0.5, 0.4), (0.0, -5.7, 0.0), fov=16.0),
        "mirror": mirror(),
        "sun": {"type": "point", "position": [-0.1, -1.6, 0.9], "intensity": {"type": "rgb", "value": [9.0, 8.0, 7.0]}},
    }


def stuck(shape, direction):
    """Something that runs through a slab of glass, behind which light may reach it, in which it may not."""
    return {
        "sensor": camera((0.0, -4.0, 0.4), (0.0, 0.0, 0.0), fov=30.0),
        "glass": slab(),
        "ball": shape,
        "sun": sun(direction),
    }


def prism():
    """Two lamps behind glass with an edge of 40 degrees."""
    a, length = np.radians(20.0), 0.9
    foot = 0.55 - length * np.cos(a)
    profile = [[0.0, 0.55], [-length * np.sin(a), foot], [length * np.sin(a), foot]]
    vertices = [[x, y, z] for x in (-0.7, 0.7) for y, z in profile]
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    return {
        "sensor": camera((0.4, -4.0, 0.4), (0.0, 0.0, 0.1), fov=24.0),
        "glass": mesh(vertices, faces, GLASS, face_normals=True),
        "lamp": lamp((0.3, 2.0, 0.9), 0.7),
        "other": lamp((-0.8, 2.5, -0.3), 0.6, 0.5),
    }


def sunk():
    """A block of glass that is sunk into a floor that shines: at their common line its sides show the floor."""
    return {
        "sensor": camera((0.2, -3.0, 1.4), (0.0, -0.45, 0.2), fov=9.0),
        "floor": shining(floor(bsdf=diffuse(0.0)), 0.9, 0.7, 0.5),
        "glass": box((0.0, 0.0, 0.2), (0.6, 0.5, 0.3), GLASS, turn=0.5),
    }


def folded(count=33, depth=0.0022):
    """A pane of glass whose front is folded, by five degrees."""
    x = np.linspace(-0.8, 0.8, count)
    front = -0.3 + depth * (np.arange(count) % 2)
    vertices = [[a, b, z] for y in (front, np.full(count, 0.3)) for z in (-0.8, 0.8) for a, b in zip(x, y, strict=True)]
    i = np.arange(count - 1)
    sheet = np.concatenate([[i, i + 1, i + count + 1], [i, i + count + 1, i + count]], 1).T
    return mesh(vertices, np.concatenate([sheet, sheet[:, ::-1] + 2 * count]), GLASS, face_normals=True)


register(
    {
        "sunk glass": sunk,
        "prism": prism,
        "prism in a mirror": lambda: {
            **prism(),
            "sensor": camera((1.5, 0.3, 0.5), (0, -6, 0.1), fov=14.0),
            "mirror": mirror(),
        },
        "wedge": lambda: wedge(30.0),
        "screened wedge": screened,
        "book": lambda: book(60.0),
        "book in a mirror": lambda: mirrored(30.0),
        "stuck in glass": lambda: stuck(ball((-0.1, 0.45, 0.05), 0.5, TWO_SIDED["bsdf"]), (0.9, -0.3, -0.3)),
        "lamp in glass": lambda: stuck(lamp((-0.1, -0.1, 0.05), 0.5), (0.5, 0.8, -0.5)),
    }
)


def fold(values):
    """The book's back moves, its pages' other edges rest."""
    tangent = np.zeros_like(values)
    tangent[:2] = [1.0, 0.3, 0.2]
    return tangent


SLIDES, RISES = moved(0.2, 1.0, 0.0), moved(0.1, 0.2, 1.0)
CASES = [
    Case("wedge", SHAPE, SLIDES, 0.005, "slides", spp=1024, difference_spp=4096, slow=False),
    Case("sunk glass", CAMERA, ALONG, 0.002, "camera moves", depth=4, spp=512, difference_spp=8192),
    Case("book", SHAPE, fold, 0.005, "back moves", spp=4096, difference_spp=16384),
    Case("book in a mirror", SHAPE, fold, 0.005, "back moves", depth=3, spp=1024, difference_spp=4096),
    Case("stuck in glass", BALL, ALONG, 0.005, "ball moves", depth=4, spp=4096, difference_spp=32768),
    Case("stuck in glass", ETA, np.ones_like, 0.005, "index changes", depth=4, spp=4096, difference_spp=32768),
    Case("lamp in glass", BALL, ALONG, 0.005, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("lamp in glass", GLASSES, ALONG, 0.005, "glass moves", depth=4, spp=1024, difference_spp=4096),
    Case("prism", GLASSES, RISES, 0.005, "prism moves", depth=4, spp=512, difference_spp=2048),
    Case("prism in a mirror", GLASSES, RISES, 0.005, "prism moves", depth=4, spp=2048, difference_spp=8192),
    Case("prism", LAMP, ALONG, 0.005, "lamp moves", depth=4, spp=1024, difference_spp=4096),
    Case("prism", ETA, np.ones_like, 0.005, "index changes", depth=4, spp=2048, difference_spp=8192),
]


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", rows(CASES))
def test_derivatives_equal_finite_differences(case: Case, mode: str) -> None:
    assert_agrees(derivatives(case, mode), differences(case)[2])


@pytest.mark.slow
@pytest.mark.parametrize("method", [psdr.boundary.PathSpace(), psdr.boundary.EdgeSampling()], ids=repr)
def test_deeper_vertices_see_into_notches(method) -> None:
    case = Case("screened wedge", SHAPE, SLIDES, 0.02, "slides", depth=3, spp=2048, difference_spp=32768)
    assert_agrees(derivatives(case, "forward", method), differences(case)[2])


@pytest.mark.slow
def test_glass_shows_what_runs_through_it() -> None:
    case = Case("stuck in glass", GLASSES, moved(0.3, 1.0, 0.2), 0.005, "glass moves", depth=4, spp=512)
    value, error = slope(derivatives(case, "reverse"), differences(case)[2])
    assert error < 0.05
    assert abs(value - 1.0) < 3.0 * error


@pytest.mark.slow
def test_glass_elsewhere_changes_nothing() -> None:
    """Behind glass notches need more room, but not at every crease of a scene that has glass."""

    def derivative(inside) -> np.ndarray:
        faceted = {"type": "sphere", "radius": 0.6, "resolution": 16, "face_normals": True, "bsdf": diffuse(0.7)}
        scene = psdr.load_dict(
            {
                "type": "scene",
                "sensor": camera((0.15, -4.0, 0.5), (0.0, 0.0, 0.1), fov=30.0),
                "ball": faceted,
                "unseen": ball((0.0, 0.0, 0.0), 0.2, inside),
                "floor": floor(-0.8, bsdf=diffuse(0.3)),
                "lamp": {"type": "point", "position": [1.0, -2.0, 3.0], "intensity": 10.0},
            }
        )
        return accumulated(scene, {BALL: moved(0.3, 0.2, 0.1)}, psdr.PathIntegrator(max_depth=2), 16, 1)

    without = derivative(diffuse(0.5))
    assert np.abs(without).max() > 0.1
    np.testing.assert_array_equal(derivative(GLASS), without)


@pytest.mark.slow
def test_hiding_unseen_lights_changes_nothing() -> None:
    """Hidden lights are looked through, but the creases of glass as without them."""
    scene = psdr.load_dict(
        {
            "type": "scene",
            "sensor": camera((0.3, -4.0, 0.4), (0.0, 0.0, 0.0), fov=30.0),
            "glass": folded(),
            "wall": mesh([[-3, 2, -3], [3, 2, -3], [3, 2, 3], [-3, 2, 3]], [[0, 1, 2], [0, 2, 3]], diffuse(0.7)),
            "sun": {"type": "point", "position": [-1.0, 0.8, 2.5], "intensity": 8.0},
            "behind the camera": lamp((0.4, -6.0, 2.5), 0.5, 9.0),
        }
    )

    def derivative(hidden: bool) -> np.ndarray:
        integrator = psdr.PathIntegrator(max_depth=4, hide_emitters=hidden)
        return accumulated(scene, {GLASSES: moved(0.3, 0.2, 0.1)}, integrator, 16, 1)

    shown = derivative(False)
    assert np.abs(shown).max() > 0.1
    np.testing.assert_array_equal(derivative(True), shown)

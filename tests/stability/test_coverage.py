"""Shining triangles seen in hard ways, against the exact area of their image: a perspective camera, no other light.

The sum of an image of radiance one is the area of its polygons in pixels, and the sum of its derivative that area's
rate of change, which double precision gives by clipping and projecting the corners. What an image's sum cannot show
cannot be wrong here: there is no interior term.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

import warp_psdr as psdr

from .record import Case, parameters
from .sweeps import box

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

FILM, FOV, NEAR = 16, 40.0, 0.01
SPP, BATCHES = 256, 4
#: Of the exact derivative's central difference: below the images of all that is thin here.
STEP = 1.0e-8
ONE, TWO = np.array([[0, 1, 2]]), np.array([[0, 1, 2], [0, 2, 3]])
DRIFT = (0.3, 0.2, 0.1)


@dataclass(frozen=True)
class Plate:
    """Triangles before a camera at the origin that looks along +z, and their velocity, (3,) or one a vertex."""

    vertices: np.ndarray
    velocity: np.ndarray
    faces: np.ndarray


def plate(vertices, velocity=DRIFT, faces=ONE) -> Plate:
    """Return a plate whose triangles are turned to the camera, rounded as the scene will be."""
    v = np.float32(vertices).astype(np.float64)
    c = v[faces]
    away = (np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) * c[:, 0]).sum(axis=1) > 0.0
    return Plate(v, np.broadcast_to(velocity, v.shape), np.where(away[:, None], faces[:, ::-1], faces))


def area(triangles: np.ndarray) -> float:
    """Return the area in pixels of the image of triangles (M, 3, 3) that do not hide each other."""
    k = np.tan(np.radians(FOV / 2.0))
    planes = [((0.0, 0.0, 1.0), -NEAR)]
    planes += [((s * a, s * b, k), 0.0) for a, b in ((1.0, 0.0), (0.0, 1.0)) for s in (1.0, -1.0)]
    total = 0.0
    for polygon in triangles:
        for normal, offset in planes:
            polygon = clipped(polygon, np.array(normal), offset)
        if len(polygon) > 2:
            x, y = (polygon[:, :2] / polygon[:, 2:] / k * FILM / 2.0).T
            total += 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
    return total


def clipped(polygon: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Return the part of a polygon where normal . p + offset >= 0."""
    found = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        f, g = a @ normal + offset, b @ normal + offset
        if f >= 0.0:
            found.append(a)
        if (f >= 0.0) != (g >= 0.0):
            found.append(a + (b - a) * f / (f - g))
    return np.array(found).reshape(-1, 3)


def load(p: Plate):
    camera = {
        "type": "perspective", "fov": FOV, "near_clip": NEAR,
        "film": {"type": "hdrfilm", "width": FILM, "height": FILM, "rfilter": {"type": "box"}},
    }  # fmt: skip
    mesh = {"type": "mesh", "vertices": p.vertices, "faces": p.faces, "face_normals": True}
    return psdr.load_dict({"type": "scene", "camera": camera, "plate": mesh | {"emitter": {"type": "area"}}})


def derivative(p: Plate) -> float:
    """Return the estimate of the area's rate of change."""
    scene = load(p)
    tangents = {"plate.vertex_positions": p.velocity.astype(np.float32)}
    integrator = psdr.PathIntegrator(max_depth=1)
    images = [
        psdr.render_forward(scene, psdr.traverse(scene), tangents, integrator=integrator, spp=SPP, seed=seed).numpy()
        for seed in range(BATCHES)
    ]
    return float(np.mean([image[..., 0].sum(dtype=np.float64) for image in images]))


def exact(p: Plate) -> float:
    high, low = (area((p.vertices + s * STEP * p.velocity)[p.faces]) for s in (1.0, -1.0))
    return (high - low) / (2.0 * STEP)


def off(plates: Sequence[Plate]) -> Callable[[], float]:
    """Return what measures the largest relative error over some plates."""
    return lambda: max(abs(derivative(p) / exact(p) - 1.0) for p in plates)


def needle(width: float) -> Plate:
    v = [[-0.5, -0.2, 3.0], [0.5, 0.3, 3.2], [0.5, 0.3 + width, 3.2]]
    return plate(v, np.array([[0, 0, 0], [0, 0, 0], [0, 1, 0]]))


def grazing(angle: float) -> Plate:
    """Return a plate along the lines of sight, tilted by about 0.4 times the angle."""
    y = 0.3 * 3.5 / 2.5 * (1.0 + angle)
    v = [[-0.5, 0.3, 2.5], [0.5, 0.3, 2.5], [0.5, y, 3.5], [-0.5, y, 3.5]]
    return plate(v, np.array([[0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 1, 0]]), TWO)


def end_on(aside: float) -> Plate:
    """Return a triangle of which one side points at the camera but for a distance."""
    return plate([[0.2 + aside, 0.1, 1.0], [0.6, 0.3, 3.0], [0.5, -0.4, 2.0]])


def behind(depth: float) -> Plate:
    """Return a triangle of which one corner is at a depth behind or beside the camera, out of sight."""
    return plate([[0.3, 0.2, depth], [0.6, 0.1, 2.0], [0.1, 0.7, 2.0]])


def close(distance: float) -> Plate:
    """Return a triangle with a corner just in front of the near plane, in sight."""
    return plate([[0.001, 0.002, NEAR * (1.0 + distance)], [0.6, 0.1, 2.0], [0.1, 0.7, 2.0]])


def body(center, half) -> Plate:
    """Return an upright box whose image grows as it comes nearer."""
    corners, faces = box((0.0, 0.0, 0.0), 1.0, 0.0)
    v = np.float32(corners * half + center).astype(np.float64)
    return Plate(v, np.broadcast_to((0.1, 0.05, 0.5), v.shape), faces)


def off_bodies(bodies: Sequence[Plate]) -> Callable[[], float]:
    """Return what measures the largest relative error over some convex bodies, of which the camera sees the fronts."""

    def fronts(p: Plate, step: float) -> np.ndarray:
        c = (p.vertices + step * p.velocity)[p.faces]
        normals = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        return c[(normals * c.mean(axis=1)).sum(axis=1) < 0.0]

    def one(p: Plate) -> float:
        expected = (area(fronts(p, STEP)) - area(fronts(p, -STEP))) / (2.0 * STEP)
        return abs(derivative(p) / expected - 1.0)

    return lambda: max(one(p) for p in bodies)


def slabs(thickness: float) -> list[Plate]:
    """Return slabs that show their upper side, their front and a narrow side."""
    t = 0.5 * thickness
    return [body((0.1, 0.6, 3.0), (0.5, t, 0.4)), body((0.1, 0.0, 3.0), (0.5, 0.4, t)),
            body((0.1, 0.3, 3.0), (t, 0.3, 0.4))]  # fmt: skip


def table(angle: float) -> Plate:
    """Return a box whose top the camera sees at an angle."""
    return body((0.1, -0.3 - 2.6 * angle, 3.0), (0.4, 0.3, 0.4))


def corner(aside: float) -> Plate:
    """Return a triangle with a vertex on a corner of four pixels, and sides along their borders."""
    return plate([[aside, 0.0, 3.0], [0.8, 0.0, 3.0], [0.0, 0.8, 3.0]])


def cut(depth: float) -> Plate:
    return plate([[0.001, 0.002, depth], [0.6, 0.1, 2.0], [0.1, 0.7, 2.0]])


def on_a_border() -> float:
    """Return the error of the derivative of a plate that slides along x with a side on a border, over a side's flux."""
    side = plate([[0.0, -0.5, 3.0], [0.0, 0.5, 3.0], [0.5, 0.5, 3.0], [0.5, -0.5, 3.0]], (1.0, 0.0, 0.0), TWO)
    grows = plate(side.vertices, np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]), TWO)
    return abs(derivative(side)) / exact(grows)


CASES = (
    Case(
        family="coverage", name="needles of width 1e-1 .. 1e-4", slow=True, bound=1.5e-4,
        measure=off([needle(w) for w in (1e-1, 1e-2, 1e-3, 1e-4)]),
        hard="both sides of an edge are looked at, and the other edge is near",
        naive="looking at a fixed distance of 3.5e-6: 1.5e-3. A primal difference needs a step below the width",
    ),
    Case(
        family="coverage", name="needles of width 1e-5", bound=1.5e-2, measure=off([needle(1e-5)]),
        hard="at its tip it is narrower than roundings of its corners", naive="the same: 0.14",
    ),
    Case(
        family="coverage", name="needles of width 3e-6 and 1e-6: not seen", bound=1.0,
        measure=off([needle(3e-6), needle(1e-6)]),
        hard="as before; their images are 1e-6 of the film", naive="the same",
    ),
    Case(
        family="coverage", name="sheets at grazing angles, 4e-2 .. 4e-5", bound=2.5e-4,
        measure=off([grazing(a) for a in (1e-1, 1e-2, 1e-3, 1e-4)]),
        hard="the surface beside an edge leaves the line of sight slowly, far in front of the edge",
        naive="rays that start beside the edge do not see it below 1e-4",
    ),
    Case(
        family="coverage", name="sheets at an angle of 4e-6", bound=2e-2, measure=off([grazing(1e-5)]),
        hard="as before", naive="the same",
    ),
    Case(
        family="coverage", name="sheets at an angle of 4e-7: not seen", bound=1.0, measure=off([grazing(1e-6)]),
        hard="as before; their images are 1e-7 of the film", naive="the same",
    ),
    Case(
        family="coverage", name="slabs of thickness 1e-3 .. 1e-6", bound=3e-3,
        measure=off_bodies([p for k in (1e-3, 1e-4, 2e-5, 1e-5, 7e-6, 4e-6, 3e-6, 1e-6) for p in slabs(k)]),
        hard="the edges around either face have nearly one image",
        naive="each is found to have the jump of both: 0.3 from above, 1 from the front",
    ),
    Case(
        family="coverage", name="a box whose top is seen at 1e-2 .. 3e-6", bound=1.5e-3,
        measure=off_bodies([table(a) for a in (1e-2, 1e-3, 1e-4, 3e-5, 1e-5, 3e-6)]),
        hard="as before, and the top hides what is behind its far edge",
        naive="0.15 below 3e-5, where rays start inside of the box",
    ),
    Case(
        family="coverage", name="a box whose top is seen at 1e-6", bound=6e-2, measure=off_bodies([table(1e-6)]),
        hard="the derivative has a kink where the top turns away",
        naive="that of the other side of the kink, as here",
    ),
    Case(
        family="coverage", name="an edge end-on, 1e-1 .. 1e-2 aside", bound=6e-5,
        measure=off([end_on(a) for a in (1e-1, 1e-2)]),
        hard="the image of the edge is short and its faces are nearly edge-on",
        naive="sampled by its length in space the edge has unbounded weights",
    ),
    Case(
        family="coverage", name="corners beside and behind the camera", bound=9e-6,
        measure=off([behind(z) for z in (-1.0, -1e-3, 0.0, 1e-3)]),
        hard="edges run through the plane of the camera, where their images are infinitely long",
        naive="projecting the ends gives an edge on the wrong side of the image",
    ),
    Case(
        family="coverage", name="a corner just in front of the near plane", bound=9e-3,
        measure=off([close(d) for d in (1e-2, 1e-3)]),
        hard="its image moves 300 times as fast as others",
        naive="the same",
    ),
    Case(
        family="coverage", name="a vertex on a corner of pixels", bound=4.5e-4,
        measure=off([corner(a) for a in (0.0, 1e-6, 1e-4)]),
        hard="an edge along a border belongs to both pixels, or to none",
        naive="a filter that is closed or open at both ends counts the edge twice or not at all",
    ),
    Case(
        family="coverage", name="an edge on a border of pixels", bound=1e-8, measure=on_a_border,
        hard="as before: the flux through two opposite sides cancels",
        naive="as before: the error is 1",
    ),
)  # fmt: skip


@pytest.mark.slow_rows(
    "a box whose top is seen at 1e-2 .. 3e-6",
    "corners beside and behind the camera",
    "slabs of thickness 1e-3 .. 1e-6",
    "sheets at grazing angles, 4e-2 .. 4e-5",
    "a vertex on a corner of pixels",
)
@pytest.mark.parametrize("case", parameters(CASES))
def test_coverage(case, check) -> None:
    check(case)


def test_hairs_are_noted() -> None:
    noted = [any("hair" in note for note in load(needle(w)).description.notes) for w in (1e-4, 1e-5, 3e-6, 1e-6)]
    assert noted == [False, False, True, True]


def test_the_exact_area_is_that_of_the_image() -> None:
    p = plate([[-0.3, -0.2, 3.0], [0.5, -0.1, 3.5], [0.1, 0.6, 2.8]])
    image = psdr.render(load(p), integrator=psdr.PathIntegrator(max_depth=1), spp=4096).numpy()
    assert image[..., 0].sum() == pytest.approx(area(p.vertices[p.faces]), rel=1e-3)


def test_an_edge_exactly_end_on_has_no_image() -> None:
    scene = load(plate([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0], [0.5, -0.4, 2.0]]))
    tangents = {"plate.vertex_positions": np.float32([[0.3, 0.2, 0.1], [0.3, 0.2, 0.1], [0.1, 0.4, 0.2]])}
    integrator = psdr.PathIntegrator(max_depth=1)
    image = psdr.render_forward(scene, psdr.traverse(scene), tangents, integrator=integrator, spp=SPP).numpy()
    assert np.isfinite(image).all() and not any(psdr.invalid_samples(scene).values())


@pytest.mark.parametrize("depth", [0.5 * NEAR, NEAR])
def test_what_the_near_plane_cuts_in_sight_is_refused(depth: float) -> None:
    with pytest.raises(ValueError, match="clip plane of sensor 0 cuts 'plate'"):
        derivative(cut(depth))


@pytest.mark.parametrize("aside", [0.0, 1e-7, 1e-3])
def test_an_edge_through_the_camera_is_refused(aside: float) -> None:
    with pytest.raises(ValueError, match="clip plane"):
        derivative(plate([[aside, aside, -1.0], [aside, aside, 2.0], [0.5, 0.4, 2.0]]))


def test_what_the_far_plane_cuts_in_sight_is_refused() -> None:
    with pytest.raises(ValueError, match="clip plane"):
        derivative(plate([[-1e3, -1.0, 5e3], [1e3, -1.0, 5e3], [0.0, 0.0, 2e4]]))
    derivative(plate([[-1e3, -1.0, 5e3], [1e3, -1.0, 5e3], [0.0, 0.0, 9e3]]))


def test_what_the_near_plane_cuts_out_of_sight_is_not_refused() -> None:
    assert exact(behind(-1.0)) != 0.0
    derivative(behind(-1.0))

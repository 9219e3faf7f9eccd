"""Small things in vast worlds: a box of size one in a world of 1e1 .. 1e6, which need not touch it.

Both sides of a comparison draw the same random numbers. The world is what ``WORLDS`` lists.
"""

import functools
import math

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene import acceleration
from warp_psdr.scene.shapes import steps

from .record import Case, parameters
from .sweeps import VELOCITY, Result, apart, box, derivatives, passes, reference, room, slope_error
from .test_scale import world

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")
#: Where a box is off the centre of its world, in the world's half sizes: multiples of 2^-10, so that float32 holds the
#: place exactly in every world, and only digits of the box are lost.
ASIDE = np.array([0.25, -0.125, 0.0])
#: Along a floor.
SLIDE = np.array([0.6, -0.3, 0.0])
#: Field of view of a box on its floor, degrees: it sees no end of it.
VIEW = 20.0


def on_a_floor(size: float, *, pieces: int = 1, place=(0.0, 0.0, 0.0)) -> dict:
    """Return a box that stands on a floor of the given size, in the middle or at a place; ``pieces``: 1, or 3 a side.

    With three pieces a side the middle one is a square of size 8, so that the box touches no vast triangle.
    """
    place = np.asarray(place, np.float64)
    ticks = np.array([-0.5, 0.5]) * size
    if pieces == 3:
        ticks = np.array([-0.5 * size, -4.0, 4.0, 0.5 * size])
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    n = len(ticks)
    corner = np.array([n * i + j for i in range(n - 1) for j in range(n - 1)])
    faces = np.concatenate([np.stack([corner, corner + n, corner + n + 1], axis=1),
                            np.stack([corner, corner + n + 1, corner + 1], axis=1)])  # fmt: skip
    scene = room()
    scene["floor"] |= {"vertices": vertices, "faces": faces}
    corners, triangles = box((0.0, 0.0, 0.0), 0.5, 0.0)
    scene["box"] |= {"vertices": corners + (place + np.array([0.0, 0.0, 0.5])), "faces": triangles}
    scene["lamp"]["vertices"] = scene["lamp"]["vertices"] + place
    scene["camera"]["fov"] = VIEW
    scene["camera"]["to_world"][:3, 3] += place
    return scene


@functools.cache
def standing(size: float, pieces: int = 1) -> Result:
    """The box slides along its floor."""
    return passes(psdr.load_dict(on_a_floor(size, pieces=pieces)), SLIDE, boundary=False)


def light(scene: dict, expected: Result, velocity=VELOCITY) -> float:
    """Return the larger relative error of image and interior derivative."""
    found = passes(psdr.load_dict(scene), velocity, boundary=False)
    return max(apart(found.image, expected.image), apart(found.interior, expected.interior))


def floating(decades) -> float:
    base, _ = reference()
    return max(light(world(10.0**k), base) for k in decades)


def floating_boundary(decades) -> float:
    """Return the error of the regression slope of the derivative, all terms together."""
    _, expected = reference()
    return max(slope_error(derivatives(world(10.0**k)), expected) for k in decades)


def contact(decades) -> float:
    """Return the error of the image; that of the interior derivative is noise next to a contact."""
    base = standing(1e3, 3)
    return max(apart(standing(10.0**k).image, base.image) for k in decades)


def contact_with_small_triangles(decades) -> float:
    return max(light(on_a_floor(10.0**k, pieces=3), standing(1e3, 3), SLIDE) for k in decades)


@functools.cache
def sliding(size: float, spp: int) -> np.ndarray:
    """Return derivative images of the box that slides along a floor, one a batch."""
    return derivatives(on_a_floor(size), 4, 500, spp, velocity=SLIDE)


def contact_boundary(decades) -> float:
    expected = sliding(1e2, 1024).mean(axis=0)
    return max(slope_error(sliding(10.0**k, 256), expected) for k in decades)


def aside(decades) -> float:
    """Return the error of the image off the centre, where the box keeps but 24 bits of its place."""
    found = 0.0
    for k in decades:
        place = np.round(ASIDE * 2.0 ** round(math.log2(10.0**k)))
        near = on_a_floor(16.0)
        far = on_a_floor(10.0**k, place=place)
        # The digits that float32 leaves of the box, and of the lamp, are the reference's.
        for name in ("box", "lamp"):
            near[name]["vertices"] = np.float32(far[name]["vertices"]).astype(np.float64) - place
        a, b = (psdr.render(psdr.load_dict(s), spp=16, seed=7).numpy().astype(np.float64) for s in (far, near))
        found = max(found, apart(a, b))
    return found


CASES = [
    Case(
        family="mixed scales", name="a world of 1e1 .. 1e6, untouched: image and interior", bound=1.2e-4,
        measure=lambda: floating(range(1, 7)),
        hard="the largest coordinate is 5e5 box sizes, and a step of 1e-5 of it is five",
        naive="one ray epsilon a scene: 1e-4, 4e-3, 1e-2, 8e-2 and all of it at 1e2, 1e3, ... 1e6",
    ),
    Case(
        family="mixed scales", name="a world of 1e4 .. 1e6, untouched: derivative", bound=1.1e-3, slow=True,
        measure=lambda: floating_boundary((4, 6)),
        hard="as before; a shadow edge is looked at from a step beside it",
        naive="as before: a fifth at 1e4, all of it at 1e6",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e3 .. 1e4: image", bound=3e-5,
        measure=lambda: contact((3, 4)),
        hard="float32 places points of the floor, and rays on it, to 1e-7 of its size",
        naive="5e-3 and 5e-2 box sizes are left out of every contact shadow",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e5: image", bound=6e-3,
        measure=lambda: contact((5,)),
        hard="as before: 1e-2 box sizes", naive="as before: half a box",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e6: image", bound=7e-2,
        measure=lambda: contact((6,)),
        hard="as before: 1e-1 box sizes", naive="black",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e3 .. 1e4: derivative", bound=3e-3, slow=True,
        measure=lambda: contact_boundary((3, 4)),
        hard="edges touch the floor: what is beyond them is off by its roundings", naive="0.1 at 1e4",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e5: derivative", bound=2e-3, slow=True,
        measure=lambda: contact_boundary((5,)),
        hard="as before: 1e-2 box sizes", naive="all of it",
    ),
    Case(
        family="mixed scales", name="on a floor of two triangles, 1e6: derivative", bound=0.13, slow=True,
        measure=lambda: contact_boundary((6,)),
        hard="as before: 1e-1 box sizes", naive="all of it",
    ),
    Case(
        family="mixed scales", name="on a floor that is cut near the box, 1e4 .. 1e6", bound=6e-5,
        measure=lambda: contact_with_small_triangles((4, 5, 6)),
        hard="steps have to follow the place", naive="as on two triangles",
    ),
    Case(
        family="mixed scales", name="off the centre, 1e2 .. 1e4: image", bound=1e-3, measure=lambda: aside((2, 3, 4)),
        hard="the box has as few digits left as the floor", naive="as on the floor",
    ),
]  # fmt: skip


@pytest.mark.slow_rows("a world of 1e1 .. 1e6, untouched: image and interior")
@pytest.mark.parametrize("case", parameters(CASES))
def test_mixed_scales(case, check) -> None:
    check(case)


@pytest.mark.slow
def test_one_step_for_all_loses_the_small(monkeypatch) -> None:
    monkeypatch.setattr(steps, "MIXED", 0.0)
    assert floating((6,)) > 0.9 and light(on_a_floor(1e5), standing(1e3, 3), SLIDE) > 0.05


@pytest.mark.slow
def test_warps_own_queries_keep_the_small_too() -> None:
    acceleration.set_ray_backend("warp")
    try:
        wide = reference()[0]
        assert light(world(1e6), wide) < 1e-2
    finally:
        acceleration.set_ray_backend("auto")

"""Scenes that are tiny, vast, far away, or of mixed scales, against the same scene of size one at the origin.

Both sides draw the same random numbers, so that what differs is rounding, and samples that it tips over an edge.
"""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.scene.files import dictionary

from .record import Case, parameters
from .sweeps import VELOCITY, derivatives, passes, rectangle, reference, room, slope_error, worst

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

#: Where scenes are moved, in their own sizes.
PLACE = np.array([1.0, 0.7, -0.4])


def scaled(scales) -> float:
    base, _ = reference()
    return max(worst(passes(psdr.load_dict(room(s)), s * VELOCITY), base) for s in scales)


def moved(decades) -> float:
    base, _ = reference()
    return max(worst(passes(psdr.load_dict(room(1.0, 10.0**k * PLACE)), VELOCITY), base) for k in decades)


def rounded(offset: np.ndarray, place: np.ndarray) -> dict:
    """Return ``room`` as its positions are once they were float32 numbers at ``offset``, moved to ``place``."""
    scene = room(1.0, offset)
    for part in scene.values():
        if isinstance(part, dict) and "vertices" in part:
            part["vertices"] = part["vertices"].astype(np.float32).astype(np.float64) - offset + place
    scene["camera"]["to_world"][:3, 3] += place - offset
    return scene


def moved_in_float32(decades) -> float:
    """Compare scenes of float32 positions far away with the same digits at the origin."""
    found = 0.0
    for k in decades:
        offset = np.round(10.0**k * PLACE)
        near, far = (passes(psdr.load_dict(rounded(offset, at)), VELOCITY) for at in (np.zeros(3), offset))
        found = max(found, worst(far, near))
    return found


def world(size: float) -> dict:
    """Return ``room`` with a black square of the given size below it, which nothing sees."""
    vertices, faces = rectangle((0.0, 0.0, -0.5 * size), 0.5 * size, np.eye(4))
    square = {"type": "mesh", "vertices": vertices, "faces": faces, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    return room(extra={"square": square})


def mixed(decades) -> float:
    """Return the error of the regression slope of the derivative, boundary term included."""
    _, expected = reference()
    return max(slope_error(derivatives(world(10.0**k)), expected) for k in decades)


def image_in_a_world(decades) -> float:
    base, _ = reference()
    found = [passes(psdr.load_dict(world(10.0**k)), VELOCITY, boundary=False) for k in decades]
    return max(float(np.abs(r.image - base.image).mean() / base.image.mean()) for r in found)


CASES = (
    Case(
        family="scale", name="size 2^-13 .. 2^20", bound=0.0,
        measure=lambda: scaled([2.0**k for k in (-13, -7, 7, 13, 20)]),
        hard="lengths enter as fourth powers; a power of two scales every float exactly",
        naive="a ray epsilon of 1e-4 in world units is the whole scene at one end and below rounding at the other",
    ),
    Case(
        family="scale", name="size 1e-4 .. 1e6", bound=8e-7,
        measure=lambda: scaled([10.0**k for k in (-4, -2, 2, 4, 6)]),
        hard="as before, with rounding of every coordinate",
        naive="as before",
    ),
    Case(
        family="scale", name="10 sizes away", bound=2e-4, measure=lambda: moved([1]),
        hard="near enough to have no origin of its own: three bits of every coordinate are lost",
        naive="the same",
    ),
    Case(
        family="scale", name="1e2 .. 1e6 sizes away, float64", bound=4.5e-6, measure=lambda: moved(range(2, 7)),
        hard="float32 world coordinates have steps of a sixteenth of the scene at the far end",
        naive="image and derivative are wrong by 8e-6 and 3e-4 at 1e2, 5e-3 and 0.06 at 1e4, and black at 1e6",
    ),
    Case(
        family="scale", name="1e2 .. 1e6 sizes away, float32", bound=5e-6,
        measure=lambda: moved_in_float32(range(2, 7)),
        hard="positions arrive rounded: nothing more may be lost",
        naive="as before, on top of what the rounding did to the shapes",
    ),
    Case(
        family="scale", name="in a world of 1e1 .. 1e3, image", bound=6e-6,
        measure=lambda: image_in_a_world(range(1, 4)),
        hard="steps are a fraction of the largest coordinate, until they follow the place (``test_mixed_scales.py``)",
        naive="4e-5 at 1e3: a step is 1/200 of the box",
    ),
    Case(
        family="scale", name="in a world of 1e1 .. 1e3, derivative", bound=1.6e-3, slow=True,
        measure=lambda: mixed(range(1, 4)),
        hard="as before; a shadow edge is looked at from a ray epsilon beside it",
        naive="the same",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_scale(case, check) -> None:
    check(case)


def test_without_an_origin_of_its_own_a_far_scene_is_lost(monkeypatch) -> None:
    monkeypatch.setattr(dictionary, "find_origin", lambda shapes: np.zeros(3))
    with pytest.warns(RuntimeWarning, match="float32 loses digits"):
        assert moved([4]) > 0.05


def test_shapes_too_small_for_their_world_are_noted() -> None:
    def notes(far: float) -> list[str]:
        scene = world(1e6)
        for name in ("box", "floor", "lamp"):
            scene[name]["vertices"] = scene[name]["vertices"] + [far, 0.0, 0.0]
        return [n for n in psdr.load_dict(scene).description.notes if "too small" in n]

    assert not notes(0.0) and not notes(1e3)
    assert any("'box'" in n for n in notes(1e5))

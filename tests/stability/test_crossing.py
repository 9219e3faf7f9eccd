"""Plates that run through each other at ever smaller angles, against closed forms.

Plate A is level; plate B leans against it by an angle and lies in front of it on one side of a line, the curve of
intersection. Where A moves by the angle a unit of time, that line moves by about one. Plates that reach less deep into
each other than the boundary term's rays start off their edges, and are at less than 1e-3 to each other, touch: nothing
is lost in silence, but a warning says so.
"""

import math
import warnings

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.topology import intersection_curves

from .record import Case, parameters

FILM, FOV, BATCHES = 16, 40.0, 8
TWO = np.array([[0, 1, 2], [0, 2, 3]])
#: Where the plates meet, and their distance from the camera or the floor.
MEET, SEEN_FROM, ABOVE = 0.2, 3.0, 1.5
#: Radiance of A and B.
LEVEL, LEANING = 1.0, 5.0
#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3, and the largest standard error over the value.
Z_LIMIT, LARGEST_NOISE = 5.4, 0.02


def plates(angle: float, half: float, z: float) -> dict:
    """Return the two, that shine towards lower z."""
    corners = half * np.array([[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0]]) + [0.0, 0.0, z]
    leaning = corners + (corners[:, :1] - MEET) * [0.0, 0.0, angle]
    rest = {"type": "mesh", "faces": TWO, "face_normals": True, "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    return {
        "a": rest | {"vertices": corners, "emitter": {"type": "area", "radiance": LEVEL}},
        "b": rest | {"vertices": leaning, "emitter": {"type": "area", "radiance": LEANING}},
    }


def camera(**more) -> dict:
    film = {"type": "hdrfilm", "width": FILM, "height": FILM, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": FOV, "near_clip": 0.01, "film": film} | more


def derivatives(scene: dict, angle: float, depth: int, spp: int) -> np.ndarray:
    """Return the image's mean derivative as A rises, one a batch."""
    loaded = psdr.load_dict({"type": "scene"} | scene)
    params, integrator = psdr.traverse(loaded), psdr.PathIntegrator(max_depth=depth)
    tangents = {"a.vertex_positions": np.broadcast_to(np.float32([0.0, 0.0, angle]), (4, 3)).astype(np.float32)}
    images = [
        psdr.render_forward(loaded, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()
        for seed in range(BATCHES)
    ]
    assert not any(psdr.invalid_samples(loaded).values())
    return np.array([image.mean(dtype=np.float64) for image in images])


def seen(angle: float) -> np.ndarray:
    """Return what the camera finds of two plates that fill its view, over the exact derivative.

    The line's image lies at x / (z tan), in halves of the film, and moves at (1 / z - angle x / z^2) / tan.
    """
    speed = (1.0 / SEEN_FROM - angle * MEET / SEEN_FROM**2) / math.tan(math.radians(0.5 * FOV))
    found = derivatives({"camera": camera()} | plates(angle, 3.0, SEEN_FROM), angle, 1, 256)
    return found / (0.5 * speed * (LEANING - LEVEL))


def irradiance(polygon: np.ndarray, p: np.ndarray) -> float:
    """Return a polygon's, of radiance 1, at a point of the floor below it (Lambert's formula)."""
    v = polygon - p
    v /= np.linalg.norm(v, axis=1)[:, None]
    w = np.roll(v, -1, axis=0)
    c = np.cross(v, w)
    return abs(float((0.5 * np.arccos((v * w).sum(axis=1)) * c[:, 2] / np.linalg.norm(c, axis=1)).sum()))


def lit(angle: float) -> float:
    """Return |z|, over its limit, of the derivative of a floor below two plates, which reflects all; inf: too noisy."""
    eye, half = np.array([0.0, -3.0, 0.8]), math.radians(10.0)

    def radiance(p: np.ndarray, rise: float) -> float:
        """Below both plates, the lower of the two is seen everywhere: they are a roof there."""
        x = MEET + rise / angle
        slope, low, high = angle * (x - MEET), ABOVE - angle * (1.0 + MEET), ABOVE + rise
        b = [[-1, -1, low], [-1, 1, low], [x, 1, ABOVE + slope], [x, -1, ABOVE + slope]]
        a = [[x, -1, high], [x, 1, high], [1, 1, high], [1, -1, high]]
        return (LEANING * irradiance(np.array(b), p) + LEVEL * irradiance(np.array(a), p)) / math.pi

    ahead = -eye / np.linalg.norm(eye)
    left = np.cross(ahead, [0.0, 0.0, 1.0])
    left /= np.linalg.norm(left)
    up, step, expected = np.cross(left, ahead), 1e-6 * angle, 0.0
    nodes, weights = np.polynomial.legendre.leggauss(12)
    for s, ws in zip(nodes, weights, strict=True):
        for t, wt in zip(nodes, weights, strict=True):
            d = ahead + math.tan(half) * (s * left + t * up)
            p = eye - d * (eye[2] / d[2])
            expected += 0.25 * ws * wt * (radiance(p, step) - radiance(p, -step)) / (2.0 * step) * angle
    floor = {"type": "rectangle", "to_world": psdr.Transform.scale(20.0), "bsdf": {"type": "diffuse", "reflectance": 1}}
    view = camera(fov=20.0, to_world=psdr.Transform.look_at(eye, (0, 0, 0), (0, 0, 1)))
    found = derivatives({"camera": view, "floor": floor} | plates(angle, 1.0, ABOVE), angle, 2, 1024)
    sigma = float(found.std(ddof=1)) / math.sqrt(BATCHES)
    noisy = not 0.0 < sigma < LARGEST_NOISE * abs(expected)
    return math.inf if noisy else abs(float(found.mean()) - expected) / sigma / Z_LIMIT


def off(*angles: float) -> float:
    """Return how far from the exact derivative the camera's is at the worst of the angles."""
    return max(abs(float(seen(angle).mean()) - 1.0) for angle in angles)


CASES = (
    Case(
        family="crossing", name="plates that cross at 1e-2 and 3e-4, seen", bound=4e-5,
        measure=lambda: off(1e-2, 3e-4),
        hard="beside the curve the surfaces are less than a rounding apart",
        naive="which one is in front is drawn at random: 0.57 at 1e-3",
    ),
    Case(
        family="crossing", name="plates that cross at 1 .. 1e-3, seen", bound=4e-5, slow=True,
        measure=lambda: off(1.0, 0.1, 3e-3, 1e-3),
        hard="as before", naive="the same",
    ),
    Case(
        family="crossing", name="lights that cross at 0.1 .. 3e-3, seen by what they light (|z| over its limit)",
        bound=1.0, quantile=True, slow=True, measure=lambda: max(lit(angle) for angle in (0.1, 1e-2, 3e-3)),
        hard="they nowhere reach as deep into each other as rays start off edges",
        naive="taken for a contact, all of the derivative is lost at 3e-3",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_crossing(case, check) -> None:
    check(case)


def test_what_crosses_at_smaller_angles_touches_and_warns() -> None:
    with pytest.warns(RuntimeWarning, match="'a' and 'b' touch"):
        assert abs(seen(1e-4)).max() < 0.01


@pytest.mark.slow
def test_taken_for_a_contact_the_curve_is_lost(monkeypatch) -> None:
    class Anything:
        shapes = np.array([[1, 2]])

    assert lit(3e-3) < 1.0
    monkeypatch.setattr(intersection_curves, "contacts", lambda scene: Anything)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # and nothing says so
        assert lit(3e-3) > 1.0

"""The edge of a shadow under disks and squares of all sizes: the boundary gradient in closed form.

A point of the floor sees a light a unit above it, half hidden by the side of a plate at half the way. What is left of
the light is a polygon, whose irradiance is known [Lambert 1760], and so is its rate of change as the plate slides.
"""

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest

import warp_psdr as psdr

from .record import Case, parameters
from .test_coverage import clipped
from .test_light import ALBEDO, DOWN, disk, invalid, polygon_share, rgb, rim, scene_dict

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")
#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3.
Z_LIMIT, BATCHES = 5.4, 8
#: Height of the plate, how far it reaches, and how far its side is off the middle of the light as seen from the floor,
#: in radii of the light but at most in units.
HEIGHT, REACH, ASIDE = 0.5, 2.0, 0.2
#: Radius of what is seen of the floor, in radii of the light, and its largest value.
SEEN, MOST_SEEN = 0.01, 1.0e-4
#: Step of the exact derivative, like ``ASIDE``.
STEP = 1.0e-4


def square(half: float) -> dict:
    to_world = psdr.Transform.translate([0.0, 0.0, 1.0]) @ DOWN @ psdr.Transform.scale(half)
    emitter = {"type": "area", "radiance": rgb((1.0 + half**2) / (4.0 * half**2))}
    return {"light": {"type": "rectangle", "to_world": to_world, "emitter": emitter}}


def plate(side: float) -> np.ndarray:
    return np.array(
        [[side, -REACH, HEIGHT], [side + REACH, -REACH, HEIGHT], [side + REACH, REACH, HEIGHT], [side, REACH, HEIGHT]]
    )


def left_of(light: np.ndarray, side: float) -> float:
    """Return the irradiance, over pi, of what a plate leaves of a polygon of radiance 1 as seen from the origin."""
    hidden = light
    for corner, after in zip(plate(side), np.roll(plate(side), -1, axis=0), strict=True):
        hidden = clipped(hidden, np.cross(corner, after), 0.0)
    return polygon_share(light) - (polygon_share(hidden) if len(hidden) > 2 else 0.0)


def errors(light: Callable[[float], dict], radius: float, spp: int) -> tuple[float, float]:
    """Return the relative error of the derivative and its standard error."""
    unit = min(radius, 1.0)
    side = HEIGHT * ASIDE * unit
    black = {"type": "twosided", "a": {"type": "diffuse", "reflectance": rgb(0.0)}}
    blocker = {"type": "mesh", "vertices": plate(side), "faces": np.array([[0, 1, 2], [0, 2, 3]]), "face_normals": True}
    fov = math.degrees(2.0 * min(SEEN * radius, MOST_SEEN) / 0.4)
    scene = psdr.load_dict(scene_dict(light(radius), fov=fov, plate=blocker | {"bsdf": black}))
    params = psdr.traverse(scene)
    found = next(s for s in scene.description.shapes if s.path == "light")
    outer = rim(np.asarray(found.vertices, np.float64))
    radiance = float(params["light.emitter.radiance.value"].numpy().flat[0])
    ahead, back = (left_of(outer, side + s * STEP * unit) for s in (1.0, -1.0))
    expected = ALBEDO * radiance * (ahead - back) / (2.0 * STEP * unit)
    tangents = {"plate.vertex_positions": np.tile(np.float32([1.0, 0.0, 0.0]), (4, 1))}
    integrator = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.EdgeSampling())
    batches = [
        psdr.render_forward(scene, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy().mean()
        for seed in range(BATCHES)
    ]
    if invalid(scene):
        return math.inf, math.inf
    return float(np.mean(batches) / expected - 1.0), float(np.std(batches, ddof=1) / BATCHES**0.5 / expected)


def share(radii: Iterable[float], spp: int, noise: float) -> float:
    """Return the largest |z| over its limit; infinite where the standard error exceeds ``noise``."""
    rows = [errors(light, radius, spp) for light in (disk, square) for radius in radii]
    return max(abs(e) / s / Z_LIMIT if 0.0 < s < noise else math.inf for e, s in rows)


CASES = [
    Case(
        family="light", name="edge before disks and squares of radius 1e-5: boundary (|z| over its limit)",
        bound=1.0, quantile=True, measure=lambda: share((1e-5,), 256, 0.3),
        hard="the light is smaller than the distance at which a ray passes an edge",
        naive="the ray misses the light behind the edge: no gradient at all",
    ),
    Case(
        family="light", name="edge before disks and squares of radius 1e-5 .. 1: boundary (|z| over its limit)",
        bound=1.0, quantile=True, slow=True, measure=lambda: share((1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0), 2048, 0.1),
        hard="as before", naive="as before",
    ),
    Case(
        family="light", name="edge before disks and squares of 10 .. 1e3: boundary (|z| over its limit)",
        bound=1.0, quantile=True, slow=True, measure=lambda: share((10.0, 100.0, 1000.0), 2048, 0.02),
        hard="half of space shines, most of it at grazing angles", naive="points drawn by area are all far away",
    ),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", parameters(CASES))
def test_penumbra(case, check) -> None:
    check(case)

"""Reflections in rough metal down to alpha = 1e-5, seen so closely that a film spans a few lobes, in closed form.

A camera a unit from the origin of a floor of metal looks at it, and what it sees there is a unit away in the mirror
direction but for a fraction of the lobe's width: a point light, or an edge. Image and derivatives are smooth functions,
which float64 integrates over the film. An error of 6e-8 in a direction is one of 6e-8 / alpha here.

Derivatives are given in units of value over width. Rays leave the floor ``scene.ray_epsilon`` above it, so what paths
find by reflection is seen from there: 1e-5 of the scene, a lobe's width.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest

import warp_psdr as psdr
from tests.bsdf.helpers import MIRROR, rough, unit
from tests.bsdf.twins import ggx_eval

from .record import Case, parameters

FILM = 4
#: Half of the film, in widths of the lobe; by how much the light is off the mirror direction, in slopes over alpha; by
#: how much an edge is, in widths.
HALF, ASIDE, EDGE_ASIDE = 2.0, (0.8, 0.5), 0.6
#: Steps of the exact derivatives over the lobe's width.
STEP = 1.0e-3
#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3, and the largest standard error over the value.
Z_LIMIT, BATCHES, LARGEST_NOISE = 5.4, 8, 0.05
#: Sides of the plate whose edge is seen, and its turn about the line of sight, radians.
PLATE, TURN = 0.2, 0.5
BLACK = {"type": "diffuse", "reflectance": 0.0}


def lobe_width(degrees: float, alpha: float) -> float:
    """Return half of the lobe's width across the plane of incidence, radians."""
    return alpha * math.cos(math.radians(degrees))


def place(degrees: float) -> np.ndarray:
    """Return the camera's place, as it is rounded."""
    t = math.radians(degrees)
    return np.float32([-math.sin(t), 0.0, math.cos(t)]).astype(np.float64)


def film_points(camera: np.ndarray, half: float, nodes: int):
    """Yield points of the floor and their weights, with Gauss' rule over the film."""
    x, weights = np.polynomial.legendre.leggauss(nodes)
    ahead = -unit(camera)
    left = unit(np.cross([0.0, 1.0, 0.0], ahead))
    up = np.cross(ahead, left)
    for a, wa in zip(x, weights, strict=True):
        for b, wb in zip(x, weights, strict=True):
            d = ahead + math.tan(half) * (a * left + b * up)
            yield camera - d * (camera[2] / d[2]), 0.25 * wa * wb


def reflected(camera: np.ndarray, point: np.ndarray, to_light: np.ndarray, alpha: float) -> float:
    """Return f_s cos at a point of the floor."""
    mat = rough(alpha, metal=MIRROR, reflectance=(1.0,) * 3)
    return float(ggx_eval(mat, unit(camera - point), unit(to_light))[0])


def load(camera: np.ndarray, alpha: float, half: float, more: dict):
    view = {
        "type": "perspective", "fov": math.degrees(2.0 * half), "near_clip": 0.01,
        "to_world": psdr.Transform.look_at(camera, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        "film": {"type": "hdrfilm", "width": FILM, "height": FILM, "rfilter": {"type": "box"}},
    }  # fmt: skip
    metal = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}
    return psdr.load_dict({"type": "scene", "camera": view, "floor": {"type": "rectangle", "bsdf": metal}, **more})


# --- a point light ---


def point_light(degrees: float, alpha: float) -> float:
    """Return the largest error of the image and of its derivatives by alpha and by the light's place."""
    alpha = float(np.float32(alpha))
    camera, width = place(degrees), lobe_width(degrees, alpha)
    h = np.array([ASIDE[0] * alpha, ASIDE[1] * alpha, 1.0])
    light = np.float32(2.0 * np.dot(camera, h) / np.dot(h, h) * h - camera).astype(np.float64)
    half, step = HALF * width, STEP * width

    def seen(alpha: float, light: np.ndarray) -> float:
        return sum(
            weight * reflected(camera, p, light - p, alpha) / np.dot(light - p, light - p)
            for p, weight in film_points(camera, half, 24)
        )

    scene = load(camera, alpha, half, {"light": {"type": "point", "position": light, "intensity": 1.0}})
    params, options = psdr.traverse(scene), {"integrator": psdr.PathIntegrator(max_depth=2), "spp": 256}
    value = seen(alpha, light)
    found = [psdr.render(scene, **options).numpy().mean(dtype=np.float64) / value - 1.0]
    # One-sided by alpha: the range begins at 1e-5.
    by_alpha = [seen(alpha + k * step, light) for k in (0, 1, 2)]
    rows = [("floor.bsdf.alpha.value", 1.0, (-1.5 * by_alpha[0] + 2.0 * by_alpha[1] - 0.5 * by_alpha[2]) / step)]
    for v in np.eye(3):
        rows.append(("light.position", v, (seen(alpha, light + step * v) - seen(alpha, light - step * v)) / 2.0 / step))
    for name, tangent, expected in rows:
        moved = psdr.render_forward(scene, params, {name: tangent}, **options).numpy().mean(dtype=np.float64)
        found.append((moved - expected) * width / value)
    return max(abs(float(e)) for e in found)


# --- edges ---


def edge(degrees: float, alpha: float, shines: bool) -> float:
    """Return |z|, over its limit, of the derivative as a plate moves across one of its sides; infinite if too noisy.

    The plate shines, and then its light's own motion is differentiated, or it hides a light behind it, and then there
    is nothing but a boundary term.
    """
    alpha = float(np.float32(alpha))
    camera, width = place(degrees), lobe_width(degrees, alpha)
    half = HALF * width
    ahead = camera * [-1.0, -1.0, 1.0]
    across = np.cross([0.0, 1.0, 0.0], ahead)
    along = math.cos(TURN) * np.array([0.0, 1.0, 0.0]) + math.sin(TURN) * across
    out = np.cross(along, ahead)
    side = ahead + EDGE_ASIDE * width * out
    corners = side + 0.5 * PLATE * np.array([along, -along, -along - 2.0 * out, along - 2.0 * out])
    corners = np.float32(corners).astype(np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    if np.dot(np.cross(corners[1] - corners[0], corners[2] - corners[0]), ahead) > 0.0:
        faces = faces[:, ::-1]
    plate = {"type": "mesh", "vertices": corners, "faces": faces, "face_normals": True, "bsdf": BLACK}
    light = {"emitter": {"type": "area", "radiance": 1.0}}
    middle = corners.mean(axis=0)
    behind = plate | light | {"vertices": 2.0 * ahead + 3.0 * (corners - middle)}
    scene = load(camera, alpha, half, {"plate": plate | light} if shines else {"plate": plate, "behind": behind})

    expected = 0.0
    start = np.array([0.0, 0.0, scene.ray_epsilon if shines else 0.0])
    normal = unit(np.cross(along, out))
    q, weights = np.polynomial.legendre.leggauss(80)
    place_on_side = 4.0 * alpha * np.tan(0.5 * np.pi * q)
    per_q = 2.0 * np.pi * alpha / np.cos(0.5 * np.pi * q) ** 2
    for p, weight in film_points(camera, half, 10):
        for s, w in zip(place_on_side, weights * per_q, strict=True):
            if abs(s) < 0.5 * PLATE:
                r = 0.5 * (corners[0] + corners[1]) + s * along - p - start
                f = reflected(camera, p, r, alpha)
                expected += (1.0 if shines else -1.0) * weight * w * f * abs(normal @ r) / np.dot(r, r) ** 1.5

    integrator = psdr.PathIntegrator(max_depth=2, boundary=psdr.boundary.EdgeSampling())
    tangents = {"plate.vertex_positions": np.broadcast_to(out, (4, 3)).astype(np.float32)}
    params = psdr.traverse(scene)
    found = [
        psdr.render_forward(scene, params, tangents, integrator=integrator, spp=1024, seed=seed).numpy().mean()
        for seed in range(BATCHES)
    ]
    sigma = float(np.std(found, ddof=1)) / math.sqrt(BATCHES)
    noisy = not 0.0 < sigma < LARGEST_NOISE * abs(expected)
    return math.inf if noisy else abs(float(np.mean(found)) - expected) / sigma / Z_LIMIT


def over(alphas, angles, one: Callable[[float, float], float]) -> float:
    return max(one(angle, alpha) for alpha in alphas for angle in angles)


CASES = (
    Case(
        family="highlights", name="a point light at alpha 1e-5, up to 88 degrees", bound=1e-2, slow=True,
        measure=lambda: over((1e-5,), (0.0, 40.0, 80.0, 88.0), point_light),
        hard="a lobe as wide as 170 roundings of a direction, and 6 at 88 degrees",
        naive="slopes of wi + wo alone: 1.9e-2; a clamp at 1e-4: all of it",
    ),
    Case(
        family="highlights", name="a point light at alpha 1e-4 .. 1e-2, up to 88 degrees", bound=4e-3, slow=True,
        measure=lambda: over((1e-4, 1e-3, 1e-2), (0.0, 40.0, 88.0), point_light),
        hard="as before", naive="the same",
    ),
    Case(
        family="highlights", name="a light's own edge at alpha 1e-5 .. 1e-3: interior (|z| over its limit)",
        bound=1.0, quantile=True, slow=True,
        measure=lambda: over((1e-5, 1e-3), (0.0, 40.0, 80.0), lambda angle, a: edge(angle, a, True)),
        hard="the derivative of the lobe is 1e15, its integral 1e4", naive="no light is found by sampling lights",
    ),
    Case(
        family="highlights", name="an edge before a light at alpha 1e-5 .. 1e-3: boundary (|z| over its limit)",
        bound=1.0, quantile=True, slow=True,
        measure=lambda: over((1e-5, 1e-3), (0.0, 40.0, 80.0), lambda angle, a: edge(angle, a, False)),
        hard="an edge of length 0.2 counts along 1e-5 of it",
        naive="points drawn evenly along the edge: one in 1e4 counts",
    ),
)  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_highlights(case, check) -> None:
    check(case)

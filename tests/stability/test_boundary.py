"""Boundary gradients where light, materials and paths are hard: against central differences of the image.

The image's sum, under weights that vary over it, is differenced with common random numbers; both sides are means of
independent batches. A case is the largest |z| over its limit; where noise would hide an error of ``LARGEST_NOISE``, it
is infinite. A light, a material or a path joins by a row of its table.
"""

import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest

import warp_psdr as psdr

from .record import Case, parameters
from .sweeps import FILM, VELOCITY, box, room

#: Scenes that are noted to be at the edge of what floats hold are what is tested.
pytestmark = pytest.mark.filterwarnings("ignore::warp_psdr.SceneWarning")

#: Two-sided quantile of Student's t with 7 degrees of freedom at 1e-3.
Z_LIMIT, BATCHES = 5.4, 8
#: Largest standard error of the comparison, over the derivative, where nothing else is said.
LARGEST_NOISE = 0.04
#: Way of the box to either side of the difference: the derivative's change over it is below the noise.
STEP = 0.02
WEIGHT = np.linspace(0.5, 1.5, FILM * FILM * 3).reshape(FILM, FILM, 3)
PIXELS = FILM * FILM
NAME = "box.vertex_positions"
#: All corners of the box of ``room`` away from its centre.
GROW = box((0.0, 0.0, 0.0), 0.5)[0]


def moved(scene: dict, way: float, velocity) -> dict:
    """Return a scene in which the box has moved."""
    return scene | {"box": scene["box"] | {"vertices": scene["box"]["vertices"] + way * np.asarray(velocity)}}


def compared(
    scene: dict,
    *,
    depth: int = 3,
    spp: int = 64,
    primal: int = 1024,
    rr: int = 5,
    velocity=VELOCITY,
    noise: float = LARGEST_NOISE,
    method="auto",
) -> float:
    """Return |z| of derivative and difference, over its limit.

    Args:
        scene: with the mesh "box", which moves with ``velocity``.
        depth: of the paths.
        spp: samples a pixel of a batch of derivatives.
        primal: the same of either image of a difference.
        rr: depth at which roulette starts.
        velocity: (3,), or (8, 3), one a corner.
        noise: largest standard error of the comparison, over the derivative.
        method: of the boundary term.
    """
    integrator = psdr.PathIntegrator(max_depth=depth, rr_depth=rr, boundary=method)
    loaded, ahead, back = (psdr.load_dict(moved(scene, s * STEP, velocity)) for s in (0.0, 1.0, -1.0))
    params = psdr.traverse(loaded)
    tangents = {NAME: np.broadcast_to(velocity, params[NAME].numpy().shape).astype(np.float32)}
    found, expected = [], []
    for seed in range(BATCHES):
        image = psdr.render_forward(loaded, params, tangents, integrator=integrator, spp=spp, seed=seed).numpy()
        found.append((WEIGHT * image).sum())
        a, b = (psdr.render(s, integrator=integrator, spp=primal, seed=100 + seed).numpy() for s in (ahead, back))
        expected.append((WEIGHT * (a.astype(np.float64) - b)).sum() / (2.0 * STEP))
    if any(psdr.invalid_samples(s)[kind] for s in (loaded, ahead, back) for kind in psdr.invalid_samples(s)):
        return math.inf
    apart = np.mean(found) - np.mean(expected)
    sigma = math.sqrt((np.var(found, ddof=1) + np.var(expected, ddof=1)) / BATCHES)
    if not sigma <= noise * abs(np.mean(expected)):
        return math.inf
    return float(abs(apart) / sigma) / Z_LIMIT


def methods_apart(scene: dict, depth: int, rr: int, spp: int, noise: float = 0.01) -> float:
    """Return |z| of the derivatives of two methods as the box grows, over its limit; infinite for more ``noise``."""
    found = []
    for method, samples in ((psdr.boundary.PathSpace(), spp), (psdr.boundary.EdgeSampling(), 2 * spp)):
        integrator = psdr.PathIntegrator(max_depth=depth, rr_depth=rr, boundary=method)
        loaded = psdr.load_dict(scene)
        options = {"integrator": integrator, "spp": samples}
        tangents = {NAME: GROW.astype(np.float32)}
        images = [
            psdr.render_forward(loaded, psdr.traverse(loaded), tangents, seed=seed, **options).numpy()
            for seed in range(BATCHES)
        ]
        found.append([float((WEIGHT * image).sum()) for image in images])
    apart = np.mean(found[0]) - np.mean(found[1])
    sigma = math.sqrt((np.var(found[0], ddof=1) + np.var(found[1], ddof=1)) / BATCHES)
    return math.inf if not sigma <= noise * abs(np.mean(found[1])) else float(abs(apart) / sigma) / Z_LIMIT


def over(rows: Iterable, one: Callable[..., float]) -> float:
    return max(one(row) for row in rows)


# --- light ---


def lamp(half: float) -> dict:
    """Return the room under a square lamp of half a side, of the same power whatever its size up to one."""
    scene = room()
    middle = scene["lamp"]["vertices"].mean(axis=0)
    corners = (scene["lamp"]["vertices"] - middle) * (half / 0.5) + middle
    radiance = 8.0 * 0.25 / min(half, 1.0) ** 2
    return scene | {"lamp": scene["lamp"] | {"vertices": corners, "emitter": {"type": "area", "radiance": radiance}}}


def sky() -> dict:
    """Return the room under a sky of 0.3 with one texel of 4e4."""
    pixels = np.full((16, 32, 3), 0.3, np.float32)
    pixels[4, 8] = 4e4
    scene = room()
    del scene["lamp"]
    up = psdr.Transform.rotate([1, 0, 0], 90)
    return scene | {"sky": {"type": "envmap", "bitmap": pixels, "to_world": up}}


def many_lights() -> dict:
    """Return the room under 1,000 point lights."""
    scene = room()
    del scene["lamp"]
    angle = 2.0 * np.pi * np.arange(1000) / 1000
    places = np.stack([0.5 + 0.7 * np.cos(angle), 0.7 * np.sin(angle), np.full(1000, 3.5)], axis=1)
    light = {"type": "point", "intensity": {"type": "rgb", "value": [0.02] * 3}}
    return scene | {f"p{i}": light | {"position": p.tolist()} for i, p in enumerate(places)}


def inside_glass() -> dict:
    """Return a shining box inside of a ball of glass, alone."""
    scene = room()
    corners, faces = box((0.1, 0.0, 0.5), 0.35)
    glass = {"type": "sphere", "center": [0.0, 0.0, 0.5], "radius": 1.2, "bsdf": {"type": "dielectric", "int_ior": 1.5}}
    shining = {"type": "mesh", "vertices": corners, "faces": faces, "face_normals": True}
    black = {"type": "diffuse", "reflectance": 0.0}
    return {
        "type": "scene", "camera": scene["camera"], "glass": glass,
        "box": shining | {"bsdf": black, "emitter": {"type": "area", "radiance": 2.0}},
    }  # fmt: skip


# --- materials and paths ---


def floor(bsdf: dict, of_box: dict | None = None) -> dict:
    scene = room()
    return scene | {
        "floor": scene["floor"] | {"bsdf": bsdf},
        "box": scene["box"] | ({"bsdf": of_box} if of_box else {}),
    }


def metal(alpha: float) -> dict:
    return {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}


def gray(value: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def closed(albedo: float) -> dict:
    """Return a black box in a closed room that shines evenly and reflects."""
    scene = room()
    return {
        "type": "scene", "camera": scene["camera"], "box": scene["box"] | {"bsdf": gray(0.0)},
        "hull": {
            "type": "cube", "flip_normals": True, "bsdf": gray(albedo), "emitter": {"type": "area", "radiance": 1.0},
            "to_world": psdr.Transform.translate([0, 0, 2]) @ psdr.Transform.scale([6.0, 6.0, 4.0]),
        },
    }  # fmt: skip


def corridor(bounces: int) -> dict:
    """Return a shining box that the camera sees after ``bounces`` reflections between two parallel mirrors."""
    scene = room()
    mirror = {"type": "conductor", "material": "none"}
    walls = {
        name: {
            "type": "rectangle", "bsdf": {"type": "twosided", "a": mirror},
            "to_world": psdr.Transform.translate([x, 10.0, 0.0])
            @ psdr.Transform.rotate((0, 1, 0), 90.0) @ psdr.Transform.scale([20.0, 20.0, 1.0]),
        } for name, x in (("left", -1.0), ("right", 1.0))
    }  # fmt: skip
    # Unfolded, the box is 2 bounces to the side and 4 ahead.
    side = 2.0 * bounces + (0.1 if bounces % 2 == 0 else -0.1)
    view = psdr.Transform.look_at((0.0, 0.0, 0.0), (side, 6.0, 0.0), (0, 0, 1))
    corners, faces = box((0.1, 6.0, 0.0), 0.3)
    shining = {"type": "mesh", "vertices": corners, "faces": faces, "face_normals": True, "bsdf": gray(0.0)}
    return {
        "type": "scene", "camera": scene["camera"] | {"to_world": view.matrix, "fov": 15.0 if bounces < 4 else 8.0},
        "box": shining | {"emitter": {"type": "area", "radiance": 2.0}}, **walls,
    }  # fmt: skip


#: Roughness of the floor, and the noise allowed: below 1e-2 that of the interior term, of the order of 1 / alpha
#: (``test_highlights.py`` looks at single lobes).
ALPHAS = ((1e-5, math.inf), (1e-4, math.inf), (1e-3, math.inf), (1e-2, 0.25), (1e-1, 0.1), (1.0, 0.06))
UP = np.array([0.0, 0.0, 1.0])
SHARE = " (|z| over its limit)"


def case(name: str, measure: Callable[[], float], hard: str, naive: str) -> Case:
    options = {"measure": measure, "hard": hard, "naive": naive, "slow": True}
    return Case(family="boundary", name=name + SHARE, bound=1.0, quantile=True, **options)


CASES = [
    case(
        "a square lamp of half side 1e-5", lambda: compared(lamp(1e-5)),
        hard="shadows without a penumbra; the lamp is smaller than the step by which an edge is passed",
        naive="a ray from beside the edge misses the lamp it was aimed at: the gradient has the wrong sign",
    ),
    case(
        "a square lamp of half side 1e-6 .. 1",
        lambda: over((1e-6, 1e-4, 1e-2, 1.0), lambda half: compared(lamp(half))),
        hard="as before", naive="as before: wrong by 1.2 at 1e-5, 0.24 at 1e-4",
    ),
    case(
        "a lamp of 10 .. 1e3: half of space",
        lambda: over((10.0, 1e3), lambda half: compared(lamp(half), spp=512, primal=4096, noise=0.08)),
        hard="the light is all around, nearly all of it at grazing angles", naive="noise",
    ),
    case(
        "a sun pixel of 4e4 in a sky of 0.3", lambda: compared(sky(), spp=256, primal=4096, noise=0.06),
        hard="nearly all shadow edges are those of one texel", naive="noise: directions by the wedge meet it never",
    ),
    case(
        "1,000 point lights", lambda: compared(many_lights()),
        hard="1,000 hard shadows", naive="one light in 1,000 lights the edge that was chosen for another",
    ),
    case(
        "a light inside glass", lambda: compared(inside_glass(), depth=6, spp=256, primal=1024, noise=0.08),
        hard="everything that moves is seen through a smooth interface", naive="no gradient at all",
    ),
    case(
        "roughness 1e-5 .. 1 of the floor",
        lambda: over(ALPHAS, lambda row: compared(floor(metal(row[0])), spp=256, noise=row[1])),
        hard="shadow edges are seen through a lobe as narrow as alpha", naive="not finite, or not there",
    ),
    case(
        "albedo 0 and 1",
        lambda: over(
            ((0, 1), (1, 0), (1, 1), (0.5, 0)), lambda row: compared(floor(gray(row[0]), gray(row[1])), depth=4)
        ),
        hard="factors of exactly 0 and 1", naive="0 / 0 in a replay",
    ),
    case(
        "64 bounces, albedo 0.999: two methods", lambda: methods_apart(closed(0.999), 64, 1 << 20, 16),
        hard="64 vertices to either side of an edge",
        naive="paths that serve more lengths the earlier they end: 6 % of the gradient is lost",
    ),
    case(
        "64 bounces, albedo 0.999, roulette: two methods", lambda: methods_apart(closed(0.999), 64, 5, 64, 0.04),
        hard="as before, and roulette to both sides",
        naive="as before",
    ),
    case(
        "roulette from the first, the second and no vertex on",
        lambda: over((1, 2, 1 << 20), lambda rr: compared(floor(gray(0.6)), depth=6, rr=rr)),
        hard="the weights of paths that go on, to either side", naive="roulette that knows one side only",
    ),
    case(
        "2 and 8 mirrors", lambda: over(
            (2, 8), lambda n: compared(corridor(n), depth=n + 2, spp=64, primal=256, velocity=UP, noise=0.12)
        ),
        hard="a chain of delta lobes between camera and edge", naive="no gradient at all",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", parameters(CASES))
def test_boundary(case, check) -> None:
    check(case)

"""Scenes drawn at random of shapes without triangles, each with a motion to be differentiated.

``python -m tests.boundary.random_shapes FIRST LAST`` compares the derivatives of that range with finite differences and
prints a line a scene, as ``random_scenes.py`` does. A world fixes the camera, its filter, the light and the kinds of
shapes, so that few kernels serve all. What is refused is printed with its reason.
"""

import sys

import numpy as np

from tests.networks import blob as bumpy
from tests.networks import fitted
from tests.path.test_sdfgrid import nodes

from .measure import Case
from .random_scenes import direction, light, measured, sensor
from .scenes import SCENES, T, diffuse, floor, load, register

#: Of the difference.
STEP = 0.004
#: Camera, filter, light, kinds of shapes.
WORLDS = (
    ("perspective", "tent", "sheet", ("sphere", "disk", "cylinder")),
    ("perspective", "gaussian", "constant", ("sphere", "linear", "bsplinecurve")),
    ("perspective", "box", "point", ("cylinder", "cubic", "linearcurve")),
    ("thinlens", "tent", "sheet", ("linear", "disk", "bsplinecurve")),
    ("orthographic", "tent", "spot", ("sphere", "cubic", "linearcurve")),
    ("perspective", "tent", "directional", ("shaded", "disk", "bsplinecurve")),
    ("perspective", "tent", "sheet", ("network", "sphere", "cylinder")),
)
NODES = 13
NETWORK = fitted(bumpy, (16, 16))


def pose(random, center, size: float) -> np.ndarray:
    """A turn and three lengths about a centre."""
    matrix = np.eye(4)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    matrix[:3, :3] = turn * (size * random.uniform(0.6, 1.0, 3))
    matrix[:3, 3] = center
    return matrix


def boxed(random, center, size: float) -> T:
    """The same of the unit cube, whose content has about this radius."""
    matrix = pose(random, center, 2.8 * size)
    matrix[:3, 3] -= 0.5 * matrix[:3, :3].sum(axis=1)
    return T(matrix)


def blob(random) -> np.ndarray:
    """Distances from a ball with bumps, (Z, Y, X)."""
    x, y, z = nodes(NODES)
    away = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - random.uniform(0.25, 0.32)
    a, b, c = random.uniform(5.0, 9.0, 3)
    return (away + random.uniform(0.0, 0.04) * np.sin(a * x) * np.sin(b * y + 1.0) * np.sin(c * z)).astype(np.float32)


def shape(random, kind: str, center, size: float) -> dict:
    bsdf = {"bsdf": diffuse(*random.uniform(0.2, 0.8, 3).tolist())}
    if kind in ("sphere", "disk", "cylinder"):
        if kind != "sphere":
            bsdf = {"bsdf": {"type": "twosided", **bsdf}}
        return {"type": kind, "exact": True, "to_world": T(pose(random, center, size)), **bsdf}
    if kind in ("linear", "cubic", "shaded"):
        normals = {"normals": "analytic" if kind == "linear" else "smooth"}
        how = {"interpolation": "cubic"} if kind == "cubic" else normals
        return {"type": "sdfgrid", "grid": blob(random), "to_world": boxed(random, center, size), **how, **bsdf}
    if kind == "network":
        return NETWORK.plugin(to_world=boxed(random, center, size), **bsdf)
    along, k = direction(random), np.linspace(-1.0, 1.0, 6)[:, None]
    bend = np.cross(along, direction(random))
    places = center + size * (k * along + random.uniform(0.0, 0.4) * np.sin(2.0 * k + 1.0) * bend)
    radii = size * random.uniform(0.15, 0.35) * (1.0 + random.uniform(-0.5, 0.5) * k)
    return {"type": kind, "control_points": np.hstack([places, radii]), **bsdf}


def content(random, camera: str, rfilter: str, lamp: str, kinds: tuple[str, ...]) -> dict:
    """A dictionary of the scene: shapes that keep apart from each other, over a floor in which they may stand."""
    found, balls = {}, []
    for number, kind in enumerate(kinds):
        for _attempt in range(1000):
            size = random.uniform(0.25, 0.4)
            center = random.uniform(-0.8, 0.8, 3) + np.array([0.0, 0.0, 0.85])
            # The corners of a box around a shape are twice as far as its surface.
            if all(np.linalg.norm(center - other) > 1.6 * (size + reach) for other, reach in balls):
                break
        balls.append((center, size))
        found[f"shape{number}"] = shape(random, kind, center, size)
    level = float(random.uniform(-0.4, 0.0)) if "network" in kinds else float(random.uniform(-0.4, 0.5))
    return {
        "sensor": sensor(random, camera, rfilter),
        **found,
        "floor": floor(level, 2.5, diffuse(*random.uniform(0.3, 0.8, 3).tolist())),
        "light": light(random, lamp),
    }


def motion(random, params):
    """(parameter, tangent): one thing that moves, turns, shears or bends."""
    turn, shift = 0.4 * random.normal(size=(3, 3)), direction(random)
    weights = random.normal(size=4) * [0.5, 0.5, 0.5, 0.15]

    def tangent(values):
        if values.shape[-2:] == (4, 4):
            moved = np.zeros((4, 4))
            middle = values[:3, 3] + (0.5 * values[:3, :3].sum(axis=1) if grid else 0.0)
            moved[:3] = turn @ values[:3]
            moved[:3, 3] += shift - turn @ middle
            return moved
        if name.endswith("control_points"):
            k = np.arange(values.size // 4)[:, None]
            return (np.cos(1.3 * k) * weights + 0.5 * weights).reshape(values.shape)
        if name.endswith("grid"):
            x, y, z = nodes(NODES)
            return (0.7 * np.sin(3.0 * x + 4.0 * weights[0]) * np.cos(2.0 * z + y) + 0.3).reshape(values.shape)
        if name.endswith("vertex_positions") or values.size == 3:
            return np.broadcast_to(shift, values.shape)
        return 0.3 * np.random.default_rng(1).standard_normal(values.shape)

    ends = (".to_world", ".grid", ".control_points", ".position", ".layer1.weight", ".layer2.bias")
    movable = [n for n in params if n.endswith(ends) or n == "light.vertex_positions"]
    name = str(random.choice(movable))
    grid = f"{name.rpartition('.')[0]}.grid" in params or f"{name.rpartition('.')[0]}.layer2.bias" in params
    return name, tangent


def draw(seed: int) -> Case:
    """Return the row of a seed; its scene is registered under the name ``random shapes SEED``."""
    random = np.random.default_rng(seed)
    scene = f"random shapes {seed}"
    described = content(random, *WORLDS[seed % len(WORLDS)])
    if scene not in SCENES:
        register({scene: lambda: described})
    name, tangent = motion(random, load(scene)[1])
    depth = int(random.integers(2, 4))
    return Case(scene, name, tangent, STEP, name, depth, 256, 1024)


if __name__ == "__main__":
    measured(draw, int(sys.argv[1]), int(sys.argv[2]))

"""Effects that people combine, two at a time, in a small room; the camera or what an effect brings moves.

``python -m tests.boundary.together [FIRST [SECOND]]`` compares the derivatives of all pairs, or of those of an effect,
with finite differences, and prints a line a request.
"""

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .measure import REMAINDER, STANDARD_ERRORS, Case
from .random_scenes import LARGEST_ERROR, measure
from .scenes import SIZE, T, register

#: Of the differences: small beside the texels, the pixels and the radii of the shapes.
STEP = 0.004
DEPTH = 4


def rgb(*values):
    return {"type": "rgb", "value": list(values)}


def bitmap(values, **more):
    return {"type": "bitmap", "bitmap": np.asarray(values, np.float32), "raw": True, **more}


def checkers():
    lie = np.array([[3.0, 0.2, 0.13], [-0.2, 3.0, 0.21], [0.0, 0.0, 1.0]])
    return {"type": "checkerboard", "color0": rgb(0.1, 0.1, 0.1), "color1": rgb(0.8, 0.7, 0.6), "to_uv": lie}


def ball(center, radius, bsdf):
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def pane(at, half, bsdf):
    pose = T.translate(at) @ T.rotate([1, 0.2, 0], 80) @ T.scale(half)
    return {"type": "rectangle", "to_world": pose, "bsdf": bsdf}


def smoke():
    inside = {"type": "homogeneous", "sigma_t": 1.5, "albedo": 0.8, "phase": {"type": "hg", "g": 0.3}}
    pose = T.translate([0.0, 0.0, 0.75]) @ T.scale([0.8, 0.7, 0.6])
    return {"type": "cube", "to_world": pose, "bsdf": {"type": "null"}, "interior": inside}


def leaf():
    holes = np.random.default_rng(1).uniform(0.1, 0.9, (4, 4, 1))
    nested = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.3, 0.6, 0.2)}}
    return pane([-0.4, -0.6, 0.7], 0.28, {"type": "mask", "opacity": bitmap(holes), "nested": nested})


def curve():
    points = np.array(
        [[-0.9, -0.9, 0.2, 0.08], [-0.3, -0.8, 0.6, 0.06], [0.4, -1.0, 0.3, 0.07], [0.9, -0.9, 0.8, 0.05]]
    )
    return {"type": "bsplinecurve", "control_points": np.vstack([points[:1], points, points[-1:]])}


def grid():
    x, y, z = np.meshgrid(*3 * [np.linspace(-1.0, 1.0, 9)], indexing="ij")
    values = np.sqrt(x * x + 1.4 * y * y + z * z).transpose(2, 1, 0) - 0.7
    pose = T.translate([0.15, -0.15, 0.85]) @ T.scale(0.6)
    return {"type": "sdfgrid", "grid": np.float32(0.5 * values[..., None]), "normals": "analytic", "to_world": pose}


def sky():
    y, x = np.mgrid[0:6, 0:12]
    values = 0.5 + 0.4 * np.sin(x)[..., None] * np.cos(y)[..., None] * np.array([1.0, 0.8, 0.6])
    return {"type": "envmap", "bitmap": np.float32(values)}


@dataclass(frozen=True)
class Effect:
    """What a scene gains, and what of it moves.

    Attributes:
        objects: of the scene; "floor" is the texture of the floor.
        moves: the parameter that moves, and how.
    """

    objects: Callable[[], dict]
    moves: tuple[str, Callable[[np.ndarray], np.ndarray]]


def shifted(*way):
    def tangent(values):
        t = np.zeros_like(values)
        t[:3, 3] = way
        return t

    return tangent


def slid(values):
    t = np.zeros_like(values)
    t[:2, 2] = [1.0, 0.7]
    return t


WAY = shifted(0.6, 0.3, 0.5)
EFFECTS = {
    "checkers": Effect(lambda: {"floor": checkers()}, ("floor.bsdf.reflectance.to_uv", slid)),
    "bitmap": Effect(
        lambda: {"floor": bitmap(np.random.default_rng(2).uniform(0.1, 0.9, (4, 4, 3)))}, ("floor.to_world", WAY)
    ),
    "glass": Effect(lambda: {"glass": ball([0.5, -0.35, 0.4], 0.3, {"type": "dielectric"})}, ("glass.to_world", WAY)),
    "mirror": Effect(
        lambda: {"mirror": pane([-0.75, 0.35, 0.7], 0.4, {"type": "conductor"})}, ("mirror.to_world", WAY)
    ),
    "thin glass": Effect(
        lambda: {"thin": pane([0.3, -0.7, 0.6], 0.35, {"type": "thindielectric"})}, ("thin.to_world", WAY)
    ),
    "leaf": Effect(lambda: {"leaf": leaf()}, ("leaf.to_world", WAY)),
    "rough glass": Effect(
        lambda: {"frosted": ball([-0.6, -0.15, 0.35], 0.28, {"type": "roughdielectric", "alpha": 0.3})},
        ("frosted.to_world", WAY),
    ),
    "sky": Effect(lambda: {"sky": sky()}, ("sensor.to_world", WAY)),
    "sun": Effect(
        lambda: {"sun": {"type": "directional", "direction": [0.3, 0.2, -1.0], "irradiance": rgb(2.0, 1.8, 1.5)}},
        ("block.to_world", WAY),
    ),
    "normals": Effect(
        lambda: {"smooth": ball([-0.35, 0.1, 1.0], 0.3, {"type": "diffuse", "reflectance": rgb(0.6, 0.4, 0.3)})},
        ("smooth.to_world", WAY),
    ),
    "smoke": Effect(lambda: {"smoke": smoke()}, ("smoke.to_world", WAY)),
    "curve": Effect(lambda: {"curve": curve()}, ("curve.control_points", lambda v: np.ones_like(v) * [1, 0, 0.5, 0])),
    "grid": Effect(lambda: {"blob": grid()}, ("blob.to_world", WAY)),
}  # fmt: skip


def room(*effects):
    """A floor, a block and a lamp with the effects in it."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "gaussian"}}
    pose = T.look_at([0.3, -3.4, 1.7], [0.0, 0.0, 0.5], [0, 0, 1])
    lamp = {"type": "rectangle", "to_world": T.translate([0.2, -0.2, 2.4]) @ T.rotate([1, 0, 0], 180) @ T.scale(0.5)}
    block = {"type": "cube", "to_world": T.translate([-0.1, 0.75, 0.31]) @ T.rotate([0, 0, 1], 25) @ T.scale(0.3)}
    objects = {name: value for effect in effects for name, value in EFFECTS[effect].objects().items()}
    texture = objects.pop("floor", rgb(0.6, 0.6, 0.6))
    return {
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": pose, "film": film},
        "floor": {"type": "rectangle", "to_world": T.scale(2.0), "bsdf": {"type": "diffuse", "reflectance": texture}},
        "lamp": {**lamp, "emitter": {"type": "area", "radiance": rgb(8.0, 8.0, 8.0)}},
        "block": {**block, "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)}},
        **objects,
    }


#: Pairs whose derivatives by what moves are refused, each with the sentence.
REFUSED = {
    ("rough glass", "curve"): "the smooth lobe behind the surface",
    ("rough glass", "grid"): "the smooth lobe behind the surface",
    ("smoke", "curve"): "what moves beside media is not followed where there is 'curve'",
    ("smoke", "grid"): "what moves beside media is not followed where there is 'blob'",
}
PAIRS = [pair for pair in itertools.combinations(EFFECTS, 2) if set(pair) != {"checkers", "bitmap"}]
register({f"together: {a}, {b}": lambda a=a, b=b: room(a, b) for a, b in PAIRS})


def cases(a: str, b: str) -> list[Case]:
    """Return the requests of a pair: the camera, and what each of the two brings."""
    moved = dict([("sensor.to_world", shifted(0.3, 0.2, 0.1)), EFFECTS[a].moves, EFFECTS[b].moves])
    scene = f"together: {a}, {b}"
    return [Case(scene, name, tangent, STEP, f"{a}, {b}", depth=DEPTH) for name, tangent in moved.items()]


def main(wanted: list[str]) -> None:
    """Print a line for each request of the pairs that hold all that is wanted."""
    pairs = [pair for pair in PAIRS if set(wanted) <= set(pair)]
    for pair in pairs:
        for case in cases(*pair):
            try:
                value, error, taken = measure(case)
            except (ValueError, AssertionError) as problem:
                print(f"{case.what}: {case.parameter}: {str(problem)[:300]}", flush=True)
                continue
            wrong = abs(value - 1.0) > STANDARD_ERRORS * error + REMAINDER
            mark = "***" if wrong else "noisy" if error > LARGEST_ERROR else ""
            print(f"{value:.4f} +- {error:.4f} {mark:5} {taken.spp:5} {case.what}: {case.parameter}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

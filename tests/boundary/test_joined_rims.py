"""Derivatives of cylinders that disks close, and of those that stand on a floor: rims that are no open edges."""

import numpy as np

from .measure import MODES, Case, assert_agrees, assert_transposes, derivatives, differences, rows
from .scenes import T, camera, diffuse, floor, load, register
from .test_exact_sphere import LIGHTS, entry

VIEW = camera((0.3, -2.6, 1.9), (0.0, 0.0, 0.35), fov=40.0)
TWO_SIDED = {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.3), "other": diffuse(0.3, 0.6, 0.5)}
CAP = {"type": "twosided", "bsdf": diffuse(0.2, 0.6, 0.8), "other": diffuse(0.8, 0.7, 0.2)}
#: An ellipse across; the axis leans to the viewer, or is upright.
ALOFT = T.translate([0.1, 0.0, 0.45]).rotate([1, -1, 0], 25.0)
UPRIGHT = T.translate([0.1, 0.0, 0.0]).rotate([0, 0, 1], 30.0)
SIZE = (0.4, 0.3, 0.6)


def closed(pose, light: str, ends: tuple[int, ...] = (1,), ground: dict | None = None):
    """A cylinder, with disks at some of its ends."""
    shapes = {"shape": {"type": "cylinder", "to_world": pose @ T.scale(list(SIZE)), "bsdf": TWO_SIDED}}
    for e in ends:
        at = T.translate([0.0, 0.0, e * SIZE[2]]) @ T.scale([SIZE[0], SIZE[1], 1.0])
        shapes[f"cap{e}"] = {"type": "disk", "to_world": pose @ at, "bsdf": CAP}
    whole = {name: {"exact": True, **shape} for name, shape in shapes.items()}
    return lambda: {"sensor": VIEW, "floor": ground or floor(half=2.0), **whole, **LIGHTS[light]()}


PLATE = {"type": "disk", "exact": True, "to_world": T.scale(2.0), "bsdf": diffuse(0.7, 0.6, 0.5)}
register(
    {
        **{f"lid, {light}": closed(ALOFT, light) for light in LIGHTS},
        **{f"cup, {light}": closed(ALOFT, light, (0,)) for light in LIGHTS},
        **{f"tin, {light}": closed(ALOFT, light, (0, 1)) for light in LIGHTS},
        **{f"standing, {light}": closed(UPRIGHT, light, ()) for light in LIGHTS},
        **{f"standing lid, {light}": closed(UPRIGHT, light) for light in LIGHTS},
        **{f"on a plate, {light}": closed(UPRIGHT, light, (), PLATE) for light in LIGHTS},
    }
)


def field(pose, linear):
    """A motion of all of space, x' = L (x - c) in the axes of a pose, c its origin: what joins stays together."""
    m = pose.matrix[:3, :3]
    g = np.zeros((4, 4))
    g[:3, :3] = m @ np.array(linear, np.float64) @ m.T
    g[:3, 3] = -g[:3, :3] @ pose.matrix[:3, 3]
    return lambda v: g @ v


def shift(x, y, z):
    g = np.zeros((4, 4))
    g[:3, 3] = x, y, z
    return lambda v: g @ v


def motions(pose):
    return {
        "radius": field(pose, np.diag([1.0, 1.0, 0.0])),
        "height": field(pose, np.diag([0.0, 0.0, 1.0])),
        "x": shift(1.0, 0.0, 0.0),
        "z": shift(0.0, 0.0, 1.0),
        "rotation": field(pose, [[0, -1, 0.5], [1, 0, 0], [-0.5, 0, 0]]),
        "turn": field(pose, [[0, -1, 0], [1, 0, 0], [0, 0, 0]]),
        "lean": field(pose, [[0, 0, 1], [0, 0, 0], [0, 0, 0]]),
    }

"""Scenes before a transient film, all of rectangles and diffuse, so that they share their kernels."""

import numpy as np

import warp_psdr as psdr

SIZE = 6
#: A film whose bins are the gate of the closed forms: 2.02 to 2.1, after a pulse of 0.03.
GATE = {"temporal_bins": 1, "bin_width_opl": 0.08, "start_opl": 2.02, "pulse_width_opl": 0.03}
#: One whose bins hold all light of the room at depth 3.
ROOM_BINS = {"temporal_bins": 40, "bin_width_opl": 0.25, "start_opl": 0.0}


def camera(origin, target, fov, size=SIZE, up=(0.0, 1.0, 0.0), **film):
    """A camera with a transient film, or with a steady one where the film has no bins."""
    kind = "transient_hdr_film" if film else "hdrfilm"
    return {
        "type": "perspective",
        "to_world": psdr.Transform.look_at(origin, target, up),
        "fov": fov,
        "film": {"type": kind, "width": size, "height": size, "rfilter": {"type": "box"}, **film},
    }


def paint(*rgb):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def plane(height=1.0, size=SIZE, **film):
    """A plane at a distance from a camera and a point light in one place; the film spans slopes of +-0.3."""
    fov = float(2.0 * np.degrees(np.arctan(0.3)))
    return psdr.load_dict(
        {
            "type": "scene",
            "camera": camera((0, 0, 0), (0, 0, -1), fov, size, **film),
            "lamp": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 1.0}},
            "plane": {
                "type": "rectangle",
                "to_world": psdr.Transform.translate((0, 0, -height)) @ psdr.Transform.scale((4, 4, 1)),
                "bsdf": paint(0.8, 0.8, 0.8),
            },
        }
    )


def wall(axis, sign, color):
    """The side of the cube [-1, 1]^3 at ``sign`` along an axis; it faces inwards."""
    turn = psdr.Transform.look_at(np.eye(3)[axis] * sign, (0, 0, 0), np.eye(3)[(axis + 1) % 3])
    return {"type": "rectangle", "to_world": turn, "bsdf": paint(*color)}


def room(light=None, size=SIZE, **film):
    """A convex room with a light in it, in which nothing hides anything."""
    light = light or {"type": "point", "position": [0.3, 0.5, 0.2], "intensity": {"type": "rgb", "value": [2, 3, 4]}}
    colors = np.random.default_rng(1).uniform(0.3, 0.9, (3, 2, 3))
    sides = {f"wall{a}{s}": wall(a, 2 * s - 1, colors[a, s]) for a in range(3) for s in range(2)}
    view = camera((0.1, 0.0, 0.7), (0, -0.2, -1), 60.0, size, **film)
    return psdr.load_dict({"type": "scene", "camera": view, "lamp": light, **sides})

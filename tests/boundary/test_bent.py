"""Interpolated normals at any depth: the terminator that other surfaces see."""

import numpy as np

from .scenes import SCENES, ball, camera, diffuse, floor, mesh, panel, sky


def glow():
    """A smooth ball above a floor: the floor is lit by the ball."""
    return {
        "sensor": camera((0.0, -2.5, 3.0), (0.0, 0.0, 0.0), fov=35.0),
        "floor": floor(bsdf=diffuse(0.7, 0.6, 0.5)),
        "shape": ball((0.2, 0.1, 0.75), 0.5, diffuse(0.9, 0.8, 0.7), 1, smooth=True),
        "light": panel((1.2, -0.4, 1.6), 0.3, 20.0),
    }


def hidden(subdivisions=1, two_sided=False, **bsdf):
    """A wall that sees a smooth ball which the camera does not see."""
    material = bsdf or diffuse(0.9, 0.8, 0.7)
    if two_sided:
        material = {"type": "twosided", "bsdf": material}
    wall = mesh([[-1, 1.5, 0], [1, 1.5, 0], [1, 1.5, 2], [-1, 1.5, 2]], [[0, 1, 2], [0, 2, 3]], diffuse(0.8))
    return {
        "sensor": camera((0.0, 0.4, 1.0), (0.0, 1.5, 1.0), fov=70.0),
        "wall": wall,
        "shape": ball((0.1, 0.8, 0.2), 0.4, material, subdivisions, smooth=True),
        "light": panel((1.1, 0.9, 1.6), 0.3, 30.0),
    }


def waves(two_sided=False, **bsdf):
    """A flat sheet with the normals of waves, seen by a wall alone."""
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 4), np.linspace(0.2, 1.3, 4))
    vertices = np.stack([x, y, 0.1 + 0.0 * x], axis=-1).reshape(-1, 3)
    tilt = 1.5 * np.cos(3.0 * np.arange(4))[:, None] * np.ones(4)
    normals = np.stack([0.3 * np.sin(5.0 * x), tilt, np.ones_like(x)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    i = np.array([4 * r + c for r in range(3) for c in range(3)])[:, None]
    faces = np.concatenate([i + np.array([0, 1, 5]), i + np.array([0, 5, 4])])
    material = bsdf or diffuse(0.9, 0.8, 0.7)
    material = {"type": "twosided", "bsdf": material} if two_sided else material
    return hidden() | {
        "shape": mesh(vertices, faces, material, normals=normals.astype(np.float32)),
        "light": sky() if two_sided else panel((0.3, 0.4, 1.2), 0.3, 30.0),
    }


SCENES |= {
    "waves": waves,
    "waves two-sided": lambda: waves(two_sided=True),
    "waves metal": lambda: waves(type="roughconductor", alpha=0.5),
    "glow": glow,
    "hidden": hidden,
    "hidden two-sided": lambda: hidden(two_sided=True),
    "hidden metal": lambda: hidden(type="roughconductor", alpha=0.4),
}

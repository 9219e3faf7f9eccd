"""Curves along which surfaces run through each other: found, and their part of the derivative."""

import numpy as np
import pytest

import warp_psdr as psdr
from warp_psdr.curves import scene_curves

from .measure import Case, assert_agrees, derivatives, differences, slope
from .scenes import SCENES, ball, box, camera, diffuse, floor, mesh, panel, sky
from .test_table import moved, scaled


def sunk(smooth=False, light=None, **more):
    """A ball half sunk into a floor."""
    return {
        "sensor": camera(),
        "floor": floor(bsdf=diffuse(0.8, 0.7, 0.3)),
        "shape": ball((0.1, 0.1, 0.2), 0.7, diffuse(0.3, 0.5, 0.8), 1, smooth),
        "light": light or panel((0.5, -0.3, 2.2), 0.35),
        **more,
    }


def post():
    """A turned box through a floor."""
    return sunk() | {"shape": box((0.1, 0.0, 0.15), (0.4, 0.3, 0.5), diffuse(0.3, 0.5, 0.8), 0.4)}


def behind():
    """A wall lit by a floor and a box in it, which the camera does not see: nothing but deeper vertices counts."""
    wall = mesh([[-1, 1.5, 0], [1, 1.5, 0], [1, 1.5, 2], [-1, 1.5, 2]], [[0, 1, 2], [0, 2, 3]], diffuse(0.8))
    return {
        "sensor": camera((0.0, -0.5, 1.6), (0.0, 1.5, 1.6), fov=25.0),
        "wall": wall,
        "floor": floor(bsdf=diffuse(0.8, 0.7, 0.3), half=1.5),
        "shape": box((0.1, 1.0, 0.0), (0.4, 0.25, 0.4), diffuse(0.2, 0.5, 0.8), 0.4),
        "light": panel((0.5, 0.3, 2.4), 0.4, 20.0),
    }


def knot(smooth=False):
    """Two balls of one mesh that run through each other."""
    a, b = ball((-0.35, 0, 0.6), 0.5, None, 1), ball((0.3, 0.1, 0.7), 0.4, None, 1)
    vertices = np.concatenate([a["vertices"], b["vertices"]])
    faces = np.concatenate([a["faces"], b["faces"] + len(a["vertices"])])
    return sunk() | {"shape": mesh(vertices, faces, diffuse(0.3, 0.5, 0.8), face_normals=not smooth)}


def lamp():
    """A glowing box through a black floor, seen by its light on a wall."""
    glow = {"type": "area", "radiance": {"type": "rgb", "value": [4.0, 3.0, 2.0]}}
    return {
        **{k: v for k, v in behind().items() if k != "light"},
        "floor": floor(bsdf=diffuse(0.0), half=1.5),
        "shape": {**box((0.1, 0.7, 0.0), (0.4, 0.25, 0.4), diffuse(0.0), 0.4), "emitter": glow},
    }


SCENES |= {
    "sunk": sunk,
    "sunk smooth": lambda: sunk(True),
    "post": post,
    "behind": behind,
    "knot": knot,
    "lamp": lamp,
    "sunk sky": lambda: sunk(light=sky()),
}

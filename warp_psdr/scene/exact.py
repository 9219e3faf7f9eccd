"""Shapes without triangles: their description, and their points.

In place of vertices such a shape has the corners of a box around it, which move with it. Code that asks how large a
scene is, and where, finds these corners among the points of the scene. No triangle and no parameter uses them.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.affine import update_primitive
from warp_psdr.kernels.primitive.cubic_grid import CUBIC_GRID
from warp_psdr.kernels.primitive.curve_kinds import CONES, TUBES
from warp_psdr.kernels.primitive.cylinder import CYLINDER
from warp_psdr.kernels.primitive.disk import DISK
from warp_psdr.kernels.primitive.linear_grid import LINEAR_GRID
from warp_psdr.kernels.primitive.network_kind import NETWORK
from warp_psdr.kernels.primitive.sphere import SPHERE

from .curve_points import held_curve_point
from .description import ShapeDescription
from .errors import error
from .primitives import PRIMITIVES, surface_area
from .transforms import transform_points

if TYPE_CHECKING:
    from . import bsdfs
    from .plugins import Properties
    from .scene import Scene

#: Plugin that may be exact -> its kind on the device.
EXACT = {"sphere": SPHERE.number, "disk": DISK.number, "cylinder": CYLINDER.number}
#: The same of all shapes without triangles.
KINDS = {
    **EXACT,
    "sdfgrid": LINEAR_GRID.number,
    "cubic sdfgrid": CUBIC_GRID.number,
    "linearcurve": CONES.number,
    "bsplinecurve": TUBES.number,
    "neuralsdf": NETWORK.number,
}
#: Corners of the box around each kind, in its own coordinates.
CORNERS = {
    "sphere": np.array(list(itertools.product((-1.0, 1.0), repeat=3)), np.float32),
    "disk": np.array(list(itertools.product((-1.0, 1.0), (-1.0, 1.0), (0.0,))), np.float32),
    "cylinder": np.array(list(itertools.product((-1.0, 1.0), (-1.0, 1.0), (0.0, 1.0))), np.float32),
}
#: What a pose has to have.
INVERTIBLE = "give all three columns an extent; that of a 'disk' along its normal is free"
#: Segments of the tessellation whose area stands for that of an exact shape, by which lights are chosen.
AREA_SEGMENTS = 128
#: Volume of the pose over the product of the lengths of its columns, up to which it has no inverse in float32.
FLAT = 1.0e-6


def is_exact(props: Properties) -> bool:
    """Return whether a plugin asks to be exact.

    Raises:
        ValueError: it also asks for what only triangles have.
    """
    if props.type not in EXACT or not props.boolean("exact", False):
        return False
    for key in ("resolution", "face_normals"):
        if props.has(key):
            raise error(
                props.where,
                f"'exact' beside '{key}'",
                "an exact shape has no triangles; leave out one of the two",
            )
    return True


def exact_shape(props: Properties, to_world: np.ndarray, bsdf: bsdfs.BsdfDescription) -> ShapeDescription:
    """Return the shape, to which its light and its sides are added.

    Raises:
        ValueError: its pose has no inverse.
    """
    reason = singular(to_world)
    if reason:
        instead = "give it an extent along all axes, or use a 'disk'" if props.type == "sphere" else INVERTIBLE
        raise error(props.where, reason, instead)
    return ShapeDescription(
        path=props.path,
        kind=props.type,
        vertices=transform_points(to_world, CORNERS[props.type]).astype(np.float32),
        faces=np.zeros((0, 3), np.int32),
        bsdf=bsdf,
        to_world=to_world.astype(np.float32),
        local_vertices=CORNERS[props.type],
        primitive=props.type,
    )


def exact_area(kind: str, box: np.ndarray) -> float:
    """Return the area of an exact shape, to a relative 1e-4; ``box``: the corners around it, (N, 3)."""
    linear = np.linalg.lstsq(np.pad(CORNERS[kind].astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0), box)[0]
    pose = np.eye(4)
    pose[:3, :3] = linear[:3].T
    source = PRIMITIVES[kind](AREA_SEGMENTS)
    return surface_area(source.vertices, source.faces, pose)


def singular(to_world: np.ndarray) -> str:
    """Return what is wrong with a pose (4, 4); empty: nothing."""
    linear = np.asarray(to_world, np.float64)[:3, :3]
    if not np.isfinite(to_world).all():
        return f"its to_world is not finite: {np.asarray(to_world).tolist()}"
    lengths = np.linalg.norm(linear, axis=0)
    if not (lengths > 0.0).all() or abs(np.linalg.det(linear / np.maximum(lengths, 1e-300))) <= FLAT:
        return f"its to_world has no inverse: {np.asarray(to_world).tolist()}"
    return ""


def update_record(scene: Scene, shape: int) -> None:
    """Write the record of a shape of a scene from its pose; these records follow those of the triangles.

    Raises:
        ValueError: its pose has no inverse.
    """
    pose, s = scene.poses.offsets(shape)[0], scene.description.shapes[shape]
    # Of curves the record holds a box around them.
    pose = scene.builder.curves.get(shape, pose)
    reason = "" if s.curves is not None else singular(scene.values[pose : pose + 16].numpy().reshape(4, 4))
    if reason:
        raise ValueError(f"{s.path}.to_world: {reason}; restore a pose that has one")
    place = scene.face_count + scene.builder.primitives.index(shape)
    inputs = [scene.values, pose, shape, KINDS[s.primitive], scene.builder.shapes[shape].orientation, place]
    launch(update_primitive, dim=1, inputs=inputs, outputs=[scene.triangles], device=scene.device)


def sphere_points(u, v) -> np.ndarray:
    """Return points (..., 3) of the unit sphere with octahedral coordinates (``kernels/primitive/sphere.py``)."""
    u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
    z = 1.0 - np.abs(u) - np.abs(v)
    x = np.where(z < 0.0, np.where(u < 0.0, np.abs(v) - 1.0, 1.0 - np.abs(v)), u)
    y = np.where(z < 0.0, np.where(v < 0.0, np.abs(u) - 1.0, 1.0 - np.abs(u)), v)
    q = np.stack([x, y, z], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def held_points(u, v) -> np.ndarray:
    """Return the points (..., 3) of a grid's box that pairs of numbers hold (``kernels/primitive/sdfgrid.py``)."""
    a, b = (np.ascontiguousarray(x, np.float32).view(np.uint32) for x in (u, v))
    low = ((a >> 21) & 511) | ((a >> 31) << 9)
    high = ((b >> 21) & 511) | ((b >> 31) << 9)
    steps = np.stack([a & 0x1FFFFF, b & 0x1FFFFF, low | (high << 10)], axis=-1).astype(np.float64)
    points = (steps + 0.5) / np.array([2.0**21, 2.0**21, 2.0**20])
    return points.reshape(*np.shape(u), 3)


def disk_points(u, v) -> np.ndarray:
    """Return points (..., 3) of the unit disk (``kernels/primitive/disk.py``)."""
    return np.stack([u, v, np.zeros_like(u)], axis=-1)


def cylinder_points(u, v) -> np.ndarray:
    """Return points (..., 3) of the unit cylinder (``kernels/primitive/cylinder.py``)."""
    return np.stack([np.cos(u), np.sin(u), v], axis=-1)


#: Kind -> its points by the two numbers that a vertex holds.
POINTS = {
    SPHERE.number: sphere_points,
    LINEAR_GRID.number: held_points,
    CUBIC_GRID.number: held_points,
    NETWORK.number: held_points,
    DISK.number: disk_points,
    CYLINDER.number: cylinder_points,
}


def position_of(scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
    """Return the point (3,) that a vertex holds, in the device's coordinates; ``record`` is that of its face."""
    if record["shape"] in scene.builder.curves:
        return held_curve_point(scene, int(record["shape"]), held_points(u, v))
    if record["i1"] >= 0:
        return (1.0 - u - v) * record["p0"] + u * record["p1"] + v * record["p2"]
    q = POINTS[-1 - int(record["i1"])](u, v)
    return record["normal"] + q[0] * record["p0"] + q[1] * record["p1"] + q[2] * record["p2"]

"""Curves with a radius as triangles, and gradients by their control points on them, for the viewer."""

from __future__ import annotations

import numpy as np

from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.view.fields import Field

#: Rings of a segment beside the first one, cubic and straight, and corners of a ring.
RINGS, SIDES = {True: 4, False: 1}, 10


def _weights(curves: Curves) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of a segment's control points at its rings, (R, K), and their derivatives along it."""
    v = np.linspace(0.0, 1.0, RINGS[curves.cubic] + 1)
    if not curves.cubic:
        one = np.ones_like(v)
        return np.stack([1.0 - v, v], axis=1), np.stack([-one, one], axis=1)
    at = [(1 - v) ** 3, 3 * v**3 - 6 * v**2 + 4, -3 * v**3 + 3 * v**2 + 3 * v + 1, v**3]
    along = [-3 * (1 - v) ** 2, 9 * v**2 - 12 * v, -9 * v**2 + 6 * v + 3, 3 * v**2]
    return np.stack(at, axis=1) / 6.0, np.stack(along, axis=1) / 6.0


def tube_mesh(curves: Curves, points: np.ndarray, to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the triangles of tubes, open at their ends.

    Args:
        curves: their segments.
        points: (P, 4) control points in their own coordinates.
        to_world: (4, 4).

    Returns:
        Vertices (N, 3) and faces (M, 3), in the world, and the directions (N, 3) from the axis to the vertices.
    """
    at, along = _weights(curves)
    world = np.column_stack([points[:, :3] @ to_world[:3, :3].T + to_world[:3, 3], points[:, 3]])
    legs = world[curves.firsts[:, None] + np.arange(at.shape[1])]
    centers = np.einsum("rk,skc->src", at, legs)
    axes = np.einsum("rk,skc->src", along, legs)[..., :3]
    axes /= np.maximum(np.linalg.norm(axes, axis=2, keepdims=True), 1e-30)
    least = np.eye(3)[np.abs(axes).argmin(axis=2)]
    across = np.cross(axes, least)
    across /= np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-30)
    # One frame is carried along a segment, so that its strips do not twist.
    for k in range(1, across.shape[1]):
        carried = across[:, k - 1] - (across[:, k - 1] * axes[:, k]).sum(axis=1, keepdims=True) * axes[:, k]
        across[:, k] = carried / np.maximum(np.linalg.norm(carried, axis=1, keepdims=True), 1e-30)
    turn = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)[:, None]
    up = np.cross(axes, across)
    out = np.cos(turn) * across[:, :, None] + np.sin(turn) * up[:, :, None]
    vertices = centers[:, :, None, :3] + centers[:, :, None, 3:] * out
    segments, rings = centers.shape[:2]
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(SIDES), indexing="ij")
    quads = np.stack([ring * SIDES + side, ring * SIDES + (side + 1) % SIDES], axis=-1).reshape(-1, 2)
    faces = np.concatenate([
        np.stack([quads[:, 0], quads[:, 1], quads[:, 1] + SIDES], axis=1),
        np.stack([quads[:, 0], quads[:, 1] + SIDES, quads[:, 0] + SIDES], axis=1),
    ])  # fmt: skip
    whole = (faces[None] + (np.arange(segments) * rings * SIDES)[:, None, None]).reshape(-1, 3)
    return vertices.reshape(-1, 3), whole, out.reshape(-1, 3)


def tube_field(
    curves: Curves, points: np.ndarray, to_world: np.ndarray, gradient: np.ndarray
) -> tuple[Field, np.ndarray, np.ndarray]:
    """Return a gradient by control points, (P, 4), on the tubes.

    It is interpolated as the control points are. Of places and radii together a vertex shows the component along the
    direction from the axis: how the value grows as the surface moves outwards there.

    Returns:
        The field, the vectors (N, 3) of the places alone at its vertices, and the directions from the axis (N, 3).
    """
    vertices, faces, out = tube_mesh(curves, points, to_world)
    at = _weights(curves)[0]
    rows = gradient[curves.firsts[:, None] + np.arange(at.shape[1])]
    held = np.repeat(np.einsum("rk,skc->src", at, rows).reshape(-1, 4), SIDES, axis=0)
    vectors = held[:, :3] @ np.linalg.inv(to_world[:3, :3])
    values = (vectors * out).sum(axis=1) + held[:, 3]
    return Field(vertices, faces, values, "vertex", "component outwards, radii included"), vectors, out

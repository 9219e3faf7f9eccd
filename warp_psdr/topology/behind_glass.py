"""Lights of no area all of whose light meets mirrors or glass first, so that no camera path finds any of it.

Rays that leave a light, spread evenly over what it lights, are followed to the first surface. The answer rests on these
samples, and is computed once for a scene, as it is then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.constants import EMITTER_DIRECTIONAL, EMITTER_POINT, EMITTER_PROJECTOR, SPOTS
from warp_psdr.scene.materials.bsdfs import model_of

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Emitter
    from warp_psdr.scene.scene import Scene

#: Rays of a light, and the most tests of a ray with a triangle for one: some tenths of a second.
RAYS, MOST_TESTS = 64, 4_000_000
#: Angle between neighbours of a spiral of evenly spread points.
GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def lights_behind_glass(scene: Scene) -> tuple[str, ...]:
    """Return the paths of lights of no area whose rays meet but mirrors and glass first; kept with the scene."""
    kept: tuple[str, ...] | None = scene.__dict__.get("_behind_glass")
    if kept is None:
        emitters = zip(scene.description.emitters, scene.builder.emitters, strict=True)
        kept = tuple(described.path for described, record in emitters if _is_behind(scene, record))
        scene.__dict__["_behind_glass"] = kept
    return kept


def _is_behind(scene: Scene, record: Emitter) -> bool:
    rays = _rays(scene, record)
    sides = [[model_of(side) for side in shape.bsdf.sides] for shape in scene.description.shapes]
    # What light passes unturned hides nothing from next-event estimation.
    passed = np.array([all(model.has_null and not model.has_smooth for model in models) for models in sides], bool)
    sharp = np.array([not any(model.has_smooth for model in models) for models in sides], bool)
    of_face = scene.builder.face_shape[: len(scene.builder.indices)]
    corners = scene.points.astype(np.float64)[scene.builder.indices[~passed[of_face]]]
    of_face = of_face[~passed[of_face]]
    if rays is None or not len(corners) or RAYS * len(corners) > MOST_TESTS:
        return False
    met = [_first(o, d, corners) for o, d in zip(*rays, strict=True)]
    found = [bool(sharp[of_face[face]]) for face in met if face >= 0]
    return bool(found) and all(found)


def _rays(scene: Scene, record: Emitter) -> tuple[np.ndarray, np.ndarray] | None:
    """Return origins and directions, (RAYS, 3) each; None: the light has an area, or none of its own place."""
    values = scene.values.numpy()
    share = (np.arange(RAYS) + 0.5) / RAYS
    turn = GOLDEN * np.arange(RAYS)
    if record.kind == EMITTER_POINT:
        height, origin = 1.0 - 2.0 * share, values[record.to_world : record.to_world + 3]
        wide = np.sqrt(1.0 - height**2)
        return np.tile(origin, (RAYS, 1)), np.stack([wide * np.cos(turn), wide * np.sin(turn), height], axis=1)
    if record.kind not in (*SPOTS, EMITTER_PROJECTOR, EMITTER_DIRECTIONAL):
        return None
    pose = values[record.to_world : record.to_world + 16].reshape(4, 4).astype(np.float64)
    # Points of a disk across the axis: of rays from infinity, of a cone, of the circle around a projector's image.
    x, y = np.sqrt(share) * np.cos(turn), np.sqrt(share) * np.sin(turn)
    if record.kind == EMITTER_DIRECTIONAL:
        axis = pose[:3, 2] / np.linalg.norm(pose[:3, 2])
        across = np.linalg.svd(axis[None])[2][1:]
        center = 0.5 * (scene.points.min(axis=0) + scene.points.max(axis=0))
        disk = center - 2.0 * scene.radius * axis + scene.radius * np.stack([x, y], axis=1) @ across
        return disk, np.tile(axis, (RAYS, 1))
    half = np.radians(0.5 * values[record.cutoff] if record.kind == EMITTER_PROJECTOR else values[record.cutoff])
    local = np.stack([np.tan(min(half, 1.5)) * x, np.tan(min(half, 1.5)) * y, np.ones(RAYS)], axis=1)
    directions = local @ pose[:3, :3].T
    return np.tile(pose[:3, 3], (RAYS, 1)), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _first(o: np.ndarray, d: np.ndarray, corners: np.ndarray) -> int:
    """Return the number of the triangle that a ray meets first; -1: none."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p, s = np.cross(d, b), o - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("ij,ij->i", a, p)
        u = np.einsum("ij,ij->i", s, p) * inverse
        q = np.cross(s, a)
        v, t = (q @ d) * inverse, np.einsum("ij,ij->i", b, q) * inverse
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    return int(np.argmin(np.where(inside, t, np.inf))) if inside.any() else -1

"""The edges of a scene with media, those of interfaces left out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.absent import absent_faces
from warp_psdr.topology.contacts import along_sides
from warp_psdr.topology.edges import Adjacency, moving_edges, scene_adjacency, select, upload, without
from warp_psdr.topology.intersection_curves import moving_curves, scene_curves
from warp_psdr.topology.secondary_edges import MOVING_SHARE, set_beside

if TYPE_CHECKING:
    from warp_psdr.kernels.boundary.local_form import Edges
    from warp_psdr.scene.scene import Scene


def edges_there(scene: Scene) -> Adjacency:
    """Return the edges of what is there."""
    return without(scene_adjacency(scene), absent_faces(scene))


def secondary_edges_there(scene: Scene, shapes: set[int]) -> Edges | None:
    """Return those that can be a silhouette for some path vertex, drawn as in ``secondary_edges.py``; None: none."""
    edges = edges_there(scene)
    weight = edges.length * edges.wedge
    keep = np.flatnonzero(weight > 0.0)
    if not len(keep):
        return None
    p = weight[keep] / weight[keep].sum()
    of_moving = np.where(moving_edges(scene, edges, shapes)[keep], p, 0.0)
    if of_moving.sum() > 0.0:
        p = (1.0 - MOVING_SHARE) * p + MOVING_SHARE * of_moving / of_moving.sum()
    found = upload(scene, edges, keep, p, np.zeros(len(keep)), np.ones(len(keep)))
    set_beside(scene, found, edges, keep)
    return found


def curves_there(scene: Scene) -> Adjacency:
    """Return the curves in which surfaces that are there run through each other."""
    curves = scene_curves(scene)
    return select(curves, np.flatnonzero(~absent_faces(scene)[curves.faces.reshape(-1, 2)].any(axis=1)))


def pierced(scene: Scene, shapes: set[int] | None = None) -> str:
    """Say of what is there which shapes run through each other, one of some if they are given; empty: none."""
    curves = curves_there(scene)
    found = curves if shapes is None else select(curves, np.flatnonzero(moving_curves(scene, curves, shapes)))
    if not len(found.length):
        return ""
    a, b = (scene.description.shapes[i].path for i in scene.builder.face_shape[found.faces[:2]])
    return f"{a!r} and {b!r} run through each other"


def joined(scene: Scene) -> str:
    """Say of what is there which shapes run through each other or have edges along each other; empty: none."""
    absent, of = absent_faces(scene), scene.builder.face_shape
    for sides in along_sides(scene).tolist():
        face = [side // 3 for side in sides]
        if not absent[face].any():
            a, b = (scene.description.shapes[of[i]].path for i in face)
            return f"{a!r} and {b!r} have edges along each other"
    return pierced(scene)

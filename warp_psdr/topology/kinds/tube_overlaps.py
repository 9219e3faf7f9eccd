"""Curves of intersection of tubes that the boundary term leaves out, as a share of the outlines.

Where two segments run through each other, their common curve is known (``tube_pairs.py``). One segment of a B-spline
that crosses itself has none, and no curve of two tubes is followed through smooth mirrors and glass. The length that
is left out is bounded by 2 l + 4 pi r: l is the length of one axis inside of the other tube, piece by piece, and r the
smaller radius, of the circles where they leave each other. The share is this over the length of the silhouettes, two
along each tube. What lies inside of a closed and opaque mesh, with the camera outside, is not seen, and counts in
neither.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.curves_overlap import find_buried
from warp_psdr.scene.kinds.curve import Curves
from warp_psdr.scene.load import SceneWarning
from warp_psdr.scene.materials.bsdfs import model_of
from warp_psdr.topology.camera_view import CameraView, camera_view
from warp_psdr.topology.edges import scene_adjacency
from warp_psdr.topology.kinds.tube_items import curve_shapes, follows
from warp_psdr.topology.tube_contacts import cones_along, overlapping
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Largest share of the silhouettes' length that gradients leave out.
LARGEST_SHARE = 0.02


@dataclass(frozen=True)
class Overlaps:
    """Tubes that run through each other in sight, along curves without a term.

    Attributes:
        share: bound of the length of their curves of intersection, over that of the silhouettes.
        pair: the two that have the longest one, in words.
        others: how many pairs of tubes there are besides.
    """

    share: float
    pair: str
    others: int

    def described(self) -> str:
        """Name the pair, and count the others."""
        more = f" and {self.others} more pair{'s' * (self.others > 1)}" if self.others else ""
        return f"{self.pair}{more} run through each other"

    def problem(self) -> str:
        """Say what keeps gradients from leaving the curves out; empty: nothing."""
        if self.share <= LARGEST_SHARE:
            return ""
        share = f"up to {self.share:.1%} of the length of their silhouettes, and {LARGEST_SHARE:.0%} may be left out"
        return f"{self.described()}, along curves that move: {share}; move them apart"

    def tell(self, scene: Scene) -> tuple[str, str, str]:
        """Return the plan's line.

        Warns:
            SceneWarning: with its text; once a scene.
        """
        share = f"up to {self.share:.2%} of the length of their silhouettes"
        if not scene.__dict__.get("_told_overlaps"):
            scene.__dict__["_told_overlaps"] = True
            text = f"{self.described()}; derivatives leave out their common curves, {share}"
            warnings.warn(text, SceneWarning, stacklevel=6)
        return "crossing tubes", "their common curves are left out", f"{share}: {self.described()}"


def tube_overlaps(scene: Scene, sensor: int, mirrors: bool | None = None) -> Overlaps | None:
    """Return what tubes that run through each other leave out before a camera; None: nothing.

    ``mirrors``: beside smooth mirrors and glass; None: as the scene says.
    """
    if not curve_shapes(scene):
        return None
    if mirrors is None:
        mirrors = any(model_of(b).has_delta for s in scene.description.shapes for b in s.bsdf.sides)
    view = camera_view(scene, sensor)
    return kept(scene, ("tube overlaps", view.numbers(), mirrors), lambda: _found(scene, view, mirrors))


def _found(scene: Scene, view: CameraView, mirrors: bool) -> Overlaps | None:
    found = curve_shapes(scene)
    meshes = None
    total, longest, named, count = 0.0, 0.0, "", 0
    for number, i in enumerate(found):
        for j in found[number:]:
            pairs, places, lengths = overlapping(scene, i, j)
            if not mirrors:
                own = (i == j) & (pairs[:, 0] == pairs[:, 1])
                pairs, places, lengths = pairs[own], places[own], lengths[own]
            if not len(pairs):
                continue
            meshes = _closed(scene, view) if meshes is None else meshes
            seen = ~_buried(scene, meshes, places)
            rows, of = np.unique(pairs[seen], axis=0, return_inverse=True)
            if not len(rows):
                continue
            least = np.zeros(len(rows))
            np.maximum.at(least, of.reshape(-1), lengths[seen, 1])
            bound = 2.0 * np.bincount(of.reshape(-1), lengths[seen, 0]) + 4.0 * np.pi * least
            numbers = np.stack([_numbers(scene, k)[rows[:, n]] for n, k in enumerate((i, j))], axis=1)
            tubes, of = np.unique(numbers, axis=0, return_inverse=True)
            sums = np.bincount(of.reshape(-1), bound)
            total, count = total + float(sums.sum()), count + len(tubes)
            if sums.max() > longest:
                longest, (a, b) = float(sums.max()), tubes[sums.argmax()]
                paths = [scene.description.shapes[k].path for k in (i, j)]
                several = f"curve {a} of {paths[0]!r} and curve {b} of {paths[1]!r}"
                named = several if i != j else f"curves {a} and {b} of {paths[0]!r}"
                named = named if i != j or a != b else f"two parts of curve {a} of {paths[0]!r}"
    if not count:
        return None
    length = sum(_outline(scene, meshes or [], i) for i in found)
    return Overlaps(total / length if length > 0.0 else np.inf, named, count - 1)


def _numbers(scene: Scene, shape: int) -> np.ndarray:
    """Return the numbers (S,) of the curves that segments belong to."""
    curves = scene.geometry(shape)
    assert isinstance(curves, Curves)
    return np.concatenate([[0], np.cumsum(~follows(curves.firsts))[:-1]])


def _closed(scene: Scene, view: CameraView) -> list[wp.Mesh]:
    """Return the closed meshes that no light passes, and outside of which the camera is."""
    if not view.finite:
        return []
    edges, owners = scene_adjacency(scene), scene.builder.face_shape
    of = owners[edges.faces]
    first = edges.first[:-1]
    low, high = np.minimum.reduceat(of, first), np.maximum.reduceat(of, first)
    good = (np.diff(edges.first) == 2) & (low == high)
    opened = set(np.unique(low[~good])) | set(np.unique(high[~good]))
    eye = np.append(view.eye, view.radius).astype(np.float32)[None]
    found = []
    for i, shape in enumerate(scene.description.shapes):
        models = [model_of(b) for b in shape.bsdf.sides]
        rows = owners == i
        if i in opened or not rows.any() or any(m.transmits or m.passes for m in models):
            continue
        points = wp.array(scene.points.astype(np.float32), dtype=wp.vec3, device=scene.device)
        indices = wp.array(scene.builder.indices[rows].reshape(-1), dtype=wp.int32, device=scene.device)
        mesh = wp.Mesh(points, indices, support_winding_number=True)
        if not _buried(scene, [mesh], eye).any():
            found.append(mesh)
    return found


def _buried(scene: Scene, meshes: list[wp.Mesh], places: np.ndarray) -> np.ndarray:
    """Return which spheres (N, 4) are inside of one of some closed meshes."""
    spheres = wp.array(np.ascontiguousarray(places, np.float32), dtype=wp.vec4, device=scene.device)
    buried = wp.zeros(len(places), dtype=wp.int32, device=scene.device)
    for mesh in meshes:
        launch(find_buried, len(places), [mesh.id, spheres], [buried], device=scene.device)
    return buried.numpy() != 0


def _outline(scene: Scene, meshes: list[wp.Mesh], shape: int) -> float:
    """Return the length of the silhouettes of curves that are not inside of closed meshes."""
    cones = cones_along(scene, shape)
    seen = ~_buried(scene, meshes, cones.mean(axis=1))
    return 2.0 * float(np.linalg.norm(cones[seen, 1, :3] - cones[seen, 0, :3], axis=1).sum())

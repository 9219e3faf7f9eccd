"""All curves of intersection between shapes without triangles and other surfaces, on the device."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels.boundary.crossing.curve import CrossingCurves
from warp_psdr.scene.lights.light_sampling import cumulative
from warp_psdr.topology.crossing_curves import Chords, cut, cut_grid, pierced_faces
from warp_psdr.topology.crossing_fields import exact_field
from warp_psdr.topology.crossing_pairs import cut_pair, exact_pairs
from warp_psdr.topology.kinds.exact_shapes import crossable_shapes
from warp_psdr.topology.kinds.grid_silhouettes import grid_shapes
from warp_psdr.topology.kinds.tube_items import curve_shapes
from warp_psdr.topology.tube_crossings import cut_tubes
from warp_psdr.topology.tube_pairs import cut_tube_pairs
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene


def crossings(scene: Scene, shapes: frozenset[int] | None) -> CrossingCurves | None:
    """Return where shapes without triangles are run through, one of a pair in ``shapes`` (None: any); None: nowhere."""
    return kept(scene, ("crossings", shapes), lambda: _crossings(scene, shapes))


def _crossings(scene: Scene, shapes: frozenset[int] | None) -> CrossingCurves | None:
    found = []
    corners = scene.points[scene.builder.indices].astype(np.float64)
    for i in crossable_shapes(scene):
        rows = pierced_faces(scene, i, shapes)
        found.append((i, cut(exact_field(scene, i), corners[rows], rows)))
    for i in grid_shapes(scene):
        # All that runs through a grid which moves counts, as if anything did.
        moved = None if shapes is None or i in shapes else shapes
        found.append((i, kept(scene, ("cut grid", i, moved), functools.partial(cut_grid, scene, i, moved))))
    found += [(j, cut_pair(scene, i, j)) for i, j in exact_pairs(scene, shapes)]
    curves = curve_shapes(scene)
    tubes = [(i, *_beside_others(*cut_tubes(scene, i, shapes))) for i in curves]
    for n, i in enumerate(curves):
        for j in curves[n:]:
            if shapes is None or i in shapes or j in shapes:
                tubes.append(
                    (j, *kept(scene, ("cut tube pairs", i, j), functools.partial(cut_tube_pairs, scene, i, j)))
                )
    others = sum(len(chords.faces) for _shape, chords in found)
    segments = np.concatenate([np.zeros((others, 2), np.int64), *(t[2] for t in tubes)])
    places = np.concatenate([np.zeros((others, 2)), *(t[3] for t in tubes)])
    return _upload(scene, [*found, *(t[:2] for t in tubes)], segments, places)


def _beside_others(chords: Chords, segments: np.ndarray, places: np.ndarray) -> tuple[Chords, np.ndarray, np.ndarray]:
    """Return chords of tubes and meshes with the segments and places of both."""
    return chords, np.stack([0 * segments, segments], axis=1), np.stack([0.0 * places, places], axis=1)


def _upload(
    scene: Scene, found: list[tuple[int, Chords]], segments: np.ndarray, places: np.ndarray
) -> CrossingCurves | None:
    """Return chords on shapes, by their numbers, on the device; None: there are none."""
    if not len(segments):
        return None
    records = [np.full(len(c.faces), scene.face_count + scene.builder.primitives.index(i)) for i, c in found]
    faces = np.stack([np.concatenate([c.faces for _i, c in found]), np.concatenate(records)], axis=1)
    points = np.concatenate([c.points for _i, c in found])
    spans = np.concatenate([c.spans for _i, c in found]).astype(np.float32)
    curves = CrossingCurves()
    length = np.linalg.norm(points[:, 1] - points[:, 0], axis=1) * (spans[:, 1] - spans[:, 0])
    curves.cdf = wp.array(cumulative(length), dtype=wp.float32, device=scene.device)
    curves.points = wp.array(points.astype(np.float32), dtype=wp.vec3, device=scene.device, ndim=2)
    curves.faces = wp.array(faces.astype(np.int32), dtype=wp.vec2i, device=scene.device)
    curves.segments = wp.array(segments.astype(np.int32), dtype=wp.vec2i, device=scene.device)
    curves.places = wp.array(places.astype(np.float32), dtype=wp.vec2, device=scene.device)
    curves.low, curves.high = (
        wp.array(np.ascontiguousarray(spans[:, e]), dtype=wp.float32, device=scene.device) for e in (0, 1)
    )
    return curves

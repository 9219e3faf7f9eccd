"""Curves of intersection between meshes and tubes: chords, as those of ``crossing_curves.py``.

Each pair of a triangle and a segment that may meet is cut by itself, with the segment's own field phi = |x - c(v)| -
r(v). The position v is searched a little beyond both ends, so that chords continue to where the next segment begins.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.scene.kinds.bsplinecurve import coefficients
from warp_psdr.scene.kinds.curve import Curves, world_points
from warp_psdr.topology.crossing_curves import Chords, cut
from warp_psdr.topology.crossing_fields import Field
from warp_psdr.topology.kinds.exact_shapes import least_distance
from warp_psdr.topology.kinds.tube_items import curve_shapes, follows
from warp_psdr.topology.tube_contacts import pierced_segments

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Longest side of a small triangle, over the radius where the triangle's plane passes the tube, and the least radius,
#: over that of the segment, that counts there.
FINE_TUBE, LEAST_RADIUS = 0.5, 0.02
#: Steps to a root; the kernels go on from there.
STEPS = 4
#: Places of an axis by which it is measured; of these, at which a point's is looked for first; Newton's steps from the
#: best one.
PLACES, LOOKS, NEWTON = 9, 6, 3
#: How far beyond the ends of a segment places go, over the radius, at least and at most of its length.
BEYOND, LEAST_BEYOND, MOST_BEYOND = 0.5, 0.02, 0.45
#: Depth in a neighbour, over the radius, below which straight segments are not looked at.
HIDDEN = 0.03
#: Pairs that are cut at once.
PAIRS = 1024
#: Chords of a whole ring, steps to each of its points, and how near these have to be, over the radius.
RING, RING_STEPS, ON_TUBE = 32, 8, 1.0e-4
#: Least cosine between axis and normal for which a ring is looked for; how far the axis has to be from the triangle's
#: plane where it is farther than the second number times the ring's reach from its middle, over the radius.
TRANSVERSAL, APART, REACH = 0.3, 1.1, 1.5
#: Points of a rim, of which no two neighbours may lie on a triangle, and how near that is, over the radius.
RIM_POINTS, ALONG = 48, 1.0e-3


def _polynomial(a: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return (..., N, D), at places (..., N), polynomials with the coefficients (K, N, D)."""
    value = a[-1] + 0.0 * v[..., None]
    for k in range(len(a) - 2, -1, -1):
        value = a[k] + v[..., None] * value
    return value


def _cone(a: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (N,), anywhere, whose spheres points (N, 3) belong to, and how far outside these are."""
    b, q = a[1], p - a[0, :, :3]
    squared = np.maximum((b[:, :3] ** 2).sum(axis=1), 1e-300)
    along = (q * b[:, :3]).sum(axis=1) / squared
    beside = np.linalg.norm(q - along[:, None] * b[:, :3], axis=1)
    v = along + beside * b[:, 3] / np.sqrt(np.maximum(squared * (squared - b[:, 3] ** 2), 1e-300))
    here = _polynomial(a, np.clip(v, 0.0, 1.0))
    return v, np.linalg.norm(p - here[:, :3], axis=1) - here[:, 3]


class TubeSegments:
    """Segments of curves (P of them, any may come twice) in the world, as polynomials."""

    def __init__(self, points: np.ndarray, firsts: np.ndarray, numbers: np.ndarray, cubic: bool):
        def straight(chosen: np.ndarray) -> np.ndarray:
            return np.stack([points[firsts[chosen]], points[firsts[chosen] + 1] - points[firsts[chosen]]])

        self.a = coefficients(points, firsts[numbers]) if cubic else straight(numbers)
        self.cubic = cubic
        self.followed = follows(firsts)[numbers]
        self.begins = ~np.roll(follows(firsts), 1)[numbers]
        #: Of straight segments those before and behind, and which have one.
        self.beside = []
        if not cubic:
            last = len(firsts) - 1
            self.beside.append((straight(np.maximum(numbers - 1, 0)), ~self.begins))
            self.beside.append((straight(np.minimum(numbers + 1, last)), self.followed))
        v = np.linspace(0.0, 1.0, PLACES)
        every = np.arange(len(numbers))
        slopes = np.linalg.norm(self.slope(np.tile(v[:, None], len(numbers)), every), axis=2)
        radii = self.at(np.tile(v[:, None], len(numbers)), every)[..., 3]
        self.radius = radii.max(axis=0)
        reach = BEYOND * self.radius / np.maximum(slopes.min(axis=0), 1e-300)
        self.beyond = np.clip(reach, LEAST_BEYOND, MOST_BEYOND) if cubic else np.zeros(len(numbers))
        #: Bound of the slope of phi.
        taper = np.abs(np.diff(radii, axis=0)).max(axis=0) * (PLACES - 1) / np.maximum(slopes.min(axis=0), 1e-300)
        self.steepest = 1.5 * np.hypot(1.0, taper) if cubic else np.ones(len(numbers))

    def at(self, v: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return (..., 4) the axis and the radius at places (..., N) of segments (N,)."""
        return _polynomial(self.a[:, rows], v)

    def slope(self, v: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return (..., 3) the derivative of the axis."""
        return _polynomial(np.stack([k * a[rows, :3] for k, a in enumerate(self.a)][1:]), v)

    def place(self, p: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the places (N,) whose circles, or spheres, points (N, 3) belong to; of straight segments anywhere."""
        return self._place_and_phi(p, rows)[0]

    def phi(self, p: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return (N,) how far points (N, 3) are outside."""
        return self._place_and_phi(p, rows)[1]

    def _place_and_phi(self, p: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = self.a[:, rows]
        if not self.cubic:
            return _cone(a, p)
        a[0, :, :3] -= p
        low, high = -self.beyond[rows], 1.0 + self.beyond[rows]
        every = low + np.linspace(0.0, 1.0, LOOKS)[:, None] * (high - low)
        here = _polynomial(a, every)
        gap = np.sqrt((here[..., :3] ** 2).sum(axis=2)) - here[..., 3]
        v = np.take_along_axis(every, gap.argmin(axis=0)[None], axis=0)[0]
        slopes, bends = np.stack([a[1], 2.0 * a[2], 3.0 * a[3]])[..., :3], np.stack([2.0 * a[2], 6.0 * a[3]])[..., :3]
        for _ in range(NEWTON):
            q, c, bend = _polynomial(a, v)[:, :3], _polynomial(slopes, v), _polynomial(bends, v)
            squared = (c * c).sum(axis=1)
            fall = np.maximum(squared + (q * bend).sum(axis=1), 1e-2 * squared + 1e-300)
            v = np.clip(v - (q * c).sum(axis=1) / fall, low, high)
        here = _polynomial(a, v)
        return v, np.linalg.norm(here[:, :3], axis=1) - here[:, 3]

    def rings(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which segments pass their triangles (P, 3, 3) in a ring within both, and points of it (N, RING, 3).

        A plane that cuts a tube across cuts it in about an ellipse around where it meets the axis. Its points are found
        on rays from there, in the plane.
        """
        n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
        every = np.arange(len(corners))
        places = np.tile(np.linspace(0.0, 1.0, PLACES)[:, None], len(corners))
        heights = ((self.at(places, every)[..., :3] - corners[:, 0]) * n).sum(axis=2)
        turns = (heights[:-1] < 0.0) != (heights[1:] < 0.0)
        rows = np.flatnonzero(turns.sum(axis=0) == 1)
        n, corners, heights = n[rows], corners[rows], heights[:, rows]
        first = turns[:, rows].argmax(axis=0)
        before, after = (np.take_along_axis(heights, (first + k)[None], axis=0)[0] for k in (0, 1))
        v = (first + before / (before - after)) / (PLACES - 1)
        for _ in range(NEWTON):
            c = self.slope(v, rows)
            fall = (c * n).sum(axis=1)
            v = v - ((self.at(v, rows)[:, :3] - corners[:, 0]) * n).sum(axis=1) / np.where(fall == 0.0, 1.0, fall)
        here, c = self.at(v, rows), self.slope(v, rows)
        length = np.linalg.norm(c, axis=1)
        axis = c / np.maximum(length, 1e-300)[:, None]
        cosine = np.abs((axis * n).sum(axis=1))
        radius = here[:, 3]
        reach = radius / np.maximum(cosine, 1e-300)
        # Far from the ring the axis keeps its distance from the plane.
        way = np.abs(np.linspace(0.0, 1.0, PLACES)[:, None] - v) * length
        apart = (np.abs(heights) > APART * self.radius[rows]) | (way < REACH * reach)
        found = (v > 0.0) & (v < 1.0) & (cosine > TRANSVERSAL) & apart.all(axis=0)
        rows, n, corners, axis, v, here = (x[found] for x in (rows, n, corners, axis, v, here))
        radius = here[:, 3]
        least = np.abs(n).argmin(axis=1)
        a = np.cross(n, np.eye(3)[least])
        a /= np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
        b = np.cross(n, a)
        angle = 2.0 * np.pi * np.arange(RING)[:, None, None] / RING
        d = np.cos(angle) * a + np.sin(angle) * b
        along = (d * axis).sum(axis=2)
        s = radius / np.sqrt(np.maximum(1.0 - along**2, 1e-12))
        of = np.tile(rows, RING)
        start = np.tile(here[:, :3], (RING, 1))
        d, s, v = d.reshape(-1, 3), s.reshape(-1), np.tile(v, RING)
        for _ in range(RING_STEPS):
            v, phi, e = self._next(start + s[:, None] * d, of, v)
            s = s - phi / np.maximum((e * d).sum(axis=1), 0.1)
        points = start + s[:, None] * d
        v, phi, _e = self._next(points, of, v)
        good = (np.abs(phi) < ON_TUBE * np.tile(radius, RING)) & (s > 0.0) & (v > 0.0) & (v < 1.0)
        for k in range(3):
            p, q = np.tile(corners[:, k], (RING, 1)), np.tile(corners[:, (k + 1) % 3], (RING, 1))
            good &= (np.cross(q - p, points - p) * np.tile(n, (RING, 1))).sum(axis=1) > 0.0
        whole = good.reshape(RING, -1).all(axis=0)
        return rows[whole], np.moveaxis(points.reshape(RING, -1, 3)[:, whole], 0, 1)

    def _next(self, p: np.ndarray, rows: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the places (N,) of points (N, 3), from those before on, phi, and the direction away from the axis."""
        if self.cubic:
            q, c = p - self.at(v, rows)[:, :3], self.slope(v, rows)
            v = v + (q * c).sum(axis=1) / np.maximum((c * c).sum(axis=1), 1e-300)
        else:
            v = self.place(p, rows)
        here = self.at(v, rows)
        q = p - here[:, :3]
        away = np.linalg.norm(q, axis=1)
        return v, away - here[:, 3], q / np.maximum(away, 1e-300)[:, None]

    def near(self, center: np.ndarray, radius: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return whether the surface may pass balls (N,)."""
        v, phi = self._place_and_phi(center, rows)
        some = np.abs(phi) <= self.steepest[rows] * radius
        if self.cubic:
            for end, sign in ((-self.beyond[rows], -1.0), (1.0 + self.beyond[rows], 1.0)):
                c = self.slope(end, rows)
                over = sign * ((center - self.at(end, rows)[:, :3]) * c).sum(axis=1)
                past = over > radius * np.linalg.norm(c, axis=1)
                # Beyond a bend the plane of an end may be crossed again.
                some &= ~(past & (np.abs(v - end) < 1e-9))
        return some

    def ends(self, p: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return (N,) below 0 where another segment has, or hides, the point; a sphere belongs to what it begins."""
        v = self.place(p, rows)
        if self.cubic:
            return np.minimum(v, 1.0 - v)
        found = np.where(self.followed[rows], 1.0 - v, 1.0)
        for k, (a, there) in enumerate(self.beside):
            other, phi = _cone(a[:, rows], p)
            shown = phi / np.maximum(self.radius[rows], 1e-300) + HIDDEN
            if k == 0:  # what is on the sphere has to be past the segment before
                shown = np.where(v < 0.0, other - 1.0, shown)
            found = np.where(there[rows], np.minimum(found, shown), found)
        return found

    def sides(self, corners: np.ndarray) -> np.ndarray:
        """Return the longest side of small parts of triangles (P, 3, 3), one of each segment."""
        rows = np.arange(len(corners))
        n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
        here = self.at(np.tile(np.linspace(0.0, 1.0, PLACES)[:, None], len(corners)), rows)
        height = np.abs(((here[..., :3] - corners[:, 0]) * n).sum(axis=2))
        passed = np.where(height <= 1.5 * here[..., 3], here[..., 3], np.inf).min(axis=0)
        return FINE_TUBE * np.clip(passed, LEAST_RADIUS * self.radius, self.radius)


def _pairs(scene: Scene, shape: int, shapes: frozenset[int] | None) -> np.ndarray:
    """Return (P, 2) triangles of meshes and segments of curves that may meet, of meshes that do run through the curves.

    One of the two is among ``shapes`` (None: any).
    """
    owners = scene.builder.face_shape
    rows = np.arange(len(owners))
    if shapes is not None and shape not in shapes:
        rows = np.flatnonzero(np.isin(owners, sorted(shapes)))
    corners = scene.points[scene.builder.indices[rows]].astype(np.float64)
    deep = np.unique(owners[rows[pierced_segments(scene, shape, corners)[:, 0]]])
    rows = rows[np.isin(owners[rows], deep)]
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    found = pierced_segments(scene, shape, scene.points[scene.builder.indices[rows]].astype(np.float64), True)
    return np.stack([rows[found[:, 0]], found[:, 1]], axis=1)


def cut_tubes(scene: Scene, shape: int, shapes: frozenset[int] | None) -> tuple[Chords, np.ndarray, np.ndarray]:
    """Return the chords of the curves in which meshes run through tubes, their segments (N,), and places there (N,).

    One of the two is among ``shapes`` (None: any). Kept until one moves.
    """
    kept = getattr(scene, "_tube_crossings", {})
    key, state = (shape, shapes), (scene.points.copy(), world_points(scene, shape))
    if key not in kept or not all(np.array_equal(a, b) for a, b in zip(kept[key][0], state, strict=True)):
        kept = {**kept, key: (state, _cut(scene, shape, state[1], _pairs(scene, shape, shapes)))}
        scene._tube_crossings = kept  # type: ignore[attr-defined]
    return kept[key][1]


def _cut(scene: Scene, shape: int, points: np.ndarray, pairs: np.ndarray) -> tuple[Chords, np.ndarray, np.ndarray]:
    """Return what ``cut_tubes`` does, of control points in the world (N, 4) and pairs (P, 2)."""
    curves = scene.geometry(shape)
    assert isinstance(curves, Curves)
    found, segments, places = [], [], []
    for start in range(0, max(len(pairs), 1), PAIRS):
        faces, numbers = pairs[start : start + PAIRS].T
        corners = scene.points[scene.builder.indices[faces]].astype(np.float64)
        tubes = TubeSegments(points, curves.firsts, numbers, curves.cubic)
        whole, rings = tubes.rings(corners)
        ends = np.stack([rings, np.roll(rings, -1, axis=1)], axis=2).reshape(-1, 2, 3)
        every = np.repeat(whole, RING)
        rest = np.setdiff1d(np.arange(len(faces)), whole)
        others = TubeSegments(points, curves.firsts, numbers[rest], curves.cubic)
        field = Field(others.phi, others.near, others.ends, others.sides, np.eye(3), np.zeros(3), STEPS, True)
        chords = cut(field, corners[rest], faces[rest])
        found.append(Chords(ends, faces[every], np.tile([0.0, 1.0], (len(ends), 1)), every))
        found.append(replace(chords, rows=rest[chords.rows]))
        for c in found[-2:]:
            segments.append(numbers[c.rows])
            places.append(tubes.place(c.points.mean(axis=1), c.rows))
    parts = (np.concatenate([getattr(c, k) for c in found]) for k in ("points", "faces", "spans", "rows"))
    return Chords(*parts), np.concatenate(segments), np.concatenate(places)


def resting_end(scene: Scene, shapes: frozenset[int] | None) -> tuple[int, int] | None:
    """Return curves with an open end that lies along a mesh, and the mesh, one among ``shapes`` (None: any)."""
    angle = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    for i in curve_shapes(scene):
        curves = scene.geometry(i)
        assert isinstance(curves, Curves)
        if not curves.cubic:
            continue
        pairs, points = _pairs(scene, i, shapes), world_points(scene, i)
        for start in range(0, len(pairs), PAIRS):
            faces, numbers = pairs[start : start + PAIRS].T
            tubes = TubeSegments(points, curves.firsts, numbers, True)
            corners = scene.points[scene.builder.indices[faces]].astype(np.float64)
            rows = np.arange(len(faces))
            for end, there in ((0.0, tubes.begins), (1.0, ~tubes.followed)):
                v = np.full(len(rows), end)
                here, axis = tubes.at(v, rows), tubes.slope(v, rows)
                least = np.abs(axis).argmin(axis=1)
                s = np.cross(axis, np.eye(3)[least])
                s /= np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-300)
                t = np.cross(axis, s) / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
                around = np.cos(angle)[:, None, None] * s + np.sin(angle)[:, None, None] * t
                rim = here[:, :3] + here[:, 3:] * around
                gap = np.stack([least_distance(corners - p[:, None]) for p in rim])
                on = (gap < ALONG * here[:, 3]) & there
                along = (on & np.roll(on, 1, axis=0)).any(axis=0)
                if along.any():
                    return i, int(scene.builder.face_shape[faces[along.argmax()]])
    return None

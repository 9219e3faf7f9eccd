"""Curves of intersection between tubes: chords, as those of ``crossing_curves.py``.

Each pair of segments that run through each other is cut by itself. The surface of the first one is covered with small
triangles in two parameters, the position along the segment and the angle around it, and cut by phi = |x - c(v)| - r(v)
of the second one. Straight segments that are joined meet in a crease instead (``tube_items.py``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.topology.crossing_curves import Chords, cut
from warp_psdr.topology.crossing_fields import Field
from warp_psdr.topology.kinds.tube_items import curves_at, follows, points_at
from warp_psdr.topology.tube_contacts import overlapping
from warp_psdr.topology.tube_crossings import PLACES, STEPS, TubeSegments

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Longest side of a small triangle, over the smaller radius.
FINE = 0.4
#: Parts around a segment, of pieces that are as long as the second number times its radius.
AROUND, LONG = 16, 0.4
#: Distance along a curve, over the radius, up to which its own parts are next to each other.
APART = 2.0
#: How far from it points at equal parameters may lie, over what is sampled.
MARGIN = 1.3
#: Newton's steps that move the end of a part of a chord onto both surfaces.
NEWTON = 3
#: Pairs that are cut at once.
PAIRS = 512
#: Directions, one of which is across the axis of a segment all along it.
ACROSS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (0, 1) if (x, y, z) > (0, 0, 0)], float)


class _Covered:
    """The surfaces of segments (P of them) by two parameters: along, [0, 1], and an angle.

    On straight segments a quarter of the first one is the sphere at either end, by the angle from the axis.
    """

    def __init__(self, tubes: TubeSegments, last: np.ndarray):
        self.tubes = tubes
        count = tubes.a.shape[1]
        every = np.arange(count)
        places = np.tile(np.linspace(0.0, 1.0, PLACES)[:, None], count)
        axis = tubes.slope(places, every)
        axis = axis / np.maximum(np.linalg.norm(axis, axis=2, keepdims=True), 1e-300)
        sines = np.linalg.norm(np.cross(axis[:, :, None], ACROSS), axis=3) / np.linalg.norm(ACROSS, axis=1)
        self.side = ACROSS[sines.min(axis=0).argmax(axis=1)]
        self.high = np.where(last, 1.0, 0.75) if not tubes.cubic else np.ones(count)
        # How far points move by each parameter.
        at = np.linspace(0.0, 1.0, 2 * PLACES + 1)
        a, b = (g.reshape(-1, 1) + np.zeros(count) for g in np.meshgrid(at, at, indexing="ij"))
        size = (len(at), len(at), count, 3)
        rows = np.broadcast_to(every, a.shape)
        x = self.at(a.reshape(-1), 2.0 * np.pi * b.reshape(-1), rows.reshape(-1)).reshape(size)
        steps = at[1] * np.array([1.0, 2.0 * np.pi])
        moved = [np.linalg.norm(np.diff(x, axis=k), axis=3).max(axis=(0, 1)) for k in (0, 1)]
        self.scales = MARGIN * np.stack(moved, axis=1) / steps

    def place(self, a: np.ndarray) -> np.ndarray:
        """Return the places (N,) along segments of first parameters (N,)."""
        return a if self.tubes.cubic else np.clip(2.0 * a - 0.5, 0.0, 1.0)

    def at(self, a: np.ndarray, angle: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the points (N, 3)."""
        v = self.place(a)
        here, c = self.tubes.at(v, rows), self.tubes.slope(v, rows)
        length = np.maximum(np.linalg.norm(c, axis=1, keepdims=True), 1e-300)
        axis = c / length
        s = np.cross(axis, self.side[rows])
        s /= np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-300)
        e = np.cos(angle)[:, None] * s + np.sin(angle)[:, None] * np.cross(axis, s)
        if not self.tubes.cubic:
            taper = self.tubes.a[1][rows, 3]
            lean = np.arccos(np.clip(-taper / length[:, 0], -1.0, 1.0))
            lean = np.where(
                a < 0.25, np.pi - 4.0 * a * (np.pi - lean), np.where(a > 0.75, 4.0 * (1.0 - a) * lean, lean)
            )
            e = np.sin(lean)[:, None] * e + np.cos(lean)[:, None] * axis
        return here[:, :3] + here[:, 3:] * e


def _pairs(scene: Scene, shape: int, other: int) -> np.ndarray:
    """Return (P, 2) segments of two shapes of curves, or of one, that may run through each other."""
    curves, others = curves_at(scene, shape), curves_at(scene, other)
    found = np.unique(overlapping(scene, shape, other)[0], axis=0)
    if not len(found):
        return found
    # A curve may go on a little on the segments before and behind.
    columns = []
    for k, geometry in enumerate((curves, others)):
        goes_on, own = follows(geometry.firsts), found[:, k]
        before = np.where(np.roll(goes_on, 1)[own], own - 1, own)
        columns.append((own, before, np.where(goes_on[own], own + 1, own)))
    found = np.unique(np.concatenate([np.stack([a, b], axis=1) for a in columns[0] for b in columns[1]]), axis=0)
    if shape != other:
        return found
    found = found[found[:, 1] > found[:, 0]]
    joined = (found[:, 1] - found[:, 0] == 1) & follows(curves.firsts)[found[:, 0]]
    return found if curves.cubic else found[~joined]


def cut_tube_pairs(scene: Scene, shape: int, other: int) -> tuple[Chords, np.ndarray, np.ndarray]:
    """Return the chords of the curves in which two shapes of curves, or one, run through each other.

    Returns:
        the chords, whose faces are the first one's record, the segments (N, 2) and the places there (N, 2).
    """
    pairs = _pairs(scene, shape, other)
    record = scene.face_count + scene.builder.primitives.index(shape)
    found = [_cut(scene, shape, other, pairs[k : k + PAIRS]) for k in range(0, len(pairs), PAIRS)]
    points = np.concatenate([np.zeros((0, 2, 3)), *(f[0] for f in found)])
    rows = np.concatenate([np.zeros(0, np.int64), *(k * PAIRS + f[1] for k, f in enumerate(found))])
    places = np.concatenate([np.zeros((0, 2)), *(f[2] for f in found)])
    faces, spans = np.full(len(points), record), np.tile([0.0, 1.0], (len(points), 1))
    return Chords(points, faces, spans, rows), pairs[rows], places


def _segments(scene: Scene, shape: int, numbers: np.ndarray) -> TubeSegments:
    curves = curves_at(scene, shape)
    return TubeSegments(points_at(scene, shape), curves.firsts, numbers, curves.cubic)


def _along(scene: Scene, shape: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the numbers (S,) of the curves that segments are of, where these begin along them, and their lengths."""
    curves = curves_at(scene, shape)
    every = np.arange(len(curves.firsts))
    tubes = _segments(scene, shape, every)
    places = np.tile(np.linspace(0.0, 1.0, PLACES)[:, None], len(every))
    length = np.linalg.norm(np.diff(tubes.at(places, every)[..., :3], axis=0), axis=2).sum(axis=0)
    number = np.concatenate([[0], np.cumsum(~follows(curves.firsts))[:-1]])
    return number, np.cumsum(length) - length, length


def _cut(scene: Scene, shape: int, other: int, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both ends of chords (N, 2, 3), the rows (N,) of pairs (P, 2) of segments, and places (N, 2) on these."""
    a, b = (_segments(scene, i, pairs[:, k]) for k, i in enumerate((shape, other)))
    covered = _Covered(a, ~a.followed)
    reach = APART * np.maximum(a.radius, b.radius)
    number, begin, length = _along(scene, shape)
    one_curve = (shape == other) & (number[pairs[:, 0]] == number[np.minimum(pairs[:, 1], len(number) - 1)])
    finest = FINE * np.minimum(a.radius, b.radius)

    def point(p: np.ndarray, rows: np.ndarray) -> np.ndarray:
        q = p / np.append(covered.scales, np.ones((len(pairs), 1)), axis=1)[rows]
        return covered.at(q[:, 0], q[:, 1], rows)

    def way(p: np.ndarray, x: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Distance along a curve between the places of both segments, less that up to which they are neighbours."""
        v = np.clip(covered.place(p[:, 0] / covered.scales[rows, 0]), 0.0, 1.0)
        w = np.clip(b.place(x, rows), 0.0, 1.0)
        first, second = (begin[n] + s * length[n] for n, s in ((pairs[rows, 0], v), (pairs[rows, 1], w)))
        return second - first - reach[rows]

    def near(center: np.ndarray, radius: np.ndarray, owners: np.ndarray) -> np.ndarray:
        rows, far = of[owners], np.sqrt(2.0) * radius
        x = point(center, rows)
        some = b.near(x, far, rows)
        own = np.flatnonzero(some & one_curve[rows])
        if len(own):
            some[own] = way(center[own], x[own], rows[own]) > -2.0 * far[own]
        return some

    def ends(p: np.ndarray, owners: np.ndarray) -> np.ndarray:
        rows = of[owners]
        x = point(p, rows)
        found = b.ends(x, rows)
        if not a.cubic:
            found = np.minimum(found, a.ends(x, rows))
        own = np.flatnonzero(one_curve[rows])
        if len(own):
            found[own] = np.minimum(found[own], way(p[own], x[own], rows[own]))
        return found

    # ---- Small triangles in both parameters, as long as what they stand for ----
    of, local = _covering(covered, b)
    field = Field(
        phi=lambda x, owners: b.phi(point(x, of[owners]), of[owners]),
        near=near,
        ends=ends,
        sides=lambda _corners: finest[of],
        linear=np.eye(3),
        origin=np.zeros(3),
        steps=STEPS,
        interpolates=True,
    )
    chords = cut(field, local, np.zeros(len(local), np.int64))
    rows = of[chords.rows]
    first, way_along = chords.points[:, :1], np.diff(chords.points, axis=1)
    parameters = first + chords.spans[..., None] * way_along
    points = np.stack([point(parameters[:, k], rows) for k in (0, 1)], axis=1)
    for k in (0, 1):
        clipped = np.flatnonzero(chords.spans[:, k] != k)
        points[clipped, k] = _onto(a, b, points[clipped, k], rows[clipped])
    middle = 0.5 * (points[:, 0] + points[:, 1])
    places = np.stack([a.place(middle, rows), b.place(middle, rows)], axis=1)
    places = np.clip(places, 0.0, 1.0)
    kept = np.linalg.norm(points[:, 1] - points[:, 0], axis=1) > 0.0
    return points[kept], rows[kept], places[kept]


def _covering(covered: _Covered, other: TubeSegments) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (M,) of pairs, and triangles (M, 3, 3) that cover what of the first segments is near the second.

    The third coordinate is 0; the first two are the parameters times their scales.
    """
    rows = np.arange(len(covered.high))
    low, high = np.zeros(len(rows)), covered.high.copy()
    done: list[tuple[np.ndarray, ...]] = []
    while len(rows):
        half = 0.5 * (high - low) * covered.scales[rows, 0]
        radius = covered.tubes.radius[rows]
        middle = covered.tubes.at(covered.place(0.5 * (low + high)), rows)[:, :3]
        keep = other.near(middle, half + radius, rows)
        short = keep & (2.0 * half <= LONG * radius)
        done.append((rows[short], low[short], high[short]))
        keep &= ~short
        rows, low, high = rows[keep], low[keep], high[keep]
        middle = 0.5 * (low + high)
        rows, low, high = np.tile(rows, 2), np.concatenate([low, middle]), np.concatenate([middle, high])
    rows, low, high = (np.concatenate([d[k] for d in done]) for k in range(3))
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND + 1)
    first, second = np.tile(turn[:-1], len(rows)), np.tile(turn[1:], len(rows))
    rows, low, high = (np.repeat(x, AROUND) for x in (rows, low, high))
    p, q, r, s = (np.stack([x, y], axis=1) for x, y in ((low, first), (high, first), (high, second), (low, second)))
    local = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)])
    of = np.tile(rows, 2)
    local = local * covered.scales[of][:, None]
    return of, np.concatenate([local, np.zeros((*local.shape[:2], 1))], axis=2)


def _onto(a: TubeSegments, b: TubeSegments, points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return points (N, 3) moved onto the surfaces of two segments, across their curve."""
    x = points.copy()
    for _ in range(NEWTON):
        step = 1.0e-4 * np.minimum(a.radius, b.radius)[rows]
        value = np.stack([a.phi(x, rows), b.phi(x, rows)], axis=1)
        slopes = np.stack(
            [
                np.stack(
                    [f.phi(x + step[:, None] * e, rows) - f.phi(x - step[:, None] * e, rows) for e in np.eye(3)], 1
                )
                / (2.0 * step[:, None])
                for f in (a, b)
            ],
            axis=1,
        )
        x = x - np.einsum("nij,nj->ni", np.linalg.pinv(slopes, rcond=1e-3), value)
    return x

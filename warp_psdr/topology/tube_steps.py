"""Lines along which textures jump on tubes, for ``kernels/boundary/crossing/tube_steps.py``.

A texture's place is linear in the texture coordinates, which are the angle in turns and the position along all
segments of a shape. So in these two a line is straight, on the rectangle that a segment is. The sphere at an end of a
straight segment has the position of that end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.kernels import constants as c
from warp_psdr.kernels.boundary.crossing.tube_steps import JOINT, SEAM, TubeSteps
from warp_psdr.topology.kinds.tube_items import curves_at, follows, points_at
from warp_psdr.topology.texture_steps import MOST, Carriers, one_of_each, place_of
from warp_psdr.topology.unchanged import kept

if TYPE_CHECKING:
    from warp_psdr.kernels.structs import Texture
    from warp_psdr.scene.scene import Scene

#: Roundings of a place, in cells: what is closer to a whole number is one.
WHOLE = 1.0e-6


def tube_lines(scene: Scene, carriers: Carriers) -> TubeSteps | None:
    """Return the lines of some textures on curves, drawn by their lengths; None: there are none."""
    return kept(scene, ("tube steps", carriers), lambda: _tube_lines(scene, carriers))


def _tube_lines(scene: Scene, carriers: Carriers) -> TubeSteps | None:
    parts = [_lines_of(scene, *carrier) for carrier in sorted(carriers)]
    marks, ends, sizes = (np.concatenate([p[k] for p in parts]) for k in range(3))
    keep = np.flatnonzero(sizes > 0.0)
    if len({shape for shape, _texture in carriers}) < len(carriers):
        keep = keep[one_of_each(np.column_stack([marks[keep, :2], ends[keep]]))]
    marks, ends, sizes = marks[keep], ends[keep], sizes[keep]
    if not len(sizes):
        return None
    found = TubeSteps()
    cdf = np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])
    cdf[-1] = 1.0
    found.cdf = wp.array(cdf, dtype=wp.float64, device=scene.device)
    found.ends = wp.array(ends.astype(np.float32), dtype=wp.vec4, device=scene.device)
    found.marks = wp.array(marks.astype(np.int32), dtype=wp.vec4i, device=scene.device)
    return found


def too_many_on_tubes(scene: Scene, carriers: Carriers) -> str:
    """Say which texture has more lines on curves than can be listed; empty: none."""
    for shape, number in sorted(carriers):
        matrix, cells = place_of(scene, scene.builder.textures[number])
        curves = curves_at(scene, shape)
        if (cells * (1.0 + np.abs(matrix[:, 0]))).sum() * len(curves.firsts) + (
            cells * np.abs(matrix[:, 1])
        ).sum() > MOST:
            path = scene.description.shapes[shape].path
            return f"a texture with steps of {path!r} has more than {MOST:,} lines on its curves"
    return ""


def slide_on_seams(scene: Scene, carriers: Carriers) -> bool:
    """Whether lines that slide lie where angles start anew, and not only they jump there, or on joints of segments."""
    for shape, number in sorted(carriers):
        curves = curves_at(scene, shape)
        texture = scene.builder.textures[number]
        matrix, cells = place_of(scene, texture)
        for axis in range(2):
            a, b, d = cells[axis] * matrix[axis]
            on_seam = a != 0.0 and b == 0.0 and _whole(d) and not _periodic(texture, matrix, cells)
            joints = (np.arange(len(curves.firsts))[1:] / len(curves.firsts))[follows(curves.firsts)[:-1]]
            on_joint = not curves.cubic and a == 0.0 and b != 0.0 and any(_whole(b * v + d) for v in joints)
            if on_seam or on_joint:
                return True
    return False


def _whole(value: float) -> bool:
    return bool(abs(value - round(value)) < WHOLE * (1.0 + abs(value)))


def _periodic(texture: Texture, matrix: np.ndarray, cells: np.ndarray) -> bool:
    """Whether a texture goes on where angles start anew."""
    turn = cells * matrix[:, 0]
    if not turn.any():
        return True
    if not all(_whole(t) for t in turn):
        return False
    if texture.kind == c.TEXTURE_CHECKERBOARD:
        return bool(round(turn.sum()) % 2 == 0)
    return texture.wrap == c.WRAP_REPEAT and all(round(t) % round(n) == 0 for t, n in zip(turn, cells, strict=True))


def _lines_of(scene: Scene, shape: int, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return marks (N, 4), ends (N, 4) and lengths (N,) of a texture's lines on curves (``TubeSteps``)."""
    curves = curves_at(scene, shape)
    texture, count = scene.builder.textures[number], len(curves.firsts)
    matrix, cells = place_of(scene, texture)
    record = scene.face_count + scene.builder.primitives.index(shape)
    points, goes_on = points_at(scene, shape), follows(curves.firsts)
    last = curves.firsts + (3 if curves.cubic else 1)
    length = np.linalg.norm(points[last, :3] - points[curves.firsts, :3], axis=1) / (3.0 if curves.cubic else 1.0)
    around = 2.0 * np.pi * np.maximum(points[curves.firsts, 3], points[last, 3])
    jumps = not _periodic(texture, matrix, cells)
    marks, ends, sizes = [], [], []

    def add(axis: int, segments: np.ndarray, u0, v0, u1, v1) -> None:
        """Lines from (turns, place held) to others."""
        new = np.stack(np.broadcast_arrays(u0, v0, u1, v1, segments), axis=1)[:, :4].astype(np.float64)
        own = np.full(len(segments), record), segments, np.full(len(segments), number), np.full(len(segments), axis)
        marks.append(np.stack(own, axis=1))
        ends.append(new)
        along = 1.0 if curves.cubic else 2.0
        sizes.append(
            np.hypot(around[segments] * (new[:, 2] - new[:, 0]), along * length[segments] * (new[:, 3] - new[:, 1]))
        )
        if not curves.cubic:  # on spheres: an arc from the circle of touch to the pole
            sphere = (np.minimum(new[:, 1], new[:, 3]) > 0.75 - 1e-9) | (np.maximum(new[:, 1], new[:, 3]) < 0.25 + 1e-9)
            arc = sphere & (new[:, 0] == new[:, 2])
            sizes[-1] = np.where(arc, 0.25 * around[segments], sizes[-1])

    every = np.arange(count)
    for axis in range(2):
        a, b, d = cells[axis] * matrix[axis]
        for rows, on, held in _parts(curves.cubic, every, goes_on):
            # S = a u + b' w + d', w in [0, 1] along the segment; on spheres b' = 0.
            b_own = b / count if on else 0.0
            d_own = b * (rows + (0.0 if on is not None else 1.0)) / count + d
            add_levels(add, axis, rows, a, b_own, d_own, held, curves.cubic, jumps)
    if jumps:
        for rows, _on, held in _parts(curves.cubic, every, goes_on):
            add(int(SEAM), rows, 0.0, held[0], 0.0, held[1])
    if not curves.cubic:
        add(int(JOINT), every[goes_on], 0.0, 0.75, 1.0, 0.75)
    return tuple(np.concatenate(x) for x in (marks, ends, sizes))  # type: ignore[return-value]


def _parts(cubic: bool, every: np.ndarray, goes_on: np.ndarray):
    """Yield segments, whether they are meant along (True), at their start (False) or end (None), and places held."""
    if cubic:
        yield every, True, (0.0, 1.0)
        return
    yield every, True, (0.25, 0.75)
    yield every, False, (0.25, 0.0)
    yield every[~goes_on], None, (0.75, 1.0)


def add_levels(
    add, axis: int, rows: np.ndarray, a: float, b: float, d: np.ndarray, held, cubic: bool, jumps: bool
) -> None:
    """Add where a u + b w + d is a whole number, for u in [0, 1] and w in [0, 1], which is held as ``held``.

    A line along the border u = 0, or w = 0, belongs to it, those along u = 1 and w = 1 do not.
    """
    span = held[1] - held[0]
    corner = np.stack([d, d + a, d + b, d + a + b])
    first, last = np.ceil(corner.min(axis=0) - WHOLE), np.floor(corner.max(axis=0) + WHOLE)
    if a == 0.0 and b == 0.0:
        return
    count = np.maximum(last - first + 1, 0).astype(np.int64)
    own = np.repeat(np.arange(len(rows)), count)
    level = first[own] + np.arange(len(own)) - np.repeat(np.cumsum(count) - count, count)
    h = level - d[own]
    segments = rows[own]
    if b == 0.0:
        u = h / a
        u = np.where(np.abs(u) * abs(a) < WHOLE, 0.0, u)
        keep = (u >= 0.0) & (u < 1.0 - WHOLE / abs(a)) & ~((u == 0.0) & jumps)
        add(axis, segments[keep], u[keep], held[0], u[keep], held[1])
        return
    if a == 0.0:
        w = h / b
        w = np.where(np.abs(w) * abs(b) < WHOLE, 0.0, w)
        keep = (w >= 0.0) & (w < 1.0 - WHOLE / abs(b))
        add(axis, segments[keep], 0.0, held[0] + span * w[keep], 1.0, held[0] + span * w[keep])
        return
    # The range of u within which w is in [0, 1].
    one, other = h / a, (h - b) / a
    low, high = np.maximum(np.minimum(one, other), 0.0), np.minimum(np.maximum(one, other), 1.0)
    keep = high > low
    low, high, h = low[keep], high[keep], h[keep]
    add(axis, segments[keep], low, held[0] + span * (h - a * low) / b, high, held[0] + span * (h - a * high) / b)

"""Curves with a radius (``kernels/primitive/curves.py``): what straight and cubic ones have in common.

Rays walk a tree over the pieces of all segments, and it is built of points in the world: what the kernels read follows
the pose, too, and the shape's record holds a box around the tubes.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_psdr.kernels.primitive.curves import HEADER, MOST_SEGMENTS
from warp_psdr.kernels.primitive.curves_walk import WIDTH
from warp_psdr.options.words import words
from warp_psdr.scene.acceleration import Accelerator
from warp_psdr.scene.errors import SceneError, error
from warp_psdr.scene.kinds.curve_files import read_curves
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.kinds.zero_set import held_points
from warp_psdr.scene.layout import SHAPE_GRID, Layout
from warp_psdr.scene.transforms import transform_points

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene

#: Pieces of a leaf of the tree (measured).
LEAF = 4
#: Words from the matrix in front of the control points to those that say where the trees lie.
TREE = 19


@dataclass(eq=False)
class Curves(Geometry):
    """Curves with a radius."""

    jumps = "joints"
    follows_pose = True
    instead = "give the triangles of the tubes as a 'mesh'"
    order: ClassVar[int]  #: control points that one segment takes
    cubic: ClassVar[bool]  #: B-splines; else straight segments

    points: np.ndarray  #: (N, 4) control points: x, y, z, radius
    firsts: np.ndarray  #: (S,) int32: of each segment, the number of its first control point
    pieces: int = 1  #: into which rays see a segment cut

    @property
    def knows(self) -> frozenset[str]:
        """It is a mirror, and no glass: light that enters a curve leaves it unseen."""
        return words("mirrors", "mirror")

    @classmethod
    def read(cls, props: Properties, to_world: np.ndarray) -> tuple[Geometry, np.ndarray]:
        """Take the control points.

        Raises:
            ValueError: there are none, too few for a curve, not finite, of negative radius, or all in one place.
        """
        points, firsts, place = cls._take(props)
        if not points[:, 3].any():
            props.context.note(f"{place}: all radii are 0, so nothing is seen of the shape")
        curves = cls(points, firsts)
        curves.prepare(props, place)
        return curves, to_world

    def prepare(self, props: Properties, place: str) -> None:
        """Find into how many pieces segments are cut, and note what is amiss; ``place``: of the control points."""

    @classmethod
    def _take(cls, props: Properties) -> tuple[np.ndarray, np.ndarray, str]:
        if props.has("flip_normals", "face_normals"):
            raise error(
                props.where, "'flip_normals' or 'face_normals' on curves", "leave it out: they are seen from outside"
            )
        given = [key for key in ("filename", "control_points") if props.has(key)]
        sources = {key: props.take(key) for key in ("filename", "control_points", "curve_starts")}
        if len(given) != 1:
            problem = f"got {' and '.join(given)}" if given else "there are no control points"
            remedy = "give one of 'filename' (a text file) and 'control_points' (an array (N, 4)) with 'curve_starts'"
            raise error(props.where, problem, remedy)
        place, value = props.place(given[0]), sources[given[0]]
        if given[0] == "filename":
            if sources["curve_starts"] is not None:
                raise error(
                    props.place("curve_starts"), "given beside 'filename'", "leave it out: empty lines start curves"
                )
            try:
                points, starts = read_curves(props.context.file(value, place))
            except SceneError:
                raise
            except ValueError as problem:
                raise SceneError(f"{place}: {problem}") from None
        else:
            points = _points(value, place)
            starts = _starts(sources["curve_starts"], len(points), props.place("curve_starts"))
        props.context.count(9 * points.size, place)
        firsts = _segments(points, starts, cls.order, place)
        return points, firsts, place

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the control points, (N, 4)."""
        return {"control_points": self.points}

    def corners(self, to_world: np.ndarray) -> np.ndarray:
        """Return the corners (8, 3) of a box in front of the pose whose image holds the tubes."""
        return box_around(self.points.astype(np.float64), to_world)

    def lay(self, layout: Layout, path: str, shape: int, pose: int) -> int:
        """Lay out a box around the tubes, which the record holds, and what is behind it; ``follow`` fills it."""
        count, segments = len(self.points), len(self.firsts)
        offset = layout.add_values(np.zeros(16))
        layout.add_values(np.array([count, segments, self.pieces] + [0.0] * (HEADER - TREE)))
        layout.add(f"{path}.control_points", self.points.reshape(-1), SHAPE_GRID, owner=shape)
        layout.add_values(np.zeros(4 * count))
        layout.add_values(self.firsts)
        return offset

    def follow(self, scene: Scene, shape: int, state: Any) -> Any:
        """Write what follows from the control points and the pose, and make or rebuild the tree, which is the state.

        The tree, its number and the pieces of each segment stay the same for as long as the scene lives.

        Raises:
            ValueError: a control point is not finite, or a radius is negative.
        """
        place, pose = scene.builder.frames[shape], scene.poses.offsets(shape)[0]
        size, first = self.points.size, place + HEADER
        to_world = scene.values[pose : pose + 16].numpy().astype(np.float64).reshape(4, 4)
        local = scene.values[first : first + size].numpy().astype(np.float64).reshape(-1, 4)
        if not np.isfinite(local).all() or (local[:, 3] < 0.0).any():
            path = scene.description.shapes[shape].path
            raise ValueError(f"{path}.control_points: a number is not finite, or a radius is negative; restore them")
        world = np.concatenate([transform_points(to_world, local[:, :3]), local[:, 3:]], axis=1).astype(np.float32)
        scene.values[first + size : first + 2 * size].assign(world.reshape(-1))
        low, high = (x.astype(np.float32) for x in self.hulls(world.astype(np.float64)))
        tree = _Tree(low, high, scene.device) if state is None else state
        words = tree.follow(low, high, made=state is not None)
        scene.values[place + TREE : place + TREE + words.size].assign(words)
        box = np.eye(4)
        box[:3, :3] = np.diag(0.5 * (high.max(axis=0) - low.min(axis=0)))
        box[:3, 3] = 0.5 * (high.max(axis=0) + low.min(axis=0))
        scene.values[place : place + 16].assign(box.astype(np.float32).reshape(-1))
        corners = box_around(local, to_world)
        scene.poses.local(shape)[0].assign(corners.astype(np.float32))
        moved = transform_points(to_world, corners).astype(np.float32).reshape(-1)
        positions = scene.poses.offsets(shape)[1]
        scene.values[positions : positions + moved.size].assign(moved)
        return tree

    def hulls(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the boxes around the pieces of the segments, low and high, (S * K, 3).

        A piece of a cubic lies in the convex hull of its Bezier points, each with its radius.

        Args:
            points: (N, 4) in the world, float64.
        """
        legs = self.legs(points)
        radius = np.maximum(legs[..., 3:], 0.0)
        return (legs[..., :3] - radius).min(axis=0), (legs[..., :3] + radius).max(axis=0)

    @abstractmethod
    def legs(self, points: np.ndarray) -> np.ndarray:
        """Return points (K, S * P, 4) around the P pieces of each segment, by control points in the world."""

    def position(self, scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
        """Return the point (3,) that a vertex holds (``kernels/primitive/curves.py``)."""
        along, turns, segment = held_points(u, v)
        first = self.firsts[int(segment * MOST_SEGMENTS)]
        c, axis, angle = self.ring(world_points(scene, int(record["shape"])), first, float(along))
        axis = axis / np.linalg.norm(axis)
        up = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        up = up / np.linalg.norm(up) if up @ up > 1.0e-12 else np.array([0.0, 1.0, 0.0])
        turn = 2.0 * np.pi * turns
        e = np.cos(turn) * np.cross(up, axis) + np.sin(turn) * up
        return c[:3] + c[3] * (e if angle is None else np.sin(angle) * e + np.cos(angle) * axis)

    @abstractmethod
    def ring(self, points: np.ndarray, first: int, along: float) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Return the middle (4,) of the ring that a vertex is on, with its radius, the axis (3,), and an angle.

        Args:
            points: (N, 4) control points in the world.
            first: number of the first one of the segment.
            along: how far along the segment, as vertices hold it.

        Returns:
            The angle is that of the point against the axis; None: a right one.
        """

    @classmethod
    def describe(cls, shapes: Sequence[tuple[str, Geometry]]) -> list[tuple[str, str, str]]:
        """Return a line about each."""
        found = [(path, curves) for path, curves in shapes if isinstance(curves, Curves)]
        return [
            (f"curves {path}", f"{len(c.firsts)} segments", f"{c.pieces} pieces of each" if c.cubic else "straight")
            for path, c in found
        ]


def world_points(scene: Scene, shape: int) -> np.ndarray:
    """Return the control points (P, 4) of curves in the device's coordinates, float64."""
    curves = scene.description.shapes[shape].geometry
    assert isinstance(curves, Curves)
    first = scene.builder.frames[shape] + HEADER + curves.points.size
    return scene.values[first : first + curves.points.size].numpy().astype(np.float64).reshape(-1, 4)


def box_around(points: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """Return corners (8, 3) of a box in front of the pose whose image holds the tubes; radii do not scale."""
    narrowest = np.linalg.svd(np.asarray(to_world, np.float64)[:3, :3], compute_uv=False)[-1]
    radius = points[:, 3:] / narrowest
    bounds = np.stack([(points[:, :3] - radius).min(axis=0), (points[:, :3] + radius).max(axis=0)])
    return np.array(list(itertools.product(*bounds.T)))


def _points(value: Any, place: str) -> np.ndarray:
    try:
        values = np.asarray(value.numpy() if hasattr(value, "numpy") else value)
        values = values.astype(np.float32) if values.dtype.kind in "iuf" else np.empty(0, np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)
    if values.size == 0 or values.size % 4 or values.ndim not in (1, 2) or (values.ndim == 2 and values.shape[1] != 4):
        raise error(place, f"got the shape {values.shape}", "give numbers (N, 4), or flat 4 N: x, y, z, radius")
    return np.ascontiguousarray(values.reshape(-1, 4))


def _starts(value: Any, count: int, place: str) -> np.ndarray:
    try:
        starts = np.asarray(0 if value is None else value)
    except ValueError:
        starts = np.empty(0)
    starts = starts.reshape(-1)
    whole = starts.size > 0 and starts.dtype.kind in "iu"
    if not whole or starts[0] != 0 or (np.diff(starts) <= 0).any() or starts[-1] >= count:
        remedy = f"give whole numbers that start with 0 and rise, all below the {count} control points"
        raise error(place, f"got {starts.tolist()[:8]}", remedy)
    return starts


def _segments(points: np.ndarray, starts: np.ndarray, order: int, place: str) -> np.ndarray:
    """Return the first control point of each segment.

    Raises:
        ValueError: as ``Curves.read``.
    """
    ends = np.append(starts[1:], len(points))
    lengths = ends - starts
    if len(points) == 0 or (lengths < order).any():
        number = int((lengths < order).argmax()) if len(points) else 0
        count = int(lengths[number]) if len(points) else 0
        raise error(place, f"curve {number + 1} has {count} control points", f"give each at least {order}")
    wrong = ~np.isfinite(points).all(axis=1)
    if wrong.any():
        raise error(place, f"control point {int(wrong.argmax()) + 1} is not finite", "give finite numbers")
    if (points[:, 3] < 0.0).any():
        number = int((points[:, 3] < 0.0).argmax())
        raise error(place, f"control point {number + 1} has the radius {points[number, 3]:g}", "give 0 or more")
    is_first = np.ones(len(points), bool)
    for k in range(1, order):
        is_first[ends - k] = False
    firsts = np.nonzero(is_first)[0]
    if len(firsts) > MOST_SEGMENTS:
        raise error(place, f"got {len(firsts)} segments", f"give at most {MOST_SEGMENTS} a shape, in several shapes")
    still = np.all([points[firsts, :3] == points[firsts + k, :3] for k in range(1, order)], axis=(0, 2))
    if still.any():
        number = int(firsts[still.argmax()])
        problem = f"the control points {number + 1} to {number + order} are all in one place"
        raise error(place, problem, "a segment has a length: leave one out")
    return firsts.astype(np.int32)


class _Tree:
    """The tree over the pieces of a shape of curves, which kernels find by numbers in the flat values."""

    def __init__(self, low: np.ndarray, high: np.ndarray, device: wp.Device):
        low_boxes, high_boxes = (wp.array(x, dtype=wp.vec3, device=device) for x in (low, high))
        self._tree = wp.Bvh(low_boxes, high_boxes, leaf_size=LEAF)
        self._packets = Packets(len(low)) if device.is_cpu else None

    def follow(self, low: np.ndarray, high: np.ndarray, *, made: bool) -> np.ndarray:
        """Bring the tree up to date where it was made of other boxes, and return its words."""
        if made:
            self._tree.lowers.assign(low)
            self._tree.uppers.assign(high)
            if self._packets is not None:  # rays do not walk it there
                self._tree.refit()
            else:
                self._tree.rebuild()
        words = np.array([self._tree.id], np.uint64).view(np.float32)
        return words if self._packets is None else np.concatenate([words, self._packets.follow(low, high)])


class Packets:
    """The tree that rays walk on the CPU (``kernels/primitive/curves_walk.py``) over the boxes of pieces."""

    def __init__(self, count: int):
        self._corners = wp.zeros(3 * count, dtype=wp.vec3, device="cpu")
        self._indices = wp.array(np.arange(3 * count, dtype=np.int32), device="cpu")
        self._tree: Accelerator | None = None

    def follow(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Build the tree, or bring it up to date, and return the words of a ``PieceTree``, (8,)."""
        # Triangles with an area, whose boxes are those of the pieces.
        high = np.maximum(high, np.nextafter(low, np.float32(np.inf)))
        third = np.stack([low[:, 0], high[:, 1], low[:, 2]], axis=1)
        self._corners.assign(np.stack([low, high, third], axis=1).reshape(-1, 3))
        if self._tree is None:
            self._tree = Accelerator(self._corners, self._indices, "cpu", "wide", width=WIDTH)
        else:
            self._tree.update()
        data = self._tree.data
        addresses = np.array([data.nodes, data.packets], np.uint64).view(np.float32)
        return np.concatenate([addresses, np.array([*data.center, data.extent], np.float32)])

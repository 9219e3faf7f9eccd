"""Curves with a radius: the reader, and the values that the kernels need (``kernels/primitive/curves.py``)."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_psdr.kernels.primitive.curves import HEADER, MOST_SEGMENTS
from warp_psdr.kernels.primitive.curves_walk import WIDTH

from .acceleration import Accelerator
from .bsdfs import BsdfDescription
from .curve_files import read_curves
from .curve_points import coefficients
from .description import Curves, ShapeDescription
from .errors import SceneError, error
from .exact import singular
from .layout import SHAPE_GRID, SHAPE_POSE, Layout, Parameter
from .transforms import transform_points

if TYPE_CHECKING:
    from .plugins import Properties
    from .scene import Scene

#: Plugin -> control points that one segment takes.
ORDER = {"linearcurve": 2, "bsplinecurve": 4}
#: What the errors offer.
INSTEAD = "give the triangles of the tubes as a 'mesh'"
#: Turn of a segment's axis, radians, up to which a ray is carried safely along a piece of it.
TURN = 0.2
#: Pieces of a segment, at most, and at least: short pieces have tight boxes. Where they are shorter than wide, more of
#: them cost more than they save.
PIECES = (2, 16)
WIDE_PIECES = 4
#: Pieces of a leaf of the tree (measured).
LEAF = 4


def is_curves(plugin: str) -> bool:
    """Return whether a plugin is made of curves."""
    return plugin in ORDER


def take_curves(props: Properties) -> Curves:
    """Take the control points of curves.

    Raises:
        ValueError: there are none, too few for a curve, not finite, of negative radius, or all in one place.
    """
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
    firsts = _segments(points, starts, ORDER[props.type], place)
    if not points[:, 3].any():
        props.context.note(f"{place}: all radii are 0, so nothing is seen of the shape")
    if props.type == "linearcurve":
        return Curves(points, firsts, False)
    a = coefficients(points.astype(np.float64), firsts)
    _note_folds(props, a, place)
    return Curves(points, firsts, True, _pieces(a))


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
        ValueError: as ``take_curves``.
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


def _note_folds(props: Properties, a: np.ndarray, place: str) -> None:
    """Note segments, of the coefficients ``a``, whose radius of curvature is below their own in the middle."""
    slope = a[1] + a[2] + 0.75 * a[3]
    bend = 2.0 * a[2] + 3.0 * a[3]
    curvature = np.linalg.norm(np.cross(slope[:, :3], bend[:, :3]), axis=1)
    radius = (a[0] + 0.5 * a[1] + 0.25 * a[2] + 0.125 * a[3])[:, 3]
    tight = int((radius * curvature > np.linalg.norm(slope[:, :3], axis=1) ** 3).sum())
    if tight:
        props.context.note(f"{place}: {tight} segments bend more than their radius allows, and run through themselves")


def hulls(points: np.ndarray, curves: Curves) -> tuple[np.ndarray, np.ndarray]:
    """Return the boxes around the pieces of the segments, low and high, (S * K, 3).

    A piece of a cubic lies in the convex hull of its Bezier points, each with its radius.

    Args:
        points: (N, 4) in the world, float64.
        curves: their segments.
    """
    if curves.cubic:
        a, size = coefficients(points, curves.firsts), 1.0 / curves.pieces
        legs = np.stack([_bezier(a, k * size, size) for k in range(curves.pieces)], axis=2).reshape(4, -1, 4)
    else:
        legs = np.stack([points[curves.firsts], points[curves.firsts + 1]])
    radius = np.maximum(legs[..., 3:], 0.0)
    return (legs[..., :3] - radius).min(axis=0), (legs[..., :3] + radius).max(axis=0)


def _bezier(a: np.ndarray, start: float, size: float) -> np.ndarray:
    """Return the Bezier points (4, S, 4) of cubics from a place on, over a size."""
    b0 = a[0] + start * (a[1] + start * (a[2] + start * a[3]))
    b1 = size * (a[1] + start * (2.0 * a[2] + 3.0 * start * a[3]))
    b2 = size**2 * (a[2] + 3.0 * start * a[3])
    b3 = size**3 * a[3]
    return np.stack([b0, b0 + b1 / 3.0, b0 + (2.0 * b1 + b2) / 3.0, b0 + b1 + b2 + b3])


def _pieces(a: np.ndarray) -> int:
    """Return into how many pieces cubic segments are cut: a power of two, by the turn between their Bezier legs."""
    legs = _bezier(a, 0.0, 1.0)
    steps = np.diff(legs[..., :3], axis=0)
    lengths = np.linalg.norm(steps, axis=2)
    turns = []
    for k in range(2):
        product = np.maximum(lengths[k] * lengths[k + 1], 1e-300)
        turns.append(np.arccos(np.clip((steps[k] * steps[k + 1]).sum(axis=1) / product, -1.0, 1.0)))
    widest = max(float(np.add(*turns).max()), 1e-9)
    radius = np.maximum(legs[..., 3].max(axis=0), 1e-300)
    slender = float(np.median(lengths.sum(axis=0) / radius))
    most = np.clip(slender, WIDE_PIECES, PIECES[1])
    return int(2 ** np.ceil(np.log2(np.clip(widest / TURN, PIECES[0], most))))


def curve_shape(props: Properties, curves: Curves, to_world: np.ndarray, bsdf: BsdfDescription) -> ShapeDescription:
    """Return the shape, to which its sides are added.

    Raises:
        ValueError: its pose has no inverse.
    """
    reason = singular(to_world)
    if reason:
        raise error(props.where, reason, "give it an extent along all axes")
    local = _box(curves.points.astype(np.float64), to_world)
    return ShapeDescription(
        path=props.path,
        kind=props.type,
        vertices=transform_points(to_world, local).astype(np.float32),
        faces=np.zeros((0, 3), np.int32),
        bsdf=bsdf,
        to_world=to_world.astype(np.float32),
        local_vertices=local.astype(np.float32),
        primitive=props.type,
        curves=curves,
    )


def _box(points: np.ndarray, to_world: np.ndarray) -> np.ndarray:
    """Return corners (8, 3) of a box in front of the pose whose image holds the tubes; radii do not scale."""
    narrowest = np.linalg.svd(np.asarray(to_world, np.float64)[:3, :3], compute_uv=False)[-1]
    radius = points[:, 3:] / narrowest
    bounds = np.stack([(points[:, :3] - radius).min(axis=0), (points[:, :3] + radius).max(axis=0)])
    return np.array(list(itertools.product(*bounds.T)))


def add_curves(layout: Layout, shape: ShapeDescription, number: int) -> int:
    """Lay out what the kernels read behind the pose, and return its flat offset; ``follow`` fills what follows."""
    curves = shape.curves
    assert curves is not None
    count, segments = len(curves.points), len(curves.firsts)
    offset = layout.add_values(np.zeros(16))
    layout.add_values(np.array([count, segments, curves.pieces] + [0.0] * (HEADER - 19)))
    layout.add(f"{shape.path}.control_points", curves.points.reshape(-1), SHAPE_GRID, owner=number)
    layout.add_values(np.zeros(4 * count))
    layout.add_values(curves.firsts)
    return offset


class Trees:
    """The trees over the pieces of all shapes of curves of a scene, which kernels find by numbers in the flat values.

    A tree, its number and the pieces of each segment stay the same for as long as the scene lives.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._trees: dict[int, wp.Bvh] = {}
        self._packets: dict[int, Packets] = {}
        for shape in scene.builder.curves:
            self._renew(shape)

    def follow(self, changed: Iterable[Parameter]) -> set[int]:
        """Follow control points and poses that have changed, and return the shapes whose control points did.

        Raises:
            ValueError: a control point is not finite, or a radius is negative.
        """
        curves = self._scene.builder.curves
        edited = {p.owner for p in changed if SHAPE_GRID in p.uses and p.owner in curves}
        for shape in edited | {p.owner for p in changed if SHAPE_POSE in p.uses and p.owner in curves}:
            self._renew(shape)
        return edited

    def _renew(self, shape: int) -> None:
        """Write what follows from a shape's control points and its pose, and make or rebuild its tree."""
        scene, curves = self._scene, self._scene.description.shapes[shape].curves
        assert curves is not None
        place, pose = scene.builder.curves[shape], scene.poses.offsets(shape)[0]
        size, first = curves.points.size, place + HEADER
        to_world = scene.values[pose : pose + 16].numpy().astype(np.float64).reshape(4, 4)
        local = scene.values[first : first + size].numpy().astype(np.float64).reshape(-1, 4)
        if not np.isfinite(local).all() or (local[:, 3] < 0.0).any():
            path = scene.description.shapes[shape].path
            raise ValueError(f"{path}.control_points: a number is not finite, or a radius is negative; restore them")
        world = np.concatenate([transform_points(to_world, local[:, :3]), local[:, 3:]], axis=1).astype(np.float32)
        scene.values[first + size : first + 2 * size].assign(world.reshape(-1))
        low, high = (x.astype(np.float32) for x in hulls(world.astype(np.float64), curves))
        number = place + 19
        if shape in self._trees:
            self._trees[shape].lowers.assign(low)
            self._trees[shape].uppers.assign(high)
            if scene.device.is_cpu:  # rays do not walk it there
                self._trees[shape].refit()
            else:
                self._trees[shape].rebuild()
        else:
            low_boxes, high_boxes = (wp.array(x, dtype=wp.vec3, device=scene.device) for x in (low, high))
            self._trees[shape] = wp.Bvh(low_boxes, high_boxes, leaf_size=LEAF)
            scene.values[number : number + 2].assign(np.array([self._trees[shape].id], np.uint64).view(np.float32))
            if scene.device.is_cpu:
                self._packets[shape] = Packets(len(low))
        if scene.device.is_cpu:
            scene.values[number + 2 : first].assign(self._packets[shape].follow(low, high))
        box = np.eye(4)
        box[:3, :3] = np.diag(0.5 * (high.max(axis=0) - low.min(axis=0)))
        box[:3, 3] = 0.5 * (high.max(axis=0) + low.min(axis=0))
        scene.values[place : place + 16].assign(box.astype(np.float32).reshape(-1))
        corners = _box(local, to_world)
        scene.poses.local(shape)[0].assign(corners.astype(np.float32))
        moved = transform_points(to_world, corners).astype(np.float32).reshape(-1)
        positions = scene.poses.offsets(shape)[1]
        scene.values[positions : positions + moved.size].assign(moved)


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

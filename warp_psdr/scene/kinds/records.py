"""Shapes without triangles: their description, their records on the device, and what follows their values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_psdr.device import launch
from warp_psdr.kernels.primitive.affine import update_primitive
from warp_psdr.scene.description import BsdfDescription, ShapeDescription
from warp_psdr.scene.errors import error
from warp_psdr.scene.kinds.kind import Geometry, geometry_of
from warp_psdr.scene.layout import SHAPE_GRID, SHAPE_POSE, Parameter
from warp_psdr.scene.transforms import singular, transform_points

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene


def shape_of(props: Properties, geometry: Geometry, to_world: np.ndarray, bsdf: BsdfDescription) -> ShapeDescription:
    """Return the shape of a geometry, to which its light and its sides are added.

    Raises:
        ValueError: its pose has no inverse.
    """
    reason = singular(to_world)
    if reason:
        raise error(props.where, reason, geometry.invertible)
    local = geometry.corners(to_world)
    return ShapeDescription(
        path=props.path,
        kind=props.type,
        vertices=transform_points(to_world, local).astype(np.float32),
        faces=np.zeros((0, 3), np.int32),
        bsdf=bsdf,
        to_world=to_world.astype(np.float32),
        local_vertices=local.astype(np.float32),
        geometry=geometry,
    )


def update_record(scene: Scene, shape: int) -> None:
    """Write the record of a shape of a scene from its pose; these records follow those of the triangles.

    Raises:
        ValueError: its pose has no inverse.
    """
    s, frame = scene.description.shapes[shape], scene.builder.frames[shape]
    geometry = geometry_of(s)
    reason = "" if geometry.follows_pose else singular(scene.values[frame : frame + 16].numpy().reshape(4, 4))
    if reason:
        raise ValueError(f"{s.path}.to_world: {reason}; restore a pose that has one")
    place = scene.face_count + scene.builder.primitives.index(shape)
    inputs = [scene.values, frame, shape, geometry.device.number, scene.builder.shapes[shape].orientation, place]
    launch(update_primitive, dim=1, inputs=inputs, outputs=[scene.triangles], device=scene.device)


def position_of(scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
    """Return the point (3,) that a vertex holds, in the device's coordinates; ``record`` is that of its face."""
    geometry = scene.description.shapes[int(record["shape"])].geometry
    if geometry is None:
        return (1.0 - u - v) * record["p0"] + u * record["p1"] + v * record["p2"]
    return geometry.position(scene, record, u, v)


class Followers:
    """What is made of the values of shapes without triangles, and of their poses, on the host.

    Args:
        scene: whose shapes have been moved to their poses.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._states: dict[int, Any] = {}
        self._posed = {i for i in scene.builder.primitives if geometry_of(scene.description.shapes[i]).follows_pose}
        self.renew()

    def renew(self) -> None:
        """Write all that follows poses, also where values of another scene name its trees, which may be gone."""
        self._renew(self._posed)

    def move(self, changed: Iterable[Parameter]) -> set[int]:
        """Follow what moves the shapes that follow their poses, and return those whose values have changed.

        Raises:
            ValueError: a value cannot be used.
        """
        own = [p for p in changed if p.owner in self._posed and p.uses & {SHAPE_GRID, SHAPE_POSE}]
        self._renew({p.owner for p in own})
        return {p.owner for p in own if SHAPE_GRID in p.uses}

    def follow(self, changed: Iterable[Parameter]) -> None:
        """Follow the values of all other shapes.

        Raises:
            ValueError: a value cannot be used.
        """
        self._renew({p.owner for p in changed if SHAPE_GRID in p.uses} - self._posed)

    def _renew(self, shapes: set[int]) -> None:
        for shape in sorted(shapes):
            geometry = geometry_of(self._scene.description.shapes[shape])
            self._states[shape] = geometry.follow(self._scene, shape, self._states.get(shape))

"""What the host asks of a kind of shape without triangles.

A kind is a class, and the geometry of a shape is an object of it: the class says what all shapes of the kind have in
common, the object holds what one was given. ``table.py`` lists the kinds. Callers ask a geometry, and do not test which
kind it is.

In place of vertices such a shape has the corners of a box around it, which move with it. Code that asks how large a
scene is, and where, finds these corners among the points of the scene. No triangle and no parameter uses them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from warp_psdr.kernels.primitive.kind import MATERIAL, Kind

if TYPE_CHECKING:
    from warp_psdr.scene.description import ShapeDescription
    from warp_psdr.scene.layout import Layout
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene


class Geometry(ABC):
    """The geometry of a shape without triangles."""

    plugin: ClassVar[str]  #: that is read as this kind
    name: ClassVar[str]  #: of the kind; that of its plugin, unless the plugin stands for several
    device: ClassVar[Kind]  #: what it declares there
    jumps: ClassVar[str] = ""  #: where its normals jump, so that no point flows along them
    has_uv: ClassVar[bool] = True  #: whether it has texture coordinates
    bounds_media: ClassVar[bool] = False  #: whether it may have media for its interior and exterior
    #: What the kernels read of it, its record included, is made on the host from its values and its pose, which then
    #: needs no inverse (``follow``).
    follows_pose: ClassVar[bool] = False
    instead: ClassVar[str]  #: what errors offer
    invertible: ClassVar[str] = "give it an extent along all axes"  #: what errors offer for a pose without an inverse
    #: What errors offer for one in a group; empty: a group may hold one, alone.
    outside_groups: ClassVar[str] = "put it in the scene itself, once for each place"

    @classmethod
    def is_asked_for(cls, props: Properties) -> bool:
        """Return whether a plugin of this name asks for this kind, and not for triangles.

        Raises:
            ValueError: it also asks for what only triangles have.
        """
        return True

    @classmethod
    @abstractmethod
    def read(cls, props: Properties, to_world: np.ndarray) -> tuple[Geometry, np.ndarray]:
        """Take the geometry of a plugin with a pose (4, 4), and return it with the pose of what is read.

        Raises:
            ValueError: a value cannot be used.
        """

    @property
    def title(self) -> str:
        """How messages call it."""
        return f"a '{self.plugin}'"

    @property
    def is_material(self) -> bool:
        """Whether its points ride on its surface."""
        return self.device.moves == MATERIAL

    @property
    @abstractmethod
    def knows(self) -> frozenset[str]:
        """The words (``options/words.py``) of what it may be, or be seen in, where something moves."""

    @property
    def shines(self) -> bool:
        """Whether an area light may be on it."""
        return self.device.affine is not None and self.device.affine.light is not None

    @abstractmethod
    def corners(self, to_world: np.ndarray) -> np.ndarray:
        """Return the corners (N, 3) of a box around it, which the pose (4, 4) is applied to."""

    def parameters(self) -> dict[str, np.ndarray]:
        """Return its own parameters, beside the pose: what follows the shape's path in their names -> values."""
        return {}

    def lay(self, layout: Layout, path: str, shape: int, pose: int) -> int:
        """Lay out what the kernels read behind the pose, and return the flat offset that the shape's record names.

        Args:
            layout: behind the pose.
            path: of the shape.
            shape: its number.
            pose: flat offset of its pose.
        """
        return pose

    def follow(self, scene: Scene, shape: int, state: Any) -> Any:
        """Write what follows from the values, and from the pose of a kind that ``follows_pose``, after they changed.

        Args:
            scene: the scene.
            shape: number of the shape.
            state: what the last call returned; None: there was none.

        Raises:
            ValueError: a value cannot be used.
        """
        return state

    @abstractmethod
    def position(self, scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
        """Return the point (3,) that a vertex holds, in the device's coordinates; ``record``: of the shape."""

    def area(self, box: np.ndarray) -> float:
        """Return the area, to a relative 1e-4, of a kind that shines; ``box``: the corners around it, (N, 3)."""
        raise NotImplementedError(f"{self.title} does not shine")

    @classmethod
    @abstractmethod
    def describe(cls, shapes: Sequence[tuple[str, Geometry]]) -> list[tuple[str, str, str]]:
        """Return the plan's lines about shapes of this class, one or more, by their paths."""


def geometry_of(shape: ShapeDescription) -> Geometry:
    """Return the geometry of a shape that is known to have no triangles."""
    assert shape.geometry is not None
    return shape.geometry

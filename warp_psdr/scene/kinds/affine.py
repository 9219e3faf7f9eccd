"""Exact shapes: a fixed surface under an affine map (``kernels/primitive/affine.py``), and its tessellation."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from warp_psdr.options.words import words
from warp_psdr.scene.errors import error
from warp_psdr.scene.kinds.kind import Geometry
from warp_psdr.scene.shapes.primitives import Tessellation, surface_area

if TYPE_CHECKING:
    from warp_psdr.scene.plugins import Properties
    from warp_psdr.scene.scene import Scene

#: Segments of the tessellation whose area stands for that of an exact shape, by which lights are chosen.
AREA_SEGMENTS = 128
#: Segments at which the area of a shape is measured; errors of fourth order in their inverse are left.
_FINE = (128, 256)


def corners_of(*ends: tuple[float, ...]) -> np.ndarray:
    """Return the corners (N, 3) of a box with these ends along each axis."""
    return np.array(list(itertools.product(*ends)), np.float32)


class Exact(Geometry):
    """An exact shape: all that is known of one is its kind.

    Without 'exact' its plugin is made of triangles (``tessellate``).
    """

    bounds_media = True
    instead = "leave out 'exact': the tessellated shape takes it"
    invertible = "give all three columns an extent; that of a 'disk' along its normal is free"
    outside_groups = "leave out 'exact', or put it in the scene itself"
    box: ClassVar[np.ndarray]  #: (N, 3) corners of the box around it

    @classmethod
    def is_asked_for(cls, props: Properties) -> bool:
        """Return whether a plugin asks to be exact.

        Raises:
            ValueError: it also asks for what only triangles have.
        """
        if not props.boolean("exact", False):
            return False
        for key in ("resolution", "face_normals"):
            if props.has(key):
                problem = f"'exact' beside '{key}'"
                raise error(props.where, problem, "an exact shape has no triangles; leave out one of the two")
        return True

    @classmethod
    def read(cls, props: Properties, to_world: np.ndarray) -> tuple[Geometry, np.ndarray]:
        """Return the shape, and the pose that its own parameters are a part of."""
        return cls(), to_world @ cls.frame(props)

    @classmethod
    def frame(cls, props: Properties) -> np.ndarray:
        """Return the matrix (4, 4) of the parameters that stand for a pose; they are those of the tessellation, too."""
        return np.eye(4)

    @property
    def title(self) -> str:
        """How messages call it."""
        return f"an exact '{self.plugin}'"

    @property
    def knows(self) -> frozenset[str]:
        """It may be of every material."""
        return words("mirrors", "mirror", "glass", "mixed")

    def corners(self, to_world: np.ndarray) -> np.ndarray:
        """Return the corners (N, 3) of the box around it."""
        return self.box

    @staticmethod
    @abstractmethod
    def tessellate(resolution: int) -> Tessellation:
        """Return its triangles, of so many segments in a full turn."""

    @staticmethod
    @abstractmethod
    def points(u, v) -> np.ndarray:
        """Return its points (..., 3), in its own coordinates, by the two numbers that a vertex holds."""

    def position(self, scene: Scene, record: np.void, u: float, v: float) -> np.ndarray:
        """Return the point (3,) that a vertex holds."""
        return placed(record, self.points(u, v))

    def reach(self, way: np.ndarray) -> float:
        """Return how far it reaches from the middle of its box along w . q, at most; ``way``: w (3,)."""
        return float(np.abs(way) @ (0.5 * (self.box.max(axis=0) - self.box.min(axis=0))))

    def area(self, box: np.ndarray) -> float:
        """Return the area, to a relative 1e-4."""
        linear = np.linalg.lstsq(np.pad(self.box.astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0), box)[0]
        pose = np.eye(4)
        pose[:3, :3] = linear[:3].T
        source = self.tessellate(AREA_SEGMENTS)
        return surface_area(source.vertices, source.faces, pose)

    @classmethod
    def widening(cls, vertices: np.ndarray, faces: np.ndarray, to_world: np.ndarray) -> np.ndarray:
        """Return the object-space scale, (3,), at which a tessellation has the area of the shape itself.

        A light then keeps its power at the radiance that its scene states. It also keeps the mean of its projected
        areas, a quarter of the area of a convex body (Cauchy), so that what is far away receives the right irradiance.

        Args:
            vertices: (N, 3) of the tessellation.
            faces: (M, 3) of the tessellation.
            to_world: (4, 4), under which the areas are compared.
        """
        coarse, fine = (surface_area(t.vertices, t.faces, to_world) for t in map(cls.tessellate, _FINE))
        # Richardson's extrapolation.
        ratio = (fine + (fine - coarse) / ((_FINE[1] / _FINE[0]) ** 2 - 1.0)) / surface_area(vertices, faces, to_world)
        return cls.widened(ratio)

    @classmethod
    def widened(cls, ratio: float) -> np.ndarray:
        """Return the object-space scale, (3,), that makes the area of the tessellation as much larger."""
        return np.full(3, np.sqrt(ratio))

    @classmethod
    def describe(cls, shapes: Sequence[tuple[str, Geometry]]) -> list[tuple[str, str, str]]:
        """Return one line about all of them."""
        kinds = [geometry.name for _path, geometry in shapes]
        found = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        return [("exact shapes", found, "without triangles; every ray is tested against each")]


def placed(record: np.void, q: np.ndarray) -> np.ndarray:
    """Return the point (3,) that the pose in a shape's record makes of a point of its own coordinates."""
    return record["normal"] + q[0] * record["p0"] + q[1] * record["p1"] + q[2] * record["p2"]

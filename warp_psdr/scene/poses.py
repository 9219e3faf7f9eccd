"""Shapes with a pose: ``to_world`` moves vertices and normals, which are otherwise the scene's own.

A shape's object-space geometry is what its pose was applied to. That of a mesh file, or of a shape whose vertices were
edited, is found from the vertices in the world, when it is first needed: by the pose that they had then.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.shape.transform import pose_shape

if TYPE_CHECKING:
    from warp_psdr.scene.scene import Scene

#: Object-space positions and normals; or the (3, 4) pose by which they are found from those in the world.
Local = tuple[wp.array, wp.array] | np.ndarray


class Poses:
    """The object-space geometry of all posed shapes.

    Args:
        scene: whose shapes they are, before its kernels are compiled.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._local: dict[int, Local] = {}
        for i, s in enumerate(scene.description.shapes):
            if s.to_world is None or s.prototype is not None:
                continue
            if s.local_vertices is None:
                self._local[i] = s.to_world[:3].astype(np.float64)
            else:
                self._local[i] = self._vectors(s.local_vertices), self._vectors(s.local_normals)
        self._local |= scene.instances.local_geometry()

    def _vectors(self, values: np.ndarray | None) -> wp.array:
        """Return (N, 3) as an array of vec3; one zero in place of None, for Warp has no null array of structures."""
        return wp.array(np.zeros((1, 3)) if values is None else values, dtype=wp.vec3, device=self._scene.device)

    def __contains__(self, shape: int) -> bool:
        return shape in self._local

    def apply_all(self) -> None:
        """Move what was given in object space to the world."""
        for shape, local in self._local.items():
            if isinstance(local, tuple):
                self.apply(shape)

    def apply(self, shape: int, with_normals: bool = True) -> None:
        """Move a shape's vertices, and its normals, to where its pose has them."""
        positions, normals = self.local(shape)
        to_world, first, first_normal = self.offsets(shape)
        launch(
            pose_shape,
            dim=self._scene.builder.shapes[shape].vertex_count,
            inputs=[positions, normals, to_world, first, first_normal if with_normals else -1],
            outputs=[self._scene.values],
            device=self._scene.device,
        )

    def local(self, shape: int) -> tuple[wp.array, wp.array]:
        """Return the object-space positions and normals of a shape."""
        local = self._local[shape]
        if isinstance(local, tuple):
            return local
        _to_world, positions, normals = self.offsets(shape)
        linear, size = local[:, :3], 3 * self._scene.builder.shapes[shape].vertex_count
        local_positions = np.linalg.solve(linear, (self._stretch(positions, size).reshape(-1, 3) - local[:, 3]).T).T
        local_normals = None
        if normals >= 0:
            local_normals = self._stretch(normals, size).reshape(-1, 3) @ linear
            local_normals /= np.maximum(np.linalg.norm(local_normals, axis=1, keepdims=True), np.finfo(float).tiny)
        self._local[shape] = found = self._vectors(local_positions), self._vectors(local_normals)
        return found

    def take(self, shape: int) -> None:
        """Let the object-space geometry of a shape follow its vertices and normals in the world.

        Raises:
            ValueError: its pose has no inverse.
        """
        pose = self._stretch(self.offsets(shape)[0], 16).reshape(4, 4)[:3]
        if np.linalg.matrix_rank(pose[:, :3]) < 3:
            path = self._scene.description.shapes[shape].path
            raise ValueError(
                f"{path}.to_world has no inverse, so what it moves cannot be edited; set a pose that has one first"
            )
        self._local[shape] = pose

    def state(self) -> dict[int, Local]:
        """Return what edits change, for ``restore``."""
        return dict(self._local)

    def restore(self, state: dict[int, Local]) -> None:
        """Go back to a state of this scene, or of one like it; the scene's values do so, too."""
        device = self._scene.device

        def here(local):
            if isinstance(local, np.ndarray) or isinstance(local[0], wp.array):
                return local
            return tuple(wp.array(values, dtype=wp.vec3, device=device) for values in local)

        self._local = {shape: here(local) for shape, local in state.items()}

    def offsets(self, shape: int) -> tuple[int, int, int]:
        """Flat offsets of a posed shape's matrix, of its first position and of its first normal.

        The last is -1 where the pose moves none: without normals, and where normals are computed from positions.
        """
        scene = self._scene
        record, s = scene.builder.shapes[shape], scene.description.shapes[shape]
        to_world = scene.parameters[scene.builder.pose_of[shape]].offset
        computed = s.normals_computed and s.prototype is None
        normals = record.normal_offset + 3 * record.first_vertex if record.smooth and not computed else -1
        return to_world, scene.positions + 3 * record.first_vertex, normals

    def _stretch(self, offset: int, size: int) -> np.ndarray:
        return self._scene.values[offset : offset + size].numpy().astype(np.float64)

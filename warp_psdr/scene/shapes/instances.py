"""Copies of the shapes of groups: their vertices as a function of the original, and both directions of the derivative.

A copy's position is x = M p + t, with the vertex p of the group's shape and the pose of the instance; its normal is
normalize(M^-T n). The adjoint of p is therefore the sum of M^T dx over the copies (``kernels/shape/transform.py``).
Normals n that follow from the vertices do so in the group's space, as in Mitsuba.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr.device import launch
from warp_psdr.kernels.shape.normals import normalization_jvp, normalization_vjp, sum_normals_jvp, sum_normals_vjp
from warp_psdr.kernels.shape.transform import add_sums, local_shape_jvp, local_shape_vjp
from warp_psdr.scene.derived_values import sum_of_normals
from warp_psdr.scene.layout import NORMALS, POSITIONS, Parameter

if TYPE_CHECKING:
    from warp_psdr.scene.build import Prototype
    from warp_psdr.scene.scene import Scene


class Instances:
    """The shapes of groups, called prototypes here, and their copies.

    Args:
        scene: of which this is a part.
    """

    def __init__(self, scene: Scene):
        self._scene = scene
        self._prototypes: list[Prototype] = scene.builder.prototypes
        self._faces: dict[int, wp.array] = {}

    def local_geometry(self) -> dict[int, tuple[wp.array, wp.array]]:
        """Return, by number of every copy, views of the values of the vertices and normals that it follows."""
        found = {}
        nothing = wp.zeros(1, dtype=wp.vec3, device=self._scene.device)
        for p in self._prototypes:
            normals = nothing if p.normals < 0 else self._view(p.normals, p)
            found |= dict.fromkeys(p.copies, (self._view(p.positions, p), normals))
        return found

    def _view(self, offset: int, p: Prototype) -> wp.array:
        count = len(p.description.vertices)
        return self._scene.values[offset : offset + 3 * count].reshape((count, 3)).view(wp.vec3)

    def following(self, names: list[str]) -> list[int]:
        """Numbers of the copies that follow named vertices or normals."""
        return [shape for k in self._named(names) for shape in self._prototypes[k].copies]

    def derived_normals(self, names: list[str]) -> list[int]:
        """Numbers of the prototypes with named vertices and normals that follow these."""
        found = [self._scene.parameters[name] for name in names]
        numbers = {p.prototype for p in found if p.prototype >= 0 and POSITIONS in p.uses}
        return sorted(k for k in numbers if self._prototypes[k].description.normals_computed)

    def _named(self, names: list[str]) -> list[int]:
        found = [self._scene.parameters[name] for name in names]
        return sorted({p.prototype for p in found if p.prototype >= 0 and p.uses & {POSITIONS, NORMALS}})

    def follow(self, changed: list[Parameter], posed: set[int]) -> set[int]:
        """Let the normals of prototypes follow their vertices; return the copies that have to follow both.

        Args:
            changed: what was edited.
            posed: numbers of the shapes whose poses were.

        Raises:
            ValueError: a copy would be mirrored, or no longer be, against what was loaded.
        """
        for shape in sorted(posed):
            self._check_side(shape)
        edited = [p for p in changed if p.prototype >= 0 and p.uses & {POSITIONS, NORMALS}]
        kept = {p.prototype for p in edited if NORMALS in p.uses}
        for number in self.derived_normals([p.name for p in edited]):
            if number not in kept:
                self._sums(number, write=True)
        return {shape for p in edited for shape in p.owners}

    def followed(self, names: list[str]) -> list[str]:
        """Names of the normals that follow named vertices."""
        return [f"{self._prototypes[k].description.path}.vertex_normals" for k in self.derived_normals(names)]

    def _check_side(self, shape: int) -> None:
        scene, s = self._scene, self._scene.description.shapes[shape]
        if s.prototype is None or s.to_world is None:
            return
        name = scene.builder.pose_of[shape]
        offset = scene.parameters[name].offset
        matrix = scene.values[offset : offset + 16].numpy().astype(np.float64).reshape(4, 4)
        if np.linalg.det(matrix[:3, :3]) * np.linalg.det(s.to_world[:3, :3].astype(np.float64)) < 0.0:
            raise ValueError(
                f"{name}: the edit mirrors an instance, whose triangles would show their other side; load the scene "
                "with that pose"
            )

    def _face_indices(self, number: int) -> wp.array:
        if number not in self._faces:
            faces = self._prototypes[number].description.faces.reshape(-1)
            self._faces[number] = wp.array(faces, dtype=wp.int32, device=self._scene.device)
        return self._faces[number]

    def _sums(self, number: int, *, write: bool) -> wp.array:
        p = self._prototypes[number]
        faces = (self._face_indices(number), 0, len(p.description.faces), 0, len(p.description.vertices))
        return sum_of_normals(self._scene, p.positions, *faces, p.normals if write else -1)

    def pull(self, names: list[str], grad: wp.array) -> None:
        """Add up what named prototypes get from their copies: through poses, then through normals of their own.

        Args:
            names: requested parameters.
            grad: flat gradients, in place.
        """
        scene, device = self._scene, self._scene.device
        for number in self._named(names):
            p = self._prototypes[number]
            count = len(p.description.vertices)
            sums = [wp.zeros(3 * count, dtype=wp.float64, device=device) for _ in range(2)]
            for shape in p.copies:
                inputs = [scene.values, *scene.poses.local(shape), *scene.poses.offsets(shape), grad]
                launch(local_shape_vjp, dim=count, inputs=inputs, outputs=sums, device=device)
            for total, offset in zip(sums, (p.positions, p.normals), strict=True):
                if offset >= 0:
                    launch(add_sums, dim=3 * count, inputs=[total, offset], outputs=[grad], device=device)
            if number in self.derived_normals(names):
                normals = self._sums(number, write=False)
                adjoint = wp.zeros_like(normals)
                inputs = [normals, grad, p.normals]
                launch(normalization_vjp, dim=count, inputs=inputs, outputs=[adjoint], device=device)
                inputs = [scene.values, p.positions, self._face_indices(number), 0, 0, adjoint]
                faces = len(p.description.faces)
                launch(sum_normals_vjp, dim=faces, inputs=inputs, outputs=[grad], device=device)

    def push(self, names: list[str], tangent: wp.array) -> None:
        """Add the tangents of the copies of named prototypes.

        Args:
            names: parameters with a tangent.
            tangent: flat tangents, in place.
        """
        scene, device = self._scene, self._scene.device
        for number in self._named(names):
            p = self._prototypes[number]
            count = len(p.description.vertices)
            if number in self.derived_normals(names):
                normals = self._sums(number, write=False)
                sums = wp.zeros_like(normals)
                inputs = [scene.values, p.positions, self._face_indices(number), 0, 0, tangent]
                launch(sum_normals_jvp, dim=len(p.description.faces), inputs=inputs, outputs=[sums], device=device)
                inputs = [normals, sums, p.normals]
                launch(normalization_jvp, dim=count, inputs=inputs, outputs=[tangent], device=device)
            for shape in p.copies:
                inputs = [scene.values, *scene.poses.local(shape), *scene.poses.offsets(shape)]
                inputs += [p.positions, p.normals]
                launch(local_shape_jvp, dim=count, inputs=inputs, outputs=[tangent], device=device)

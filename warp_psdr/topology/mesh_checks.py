"""Checks for meshes and values that an optimisation ruins, which are found at that step and put back.

After too long a step, vertices become NaN or infinite, triangles collapse to lines or points, or turn over. Rendering
goes on in the last two cases (rays miss a collapsed triangle, and a flipped one shows its back), so that the loss tells
late, or never. A triangle has collapsed when its area is below ``FLAT`` times its longest edge squared, and was not
before. It has flipped when its normal is more than a right angle from that after the last good step. Single triangles
do both in healthy runs; a tenth of a mesh at once is a step that cannot be trusted.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from warp_psdr.scene.layout import POSITIONS

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters

#: Area over the longest edge squared below which a triangle has none: float32 holds no such area. As on load.
FLAT = 1.0e-9
#: Share of a mesh's triangles that may collapse or flip in one step.
SHARE = 0.1


@dataclass(frozen=True)
class Finding:
    """What happened to a parameter in a step.

    Attributes:
        parameter: Its name.
        step: As it was given to the check.
        kind: What happened.
        count: Numbers, or triangles, to which it happened.
        total: Of how many.
        first: Index of the first of them: of a number in the flattened values, or of a triangle of the shape.
    """

    parameter: str
    step: int
    kind: Literal["not finite", "collapsed", "flipped"]
    count: int
    total: int
    first: int

    def __str__(self) -> str:
        """Return a sentence's part."""
        what = "values are" if self.kind == "not finite" else "triangles have"
        return f"{self.parameter!r}: {self.count} of {self.total} {what} {self.kind} (the first: {self.first})"


class MeshError(ValueError):
    """A step has ruined parameters; ``findings`` says how."""

    def __init__(self, findings: list[Finding]):
        self.findings = findings
        super().__init__(
            f"step {findings[0].step} has ruined parameters: {'; '.join(map(str, findings))}. The last good values are "
            "those of the step before: go back to them (MeshWatch.back_off, or a checkpoint) and lower the learning "
            "rate; psdr.optim.LargeSteps keeps the triangles of a mesh in shape"
        )


class MeshWatch:
    """Watches the requested parameters of a scene during an optimisation.

        watch = MeshWatch(params)
        for step in range(100):
            ...
            with watch.step(step):      # or: optimizer.step(); watch.check(step)
                optimizer.step()

    Args:
        params: Parameters of a scene, after ``requires_grad``; their present values count as good.
        share: Share of a mesh's triangles that may collapse, or flip, in one step.

    Attributes:
        seen: All collapsed and flipped triangles found so far, tolerated ones included.
    """

    def __init__(self, params: Parameters, *, share: float = SHARE):
        if not 0.0 <= share < 1.0:
            raise ValueError(f"share: got {share}, expected a number in [0, 1)")
        self._params = params
        self._share = share
        self.seen: list[Finding] = []
        scene = params.scene
        self._faces: dict[str, np.ndarray] = {}
        for name in params.requested:
            p = scene.parameters[name]
            if POSITIONS in p.uses:
                shape = scene.builder.shapes[p.owner]
                rows = slice(shape.first_face, shape.first_face + shape.face_count)
                self._faces[name] = scene.builder.indices[rows] - shape.first_vertex
        self._keep()

    def check(self, step: int) -> None:
        """Look at the values after a step; they are the good ones from now on.

        Raises:
            MeshError: The step has ruined them; the good ones stay those of the last check.
        """
        fatal = self._not_finite(step)
        if not fatal:
            for name in self._faces:
                for found in self._turned(name, step):
                    self.seen.append(found)
                    if found.count > self._share * found.total:
                        fatal.append(found)
        if fatal:
            raise MeshError(fatal)
        self._keep()

    @contextlib.contextmanager
    def step(self, step: int) -> Iterator[None]:
        """Check what is done inside, once it is done or has failed.

        Raises:
            MeshError: It has ruined the parameters.
        """
        try:
            yield
        except ValueError as error:
            # An update of the scene says that vertices are not finite, but not whose.
            fatal = self._not_finite(step)
            if fatal:
                raise MeshError(fatal) from error
            raise
        self.check(step)

    def back_off(self) -> None:
        """Put the last good values back."""
        for name, values in self._good.items():
            self._params[name] = values
        self._params.update()

    def _keep(self) -> None:
        self._good = {name: self._params[name].numpy().copy() for name in self._params.requested}
        self._normals = {name: normals(self._good[name], faces) for name, faces in self._faces.items()}

    def _not_finite(self, step: int) -> list[Finding]:
        findings = []
        for name in self._params.requested:
            bad = ~np.isfinite(self._params[name].numpy().reshape(-1))
            if bad.any():
                findings.append(Finding(name, step, "not finite", int(bad.sum()), bad.size, int(bad.argmax())))
        return findings

    def _turned(self, name: str, step: int) -> Iterator[Finding]:
        now, before = normals(self._params[name].numpy(), self._faces[name]), self._normals[name]
        solid = before.any(axis=1)
        masks: dict[Literal["not finite", "collapsed", "flipped"], np.ndarray] = {
            "collapsed": np.asarray(solid & ~now.any(axis=1)),
            "flipped": (now * before).sum(axis=1) < 0.0,
        }
        for kind, mask in masks.items():
            if mask.any():
                yield Finding(name, step, kind, int(mask.sum()), len(mask), int(mask.argmax()))


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals of triangles, (M, 3) float64; zeros for those without an area.

    Args:
        vertices: (N, 3).
        faces: (M, 3).
    """
    corners = vertices.astype(np.float64)[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    cross = np.cross(edges[:, 1], edges[:, 2])
    doubled = np.linalg.norm(cross, axis=1)
    flat = doubled <= 2.0 * FLAT * (edges**2).sum(axis=2).max(axis=1)
    return np.where(flat[:, None], 0.0, cross / np.where(flat, 1.0, doubled)[:, None])

"""Affine transformations of 3D space."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from warp_psdr.scene.errors import SceneError

#: Numbers are 32-bit on the device.
FLOAT_MAX = float(np.finfo(np.float32).max)
#: Volume of a pose over the product of the lengths of its columns, up to which it has no inverse in float32.
FLAT = 1.0e-6


class _Chained(staticmethod):
    """Let a constructor be called on the class, or on a transformation that it then extends."""

    def __get__(self, instance: Any, owner: type[Any] | None = None) -> Callable[..., Transform]:
        function, kind = self.__func__, owner or Transform

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Transform:
            step = kind(function(*args, **kwargs))
            return step if instance is None else instance @ step

        # For help() and the documentation; the function itself returns a matrix.
        call.__signature__ = inspect.signature(function).replace(return_annotation=Transform)  # type: ignore[attr-defined]
        return call


class Transform:
    """An affine transformation, a 4x4 matrix that acts on column vectors.

    The constructors work on the class and in chains: ``Transform.translate(a) @ Transform.scale(b)`` equals
    ``Transform().translate(a).scale(b)``; both scale first and translate last.

    Args:
        matrix: Shape (4, 4), or (3, 3) for a linear map; identity by default.

    Raises:
        ValueError: If the matrix is of another shape, is not finite or is not affine.
    """

    __slots__ = ("matrix",)

    matrix: np.ndarray

    def __init__(self, matrix: Any = None):
        self.matrix = np.eye(4) if matrix is None else as_matrix(matrix)

    @_Chained
    def translate(v: Any) -> np.ndarray:
        """Return the translation by ``v``, shape (3,)."""
        matrix = np.eye(4)
        matrix[:3, 3] = _vector(v, "translate")
        return matrix

    @_Chained
    def scale(v: Any) -> np.ndarray:
        """Return the scaling by ``v``, one number or shape (3,)."""
        factors = np.asarray(v, dtype=np.float64)
        return np.diag([*(np.full(3, factors) if factors.ndim == 0 else _vector(v, "scale")), 1.0])

    @_Chained
    def rotate(axis: Any, degrees: float) -> np.ndarray:
        """Return the rotation about ``axis``, a unit vector of shape (3,), by an angle in degrees, counter-clockwise.

        As in Mitsuba 3, the axis is taken as it is: if its length is not one, the matrix scales and is no rotation.
        """
        v = _vector(axis, "rotate")
        _unit(v, "the axis of a rotation has no length; give a non-zero axis")
        x, y, z = v
        angle = math.radians(float(degrees))
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        matrix = np.eye(4)
        # Rodrigues' formula.
        cosine = math.cos(angle)
        matrix[:3, :3] = cosine * np.eye(3) + math.sin(angle) * cross + (1.0 - cosine) * np.outer(v, v)
        return matrix

    @_Chained
    def look_at(origin: Any, target: Any, up: Any = (0.0, 1.0, 0.0)) -> np.ndarray:
        """Return the frame at ``origin`` whose +z points to ``target``, with +y towards ``up`` and +x to the left."""
        eye = _vector(origin, "look_at origin")
        z = _unit(_vector(target, "look_at target") - eye, "origin and target of look_at coincide; move one of them")
        hint = "up of look_at is zero or parallel to the viewing direction; choose another up vector"
        x = _unit(np.cross(_unit(_vector(up, "look_at up"), hint), z), hint)
        matrix = np.eye(4)
        matrix[:3, :4] = np.stack([x, np.cross(z, x), z, eye], axis=1)
        return matrix

    def inverse(self) -> Transform:
        """Return the inverse transformation."""
        return Transform(np.linalg.inv(self.matrix))

    def __matmul__(self, other: Any) -> Transform:
        """Compose: the right operand is applied first."""
        return Transform(self.matrix @ as_matrix(other))

    def __rmatmul__(self, other: Any) -> Transform:
        """Compose with a matrix on the left."""
        return Transform(as_matrix(other) @ self.matrix)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the matrix, shape (4, 4)."""
        return np.array(self.matrix, dtype=dtype)

    def __repr__(self) -> str:
        """Return the matrix as text."""
        return f"Transform({self.matrix.tolist()})"


def as_matrix(value: Any) -> np.ndarray:
    """Return a 4x4 float64 matrix from a ``Transform``, an array, nested lists or another library's transform.

    Raises:
        ValueError: If the value is no affine transformation of 3D space.
    """
    if isinstance(value, Transform):
        return value.matrix
    # Transforms of other libraries carry their matrix in an attribute of this name.
    source = getattr(value, "matrix", value)
    try:
        matrix = np.array(source, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"got {value!r} for a transformation; give a 4x4 matrix or a psdr.Transform") from None
    if matrix.shape == (3, 3):
        linear, matrix = matrix, np.eye(4)
        matrix[:3, :3] = linear
    if matrix.shape != (4, 4):
        raise SceneError(f"a transformation has shape {matrix.shape}; give a 4x4 matrix or a psdr.Transform")
    if not np.isfinite(matrix).all():
        raise SceneError("a transformation holds NaN or infinity; give finite numbers")
    if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
        raise SceneError(
            f"the last row of a transformation is {matrix[3].tolist()}; only affine maps are supported, "
            "so it must be [0, 0, 0, 1]"
        )
    return matrix


def singular(to_world: np.ndarray) -> str:
    """Return what is wrong with a pose (4, 4); empty: nothing."""
    linear = np.asarray(to_world, np.float64)[:3, :3]
    if not np.isfinite(to_world).all():
        return f"its to_world is not finite: {np.asarray(to_world).tolist()}"
    lengths = np.linalg.norm(linear, axis=0)
    if not (lengths > 0.0).all() or abs(np.linalg.det(linear / np.maximum(lengths, 1e-300))) <= FLAT:
        return f"its to_world has no inverse: {np.asarray(to_world).tolist()}"
    return ""


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the transformed points, float64, shape (N, 3)."""
    x, y, z = np.asarray(points, dtype=np.float64).T
    # Written out: equal points must give equal bits, which a matrix product does not promise.
    with np.errstate(invalid="ignore"):  # infinite points become NaN, which the checks of meshes report
        return np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in matrix[:3]], axis=1)


def transform_normals(matrix: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the unit normals moved by the inverse transpose, float64, shape (N, 3)."""
    moved = np.asarray(normals, dtype=np.float64) @ np.linalg.inv(matrix[:3, :3])
    return moved / np.maximum(np.linalg.norm(moved, axis=-1, keepdims=True), np.finfo(np.float64).tiny)


def _vector(value: Any, what: str) -> np.ndarray:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not (np.abs(vector) <= FLOAT_MAX).all():
        raise SceneError(f"{what} got {value!r}; give three finite numbers")
    return vector


def _unit(vector: np.ndarray, problem: str) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        raise SceneError(problem)
    return vector / length

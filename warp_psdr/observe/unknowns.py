"""What ``psdr.solve`` finds: numbers that parameters of a scene depend on.

Every kind tells how its numbers move parameters now (tangents, for ``render_forward``), and takes steps. A step of a
rigid motion is a turn and a shift of what is there, so that poses stay poses however far they go.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters

__all__ = ["Entries", "Function", "Rigid", "Unknowns"]

#: Relative step of the differences by which ``Function`` is differentiated: the cube root of float64's rounding.
STEP = 6.0e-6


class Unknowns(Protocol):
    """Some numbers.

    Attributes:
        labels: their names.
    """

    labels: list[str]

    def values(self, params: Parameters) -> np.ndarray:
        """Return the numbers, for tables."""

    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return for each number how parameters move with it: name -> velocity."""

    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Add a step, and write the parameters (``params.update()`` is the caller's)."""

    def state(self, params: Parameters) -> Any:
        """Return what ``restore`` goes back to."""

    def restore(self, params: Parameters, state: Any) -> None:
        """Go back to a state."""


class Entries:
    """Every number of a parameter by itself.

    Args:
        name: of the parameter.
        together: one number that all entries are moved by, a grey level for example.
    """

    def __init__(self, name: str, *, together: bool = False):
        self.name, self.together = name, together
        self.labels: list[str] = []

    def values(self, params: Parameters) -> np.ndarray:
        """Return the entries, or their mean."""
        held = params[self.name].numpy().astype(float).ravel()
        n = 1 if self.together else held.size
        self.labels = [self.name] if n == 1 else [f"{self.name}[{i}]" for i in range(n)]
        return np.array([held.mean()]) if self.together else held

    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return one entry each."""
        shape = params[self.name].numpy().shape
        if self.together:
            return [{self.name: np.ones(shape, np.float32)}]
        return [{self.name: row.reshape(shape)} for row in np.eye(int(np.prod(shape)), dtype=np.float32)]

    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Add the step, within the parameter's bounds."""
        held = params[self.name].numpy()
        low, high = params.scene.parameters[self.name].bounds
        moved = held + (step[0] if self.together else step.reshape(held.shape))
        params[self.name] = np.clip(moved, low, high).astype(np.float32)

    def state(self, params: Parameters) -> Any:
        """Return the values."""
        return params[self.name].numpy().copy()

    def restore(self, params: Parameters, state: Any) -> None:
        """Write the values."""
        params[self.name] = state


class Rigid:
    """A rigid motion: three angles (radians) of a turn about the world's axes through a point, and three lengths.

    Args:
        name: of a pose, ``shape.to_world`` or ``sensor.to_world``, or of ``vertex_positions``.
        about: the point, world; default: the middle of what moves, a pose's origin.
    """

    def __init__(self, name: str, about: Sequence[float] | None = None):
        self.name = name
        self.about = None if about is None else np.asarray(about, float)
        self.labels = [f"{name} {what} {axis}" for what in ("turn", "shift") for axis in "xyz"]
        self._moved = np.zeros(6)

    def values(self, params: Parameters) -> np.ndarray:
        """Return the sum of all steps."""
        return self._moved.copy()

    def _middle(self, held: np.ndarray) -> np.ndarray:
        if self.about is not None:
            return self.about
        return held[:3, 3] if held.shape == (4, 4) else 0.5 * (held.min(axis=0) + held.max(axis=0))

    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return velocities of a pose or of vertices."""
        held = params[self.name].numpy().astype(float)
        middle = self._middle(held)
        found = []
        for i in range(6):
            w, v = (np.eye(3)[i], np.zeros(3)) if i < 3 else (np.zeros(3), np.eye(3)[i - 3])
            turn = np.cross(w, np.eye(3)).T
            if held.shape == (4, 4):
                velocity = np.zeros((4, 4))
                velocity[:3] = turn @ held[:3]
                velocity[:3, 3] += v - turn @ middle
            else:
                velocity = (held - middle) @ turn.T + v
            found.append({self.name: velocity.astype(np.float32)})
        return found

    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Turn and shift what is there."""
        held = params[self.name].numpy().astype(float)
        middle, turn = self._middle(held), Rotation.from_rotvec(step[:3]).as_matrix()
        if held.shape == (4, 4):
            moved = held.copy()
            moved[:3, :3] = turn @ held[:3, :3]
            moved[:3, 3] = turn @ (held[:3, 3] - middle) + middle + step[3:]
        else:
            moved = (held - middle) @ turn.T + middle + step[3:]
        params[self.name] = moved.astype(np.float32)
        self._moved += step
        if self.about is not None:
            self.about = self.about + step[3:]

    def state(self, params: Parameters) -> Any:
        """Return the pose or the vertices, the steps so far and the point."""
        return params[self.name].numpy().copy(), self._moved.copy(), self.about

    def restore(self, params: Parameters, state: Any) -> None:
        """Write them."""
        params[self.name] = state[0]
        self._moved, self.about = state[1].copy(), state[2]


class Function:
    """Numbers that any function takes to parameters; it is differentiated by central differences.

    Args:
        function: (n,) float64 -> name -> values. What it launches on Warp arrays it returns as NumPy arrays; in
            float32, give ``step``.
        start: (n,) where the numbers start.
        labels: their names; default ``x[0]``, ...
        step: of the differences, relative to a number's size (or 1).
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], dict[str, np.ndarray]],
        start: Sequence[float],
        labels: Sequence[str] | None = None,
        *,
        step: float = STEP,
    ):
        self.x, self._function, self._step = np.array(start, float), function, step
        self.labels = list(labels) if labels is not None else [f"x[{i}]" for i in range(self.x.size)]
        if len(self.labels) != self.x.size:
            raise ValueError(f"Function: got {len(self.labels)} labels of {self.x.size} numbers")

    def values(self, params: Parameters) -> np.ndarray:
        """Return the numbers."""
        return self.x.copy()

    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return differences of the function's values."""
        found = []
        for i in range(self.x.size):
            h = self._step * max(abs(self.x[i]), 1.0) * np.eye(self.x.size)[i]
            high, low = self._function(self.x + h), self._function(self.x - h)
            over = 2.0 * float(h[i])
            rows = {name: (np.asarray(high[name], float) - np.asarray(low[name], float)) / over for name in high}
            # What a number does not move needs no derivative image.
            found.append({name: row.astype(np.float32) for name, row in rows.items() if np.any(row)})
        return found

    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Add the step."""
        self.restore(params, self.x + step)

    def state(self, params: Parameters) -> Any:
        """Return the numbers."""
        return self.x.copy()

    def restore(self, params: Parameters, state: Any) -> None:
        """Take other numbers."""
        self.x = state.copy()
        for name, values in self._function(self.x).items():
            params[name] = np.asarray(values, np.float32)

"""What ``psdr.solve`` finds: numbers that parameters of a scene depend on.

Every kind tells how its numbers move parameters now (tangents, for ``render_forward``; ``push`` and ``pull`` where they
are many), and takes steps. A step of a rigid motion is a turn and a shift of what is there, so that poses stay poses
however far they go.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from warp_psdr.scene.parameters import Parameters

__all__ = ["Entries", "Function", "Rigid", "Taped", "Unknowns"]

#: Relative step of the differences by which ``Function`` is differentiated: the cube root of float64's rounding.
STEP = 6.0e-6
#: That of ``Taped``, whose values are single precision.
SINGLE_STEP = 1.0e-3


class Unknowns(ABC):
    """Some numbers.

    Attributes:
        labels: their names.
    """

    labels: list[str]

    @abstractmethod
    def names(self, params: Parameters) -> list[str]:
        """Return which parameters the numbers move."""

    @abstractmethod
    def values(self, params: Parameters) -> np.ndarray:
        """Return the numbers, for tables."""

    @abstractmethod
    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return for each number how parameters move with it: name -> velocity."""

    @abstractmethod
    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Add a step, and write the parameters (``params.update()`` is the caller's)."""

    @abstractmethod
    def state(self, params: Parameters) -> Any:
        """Return what ``restore`` goes back to."""

    @abstractmethod
    def restore(self, params: Parameters, state: Any) -> None:
        """Go back to a state."""

    def push(self, params: Parameters, direction: np.ndarray) -> dict[str, np.ndarray]:
        """Return how parameters move if the numbers move along a direction (n,): name -> velocity."""
        total: dict[str, np.ndarray] = {}
        for number, row in zip(direction, self.tangents(params), strict=True):
            for name, velocity in row.items():
                total[name] = total.get(name, np.float32(0.0)) + np.float32(number) * velocity
        return total

    def pull(self, params: Parameters, gradients: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return derivatives by the numbers (n,) from those by the parameters."""
        rows = self.tangents(params)
        return np.array([sum(float((gradients[k].astype(float) * v).sum()) for k, v in row.items()) for row in rows])


def pushed(unknowns: Sequence[Unknowns], params: Parameters, direction: np.ndarray) -> dict[str, np.ndarray]:
    """Return how parameters move if all numbers move along a direction, whose further numbers are not theirs."""
    total: dict[str, np.ndarray] = {}
    first = 0
    for u in unknowns:
        last = first + len(u.labels)
        for name, velocity in u.push(params, direction[first:last]).items():
            total[name] = total.get(name, np.float32(0.0)) + velocity
        first = last
    return total


class Entries(Unknowns):
    """Every number of a parameter by itself.

    Args:
        name: of the parameter.
        together: one number that all entries are moved by, a grey level for example.
    """

    def __init__(self, name: str, *, together: bool = False):
        self.name, self.together = name, together
        self.labels: list[str] = []

    def names(self, params: Parameters) -> list[str]:
        """Return the parameter."""
        return [self.name]

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

    def push(self, params: Parameters, direction: np.ndarray) -> dict[str, np.ndarray]:
        """Return the direction in the parameter's shape."""
        shape = params[self.name].numpy().shape
        moved = np.full(shape, direction[0]) if self.together else direction.reshape(shape)
        return {self.name: moved.astype(np.float32)}

    def pull(self, params: Parameters, gradients: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the parameter's derivatives in a row, or their sum."""
        found = gradients[self.name].astype(float).ravel()
        return np.array([found.sum()]) if self.together else found

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


class Rigid(Unknowns):
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

    def names(self, params: Parameters) -> list[str]:
        """Return the pose or the positions."""
        return [self.name]

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


class Function(Unknowns):
    """A few numbers that any function takes to parameters; it is differentiated by central differences.

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

    def names(self, params: Parameters) -> list[str]:
        """Return what the function gives."""
        return list(self._function(self.x))

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


class Taped(Unknowns):
    """Many numbers that Warp kernels take to parameters; the kernels are differentiated by their tape.

    A mesh whose vertices follow a coarse cage, or a texture that a grid of few numbers makes smooth.

    Args:
        function: array of ``start``'s type and shape -> name -> array of the parameter's type and shape. What it
            launches has to be on ``wp.Tape``: it is called within one.
        start: where the numbers start, of single precision (vectors likewise).
        labels: names of all single numbers; default ``x[0]``, ...
    """

    def __init__(
        self, function: Callable[[wp.array], dict[str, wp.array]], start: wp.array, labels: Sequence[str] | None = None
    ):
        self.x, self._function = wp.clone(start, requires_grad=True), function
        size = self.x.numpy().size
        self.labels = list(labels) if labels is not None else [f"x[{i}]" for i in range(size)]
        if len(self.labels) != size:
            raise ValueError(f"Taped: got {len(self.labels)} labels of {size} numbers")

    def _of(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the parameters of other numbers."""
        x = wp.array(values.reshape(self.x.numpy().shape).astype(np.float32), dtype=self.x.dtype, device=self.x.device)
        return {name: array.numpy() for name, array in self._function(x).items()}

    def names(self, params: Parameters) -> list[str]:
        """Return what the function gives."""
        return list(self._function(self.x))

    def values(self, params: Parameters) -> np.ndarray:
        """Return the numbers in a row."""
        return self.x.numpy().astype(float).ravel()

    def tangents(self, params: Parameters) -> list[dict[str, np.ndarray]]:
        """Return one number each."""
        return [self.push(params, row) for row in np.eye(len(self.labels))]

    def push(self, params: Parameters, direction: np.ndarray) -> dict[str, np.ndarray]:
        """Return a central difference along the direction."""
        x, size = self.values(params), float(np.abs(direction).max())
        if size == 0.0:
            return {}
        h = SINGLE_STEP * max(float(np.abs(x).max()), 1.0) / size
        high, low = self._of(x + h * direction), self._of(x - h * direction)
        return {name: (high[name] - low[name]) / np.float32(2.0 * h) for name in high}

    def pull(self, params: Parameters, gradients: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return what the tape gives."""
        self.x.grad.zero_()
        with wp.Tape() as tape:
            arrays = self._function(self.x)
        grads = {a: wp.array(gradients[n], dtype=a.dtype, device=a.device) for n, a in arrays.items() if n in gradients}
        tape.backward(grads=grads)
        return self.x.grad.numpy().astype(float).ravel()

    def move(self, params: Parameters, step: np.ndarray) -> None:
        """Add the step."""
        self.restore(params, (self.values(params) + step).reshape(self.x.numpy().shape))

    def state(self, params: Parameters) -> Any:
        """Return the numbers."""
        return self.x.numpy().copy()

    def restore(self, params: Parameters, state: Any) -> None:
        """Take other numbers."""
        self.x.assign(state.astype(np.float32))
        for name, values in self._function(self.x).items():
            params[name] = values.numpy()

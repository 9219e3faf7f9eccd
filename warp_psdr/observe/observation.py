"""Observations: what was seen of a scene, and how an image is compared with it."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["Observation"]


class Observation:
    """Values that an image of a scene should have, for ``psdr.solve``.

    It serves any film, a transient one too. For an instrument that makes something else of an image, derive a class:
    override ``residual``, ``pushed`` and, for conjugate gradients, ``pulled``, and set ``linear`` and ``weights``, as
    ``Photograph`` does. Residuals are arrays (H, W, C) of any size; error bars are made of blocks of neighbours in
    H and W.

    Args:
        target: (..., 3), as ``render`` returns: (H, W, 3), or (H, W, bins, 3) of a transient film.
        weights: of the residuals, one over their standard deviation, broadcast to the target; a value of weight 0 does
            not count.
        name: for messages.

    Attributes:
        name: likewise.
        shape: of the images that it is compared with, without channels.
        weights: (H, W, C) of the residuals; bins of a transient film lie along W.
        linear: (H, W, C), what was seen; its contrast tells whether a scene looks like it.
        unknowns: names of its own numbers that are to be found.
        values: these numbers by name, (n,) each.

    Raises:
        ValueError: the target is no image, or has values that are not finite where the weights are not 0.
    """

    def __init__(self, target: Any, weights: Any = 1.0, *, name: str = "observation"):
        seen = np.asarray(target.numpy() if hasattr(target, "numpy") else target, float)
        if seen.ndim not in (3, 4) or seen.shape[-1] != 3:
            raise ValueError(f"{name}: got shape {seen.shape}, expected (H, W, 3) or (H, W, bins, 3)")
        weighed = np.broadcast_to(np.asarray(weights, float), seen.shape)
        if not np.all(np.isfinite(seen[weighed > 0.0])):
            raise ValueError(f"{name}: some values are not finite; give them the weight 0")
        self.name = name
        self.unknowns: tuple[str, ...] = ()
        self.values: dict[str, np.ndarray] = {}
        self._shape = seen.shape[:-1]
        self.linear = _rows(np.where(weighed > 0.0, seen, 0.0))
        self.weights = _rows(weighed)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images that it is compared with, without channels."""
        return self._shape

    @property
    def labels(self) -> list[str]:
        """Names of the unknown numbers, in order."""
        return list(self.unknowns)

    @property
    def unknown_values(self) -> np.ndarray:
        """Values of the unknown numbers."""
        return np.concatenate([self.values[u] for u in self.unknowns]) if self.unknowns else np.zeros(0)

    def move(self, step: np.ndarray) -> None:
        """Add a step to the unknown numbers."""
        first = 0
        for name in self.unknowns:
            n = self.values[name].size
            self.values[name] = self.values[name] + step[first : first + n]
            first += n

    def look(self) -> None:
        """Prepare for a step: what depends on the scene's present state is asked again."""

    def residual(self, image: np.ndarray) -> np.ndarray:
        """Return what an image has too much, weighted, (H, W, C)."""
        return self.weights * (_rows(image) - self.linear)

    def pushed(self, image: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the derivative of the residual, (H, W, C), where the image has the derivative ``moved``."""
        return self.weights * _rows(moved)

    def pulled(self, image: np.ndarray, adjoint: np.ndarray) -> np.ndarray:
        """Return what ``pushed`` makes of an image's derivative, transposed: (H, W, C) to the image's shape.

        Raises:
            NotImplementedError: a derived class overrides ``pushed`` and not this.
        """
        if type(self).pushed is not Observation.pushed:
            raise NotImplementedError(f"{self.name} has no 'pulled'; give solve method='dense', or add it")
        return (self.weights * adjoint).reshape(image.shape)

    def derivatives(self, image: np.ndarray) -> np.ndarray:
        """Return the residual's derivatives by the unknown numbers, (n, H, W, C)."""
        return np.zeros((0, *self.weights.shape))

    def doubts(self, image: np.ndarray) -> np.ndarray:
        """Return the residual's derivatives by what may be wrong everywhere and is no unknown, (n, H, W, C)."""
        return np.zeros((0, *self.weights.shape))


def _rows(image: np.ndarray) -> np.ndarray:
    """Return an image with its bins along its rows, (H, W, C)."""
    return image.reshape(image.shape[0], -1, image.shape[-1])

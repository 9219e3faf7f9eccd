"""``psdr.certify_function``: the certificate of somebody else's renderer, by differences of its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_psdr.certify import slope
from warp_psdr.certify.adjoints import random_adjoints
from warp_psdr.certify.certificate import Certificate
from warp_psdr.certify.directions import Direction, directions_of_numbers
from warp_psdr.certify.issue import Request, issue
from warp_psdr.kernels.rng import mix_seed

#: Range of a parameter of which nothing is said.
UNBOUNDED = (-np.inf, np.inf)


@dataclass(eq=False)
class FunctionSubject:
    """Two functions.

    Attributes:
        render: (values, seed) -> image.
        gradient: (values, adjoint, seed) -> name -> gradient.
        values: name -> float64.
        shape: (H, W).
    """

    render: Callable[[dict[str, np.ndarray], int], Any]
    gradient: Callable[[dict[str, np.ndarray], np.ndarray, int], Mapping[str, Any]]
    values: dict[str, np.ndarray]
    shape: tuple[int, int] = (0, 0)

    def image(self, moved: Mapping[str, np.ndarray], seed: int) -> np.ndarray:
        """Return the image at other values of some parameters."""
        image = np.asarray(self.render({**self.values, **moved}, seed), np.float64)
        if image.ndim != 3 or image.shape[2] != 3 or (self.shape != (0, 0) and image.shape[:2] != self.shape):
            size = "(H, W, 3)" if self.shape == (0, 0) else str((*self.shape, 3))
            raise ValueError(f"render: returned an image of shape {image.shape}, expected {size}")
        return image

    def gradients(self, adjoints: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """Return the gradients of adjoints."""
        found: dict[str, list[np.ndarray]] = {name: [] for name in self.values}
        for k, adjoint in enumerate(adjoints):
            gradients = self.gradient(dict(self.values), adjoint, mix_seed(seed, k))
            for name, value in self.values.items():
                if name not in gradients:
                    raise ValueError(f"gradient: returned none for {name!r}; expected one for every parameter")
                array = np.asarray(gradients[name], np.float64)
                if array.size != value.size:
                    raise ValueError(f"gradient: of {name!r} has shape {array.shape}, expected {value.shape}")
                found[name].append(array.reshape(value.shape))
        return {name: np.stack(rows) for name, rows in found.items()}


def certify_function(
    render: Callable[[dict[str, np.ndarray], int], Any],
    gradient: Callable[[dict[str, np.ndarray], np.ndarray, int], Mapping[str, Any]],
    parameters: Mapping[str, Any],
    adjoint: Any = None,
    *,
    units: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    budget: float = 60.0,
    level: float = 0.99,
    tolerance: float = 0.02,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Certificate:
    """Examine the gradients of any renderer by the slope check, as ``psdr.certify`` does those of a scene.

    Args:
        render: (values by name, seed) -> image (H, W, 3), linear. Equal seeds are to share random numbers, and images
            of different seeds are to be independent.
        gradient: (values by name, adjoint (H, W, 3), seed) -> gradients of sum(adjoint * image) by name, each in its
            parameter's shape. Independent for different seeds, and of the images.
        parameters: name -> the values at which gradients are examined.
        adjoint: as of ``certify``.
        units: name -> the longest step of a difference, in the parameter's units; for positions a pixel or two.
            Default: a tenth of the largest value.
        bounds: name -> range of the values; differences stay inside. Default: there is none.
        budget: as of ``certify``.
        level: as of ``certify``.
        tolerance: as of ``certify``.
        seed: as of ``certify``.
        progress: as of ``certify``.

    Returns:
        The certificate.

    Raises:
        ValueError: there is no parameter, a value that is not finite, an option out of range, or a function returns
            what it should not.
    """
    request = Request.checked(budget, level, tolerance, slope.NAME, seed, (slope.NAME,))
    values = {name: np.atleast_1d(np.asarray(value, np.float64)) for name, value in parameters.items()}
    if not values:
        raise ValueError("parameters: got none; expected at least one, {'name': values}")
    for name, value in values.items():
        if not np.isfinite(value).all():
            raise ValueError(f"parameters: {name!r} holds NaN or infinity; give finite values")
    subject = FunctionSubject(render, gradient, values)
    height, width, _channels = subject.image({}, 0).shape
    subject.shape = (height, width)
    adjoints = random_adjoints(subject.shape, seed) if adjoint is None else np.asarray(adjoint, np.float32)[None]
    if adjoints.shape[1:] != (height, width, 3):
        raise ValueError(f"adjoint: got shape {adjoints.shape[1:]}, expected the image's {(height, width, 3)}")
    subject.gradients(adjoints[:1], 0)  # compiles, or whatever is done once

    def directions(name: str, mean: np.ndarray, deviation: np.ndarray) -> tuple[list[Direction], list[str]]:
        range_of = (bounds or {}).get(name, UNBOUNDED)
        unit = (units or {}).get(name)
        return directions_of_numbers(name, values[name], mean, deviation, range_of, unit, seed), []

    return issue(subject, adjoints, directions, request, progress, adjoint is None)

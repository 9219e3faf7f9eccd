"""Normal equations of thousands of numbers: products with H alone, and steps by conjugate gradients.

H d costs a forward derivative image and a reverse pass of each look; H itself and derivative images of single numbers
are never made. The directions of the two passes have independent random numbers, so that products have no bias.

Derivation: ``docs/theory/photographs.md``.
"""

from __future__ import annotations

import numpy as np

from warp_psdr.observe.problem import Problem, Side

#: Residual of a step over that of none, at which conjugate gradients stop; most products of a step.
TOLERANCE, MOST_PRODUCTS = 0.1, 24


class Products:
    """Normal equations of two looks, as products.

    Args:
        problem: what is unknown.
        a, b: the looks, without derivative images of single numbers.
        robust: Huber's weights of all residuals, (H, W, 1) each.
        seed: of the directions that tell each group's scale.

    Attributes:
        g_a, g_b: (n,) J_2^T W r_1, J_1^T W r_2.
    """

    def __init__(self, problem: Problem, a: list[Side], b: list[Side], robust: list[np.ndarray], seed: int):
        self._problem, self._a, self._b, self._robust = problem, a, b, robust
        self.g_a = problem.pulled(self._weighted([s.residual for s in a]), b)
        self.g_b = problem.pulled(self._weighted([s.residual for s in b]), a)
        self._scale = self._scales(np.random.default_rng(seed))
        seen = self._scale > 0.0
        self._inverse = np.where(seen, 1.0 / np.where(seen, self._scale, 1.0), 0.0)

    @property
    def g(self) -> np.ndarray:
        """Half of the gradient of the sum of squares."""
        return 0.5 * (self.g_a + self.g_b)

    @property
    def told(self) -> bool:
        """Whether some number changes a picture."""
        return bool(np.any(self._scale > 0.0))

    def _weighted(self, images: list[np.ndarray]) -> list[np.ndarray]:
        return [w * image for w, image in zip(self._robust, images, strict=True)]

    def product(self, direction: np.ndarray) -> np.ndarray:
        """Return H d."""
        forth = self._problem.pulled(self._weighted(self._problem.pushed(direction, self._a)), self._b)
        back = self._problem.pulled(self._weighted(self._problem.pushed(direction, self._b)), self._a)
        return 0.5 * (forth + back)

    def _scales(self, rng: np.random.Generator) -> np.ndarray:
        """Return the mean of the diagonal of H over each group of numbers, (n,): random signs tell the trace."""
        found = np.zeros(self._problem.size)
        for group in self._problem.groups():
            signs = np.zeros(self._problem.size)
            signs[group] = rng.choice([-1.0, 1.0], size=group.stop - group.start)
            found[group] = max(float(signs @ self.product(signs)), 0.0) / (group.stop - group.start)
        return found

    def step(self, damping: float) -> np.ndarray:
        """Return about -(H + damping D)^-1 g, D the groups' scales, 0 for groups that the pictures do not tell.

        It stops where noise makes H indefinite (Steihaug 1983), which SciPy's does not.
        """
        found = np.zeros_like(self.g)
        rest = -self.g
        direction = self._inverse * rest
        size = first = float(rest @ direction)
        for _product in range(MOST_PRODUCTS):
            if size <= TOLERANCE**2 * first:
                break
            turned = self.product(direction) + damping * self._scale * direction
            curvature = float(direction @ turned)
            if curvature <= 0.0:
                break
            found += size / curvature * direction
            rest -= size / curvature * turned
            before, size = size, float(rest @ (self._inverse * rest))
            direction = self._inverse * rest + size / before * direction
        return found

    def promised(self, step: np.ndarray) -> float:
        """Return by how much the sum of squares would fall if the residuals were linear."""
        return -2.0 * float(self.g @ step) - float(step @ self.product(step))

    def within(self, _step: np.ndarray, _damping: float) -> bool:
        """Return whether the gradient is no longer than its own error."""
        noise = 0.5 * (self.g_a - self.g_b)
        return float(self._inverse @ self.g**2) <= 2.0 * float(self._inverse @ noise**2)

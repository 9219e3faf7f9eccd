"""Where on the image samples are spent: tiles with sample counts of their own, for the term that runs over pixels.

With the variance v_t of one sample a pixel of tile t, and samples of equal cost, the variance sum_t v_t / n_t at a
given number of samples is least at n_t ~ sqrt(v_t) (Neyman allocation). The counts of a tiling are the batch's times
powers of two from 1/4 to 4. They come from runs of their own, which are thrown away, so that what they are used for
is unbiased whatever they are; and no tile goes without samples, unless its adjoint is zero and it therefore has no
gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.work_precision.quantity import Quantity

#: Sides of tiles, pixels, from the smallest one on by powers of two.
SMALLEST_TILE = 8
#: Most tiles: of an image, whose pixels tell their variance one by one, and of a gradient, where each tile is run.
MOST_TILES_IMAGE, MOST_TILES_GRADIENT = 4096, 64
#: Batches from which a tile's variance is estimated.
BATCHES = 6
#: Largest power of two between a tile's samples and the batch's.
REACH = 2
#: Share of the even spread that is kept, since variances of few batches are themselves uncertain.
EVEN = 0.2
#: A tiling is used where it is expected to lower the variance at equal time by this factor.
WORTH = 1.15
#: Exponent that stands for "no samples".
NEVER = -128


@dataclass(frozen=True)
class Tiling:
    """Sample counts of tiles.

    Attributes:
        width: of the raster, pixels.
        height: of the raster, pixels.
        side: of a tile, pixels.
        exponents: for every tile, row by row, log2 of its samples over the batch's; ``NEVER``: none.
        skip: pixels, row by row, that are left out although their tile is not; None: there are none.
    """

    width: int
    height: int
    side: int
    exponents: tuple[int, ...]
    skip: np.ndarray | None = field(default=None, compare=False, repr=False)

    def exponent_of_pixels(self) -> np.ndarray:
        """Return (height * width,): every pixel's exponent."""
        columns = -(-self.width // self.side)
        y, x = np.divmod(np.arange(self.width * self.height), self.width)
        exponents = np.asarray(self.exponents, np.int64)[(y // self.side) * columns + x // self.side]
        return exponents if self.skip is None else np.where(self.skip, NEVER, exponents)

    @cached_property
    def groups(self) -> list[tuple[np.ndarray, int]]:
        """(numbers of pixels along a Morton curve, exponent) of the pixels that get samples."""
        order = workers.pixel_order(self.width, self.height)
        exponents = self.exponent_of_pixels()[order]
        return [(order[exponents == e], int(e)) for e in np.unique(exponents) if e != NEVER]

    def launches(self, spp: int, device) -> list[tuple[wp.array, int]]:
        """Return (numbers of pixels, samples of each) of the launches that make a batch of ``spp`` samples a pixel."""
        return [(wp.array(pixels, dtype=wp.int32, device=device), _samples(spp, e)) for pixels, e in self.groups]

    def samples(self, spp: int) -> int:
        """Return the number of samples of a batch."""
        return sum(len(pixels) * _samples(spp, e) for pixels, e in self.groups)


def _samples(spp: int, exponent: int) -> int:
    return max(1, round(spp * 2.0**exponent))


def uniform(quantity: Quantity) -> Tiling:
    """Return the even spread over the pixels that count: in reverse mode those whose adjoint is not zero."""
    return from_exponents(quantity, max(quantity.raster), (0,))


def from_exponents(quantity: Quantity, side: int, exponents: Sequence[int]) -> Tiling:
    """Return a tiling of a quantity's raster."""
    width, height, _margin = quantity.raster
    return Tiling(width, height, side, tuple(exponents), _unused(quantity))


def measured(quantity: Quantity, spp: int, seeds: Sequence[int]) -> Tiling | None:
    """Return the tiling that the variances of a few batches ask for; None: an even spread is about as good.

    Args:
        quantity: what is estimated.
        spp: samples a pixel of the batches that are run.
        seeds: one a batch.
    """
    width, height, margin = quantity.raster
    most = MOST_TILES_GRADIENT if quantity.role == "reverse" else MOST_TILES_IMAGE
    side = SMALLEST_TILE
    while -(-width // side) * -(-height // side) > most:
        side *= 2
    columns, rows = -(-width // side), -(-height // side)
    y, x = np.mgrid[0:height, 0:width]
    tile = ((y // side) * columns + x // side).reshape(-1)
    unused = _unused(quantity)
    used = np.bincount(tile[~unused] if unused is not None else tile, minlength=columns * rows)
    if np.count_nonzero(used) < 2:
        return None
    if quantity.role == "reverse":
        variance = _of_gradients(quantity, spp, seeds, side, used)
    else:
        variance = _of_pixels(quantity, spp, seeds)
        inner_y, inner_x = (
            np.clip(y - margin, 0, height - 2 * margin - 1),
            np.clip(x - margin, 0, width - 2 * margin - 1),
        )
        variance = np.bincount(tile, variance[inner_y, inner_x].reshape(-1), minlength=columns * rows)
    # n samples each of its used[t] pixels: a tile's variance is that of one pixel's samples, v_t used[t] / n.
    density = np.sqrt(variance / np.maximum(used, 1))
    mean = float((density * used).sum() / used.sum())
    if mean <= 0.0:
        return None
    factor = np.clip((1.0 - EVEN) * density / mean + EVEN, 2.0**-REACH, 2.0**REACH)
    exponents = np.round(np.log2(factor)).astype(int)
    counts = 2.0**exponents
    gain = variance.sum() * used.sum() / ((variance / counts).sum() * (counts * used).sum())
    if gain < WORTH:
        return None
    return from_exponents(quantity, side, np.where(used > 0, exponents, NEVER).tolist())


def _unused(quantity: Quantity) -> np.ndarray | None:
    """Return the pixels that contribute nothing: whose adjoint is zero."""
    if quantity.adjoint is None:
        return None
    unused = np.asarray(~quantity.adjoint.reshape(-1, 3).any(axis=1))
    return unused if unused.any() else None


def _of_pixels(quantity: Quantity, spp: int, seeds: Sequence[int]) -> np.ndarray:
    """Return (H, W), the variances of the pixels of an image, summed over its channels."""
    width, height, margin = quantity.raster
    batches = np.array([quantity.finished(quantity.parts[0].run(spp, seed)) for seed in seeds])
    return batches.var(axis=0, ddof=1).reshape(height - 2 * margin, width - 2 * margin, 3).sum(axis=-1)


def _of_gradients(quantity: Quantity, spp: int, seeds: Sequence[int], side: int, used: np.ndarray) -> np.ndarray:
    """Return (tiles,), the variances of the tiles' gradients.

    Those of several parameters are added relative to the squared norms of their whole gradients, all terms together.
    """
    rows = np.empty((len(used), len(quantity.blocks)))
    total = np.zeros(max(block.stop for block in quantity.blocks.values()))
    for t in range(len(used)):
        if not used[t]:
            rows[t] = 0.0
            continue
        exponents = np.full(len(used), NEVER)
        exponents[t] = 0
        tiling = from_exponents(quantity, side, exponents.tolist())
        batches = np.array([quantity.over_pixels(spp, mix_seed(seed, t), tiling) for seed in seeds])
        total += batches.mean(axis=0)
        variance = batches.var(axis=0, ddof=1)
        rows[t] = [variance[block].sum() for block in quantity.blocks.values()]
    if len(quantity.blocks) == 1:
        return rows[:, 0]
    noise = rows.sum(axis=0) / len(seeds)
    for part in quantity.parts[1:]:
        batches = np.array([part.run(spp, mix_seed(seed, len(used))) for seed in seeds])
        total += batches.mean(axis=0)
        variance = batches.var(axis=0, ddof=1) / len(seeds)
        noise += [variance[block].sum() for block in quantity.blocks.values()]
    norms = np.array([float((total[block] ** 2).sum()) for block in quantity.blocks.values()])
    # A parameter that drowns in noise here counts as if its gradient were as large as that noise.
    return (rows / np.maximum(np.maximum(norms - noise, noise), 1e-300)).sum(axis=1)

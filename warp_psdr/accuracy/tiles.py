"""The allocation of samples over the image, for the term that runs over pixels.

Neyman allocation gives pixel p a number n_p in proportion to |w_p| s_t, its adjoint times the deviation measured in its
tile. A share of the samples is spread evenly. Counts are powers of two of the batch's, systematically thinned below
one.

Derivation: ``docs/theory/accuracy.md#samples-over-the-image``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_psdr import workers
from warp_psdr.kernels.rng import mix_seed

if TYPE_CHECKING:
    from warp_psdr.accuracy.quantity import Quantity

#: Sides of tiles, pixels, from the smallest one on by powers of two.
SMALLEST_TILE = 8
#: Most tiles: of an image, whose pixels tell their variance one by one, and of a gradient, where each tile is run.
MOST_TILES_IMAGE, MOST_TILES_GRADIENT = 4096, 64
#: Batches from which a tile's variance is estimated.
BATCHES = 6
#: Share of the even spread that is kept, since variances of few batches are themselves uncertain.
EVEN = 0.1
#: Largest power of two between a pixel's samples and the batch's.
REACH = 8
#: A tiling is used where it is expected to lower the variance at equal time by this factor.
WORTH = 1.15
#: Exponent that stands for "no samples".
NEVER = -128
#: Seed stream of which pixels are run where there are fewer samples than pixels.
STREAM_THINNED = 0x7468696E


@dataclass(frozen=True, eq=False)
class Tiling:
    """Sample counts of pixels.

    Attributes:
        width: of the raster, pixels.
        height: of the raster, pixels.
        exponents: (height * width,) for every pixel, row by row, log2 of its samples over the batch's; ``NEVER``: none.
        thins: whether counts below one are reached by leaving out pixels.
    """

    width: int
    height: int
    exponents: np.ndarray
    thins: bool

    @cached_property
    def groups(self) -> list[tuple[np.ndarray, int]]:
        """(numbers of pixels along a Morton curve, exponent) of the pixels that get samples."""
        order = workers.pixel_order(self.width, self.height)
        exponents = self.exponents[order]
        return [(order[exponents == e], int(e)) for e in np.unique(exponents) if e != NEVER]

    def launches(self, spp: int, seed: int, device) -> list[tuple[wp.array, int, float]]:
        """Return (numbers of pixels, samples of each, their weight) of a batch of ``spp`` samples a pixel."""
        found = []
        for pixels, exponent in self.groups:
            count, run = self._counts(len(pixels), spp, exponent)
            weight = len(pixels) / run
            if run < len(pixels):
                start = mix_seed(mix_seed(seed, STREAM_THINNED), exponent - NEVER) / 2.0**32
                chosen = ((start + np.arange(run)) * weight).astype(np.int64)
                pixels = pixels[np.minimum(chosen, len(pixels) - 1)]
            found.append((wp.array(pixels, dtype=wp.int32, device=device), count, weight))
        return found

    def samples(self, spp: int) -> int:
        """Return the number of samples of a batch."""
        return sum(int(np.prod(self._counts(len(pixels), spp, e))) for pixels, e in self.groups)

    def _counts(self, pixels: int, spp: int, exponent: int) -> tuple[int, int]:
        """Return how many samples a pixel of a power gets, and how many of its pixels do."""
        wanted = spp * 2.0**exponent
        if wanted >= 1.0 or not self.thins:
            return max(round(wanted), 1), pixels
        return 1, max(round(wanted * pixels), 1)


def uniform(quantity: Quantity) -> Tiling:
    """Return the even spread over the pixels that count: in reverse mode those whose adjoint is not zero."""
    return from_exponents(quantity, max(quantity.raster), (0,))


def from_exponents(quantity: Quantity, side: int, exponents: Sequence[int]) -> Tiling:
    """Return the spread of which every tile has the exponent that is given, row by row."""
    width, height, _margin = quantity.raster
    of_pixels = np.asarray(exponents, np.int64)[_tile_of_pixels(quantity, side)]
    of_pixels = np.where(_strength(quantity) > 0.0, of_pixels, NEVER)
    return Tiling(width, height, of_pixels, quantity.role != "primal")


def spread(quantity: Quantity, side: int, deviations: Sequence[float]) -> Tiling:
    """Return the spread for a quantity whose tiles have these deviations, up to a factor of all."""
    width, height, _margin = quantity.raster
    wanted = density(quantity, side, deviations)
    used = _strength(quantity) > 0.0
    mean = float(wanted[used].mean()) if used.any() else 0.0
    if mean <= 0.0:
        return uniform(quantity)
    share = (1.0 - EVEN) * wanted / mean + EVEN
    exponents = np.clip(np.round(np.log2(share)), -REACH, REACH).astype(np.int64)
    return Tiling(width, height, np.where(used, exponents, NEVER), quantity.role != "primal")


def density(quantity: Quantity, side: int, deviations: Sequence[float]) -> np.ndarray:
    """Return (height * width,): the best counts of pixels up to a factor, |w_p| s_t."""
    return _strength(quantity) * np.asarray(deviations, np.float64)[_tile_of_pixels(quantity, side)]


def tile_count(quantity: Quantity, side: int) -> int:
    """Return the number of tiles of a quantity's raster."""
    width, height, _margin = quantity.raster
    return -(-width // side) * -(-height // side)


def measured(
    quantity: Quantity, spp: int, seeds: Sequence[int], side: int | None = None
) -> tuple[int, tuple[float, ...]] | None:
    """Return the side of tiles and their deviations from a few batches; None: an even spread is about as good.

    Args:
        quantity: what is estimated.
        spp: samples a pixel of the batches that are run.
        seeds: one a batch.
        side: of the tiles; None: as small as their number allows.
    """
    if side is None:
        side, most = SMALLEST_TILE, MOST_TILES_GRADIENT if quantity.role == "reverse" else MOST_TILES_IMAGE
        while tile_count(quantity, side) > most:
            side *= 2
    tile, strength, tiles = _tile_of_pixels(quantity, side), _strength(quantity), tile_count(quantity, side)
    weight = np.bincount(tile, strength**2, minlength=tiles)
    if np.count_nonzero(strength) < 2:
        return None
    if quantity.role == "reverse":
        variance = _of_gradients(quantity, spp, seeds, side, weight > 0.0)
    else:
        variance = np.bincount(tile, _of_pixels(quantity, spp, seeds), minlength=tiles)
    if not variance.any():
        return None
    of_one = variance / np.where(weight > 0.0, weight, 1.0)
    largest = float(of_one.max())
    deviations = tuple(np.sqrt(of_one / largest).tolist())
    # A pixel with n samples has the variance |w|^2 s^2 / n; all samples cost alike.
    used = strength > 0.0
    counts = 2.0 ** spread(quantity, side, deviations).exponents[used]
    variances = (strength**2 * of_one[tile])[used]
    gain = variances.mean() / ((variances / counts).mean() * counts.mean())
    return (side, deviations) if gain >= WORTH else None


def _tile_of_pixels(quantity: Quantity, side: int) -> np.ndarray:
    """Return (height * width,), the number of every pixel's tile."""
    width, height, _margin = quantity.raster
    y, x = np.divmod(np.arange(width * height), width)
    return (y // side) * -(-width // side) + x // side


def _strength(quantity: Quantity) -> np.ndarray:
    """Return (height * width,), the length of every pixel's adjoint; ones without one."""
    if quantity.adjoint is None:
        return np.ones(math.prod(quantity.raster[:2]))
    return np.linalg.norm(quantity.adjoint.reshape(-1, 3).astype(np.float64), axis=1)


def _of_pixels(quantity: Quantity, spp: int, seeds: Sequence[int]) -> np.ndarray:
    """Return (height * width,), the variances of an image's pixels, summed over channels; the margin's repeat them."""
    width, height, margin = quantity.raster
    batches = np.array([quantity.finished(quantity.parts[0].run(spp, seed)) for seed in seeds])
    inner = batches.var(axis=0, ddof=1).reshape(height - 2 * margin, width - 2 * margin, 3).sum(axis=-1)
    return np.pad(inner, margin, mode="edge").reshape(-1)


def _of_gradients(quantity: Quantity, spp: int, seeds: Sequence[int], side: int, used: np.ndarray) -> np.ndarray:
    """Return (tiles,), the variances of the tiles' gradients.

    Those of several parameters are added relative to the squared norms of their whole gradients, all terms together.
    """
    rows = np.zeros((len(used), len(quantity.blocks)))
    total = np.zeros(max(block.stop for block in quantity.blocks.values()))
    for t in np.flatnonzero(used).tolist():
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

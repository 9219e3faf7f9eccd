"""Bounds of a network of signed distances in boxes: where its surface may pass, and its greatest second derivative.

In a box with the centre c the values z of each layer are known, with their gradients at c. A pass forwards bounds how
far those gradients change in the box, and the remainder of their linear part: these bound the arguments of the
activations and of their derivatives. A pass backwards bounds the slopes of phi by each activation's value, and their
change. Slopes keep their signs, so that bounds of phi and of its second derivatives tighten as boxes shrink.

Derivation: ``docs/theory/implicit.md#networks``.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from warp_psdr.kernels.primitive.network import LEVEL

if TYPE_CHECKING:
    from warp_psdr.scene.kinds.neuralsdf import Network

#: Cells along an axis of the coarsest grid, which are halved where the surface may pass.
COARSEST = 8
#: Boxes at a time, and rounding of float32 over the size of the numbers of a layer.
CHUNK, ROUNDING = 8192, 1.0e-6
#: How much larger than the greatest slope that was met its bound may be, and the products of boxes and weights after
#: which it is what it is.
TIGHT, MOST_WORK = 1.5, 1 << 27
OFFSETS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


@dataclass(frozen=True, eq=False)
class Bounds:
    """Of N boxes: phi and its gradient at the centre, and what they are off by at most."""

    phi: np.ndarray  #: (N,)
    gradient: np.ndarray  #: (N, 3)
    bend: np.ndarray  #: (N,) greatest second derivative along a unit vector
    slope: np.ndarray  #: (N,) greatest length of the gradient
    low: np.ndarray  #: (N,) least phi
    high: np.ndarray  #: (N,) greatest phi

    @property
    def passed(self) -> np.ndarray:
        """Return whether phi may be zero (N,)."""
        return (self.low <= 0.0) & (self.high >= 0.0)


def encoded(network: Network, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what the first layer takes at points (N, 3): (N, F) numbers, their slopes, and the axes of those."""
    parts, slopes = [x], [np.ones_like(x)]
    for k in range(network.frequencies):
        turn = float(2.0**k * np.pi)
        parts += [np.sin(turn * x), np.cos(turn * x)]
        slopes += [turn * parts[-1], -turn * parts[-2]]
    axes = np.tile(np.arange(3), 1 + 2 * network.frequencies)
    return np.concatenate(parts, axis=1), np.concatenate(slopes, axis=1), axes


def activated(network: Network, z: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the activation at z, its derivative there, and bounds of the sizes of both derivatives in z +- off."""
    s = network.scale
    if network.sine:
        sine, cosine = np.sin(s * z), np.cos(s * z)
        far = s * off
        first = s * np.minimum(1.0, np.abs(cosine) + np.abs(sine) * far + 0.5 * far**2)
        second = s * s * np.minimum(1.0, np.abs(sine) + np.abs(cosine) * far + 0.5 * far**2)
        return sine, s * cosine, first, second
    share = _sigmoid(s * z)
    steepest = _sigmoid(s * (z + off))
    nearest = _sigmoid(s * np.maximum(np.abs(z) - off, 0.0))
    return np.logaddexp(0.0, s * z) / s, share, steepest, s * nearest * (1.0 - nearest)


def _sigmoid(z: np.ndarray) -> np.ndarray:
    return 0.5 + 0.5 * np.tanh(0.5 * z)


def values_of(network: Network, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return phi (N,) and its gradient (N, 3) at points (N, 3) of the box, float64."""
    a, slopes, axes = encoded(network, x)
    rates = np.zeros((3, *a.shape), a.dtype)
    rates[axes, :, np.arange(len(axes))] = slopes.T
    for n, (weight, bias) in enumerate(network.layers):
        z, rates = a @ weight.T + bias, rates @ weight.T
        if n == len(network.layers) - 1:
            return z[:, 0], rates[:, :, 0].T
        a, slope = activated(network, z, np.zeros(()))[:2]
        rates = slope * rates
    raise AssertionError


def bounds_of(network: Network, x: np.ndarray, half: np.ndarray) -> Bounds:
    """Return bounds in boxes with centres (N, 3) and half extents (3,) or (N, 3)."""
    half = np.broadcast_to(half, x.shape)
    a, slopes, axes = encoded(network, x)
    rates = np.zeros((3, *a.shape), a.dtype)
    rates[axes, :, np.arange(len(axes))] = slopes.T
    # Second derivatives: of the coordinates none, of their sines and cosines as of sines.
    turns = np.concatenate([np.zeros(3), *(np.full(6, 2.0**k * np.pi) for k in range(network.frequencies))])
    turns = turns.astype(a.dtype)
    far = turns * half[:, axes]
    steepest, bends = np.abs(rates), turns**2 * np.minimum(1.0, np.abs(a) + far) * (turns > 0.0)
    steepest[axes, :, np.arange(len(axes))] += (bends * half[:, axes]).T
    amiss = 0.5 * bends * half[:, axes] ** 2
    curved = [(bends, np.ones_like(a), amiss)]
    kept = []
    # ---- Forwards: rates of all numbers, how far they change in the box, and what the linear part misses ----
    for n, (weight, bias) in enumerate(network.layers):
        spread = np.abs(weight).T
        size = ROUNDING * (np.abs(a) @ spread + np.abs(bias))
        z, rates, steepest, amiss = (
            a @ weight.T + bias,
            rates @ weight.T,
            (steepest - np.abs(rates)) @ spread,
            amiss @ spread,
        )
        steepest += np.abs(rates)
        amiss += size
        if n == len(network.layers) - 1:
            break
        linear = _along(np.abs(rates), half)
        off = np.minimum(linear + amiss, _along(steepest, half) + size)
        a, slope, first, second = activated(network, z, off)
        changed = np.minimum(second * off, first + np.abs(slope))
        amiss = first * amiss + 0.5 * second * linear**2
        kept.append((slope, first, changed))
        curved.append((second, (steepest * steepest).sum(axis=0), 0.5 * second * linear**2))
        # |D J - D_c J_c| <= first |J - J_c| + changed |J_c|.
        steepest = first * (steepest - np.abs(rates)) + changed * np.abs(rates) + np.abs(slope * rates)
        rates = slope * rates
    # ---- Backwards: the slopes of phi by what each activation gives, and how far they change ----
    phi, gradient = z[:, 0], rates[:, :, 0].T
    weight = network.layers[-1][0]
    down, rest = np.repeat(weight, len(x), axis=0), np.zeros((len(x), weight.shape[1]), a.dtype)
    bend = np.zeros(len(x), a.dtype)
    low, high = -size[:, 0], size[:, 0]
    for n in range(len(network.layers) - 1, -1, -1):
        second, squared, missed = curved[n]
        most = np.abs(down) + rest
        bend += (most * second * squared).sum(axis=1)
        if network.sine or n == 0:
            both = (most * missed).sum(axis=1)
            low, high = low - both, high + both
        else:
            high = high + (np.maximum(down + rest, 0.0) * missed).sum(axis=1)
            low = low + (np.minimum(down - rest, 0.0) * missed).sum(axis=1)
        if n > 0:
            slope, first, changed = kept[n - 1]
            weight = network.layers[n - 1][0]
            rest = (first * rest + changed * np.abs(down)) @ np.abs(weight)
            down = (slope * down) @ weight
    linear = (np.abs(gradient) * half).sum(axis=1)
    bent = np.linalg.norm(gradient, axis=1) + bend * np.linalg.norm(half, axis=1)
    slope = np.minimum(np.linalg.norm(steepest[:, :, 0], axis=0), bent)
    return Bounds(phi, gradient, bend, slope, phi - linear + low, phi + linear + high)


def _along(rates: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return how far numbers with rates (3, N, F) change over half extents (N, 3), (N, F)."""
    return rates[0] * half[:, :1] + rates[1] * half[:, 1:2] + rates[2] * half[:, 2:]


def single(network: Network) -> Network:
    """Return a network whose numbers are float32."""
    layers = [(w.astype(np.float32), b.astype(np.float32)) for w, b in network.layers]
    return replace(network, layers=layers, cells=None)


def in_parts(network: Network, x: np.ndarray, half: np.ndarray) -> Bounds:
    """Return the same, some boxes at a time."""
    parts = [bounds_of(network, x[i : i + CHUNK], half) for i in range(0, max(len(x), 1), CHUNK)]
    return Bounds(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Bounds)))


def cells_of(network: Network, cells: int) -> np.ndarray:
    """Return of each cell (Z, Y, X) minus the bound of its second derivatives, or its reach, as on grids.

    The reach is how many cells it is away from one that the surface may pass; at least 1.
    """
    n, coarse = COARSEST, single(network)
    at = np.indices((n, n, n)).reshape(3, -1).T
    while True:
        half = np.full(3, 0.5 / n, np.float32)
        found = in_parts(coarse, ((at + 0.5) / n).astype(np.float32), half)
        at = at[found.passed]
        if n == cells:
            break
        n *= 2
        at = (2 * at[:, None] + (OFFSETS > 0.0)).reshape(-1, 3)
    passed = np.zeros((n, n, n), bool)
    passed[tuple(at[:, ::-1].T)] = True
    if not passed.any():
        return np.full(passed.shape, float(n), np.float32)
    from scipy.ndimage import distance_transform_cdt

    result = distance_transform_cdt(~passed, metric="chessboard").astype(np.float32)
    result[tuple(at[:, ::-1].T)] = -np.maximum(found.bend[found.passed], 1.0e-6) * (1.0 + ROUNDING)
    return result


def steepness(network: Network, cells: np.ndarray) -> tuple[float, float]:
    """Return a bound of the slope of phi where it is at most a level, and that level; ``cells``: of ``cells_of``.

    Boxes whose bounds are far above the slopes in their middles are halved.
    """
    coarse, size = single(network), len(cells)
    at = np.argwhere(cells <= 0.0)[:, ::-1]
    if not len(at):
        return 1.0, LEVEL
    middles = (at[:: -(-len(at) // CHUNK)] + 0.5) / size
    met = np.linalg.norm(values_of(network, middles)[1], axis=1)
    level, best = LEVEL * float(np.median(met)), float(met.max())
    n = COARSEST
    at = np.indices((n, n, n)).reshape(3, -1).T
    bound, count, most = best, 0, MOST_WORK // sum(w.size for w, _b in network.layers)
    while len(at):
        found = in_parts(coarse, ((at + 0.5) / n).astype(np.float32), np.full(3, 0.5 / n, np.float32))
        count += len(at)
        near = (found.low <= level) & (found.high >= -level)
        inner = np.abs(found.phi) <= level
        best = max(best, float(np.linalg.norm(found.gradient[inner], axis=1).max(initial=0.0)))
        loose = near & (found.slope > TIGHT * best)
        if count + 8 * int(loose.sum()) > most:
            loose[:] = False
        bound = max(bound, float(found.slope[near & ~loose].max(initial=0.0)))
        n *= 2
        at = (2 * at[loose][:, None] + (OFFSETS > 0.0)).reshape(-1, 3)
    return bound * (1.0 + ROUNDING), level

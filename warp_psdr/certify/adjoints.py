"""Adjoints of a certificate: smooth random ones, and one that sees much of every derivative and little noise.

A pilot tells a direction's derivative image S, and the variances V of its pixels, by differences and by the method that
is examined. The adjoint w with the least variance of <w, S> at <w, S> = 1 is S / V. One adjoint serves all directions:
the sum of theirs, with the factors by which the certificate takes least time.

Derivation: ``docs/theory/certificates.md#adjoints``.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize

from warp_psdr.certify.examination import Examination
from warp_psdr.certify.slope import difference_images
from warp_psdr.certify.spending import PILOT
from warp_psdr.kernels.rng import mix_seed

#: Random adjoints, and the most half-waves of one across the image.
ADJOINTS, HALF_WAVES = 3, 3
#: Standard deviation of the filter of a pilot's images: pixels, and share of the longer side; the larger one counts.
SMOOTH, SMOOTH_SHARE = 1.5, 1.0 / 32.0
#: Step of the pilot's differences, and how many of them a batch of the test has.
STEP, PAIRS = 0.5, 2
#: Share of the mean variance that is added to a pixel's: noisy pixels are not left out, for there may be the bias.
LEAST_VARIANCE = 1.0
#: Signs of factors that are tried, and how many of them are improved.
TRIED, IMPROVED = 256, 3


def random_adjoints(shape: tuple[int, int], seed: int, count: int = ADJOINTS) -> np.ndarray:
    """Return smooth random adjoints (K, H, W, 3), float32, of mean square one."""
    random = np.random.default_rng((seed, 1))
    y, x = ((np.arange(n) + 0.5) / n for n in shape)
    waves = range(HALF_WAVES)
    rows, columns = (np.stack([np.cos(np.pi * i * z) for i in waves]) for z in (y, x))
    falling = np.array([[1.0 / (1.0 + i + j) for j in waves] for i in waves])
    found = []
    for _ in range(count):
        weights = random.normal(size=(3, len(waves), len(waves))) * falling
        image = np.einsum("cij,ih,jw->hwc", weights, rows, columns)
        found.append(image / np.sqrt((image**2).mean()))
    return np.stack(found).astype(np.float32)


@dataclass(frozen=True)
class Seen:
    """What a pilot sees of a direction, in smoothed images (H, W, 3).

    Attributes:
        signal: the derivative.
        differences: variance of its pixels by differences, times the seconds of a batch.
        derivative: by the method that is examined, likewise.
    """

    signal: np.ndarray
    differences: np.ndarray
    derivative: np.ndarray

    @property
    def adjoint(self) -> np.ndarray:
        """The adjoint that is best for this direction alone, of <adjoint, signal> = 1; zeros where nothing is seen."""
        noise = self.differences + self.derivative
        mean = float(noise.mean())
        weighted = self.signal / (noise / mean + LEAST_VARIANCE) if mean > 0.0 else self.signal
        size = float((weighted * self.signal).sum())
        return weighted / size if size > 0.0 else np.zeros_like(weighted)


def telling_adjoint(e: Examination) -> np.ndarray:
    """Return the adjoint (1, H, W, 3), float32, of mean square one, that sees the directions of an examination best."""
    if (subject := e.scene_subject) is not None:
        for d in {d.parameter: d for d in e.directions}.values():
            e.compile(partial(subject.derivative, d.parameter, d.tangent))
    seen = [found for number in range(len(e.directions)) if np.any((found := _seen(e, number)).adjoint)]
    if not seen:
        return e.adjoints[:1]
    adjoint = np.einsum("d,dhwc->hwc", factors(seen), np.stack([s.adjoint for s in seen]))
    return (adjoint / np.sqrt((adjoint**2).mean()))[None].astype(np.float32)


def _seen(e: Examination, number: int) -> Seen:
    """Draw a pilot's images of a direction."""
    direction, stream = e.directions[number], e.stream("adjoint", number)
    smooth = max(SMOOTH, SMOOTH_SHARE * max(e.subject.shape))

    def smoothed(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, (smooth, smooth, 0.0))

    begun = time.perf_counter()
    images = np.stack([difference_images(e, direction, (STEP,), mix_seed(stream, i))[0] for i in range(PILOT)])
    seconds = PAIRS * (time.perf_counter() - begun) / PILOT
    signal, differences = images.mean(axis=0), seconds * smoothed(images.var(axis=0, ddof=1))
    subject = e.scene_subject
    if subject is None:
        return Seen(smoothed(signal), differences, np.zeros_like(differences))
    derivative = partial(subject.derivative, direction.parameter, direction.tangent)
    images = np.stack([derivative(mix_seed(stream, PILOT + i)) for i in range(PILOT)])
    seconds = e.base.cost / len(e.adjoints)
    signal = 0.5 * (signal + images.mean(axis=0))
    return Seen(smoothed(signal), differences, seconds * smoothed(images.var(axis=0, ddof=1)))


def factors(seen: list[Seen]) -> np.ndarray:
    """Return the factors of directions' adjoints by which a certificate takes least time.

    Every direction takes batches of differences, and all of them share those of the method that is examined.
    """
    w, signal = np.stack([s.adjoint for s in seen]), np.stack([s.signal for s in seen])
    signals = np.einsum("ehwc,dhwc->de", w, signal)
    noise = [
        np.stack([np.einsum("ehwc,hwc,fhwc->ef", w, image, w, optimize=True) for image in images])
        for images in ([s.differences for s in seen], [s.derivative for s in seen])
    ]

    def seconds(factors: np.ndarray) -> float:
        sizes = np.maximum((signals @ factors) ** 2, 1e-30)
        differences, derivative = (np.einsum("def,e,f->d", of_side, factors, factors) / sizes for of_side in noise)
        return math.log(max(differences.sum() + derivative.max(), 1e-300))

    tried = np.random.default_rng(0).choice([-1.0, 1.0], (TRIED, len(seen)))
    best = sorted(tried, key=seconds)[:IMPROVED]
    return min((minimize(seconds, start, method="Nelder-Mead").x for start in best), key=seconds)

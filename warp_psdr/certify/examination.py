"""What the checks of one certificate share: the subject, its adjoints and directions, and batches of its derivative."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from warp_psdr.certify.certificate import Price
from warp_psdr.certify.directions import Direction
from warp_psdr.certify.spending import LEAST, PILOT, Sampler
from warp_psdr.certify.subject import SceneSubject, Subject
from warp_psdr.kernels.rng import mix_seed


@dataclass(eq=False)
class Examination:
    """A certificate in the making.

    Attributes:
        subject: what is examined.
        adjoints: (K, H, W, 3); one from ``watch`` on.
        directions: of all parameters.
        seed: of everything random.
        tolerance: of slopes.
        base: batches (K, directions) of the derivative that is examined.
        refused: (method, reason) of methods that do not cover the request.
        notes: what else there is to say.
        prices: what gradients cost.
        for_methods: seconds that pilots of other methods and modes, and the least batches of each, may take.
        compiling: seconds of calls that compile, which no budget pays for.
    """

    subject: Subject
    adjoints: np.ndarray
    directions: list[Direction]
    seed: int
    tolerance: float
    base: Sampler = field(init=False)
    refused: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    prices: list[Price] = field(default_factory=list)
    for_methods: float = 0.0
    compiling: float = 0.0

    def __post_init__(self) -> None:
        """Make the sampler of the derivative."""
        self.base = Sampler(self.derivatives(self.subject), self.stream("derivative", 0))

    def pilot(self) -> list[dict[str, np.ndarray]]:
        """Return gradients, as of ``Subject.gradients``, by which directions are chosen and numbers planned."""
        found = []
        for number in range(PILOT):
            begun = time.perf_counter()
            found.append(self.subject.gradients(self.adjoints, self.stream("pilot", number)))
            self.base.seconds += time.perf_counter() - begun
            self.base.calls += 1
        return found

    def take(self, directions: list[Direction], pilot: list[dict[str, np.ndarray]]) -> None:
        """Examine these directions."""
        self.directions = directions
        self.base.pilot = [self._along(gradients) for gradients in pilot] if directions else []

    def watch(self, adjoints: np.ndarray) -> None:
        """Examine the same directions with other adjoints."""
        self.adjoints = adjoints
        self.base.seconds, self.base.calls = 0.0, 0
        self.take(self.directions, self.pilot())

    def stream(self, name: str, number: int) -> int:
        """Return the seed of a stream of random numbers."""
        return mix_seed(mix_seed(self.seed, zlib.crc32(name.encode())), number)

    def derivatives(self, subject: Subject) -> Callable[[int], np.ndarray]:
        """Return seed -> derivatives (K, directions) by a subject."""
        return lambda seed: self._along(subject.gradients(self.adjoints, seed))

    def _along(self, gradients: dict[str, np.ndarray]) -> np.ndarray:
        return np.stack([d.along(gradients[d.parameter]) for d in self.directions], axis=1)

    def compile(self, draw: Callable[[int], np.ndarray]) -> None:
        """Draw once, for nothing."""
        begun = time.perf_counter()
        draw(0)
        self.compiling += time.perf_counter() - begun

    def affords(self, sampler: Sampler, label: str) -> bool:
        """Return whether there is time for a sampler's pilot and a test, and take it, or note that there is none.

        ``sampler`` has drawn once, which tells what a batch costs, and forgets it.
        """
        least = (PILOT + LEAST) * sampler.cost
        sampler.pilot.clear()
        if least > self.for_methods:
            self.notes.append(f"{label} is left out: its {PILOT + LEAST} batches take {least:.2g} s, raise the budget")
            return False
        self.for_methods -= least
        return True

    @property
    def scene_subject(self) -> SceneSubject | None:
        """The subject, if it is a scene of this renderer."""
        return self.subject if isinstance(self.subject, SceneSubject) else None

    def telling(self) -> list[tuple[int, Direction]]:
        """Return one direction of each parameter, with its number: the one that stands out most of a pilot's noise."""
        pilot = np.stack(self.base.pilot)
        mean, error = pilot.mean(axis=0), pilot.std(axis=0, ddof=1) / np.sqrt(len(pilot))
        signal = np.linalg.norm(mean, axis=0) / np.maximum(np.linalg.norm(error, axis=0), 1e-300)
        best: dict[str, int] = {}
        for i, d in enumerate(self.directions):
            if d.parameter not in best or signal[i] > signal[best[d.parameter]]:
                best[d.parameter] = i
        return [(i, self.directions[i]) for i in best.values()]


def weighted(number: int, weights: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return batches (n, K, directions) -> (n,): the derivative along a direction, adjoints weighted."""
    return lambda values: np.asarray(values[:, :, number] @ weights)

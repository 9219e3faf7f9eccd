"""What every method of guiding shares: its options, and the form of what it builds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warp_psdr.estimate.guiding.build import Leaves, Target


@dataclass(frozen=True, kw_only=True)
class Method(ABC):
    """A way to guide the sampling of boundary segments.

    Whatever a method finds, the estimator stays unbiased: a share of the samples is uniform. What it finds is kept on
    the scene and reused by later gradients of it (``store.py``), so their random errors depend on the calls before;
    ``guiding.reset(scene)`` forgets. Equal histories and seeds give equal bits, whatever the number of workers.

    Attributes:
        max_leaves: most leaves of a technique's structure.
        samples: evaluations of the integrand a leaf while it is built, best a multiple of eight.
        floor: share of uniform samples, in (0, 1].
        refresh: evaluations a leaf where a kept structure meets a scene that has changed; of a part of the leaves where
            they would be more than a tenth of the samples.
        drift: how far vertices, lights or the camera may have moved since the structure was built, relative to the
            scene's radius, before it is built anew: as soon as that is cheap beside the samples, and at ten times as
            far at the latest.
    """

    max_leaves: int = 16384
    samples: int = 8
    floor: float = 0.2
    refresh: int = 2
    drift: float = 0.02

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: an option out of range.
        """
        for name in ("max_leaves", "samples", "refresh"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}: got {value!r}, expected a positive integer")
        if self.max_leaves > MAX_LEAVES:
            raise ValueError(f"max_leaves: got {self.max_leaves}, expected at most {MAX_LEAVES} (2^20)")
        if not 0.0 < self.floor <= 1.0:
            raise ValueError(f"floor: got {self.floor!r}, expected a share in (0, 1]: without uniform samples is bias")
        if not self.drift >= 0.0:
            raise ValueError(f"drift: got {self.drift!r}, expected a non-negative number (1: the scene's radius)")

    @property
    def label(self) -> str:
        """What the plan calls it."""
        return f"guiding.{type(self).__name__}"

    @abstractmethod
    def build(self, target: Target) -> Leaves:
        """Return leaves that follow the target (one call for each technique)."""


#: Selection probabilities are multiples of 2^-24, so that 2^20 leaves still differ.
MAX_LEAVES = 1 << 20

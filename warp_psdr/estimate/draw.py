"""Which of a call's samples a pass draws: all of them, a range of every pixel's, or those of some shards."""

from __future__ import annotations

from dataclasses import dataclass

from warp_psdr.workers import WHOLE, Share


@dataclass(frozen=True)
class Draw:
    """The samples that are drawn.

    Attributes:
        spp: samples a pixel of the whole call, which says how much each counts.
        first: number of the first sample of every pixel.
        stop: number after the last; None: ``spp``.
        share: which of the pass's shards are run.
    """

    spp: int
    first: int = 0
    stop: int | None = None
    share: Share = WHOLE

    @property
    def count(self) -> int:
        """Samples of every pixel."""
        return (self.spp if self.stop is None else self.stop) - self.first

    def of_term(self, samples: int) -> tuple[int, int]:
        """Return the first and the number of those drawn of the samples of a boundary term."""
        first = self.first * samples // self.spp
        return first, (self.first + self.count) * samples // self.spp - first

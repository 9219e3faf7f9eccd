"""Methods of the interior term (survey eq. 12 first term, section 3)."""

from __future__ import annotations

from dataclasses import dataclass


class Method:
    """Base of all methods: a way to estimate the interior term."""


@dataclass(frozen=True, kw_only=True)
class Replay(Method):
    """Path replay [VSJ21] by record and sweep (``kernels/interior/replay.py``).

    Attributes:
        block: K, how many path vertices are kept at a time. Longer paths are replayed in blocks of K (without a depth
            limit those of some 500 vertices more than Russian roulette begins at are cut, one in 10^11).
    """

    block: int = 8

    def __post_init__(self) -> None:
        """Validate once.

        Raises:
            ValueError: ``block`` is not between 1 and 64.
        """
        if isinstance(self.block, bool) or not isinstance(self.block, int) or not 1 <= self.block <= 64:
            remedy = "; textbook replay, which keeps no vertices, is interior.Textbook()" if self.block == 0 else ""
            raise ValueError(f"block: got {self.block!r}, expected an integer from 1 to 64{remedy}")


@dataclass(frozen=True, kw_only=True)
class Textbook(Method):
    """Path replay as [VSJ21] print it (``kernels/interior/textbook.py``), for comparison only.

    It keeps no vertices and divides by every factor, and therefore loses the derivative of factors that are exactly
    zero. It refuses vertices that move in scenes with smooth mirrors or glass.
    """

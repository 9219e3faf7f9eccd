"""The interior term ([ZCZ25] eq. 12 first term, section 3): its methods, one object each, and their comparison."""

from warp_psdr.accuracy.methods import Compared, Comparison, compare
from warp_psdr.options.interior import (
    Antithetic,
    Attached,
    Bidirectional,
    Decomposed,
    DifferentialRatioTracking,
    FilmAntithetic,
    LightTracing,
    Method,
    Radiative,
    RadiativeTransfer,
    Replay,
    Resampled,
    Textbook,
)

__all__ = [
    "Antithetic",
    "Attached",
    "Bidirectional",
    "Compared",
    "Comparison",
    "Decomposed",
    "DifferentialRatioTracking",
    "FilmAntithetic",
    "LightTracing",
    "Method",
    "Radiative",
    "RadiativeTransfer",
    "Replay",
    "Resampled",
    "Textbook",
    "compare",
]

"""The interior term (survey eq. 12 first term, section 3): its methods, one object each."""

from warp_psdr.options.interior import (
    Antithetic,
    Attached,
    DifferentialRatioTracking,
    LightTracing,
    Method,
    Radiative,
    Replay,
    Resampled,
    Textbook,
)

__all__ = [
    "Antithetic",
    "Attached",
    "DifferentialRatioTracking",
    "LightTracing",
    "Method",
    "Radiative",
    "Replay",
    "Resampled",
    "Textbook",
]

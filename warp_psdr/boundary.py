"""The boundary term ([ZCZ25] eq. 12 second term, sections 2.1, 2.2 and 4): its methods, one object each."""

from warp_psdr.options.boundary import (
    EdgeSampling,
    Method,
    NeuralSignedDistance,
    PathSpace,
    PathWarpedArea,
    Projective,
    Rotation,
    SignedDistance,
    WarpedArea,
)

__all__ = [
    "EdgeSampling",
    "Method",
    "NeuralSignedDistance",
    "PathSpace",
    "PathWarpedArea",
    "Projective",
    "Rotation",
    "SignedDistance",
    "WarpedArea",
]

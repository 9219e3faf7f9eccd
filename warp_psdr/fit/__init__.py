"""Fits: recover named parameters of a scene from target images."""

from warp_psdr.fit.config import FitConfig, Unknown
from warp_psdr.fit.run import FitResult, fit

__all__ = ["FitConfig", "FitResult", "Unknown", "fit"]

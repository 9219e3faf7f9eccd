"""Estimators of the boundary term: what the motion of discontinuities adds to the derivative of an image."""

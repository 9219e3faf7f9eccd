"""Estimates: the passes over pixels and boundary samples, their arguments and their sums."""

"""Paths side by side in SIMD registers: an optional extension for the scenes that it covers."""

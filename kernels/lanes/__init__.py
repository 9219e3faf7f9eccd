"""Paths side by side in SIMD registers: a closed extension for the scenes that it covers."""

"""Participating media: their records, the flights of light in them, and their transmittance."""

"""Guiding structures: how they are built, kept and reused."""

"""Guiding structures: building, storage and reuse."""

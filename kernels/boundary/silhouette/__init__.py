"""Smooth silhouettes of shapes without triangles, one kind of shape a file."""

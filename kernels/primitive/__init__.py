"""Shapes without triangles: one kind a file, what affine kinds share, and a dispatch."""

"""Shapes without triangles: one kind a file, the common part of affine kinds, and a dispatch."""

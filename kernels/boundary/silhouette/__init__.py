"""Smooth silhouettes: of shapes without triangles, one kind a file."""

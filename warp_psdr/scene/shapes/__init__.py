"""Shapes made of triangles, their copies and groups."""

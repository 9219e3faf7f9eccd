"""Curves of intersection between a shape without triangles and another surface."""

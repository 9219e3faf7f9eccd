"""Curves in which a shape without triangles and another surface run through each other."""

"""Shapes without triangles: a file a kind, and ``table.py``, which lists them."""

"""Families of shapes without triangles, a file each, and the list of them (``table.py``)."""

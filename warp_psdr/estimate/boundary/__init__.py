"""The launches of the boundary term."""

"""Densities that guide the sampling of boundary segments: trees of cells in the unit cube."""

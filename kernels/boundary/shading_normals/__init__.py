"""Discontinuities that interpolated normals cause: terminators and horizons."""

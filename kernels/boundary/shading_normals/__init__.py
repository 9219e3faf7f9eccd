"""Discontinuities that interpolated normals make: terminators and horizons."""

"""Differentiable shape processing: vertex normals, rigid and affine transforms."""

"""The rate of the unit normal as a point moves over a shape without triangles: n' = (1 - n n^T) H x' / |grad phi|.

The shape is at rest. The adjoints of vertices contain the part that the shape's own motion adds.

Derivation: ``docs/theory/specular.md#mirrors-and-glass-without-triangles``.
"""

import warp as wp

from warp_psdr.kernels.primitive.affine import cofactor
from warp_psdr.kernels.structs import Triangle
from warp_psdr.kernels.vertex_motion import normalize_jvp


@wp.func
def turned_normal(tri: Triangle, slope: wp.vec3, slope_dot: wp.vec3) -> wp.vec3:
    """N' from the gradient of phi in the shape's coordinates and its rate."""
    c = cofactor(tri, slope)
    length = wp.length(c)
    sign = wp.float32(tri.i2)
    return normalize_jvp((sign / wp.where(length > 0.0, length, 1.0)) * c, length, sign * cofactor(tri, slope_dot))

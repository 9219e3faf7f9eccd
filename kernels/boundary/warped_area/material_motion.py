"""The motion of material points as a ray's direction sees it, which path space's interior term already contains.

A ray of the direction w from x finds y = sum_k b_k p_k on a triangle. This point moves with y' = sum_k b_k p_k', so its
direction turns by m(w) = P (y' - x') / d, P = 1 - w w^T, d = |y - x|. Subtracting m from the motion V of the ray leaves
the motion V - m of the ray against the points that it finds.

Derivation: ``docs/theory/reparameterisation.md#in-path-space``.
"""

import functools

import warp as wp

from warp_psdr.kernels.sink import make_sink_vec3
from warp_psdr.kernels.structs import Scene
from warp_psdr.kernels.surface import RayAdjoint, point_on


@functools.cache
def make_material_motion(role: str):
    """Return ``pull(scene, target, face, u, v, x, w, value, a_w) -> RayAdjoint``.

    It scatters the adjoint of ``value . div m + a_w . m`` to the corners of the triangle that the ray from x finds, and
    returns that of x.
    """
    sink3 = make_sink_vec3(role)

    @wp.func
    def pull_material(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        face: wp.int32,
        u: wp.float32,
        v: wp.float32,
        x: wp.vec3,
        w: wp.vec3,
        value: wp.float32,
        a_w: wp.vec3,
    ) -> RayAdjoint:
        tri = scene.triangles[face]
        d = wp.length(point_on(tri, u, v) - x)
        e1 = tri.p1 - tri.p0
        e2 = tri.p2 - tri.p0
        c = wp.cross(e1, e2)
        # The gradient of ln(1 / d), and those of b_1 and b_2 on the plane and by w, over d.
        steep = c / wp.dot(c, w) - w
        g1 = wp.cross(e2, c) / wp.dot(c, c)
        g2 = wp.cross(c, e1) / wp.dot(c, c)
        s1 = g1 - wp.dot(g1, w) * (w + steep)
        s2 = g2 - wp.dot(g2, w) * (w + steep)
        # Of y' - x': the adjoint of m, and of what 1 / d and the sphere's curvature add to div m.
        a_y = (1.0 / d) * (a_w - wp.dot(w, a_w) * w + value * (steep - 2.0 * w))
        r = RayAdjoint()
        r.dot += sink3(target, scene.positions + 3 * tri.i0, (1.0 - u - v) * a_y - value * (s1 + s2))
        r.dot += sink3(target, scene.positions + 3 * tri.i1, u * a_y + value * s1)
        r.dot += sink3(target, scene.positions + 3 * tri.i2, v * a_y + value * s2)
        r.o = -a_y
        return r

    return pull_material

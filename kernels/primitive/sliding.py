"""Velocities of vertices that slide along rays: forward mode's counterpart of their adjoints, by the same sinks."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.structs import Scene, Triangle
from warp_psdr.kernels.surface import VertexAdjoint
from warp_psdr.kernels.vertex_motion import VertexTangent


@functools.cache
def make_sliding_jvp(accumulate: wp.Function, uv: bool, tangent: bool, flow: bool = False):
    """Return ``sliding_jvp(scene, tangents, tri, u, v, by_ray, o, d, o_dot, d_dot) -> VertexTangent``.

    Component by component, by the sink of a kind in its forward role. The normal that carries the area element has no
    velocity in form S, which has no need of one.

    Args:
        accumulate: the sink.
        uv: texture coordinates are read.
        tangent: dp/du is read.
        flow: vertices flow along normals, and that normal has a velocity.
    """

    @wp.func
    def sliding_jvp(
        scene: Scene,
        tangents: wp.array(dtype=wp.float32),
        tri: Triangle,
        u: wp.float32,
        v: wp.float32,
        by_ray: wp.bool,
        o: wp.vec3,
        d: wp.vec3,
        o_dot: wp.vec3,
        d_dot: wp.vec3,
    ) -> VertexTangent:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        result = VertexTangent()
        axis = wp.int32(0)
        while axis < 3:
            e = wp.vec3(0.0, 0.0, 0.0)
            e[axis] = 1.0
            of_x = VertexAdjoint()
            of_x.x = e
            ax = accumulate(scene, tangents, tri, u, v, of_x, by_ray, o, d)
            of_n = VertexAdjoint()
            of_n.n = e
            an = accumulate(scene, tangents, tri, u, v, of_n, by_ray, o, d)
            result.x[axis] = ax.dot + wp.dot(ax.o, o_dot) + wp.dot(ax.d, d_dot)
            result.n[axis] = an.dot + wp.dot(an.o, o_dot) + wp.dot(an.d, d_dot)
            if wp.static(flow):
                of_c = VertexAdjoint()
                of_c.c = e
                result.c[axis] = accumulate(scene, tangents, tri, u, v, of_c, by_ray, o, d).dot
            if wp.static(tangent):
                of_t = VertexAdjoint()
                of_t.tangent = e
                at = accumulate(scene, tangents, tri, u, v, of_t, by_ray, o, d)
                result.tangent[axis] = at.dot + wp.dot(at.o, o_dot) + wp.dot(at.d, d_dot)
            if wp.static(uv):
                if axis < 2:
                    of_uv = VertexAdjoint()
                    of_uv.uv = wp.vec2(e[0], e[1])
                    auv = accumulate(scene, tangents, tri, u, v, of_uv, by_ray, o, d)
                    result.uv[axis] = auv.dot + wp.dot(auv.o, o_dot) + wp.dot(auv.d, d_dot)
            axis += 1
        return result

    return sliding_jvp

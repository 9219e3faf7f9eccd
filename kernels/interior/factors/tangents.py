"""Velocities of shading frames, rays and geometric factors: forward mode's counterpart of ``pullback.py``.

A dot denotes the derivative along the tangent. Those of vertices are in ``kernels/vertex_motion.py``.
"""

import functools

import warp as wp

from warp_psdr.kernels.interaction import Frame
from warp_psdr.kernels.vertex_motion import VertexTangent, normalize_jvp


@wp.struct
class FrameTangent:
    """Velocity of a shading frame."""

    n: wp.vec3
    s: wp.vec3
    t: wp.vec3


@wp.struct
class Moving:
    """A vertex's velocity and how its ray moves."""

    vertex: VertexTangent
    o: wp.vec3  # of the ray that found it
    d: wp.vec3
    by_ray: wp.bool
    chi: wp.float32  # weight of its connection with the vertex before


@wp.func
def local_jvp(frame: Frame, moving: FrameTangent, w: wp.vec3, w_dot: wp.vec3) -> wp.vec3:
    """Velocity of the local coordinates of the world direction w."""
    return wp.vec3(
        wp.dot(frame.s, w_dot) + wp.dot(moving.s, w),
        wp.dot(frame.t, w_dot) + wp.dot(moving.t, w),
        wp.dot(frame.n, w_dot) + wp.dot(moving.n, w),
    )


@wp.func
def log_geometry_jvp(cross: wp.vec3, r: wp.vec3, cross_dot: wp.vec3, r_dot: wp.vec3, chi: wp.float32) -> wp.float32:
    """G' / G for G = |c . r| / |r|^3 (``pullback.connection_vjp``); chi weights all but |c|' / |c| (``contact.py``)."""
    projected = wp.dot(cross, r)
    if projected == 0.0:
        return 0.0
    rate = (wp.dot(cross_dot, r) + wp.dot(cross, r_dot)) / projected - 3.0 * wp.dot(r, r_dot) / wp.dot(r, r)
    return chi * rate + (1.0 - chi) * wp.dot(cross, cross_dot) / wp.dot(cross, cross)


@functools.cache
def make_frame_jvp(tangent: bool):
    """Return ``frame_jvp(frame, dpdu, vertex) -> FrameTangent``.

    An isotropic model does not feel a turn of the frame about its normal, so s' = -(s . n') n serves; an anisotropic
    one has s = normalize(dpdu - n (n . dpdu)).
    """

    @wp.func
    def frame_jvp(frame: Frame, dpdu: wp.vec3, vertex: VertexTangent) -> FrameTangent:
        result = FrameTangent()
        result.n = frame.side * vertex.n
        if wp.static(tangent):
            p = dpdu - frame.n * wp.dot(frame.n, dpdu)
            p_dot = (
                vertex.tangent
                - result.n * wp.dot(frame.n, dpdu)
                - frame.n * (wp.dot(result.n, dpdu) + wp.dot(frame.n, vertex.tangent))
            )
            result.s = normalize_jvp(frame.s, wp.length(p), p_dot)
            result.t = wp.cross(result.n, frame.s) + wp.cross(frame.n, result.s)
        else:
            result.s = -wp.dot(frame.s, result.n) * frame.n
            result.t = -wp.dot(frame.t, result.n) * frame.n
        return result

    return frame_jvp

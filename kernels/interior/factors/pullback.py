"""Adjoints of the geometry between path vertices: the shading frame and the connection of two points."""

import functools

import warp as wp

from warp_psdr.kernels.autodiff import anchor, differentiable
from warp_psdr.kernels.interaction import Frame
from warp_psdr.kernels.math import to_local, to_world
from warp_psdr.kernels.surface import normalize_vjp


@wp.struct
class FrameAdjoint:
    """Adjoint of the shading frame's normal and tangent, and of the directions expressed in it."""

    n: wp.vec3
    tangent: wp.vec3
    wi: wp.vec3
    wo: wp.vec3


@wp.struct
class ConnectionAdjoint:
    """Adjoint of a connection x -> y: of x (that of y is the opposite), and of the cross product of y's edges."""

    x: wp.vec3
    c: wp.vec3


@differentiable
@wp.func
def tangent_frame_dot(
    n: wp.vec3, tangent: wp.vec3, wi: wp.vec3, wo: wp.vec3, a_wi: wp.vec3, a_wo: wp.vec3
) -> wp.float32:
    """Local factor of a frame whose s follows a surface tangent: world directions to local ones."""
    s = wp.normalize(tangent - n * wp.dot(n, tangent))
    t = wp.cross(n, s)
    return wp.dot(a_wi, to_local(s, t, n, wi)) + wp.dot(a_wo, to_local(s, t, n, wo))


@wp.func
def turn_normal(frame: Frame, w: wp.vec3, a: wp.vec3) -> wp.vec3:
    """Adjoint of n from the adjoint a (world axes) of w expressed in an isotropic frame.

    With any frame that stays orthonormal, ds = -(s . dn) n and dt = -(t . dn) n up to a turn about n, which an
    isotropic model does not feel. So d(w . n) = w . dn and d(w . s) = -(w . n) s . dn; collected with the adjoint
    a = a_s s + a_t t + a_n n:   (n . a) w - (w . n) (a - n (n . a)).
    """
    a_n = wp.dot(frame.n, a)
    return a_n * w - wp.dot(w, frame.n) * (a - a_n * frame.n)


@functools.cache
def make_frame_vjp(tangent: bool):
    """Return ``frame_vjp(frame, dpdu, wi, wo, a_wi, a_wo) -> FrameAdjoint``: local adjoints to world ones."""

    @wp.func
    def frame_vjp(frame: Frame, dpdu: wp.vec3, wi: wp.vec3, wo: wp.vec3, a_wi: wp.vec3, a_wo: wp.vec3) -> FrameAdjoint:
        result = FrameAdjoint()
        if wp.static(tangent):
            g_n, g_t, g_wi, g_wo, _a, _b = wp.grad(tangent_frame_dot)(frame.n, dpdu, wi, wo, a_wi, a_wo)
            result.n = g_n
            result.tangent = g_t
            result.wi = g_wi
            result.wo = g_wo
        else:
            _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
            result.wi = to_world(frame.s, frame.t, frame.n, a_wi)
            result.wo = to_world(frame.s, frame.t, frame.n, a_wo)
            result.n = turn_normal(frame, wi, result.wi) + turn_normal(frame, wo, result.wo)
        return result

    return frame_vjp


@wp.func
def connection_vjp(
    x: wp.vec3, y: wp.vec3, cross: wp.vec3, wo: wp.vec3, a_wo: wp.vec3, value: wp.float32, chi: wp.float32
) -> ConnectionAdjoint:
    """VertexPullback a connection x -> y in material form back to its ends.

    ``x``: where the ray to y started, a step off the surface. From the surface itself, G would change at another rate
    than that of what was traced, by the step over r: next to contacts the difference does not cancel, and adds up.
    ``a_wo``: adjoint of its direction wo, in which the path left x; ``value``: the weighted contribution that carries
    the geometric factor G, so that G's own adjoint is value / G; ``chi``: weight of G (``contact.py``), which a_wo
    has already. y is rounded: at grazing angles the part of a_wo along the normal must not leak into the length.
    """
    r = y - x
    length = wp.length(r)
    direction = (1.0 / wp.where(length > 0.0, length, 1.0)) * r
    cosine = wp.dot(cross, direction)
    faces = length > 0.0 and cosine != 0.0
    # log G = log |c . r| - 3 log |r|, of which chi leaves log |c|.
    weighted = wp.where(faces, chi * value, 0.0)
    rest = wp.where(faces, value - weighted, 0.0)
    across = weighted / wp.where(faces, cosine, 1.0)
    along = 3.0 * weighted
    result = ConnectionAdjoint()
    inv_length = 1.0 / wp.where(faces, length, 1.0)
    result.x = -normalize_vjp(wo, length, a_wo) - inv_length * (across * cross - along * direction)
    result.c = across * direction + (rest / wp.where(faces, wp.dot(cross, cross), 1.0)) * cross
    return result

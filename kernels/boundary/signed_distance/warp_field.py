"""The motion of rays next to silhouettes of a signed distance [VSJ22, BGL*22], and its divergence.

A ray of the direction w moves by V(w) = P W, P = 1 - w w^T, W = c (v(x) - (1 - t / d) o'). Here v = -phi_pi grad phi /
|grad phi|^2 is the flow of the surfaces of equal distance, x = o + t w, o' the velocity of the ray's origin, and d the
distance of its target. [VSJ22] evaluate v once, at the mean t of the steps; [BGL*22] evaluate it at every step. On the
sphere of directions div V = tr(dW) - 2 w . W.

Derivation: ``docs/theory/signed_distances.md#the-motion-of-rays``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_psdr.kernels.autodiff import anchor
from warp_psdr.kernels.boundary.signed_distance.distance import Distance
from warp_psdr.kernels.boundary.signed_distance.fields import FIELDS
from warp_psdr.kernels.boundary.signed_distance.march import BAND, MOST_STEPS, across, make_march
from warp_psdr.kernels.primitive.affine import last_primitive
from warp_psdr.kernels.structs import Scene, Triangle


class WarpOptions(NamedTuple):
    """What of a method is compiled.

    Attributes:
        neural: the weights of [BGL*22].
        max_steps: after which rays end; 0: they go on until they arrive or leave.
        step_scale: of the steps.
    """

    neural: bool = False
    max_steps: int = 0
    step_scale: float = 1.0


@wp.struct
class Warp:
    """Where a ray's motion is evaluated, and how much of it counts."""

    moves: wp.int32  # 0: nowhere near the shape
    t: wp.float32
    t_w: wp.vec3  # gradients by the direction have _w
    share: wp.float32  # c t
    share_w: wp.vec3
    off: wp.float32  # |phi| at the mean of the steps over the width of the band: 0 at silhouettes
    off_w: wp.vec3
    total: wp.float32  # sum of the weights
    total_w: wp.vec3


@wp.struct
class Beyond:
    """What a ray is to meet: nothing at a finite distance, or a point of a plane."""

    inverse: wp.float32  # 1 / d; 0: infinitely far away
    inverse_w: wp.vec3
    bordered: wp.int32  # 1: what is met ends somewhere
    border: wp.float32  # distance from there, over some width
    border_w: wp.vec3


@wp.struct
class WarpAdjoint:
    """Adjoint of the origin of a ray, and the sink's sum."""

    o: wp.vec3
    dot: wp.float32


class WarpFunctions(NamedTuple):
    """Functions of the one signed distance of a scene; ``o`` and ``w`` are a ray, w a unit vector.

    Attributes:
        trace: ``(scene, o, w) -> Warp``.
        pull: ``(scene, target, o, w, warp, beyond, value, a_w) -> WarpAdjoint``: scatters the adjoint of
            ``value . div V + a_w . V`` to what moves the shape, and returns that of the ray's origin.
    """

    trace: wp.Function
    pull: wp.Function


@functools.cache
def make_warp_field(kind: int, options: WarpOptions, role: str) -> WarpFunctions:
    """Return the functions of a scene whose only shape without triangles is of a kind that has a field."""
    field = FIELDS[kind]
    size_of, distance_at, pull_field = field.size, field.at, field.make_pull(role)
    most = options.max_steps or MOST_STEPS
    start, march = make_march(field, options.neural, most, options.step_scale)

    @wp.func
    def settle(tri: Triangle, at: Distance, w: wp.vec3, given: Warp) -> Warp:
        """How far off the surface a ray is, and the share of its motion: of [VSJ22] it ends with a band."""
        r = given
        r.moves = wp.where(r.total > 0.0, 1, 0)
        r.share = wp.min(r.total, 1.0)
        r.share_w = r.total_w
        if r.total >= 1.0:
            r.share_w = wp.vec3(0.0, 0.0, 0.0)
        width = wp.static(BAND) * size_of(tri)
        sign = wp.where(at.phi < 0.0, -1.0, 1.0)
        r.off = sign * at.phi / width
        r.off_w = (sign / width) * (wp.dot(at.gradient, w) * r.t_w + r.t * across(w, at.gradient))
        if wp.static(not options.neural):
            if r.off >= 1.0:
                r.moves = 0
                return r
            r.share_w = (1.0 - r.off) * r.share_w - r.share * r.off_w
            r.share *= 1.0 - r.off
        return r

    @wp.func
    def trace(scene: Scene, o: wp.vec3, w: wp.vec3) -> Warp:
        tri = scene.triangles[last_primitive(scene)]
        r = Warp()
        m = start(scene, tri, o, w)
        while m.going == 1:
            t = wp.float32(m.t)
            t_w = m.t_w
            m = march(scene, tri, o, w, m)
            if m.weight > 0.0:
                # A running mean: differences stay small where all of the weight is next to one place.
                total = r.total + m.weight
                r.total_w += m.weight_w
                part = m.weight / total
                part_w = (1.0 / total) * (m.weight_w - part * r.total_w)
                r.t_w += (t - r.t) * part_w + part * (t_w - r.t_w)
                r.t += part * (t - r.t)
                r.total = total
        if r.total <= 0.0:
            return r
        return settle(tri, distance_at(scene, tri, o, w, wp.float64(r.t)), w, r)

    @wp.func
    def pull_at(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        tri: Triangle,
        o: wp.vec3,
        w: wp.vec3,
        t: wp.float32,
        t_w: wp.vec3,
        part: wp.float32,
        part_w: wp.vec3,
        beyond: Beyond,
        value: wp.float32,
        a_w: wp.vec3,
    ) -> WarpAdjoint:
        """The part of one place, whose W is part / t (v - (1 - t / d) o')."""
        r = WarpAdjoint()
        x = o + t * w
        at = distance_at(scene, tri, o, w, wp.float64(t))
        c = part / t
        c_w = (1.0 / t) * (part_w - c * t_w)
        squared = wp.max(wp.dot(at.gradient, at.gradient), 1.0e-12)
        m = at.gradient / squared
        # dm/dx = H / |g|^2 - 2 m (H m)^T; tr(dm M) with M = w t_w^T + t (1 - w w^T).
        hw = at.hessian * w
        hm = at.hessian * m
        of_w = hw / squared - (2.0 * wp.dot(hm, w)) * m
        trace_m = wp.trace(at.hessian) / squared - 2.0 * wp.dot(hm, m)
        mu = wp.dot(t_w, of_w) + t * (trace_m - wp.dot(w, of_w))
        k = value * c_w + c * across(w, a_w) - (2.0 * value * c) * w
        a_phi = -(wp.dot(k, m) + value * c * mu)
        a_g = -(value * c) * (wp.dot(t_w, m) * w + t * across(w, m))
        r.dot = pull_field(scene, target, tri, x, a_phi, a_g)
        r.o = (t * beyond.inverse - 1.0) * k + (value * c) * (beyond.inverse * t_w + t * beyond.inverse_w)
        return r

    @wp.func
    def pull(
        scene: Scene,
        target: wp.array(dtype=wp.float32),
        o: wp.vec3,
        w: wp.vec3,
        warp: Warp,
        beyond: Beyond,
        value: wp.float32,
        a_w: wp.vec3,
    ) -> WarpAdjoint:
        _anchor = wp.grad(anchor)(0.0)  # see kernels/autodiff.py
        r = WarpAdjoint()
        if warp.moves == 0:
            return r
        tri = scene.triangles[last_primitive(scene)]
        share = warp.share
        share_w = warp.share_w
        if beyond.bordered == 1:
            # 0 at the border, 1 at silhouettes.
            sum = wp.max(beyond.border + warp.off, 1.0e-12)
            b = beyond.border / sum
            b_w = (warp.off * beyond.border_w - beyond.border * warp.off_w) / (sum * sum)
            share_w = b * share_w + share * b_w
            share *= b
        if wp.static(options.neural):
            m = start(scene, tri, o, w)
            while m.going == 1:
                t = wp.float32(m.t)
                t_w = m.t_w
                m = march(scene, tri, o, w, m)
                if m.weight > 0.0:
                    part = m.weight / warp.total
                    part_w = (1.0 / warp.total) * (m.weight_w - part * warp.total_w)
                    found = pull_at(
                        scene, target, tri, o, w, t, t_w,
                        part * share, share * part_w + part * share_w, beyond, value, a_w,
                    )  # fmt: skip
                    r.o += found.o
                    r.dot += found.dot
            return r
        else:
            return pull_at(scene, target, tri, o, w, warp.t, warp.t_w, share, share_w, beyond, value, a_w)

    return WarpFunctions(trace, pull)

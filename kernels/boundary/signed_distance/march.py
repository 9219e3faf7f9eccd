"""Sphere tracing with weighted steps: where [VSJ22] and [BGL*22] evaluate the motion of silhouettes.

The steps of sphere tracing [Har96] along a ray o + t w lie at t_i. Each has a weight q_i that is large where phi and
the slope of phi along the ray are small. Next to a silhouette all of the weight lies where the ray passes the surface.
Everything is a function of the direction w, and its gradient is carried along: x_i' = w (grad t_i . w') + t_i w'.

Derivation: ``docs/theory/signed_distances.md#weights``.
"""

import functools

import warp as wp

from warp_psdr.kernels.boundary.signed_distance.distance import Field
from warp_psdr.kernels.structs import Scene, Triangle

#: Distance, over the shape's size, at which a ray has arrived.
ARRIVED = 1.0e-7
#: Least step, over the size, of a ray that has not come closer yet: it may start on the surface.
LEAVING = 1.0e-6
#: Steps after which a ray that neither arrives nor leaves is given up; far beyond what rays next to silhouettes take.
MOST_STEPS = 1 << 15
#: [VSJ22], section 4.2: the least |phi|, the weight of the slope along the ray, and the power. The paper's least is
#: 1e-6, by which silhouettes that move along the view move 1 % too much.
LEAST, SLOPE, POWER = 1.0e-7, 0.05, 3.0
#: [VSJ22]: width of the band around silhouettes in which rays move, over the shape's size.
BAND = 0.05
#: [BGL*22]: the least |phi|, which they do without, the weight of the slope, and the power.
NEURAL_LEAST, NEURAL_SLOPE, NEURAL_POWER = 1.0e-6, 0.1, 4.0


@wp.struct
class March:
    """A ray on its way: the step that it stands at, and its weight."""

    t: wp.float64
    last: wp.float32  # where what is known ends
    t_w: wp.vec3  # gradients by the direction have _w; they are perpendicular to it
    before: wp.float32  # |phi| over the size at the step before, 0 at the first
    before_w: wp.vec3
    signed_before: wp.float32
    step_before: wp.float32  # the step from there
    step_before_w: wp.vec3
    approach: wp.float32  # how far the ray has come closer, 0 to 1
    approach_w: wp.vec3
    count: wp.int32
    going: wp.int32  # 0: this was the last step
    weight: wp.float32  # q_i
    weight_w: wp.vec3


@wp.func
def across(w: wp.vec3, a: wp.vec3) -> wp.vec3:
    """The part of a perpendicular to the unit vector w."""
    return a - w * wp.dot(w, a)


@functools.cache
def make_march(field: Field, neural: bool, max_steps: int, step_scale: float):
    """Return ``(start, march)``: the first step of a ray, and the weight of the step m stands at and the next one.

    ``start(scene, tri, o, w) -> March``, ``march(scene, tri, o, w, m) -> March``.

    Args:
        field: of the shape.
        neural: weights of [BGL*22].
        max_steps: after which rays end; a bias.
        step_scale: of the steps.
    """
    size_of, distance_at = field.size, field.at

    known = field.known

    @wp.func
    def start(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3) -> March:
        m = March()
        part = known(scene, tri, o, w)
        m.t = wp.float64(part.first)
        m.t_w = part.first_w
        m.last = part.last
        m.going = wp.where(part.last > part.first, 1, 0)
        return m

    @wp.func
    def march(scene: Scene, tri: Triangle, o: wp.vec3, w: wp.vec3, given: March) -> March:
        m = given
        size = size_of(tri)
        at = distance_at(scene, tri, o, w, m.t)
        t = wp.float32(m.t)
        sign = wp.where(at.phi < 0.0, -1.0, 1.0)
        g = at.gradient
        along = wp.dot(g, w)
        hw = at.hessian * w
        # ---- phi, its slope along the ray, and their gradients by the direction ----
        phi = wp.abs(at.phi) / size
        phi_w = (sign / size) * (along * m.t_w + t * across(w, g))
        squared = wp.max(wp.dot(g, g), 1.0e-12)
        along_w = across(w, wp.dot(w, hw) * m.t_w + t * hw + g)
        squared_w = 2.0 * across(w, wp.dot(g, hw) * m.t_w + t * (at.hessian * g))
        base = phi
        base_w = phi_w
        if wp.static(neural):
            length = wp.sqrt(squared)
            base = phi + NEURAL_LEAST + wp.static(NEURAL_SLOPE) * wp.abs(along) / length
            base_w = phi_w + wp.static(NEURAL_SLOPE) / length * (
                wp.sign(along) * along_w - (0.5 * wp.abs(along) / squared) * squared_w
            )
        else:
            cosine = along * along / squared
            base = LEAST + phi + wp.static(SLOPE) * cosine
            base_w = phi_w + wp.static(SLOPE) / squared * (2.0 * along * along_w - cosine * squared_w)
        power = wp.static(NEURAL_POWER if neural else POWER)
        weight = wp.pow(base, -power)
        weight_w = (-power * weight / base) * base_w
        # ---- The border of where phi is known ----
        border = at.inside_gradient
        inside_w = wp.dot(border, w) * m.t_w + t * across(w, border)
        if at.inside <= 0.0:
            inside_w = wp.vec3(0.0, 0.0, 0.0)
        weight_w = at.inside * weight_w + weight * inside_w
        weight *= at.inside
        # ---- Only rays that have come closer ----
        # A start on the surface may be rounded to its inside, which rays leave.
        if m.count > 0 and sign * phi < m.signed_before and m.approach < 1.0:
            unit = wp.max(wp.min(phi, wp.static(BAND)), 1.0e-9)
            closer = (m.before - phi) / unit
            m.approach += closer
            m.approach_w += (m.before_w - phi_w) / unit
            if phi < wp.static(BAND):
                m.approach_w -= (closer / unit) * phi_w
            if m.approach >= 1.0:
                m.approach = 1.0
                m.approach_w = wp.vec3(0.0, 0.0, 0.0)
        weight_w = m.approach * weight_w + weight * m.approach_w
        weight *= m.approach
        # ---- The trapezoid of the steps before and behind ----
        step = at.step / size
        step_w = (1.0 / size) * (wp.dot(at.step_gradient, w) * m.t_w + t * across(w, at.step_gradient))
        width = 0.5 * step_scale * (step + m.step_before)
        m.weight = width * weight
        m.weight_w = width * weight_w + (0.5 * step_scale * weight) * (step_w + m.step_before_w)
        # ---- The next step ----
        m.before = phi
        m.before_w = phi_w
        m.signed_before = sign * phi
        m.step_before = step
        m.step_before_w = step_w
        m.count += 1
        if m.approach == 0.0 and phi < LEAVING:
            m.t += wp.float64(LEAVING * size)
        else:
            m.t += wp.float64(step_scale * size * step)
            m.t_w += (step_scale * size) * step_w
        arrived = phi < ARRIVED and m.approach > 0.0
        gone = m.t >= wp.float64(m.last)
        m.going = wp.where(arrived or gone or m.count >= wp.static(max_steps), 0, 1)
        return m

    return start, march
